"""Checkpoints: one safetensors file with weights, config, normalisation and provenance. Loading executes no code.

The header has one metadata key, ``hoidata``, with canonical JSON. With several keys safetensors would write them in the
order of a hash map, but equal trainings must give equal bytes. Files contain no time, host or user.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from hoidata.annotation.encoders import TextEncoder, refuse_other_encoder
from hoidata.errors import BadInput
from hoidata.files import canonical_json, write_whole
from hoidata.files.checksums import EMPTY_CHECKSUMS, METADATA_KEY, sealed, verify_checksums
from hoidata.files.written import EMPTY, empty_reason
from hoidata.hands import HandPair
from hoidata.settings import build_config, plain_config
from models.common.family import StoredNetwork
from models.common.features import Normaliser

FORMAT = 2
FILE_NAME = "model.safetensors"
_WEIGHTS, _NORMALISER = "weights.", "normaliser."


@dataclass(frozen=True)
class Checkpoint:
    """A trained network in evaluation mode, with its normalisation and metadata."""

    network: nn.Module
    normaliser: Normaliser | None  # None if the network was trained without one
    # "model", "config", "facts" (clips, counts, synthetic, encoder, hand, ...), "results" and "provenance".
    info: dict[str, Any]

    @property
    def facts(self) -> dict[str, Any]:
        return self.info["facts"]


def save_checkpoint(
    folder: str | Path, model_name: str, network: nn.Module, normaliser: Normaliser | None, info: dict[str, Any]
) -> Path:
    """Write ``folder/model.safetensors`` atomically. info: "facts", "results", "provenance"."""
    tensors = {_WEIGHTS + name: tensor for name, tensor in network.state_dict().items()}
    if normaliser is not None:
        tensors |= {_NORMALISER + name: tensor for name, tensor in normaliser.tensors().items()}
    tensors = {name: tensors[name].detach().cpu().contiguous() for name in sorted(tensors)}
    header = {"format": FORMAT, "model": model_name, "config": plain_config(network.config)}
    metadata = {**header, **info, "seal": EMPTY_CHECKSUMS}  # not the checksum of a file from which the facts were read
    return write_whole(
        Path(folder) / FILE_NAME, sealed(save(tensors, metadata={METADATA_KEY: canonical_json(metadata)}))
    )


def read_info(path: str | Path) -> dict[str, Any]:
    """The metadata of a checkpoint file. Raises BadInput for any other file."""
    try:
        with safe_open(path, framework="pt") as stored:
            metadata = stored.metadata() or {}
        info = json.loads(metadata[METADATA_KEY])
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise BadInput(path, "a checkpoint of hoidata", f"{type(error).__name__}: {error}", "train it again") from error
    if not isinstance(info, dict) or info.get("format") != FORMAT:
        raise BadInput(path, f"format {FORMAT}", "another one", "train it again with this version")
    return info


def checkpoint_file(folder: str | Path) -> Path:
    """The checkpoint file in a folder; a path of a checkpoint file itself is returned."""
    return Path(folder) if str(folder).endswith(".safetensors") else Path(folder) / FILE_NAME


def load_checkpoint(folder: str | Path, network: StoredNetwork, device: torch.device | str = "cpu") -> Checkpoint:
    """Load the checkpoint of ``network`` from a folder or a file.

    Raises BadInput if it is missing, is of another network, or has weights that are not finite.
    """
    path = checkpoint_file(folder)
    if not path.is_file():
        raise BadInput(path, "a trained model", empty_reason(path.parent) or "no file", "run `dvc repro`")
    info = read_info(path)
    verify_checksums(path)
    if info.get("model") != network.name:
        remedy = "point to the right folder"
        raise BadInput(path, f"a checkpoint of {network.name}", f"one of {info.get('model')}", remedy)
    module = network.build(_config(network, info, path))
    with safe_open(path, framework="pt") as stored:
        tensors: dict[str, Tensor] = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    try:
        module.load_state_dict(_below(tensors, _WEIGHTS))
    except RuntimeError as error:
        raise BadInput(path, "weights that fit its config", str(error).splitlines()[0], "train it again") from error
    if not_finite := [name for name, tensor in tensors.items() if not bool(tensor.isfinite().all())]:
        got = f"NaN or infinity in {len(not_finite)} tensors, such as {not_finite[0]}"
        raise BadInput(path, "finite weights", got, "train it again with a lower learning rate")
    normaliser = _below(tensors, _NORMALISER)
    return Checkpoint(
        module.to(device).eval().requires_grad_(False),
        Normaliser(**normaliser).to(device) if normaliser else None,
        info,
    )


def _config(network: StoredNetwork, info: dict[str, Any], path: Path) -> Any:
    try:
        return build_config(network.config, info["config"], f"{path}: config")
    except BadInput as error:
        remedy = "train it again with this version"
        raise BadInput(path, "settings of this version", str(error), remedy) from error


def write_empty(folder: str | Path, reason: str) -> Path:
    """Write ``empty.json`` instead of a checkpoint, with the reason."""
    return write_whole(Path(folder) / EMPTY, canonical_json({"reason": reason}) + "\n")


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def refuse_other_inputs(checkpoint: Checkpoint, hands: HandPair, encoder: TextEncoder, source: Path) -> None:
    """Raise BadInput if a network was trained with another hand model or text encoder."""
    facts = checkpoint.facts
    if facts["hand_digest"] != hands.digest:
        remedy = "pass the hand the models were trained with, or train with this one"
        expected = f"hand {facts['hand']} {facts['hand_digest'][:12]}"
        raise BadInput(source, expected, f"{hands.name} {hands.digest[:12]}", remedy)
    refuse_other_encoder(source, facts["encoder"], encoder.identity)
