"""Checkpoints: one safetensors file with weights, config, normalisation and provenance; nothing in it is ever executed.

The header has exactly one metadata key, ``hoidata``, holding canonical JSON: safetensors keeps several keys in a hash
map, whose order changes from run to run, and equal trainings must give equal bytes. Files carry no time, host or user.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from hoidata.errors import BadInput
from hoidata.files import atomic_file, canonical_json
from models.common.config import build_config, plain_config
from models.common.features import Normaliser
from models.text2hoi.contact import ContactConfig, ContactModel
from models.text2hoi.diffusion import DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.length import LengthConfig, LengthModel
from models.text2hoi.refiner import RefinerConfig, RefinerModel

FORMAT = 1
METADATA_KEY = "hoidata"
FILE_NAME = "model.safetensors"
EMPTY_NAME = "empty.json"
NETWORKS: dict[str, tuple[type, type[nn.Module]]] = {
    "contact": (ContactConfig, ContactModel),
    "length": (LengthConfig, LengthModel),
    "diffusion": (DiffusionConfig, DiffusionModel),
    "refiner": (RefinerConfig, RefinerModel),
}
_WEIGHTS, _NORMALISER = "weights.", "normaliser."


@dataclass(frozen=True)
class Checkpoint:
    """A trained network in evaluation mode, the normalisation it was trained with (or None), and what is known of it.

    info: "model", "config", "facts" (clips, counts, synthetic, encoder, hand, ...), "results" and "provenance".
    """

    network: nn.Module
    normaliser: Normaliser | None
    info: dict[str, Any]

    @property
    def facts(self) -> dict[str, Any]:
        return self.info["facts"]

    @property
    def contact_threshold(self) -> float:
        """The probability from which a point counts as touched, chosen on validation clips (contact model only)."""
        return float(self.info["results"]["contact_threshold"])


def save_checkpoint(
    folder: str | Path, model_name: str, network: nn.Module, normaliser: Normaliser | None, info: dict[str, Any]
) -> Path:
    """Write ``model.safetensors`` into ``folder``, whole or not at all. info: "facts", "results", "provenance"."""
    tensors = {_WEIGHTS + name: tensor for name, tensor in network.state_dict().items()}
    if normaliser is not None:
        tensors |= {_NORMALISER + name: tensor for name, tensor in normaliser.tensors().items()}
    tensors = {name: tensors[name].detach().cpu().contiguous() for name in sorted(tensors)}
    known = {"format": FORMAT, "model": model_name, "config": plain_config(network.config), **info}
    path = Path(folder) / FILE_NAME
    with atomic_file(path) as part:
        part.write_bytes(save(tensors, metadata={METADATA_KEY: canonical_json(known)}))
    return path


def read_info(path: str | Path) -> dict[str, Any]:
    """The metadata of a checkpoint file. Raises BadInput for anything else."""
    try:
        with safe_open(path, framework="pt") as stored:
            metadata = stored.metadata() or {}
        info = json.loads(metadata[METADATA_KEY])
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise BadInput(path, "a checkpoint of hoidata", f"{type(error).__name__}: {error}", "train it again") from error
    if info.get("format") != FORMAT or info.get("model") not in NETWORKS:
        got = f"format {info.get('format')} of model {info.get('model')}"
        raise BadInput(path, f"format {FORMAT} of a known model", got, "train it again with this version")
    return info


def load_checkpoint(folder: str | Path, expected: str | None = None, device: torch.device | str = "cpu") -> Checkpoint:
    """The checkpoint in ``folder``, or of a file. Raises BadInput where there is none, or one of another model."""
    path = Path(folder) if str(folder).endswith(".safetensors") else Path(folder) / FILE_NAME
    if not path.is_file():
        raise BadInput(path, "a trained model", empty_reason(path.parent) or "no file", "run `dvc repro`")
    info = read_info(path)
    if expected is not None and info["model"] != expected:
        raise BadInput(path, f"a checkpoint of {expected}", f"one of {info['model']}", "point to the right folder")
    config_type, network_type = NETWORKS[info["model"]]
    network = network_type(build_config(config_type, info["config"], f"{path}: config"))
    with safe_open(path, framework="pt") as stored:
        tensors: dict[str, Tensor] = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    try:
        network.load_state_dict(_below(tensors, _WEIGHTS))
    except RuntimeError as error:
        raise BadInput(path, "weights that fit its config", str(error).splitlines()[0], "train it again") from error
    normaliser = _below(tensors, _NORMALISER)
    return Checkpoint(
        network.to(device).eval().requires_grad_(False),
        Normaliser(**normaliser).to(device) if normaliser else None,
        info,
    )


def motion_generator(checkpoint: Checkpoint) -> MotionGenerator:
    """The motion generator of a diffusion checkpoint."""
    assert isinstance(checkpoint.network, DiffusionModel)
    assert checkpoint.normaliser is not None
    return MotionGenerator(checkpoint.network, checkpoint.normaliser)


def write_empty(folder: str | Path, reason: str) -> Path:
    """``empty.json`` in place of a checkpoint that could not be trained, with the reason."""
    path = Path(folder) / EMPTY_NAME
    with atomic_file(path) as part:
        part.write_text(canonical_json({"reason": reason}) + "\n")
    return path


def empty_reason(folder: str | Path) -> str | None:
    """Why a folder holds no checkpoint, or None when it says nothing."""
    path = Path(folder) / EMPTY_NAME
    return json.loads(path.read_text())["reason"] if path.is_file() else None


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
