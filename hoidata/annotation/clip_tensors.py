"""The tensors of a CLIP text tower by open_clip's names, from weight files of the libraries that people have them from.

A file is a safetensors archive or a zip file of ``torch.save``. Its names may be those of open_clip and OpenAI
(``transformer.resblocks.0.ln_1.weight``) or of transformers (``text_model.encoder.layers.0.layer_norm1.weight``), below
any prefix (``text.``, ``module.``, ``clip_model.``). Everything beside the text tower is never read.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import torch
from torch import Tensor

from hoidata.errors import BadInput

Tensors = dict[str, Tensor]
ZIP_BYTES = b"PK\x03\x04"
# The tensor by which a tower is found, and with it the prefix of all its tensors.
OPEN_CLIP, TRANSFORMERS = "token_embedding.weight", "embeddings.token_embedding.weight"
PROJECTION = "text_projection"
NAMINGS = "a CLIP text tower by the names of open_clip, OpenAI or transformers"
# Transformers' names, and open_clip's for the same tensor.
RENAMED = {
    "embeddings.token_embedding.": "token_embedding.",
    "embeddings.position_embedding.weight": "positional_embedding",
    "final_layer_norm.": "ln_final.",
    "encoder.layers.": "transformer.resblocks.",
    ".layer_norm1.": ".ln_1.",
    ".layer_norm2.": ".ln_2.",
    ".mlp.fc1.": ".mlp.c_fc.",
    ".mlp.fc2.": ".mlp.c_proj.",
    ".self_attn.out_proj.": ".attn.out_proj.",
}
CONVERT = "write the weights' state_dict() as safetensors (docs/words.md says how)"
# What stands beside the text tower in a whole model of open_clip or OpenAI.
BESIDE = ("visual.", "logit_", "attn_mask", "input_resolution", "context_length", "vocab_size")


def read_tower(path: Path) -> Tensors:
    """The text tower's tensors, float32, by open_clip's names. Raises BadInput for a file that holds none."""
    names, load = _opened(path)
    found = [name for name in names if f".{name}".endswith(f".{OPEN_CLIP}")]
    if len(found) != 1:
        got = f"{len(found)} of them" if found else f"tensors {', '.join(sorted(names)[:3])}"
        raise BadInput(path, NAMINGS, got, "give the weights of one CLIP model")
    is_transformers = found[0].endswith(TRANSFORMERS)
    prefix = found[0].removesuffix(TRANSFORMERS if is_transformers else OPEN_CLIP)
    if is_transformers:
        return _of_transformers(path, names, load, prefix)
    own = [name for name in names if name.startswith(prefix)]
    own = [name for name in own if not name.startswith(tuple(prefix + part for part in BESIDE))]
    return {name.removeprefix(prefix): load(name).float() for name in own}


def _of_transformers(path: Path, names: list[str], load: Callable[[str], Tensor], prefix: str) -> Tensors:
    """The tensors of a tower below ``prefix``; its projection stands beside it, transposed."""
    projection = f"{prefix.removesuffix('text_model.')}{PROJECTION}.weight"
    if projection not in names:
        remedy = "take the weights of a CLIPModel or a CLIPTextModelWithProjection"
        raise BadInput(path, f"{projection}, the last layer of the text tower", "a CLIPTextModel without it", remedy)
    parts = tuple(f"{prefix}{part}" for part in ("embeddings.", "encoder.", "final_layer_norm."))
    own = {
        name.removeprefix(prefix): load(name).float()
        for name in names
        if name.startswith(parts) and not name.endswith("position_ids")
    }
    attention = {name for name in own if name.rpartition(".")[0].endswith(("q_proj", "k_proj", "v_proj"))}
    found = {_renamed(name): tensor for name, tensor in own.items() if name not in attention}
    for query in sorted(name for name in attention if ".q_proj." in name):
        layer, kind = query.split(".self_attn.q_proj.")
        three = [own.get(query.replace("q_proj", part)) for part in ("q_proj", "k_proj", "v_proj")]
        if any(tensor is None for tensor in three):
            raise BadInput(path, f"{prefix}{layer}.self_attn: q_proj, k_proj and v_proj", "not all", "copy it again")
        found[_renamed(f"{layer}.attn.in_proj_{kind}")] = torch.cat([own for own in three if own is not None])
    return {**found, PROJECTION: load(projection).float().T.contiguous()}


def _renamed(name: str) -> str:
    for theirs, ours in RENAMED.items():
        name = name.replace(theirs, ours)
    return name


def _opened(path: Path) -> tuple[list[str], Callable[[str], Tensor]]:
    """The names of a file's tensors, and what reads one of them."""
    with path.open("rb") as file:
        is_zip = file.read(len(ZIP_BYTES)) == ZIP_BYTES
    if is_zip:
        tensors = _state_dict(path)
        return list(tensors), tensors.__getitem__
    from safetensors import SafetensorError, safe_open

    try:
        archive = safe_open(path, framework="pt")
        return list(archive.keys()), archive.get_tensor
    except SafetensorError as error:
        raise BadInput(path, "a safetensors file, or a zip file of torch.save", str(error), CONVERT) from error


def _state_dict(path: Path) -> Tensors:
    """The tensors by name of a zip file, also below "state_dict", as open_clip's trainings keep them."""
    expected = "a zip file of torch.save with weights alone"
    try:
        with ZipFile(path) as archive:
            members = archive.namelist()
    except (BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise BadInput(path, expected, str(error), "download it again") from error
    if any(name.endswith("/constants.pkl") for name in members):
        raise BadInput(path, expected, "a TorchScript archive, which holds code", CONVERT)
    try:
        stored: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a malformed file can raise anything
        text = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"[:300]
        raise BadInput(path, expected, text, CONVERT) from error
    if isinstance(stored, Mapping) and isinstance(stored.get("state_dict"), Mapping):
        stored = stored["state_dict"]
    named = stored.items() if isinstance(stored, Mapping) else ()
    return {name: tensor for name, tensor in named if isinstance(name, str) and isinstance(tensor, Tensor)}
