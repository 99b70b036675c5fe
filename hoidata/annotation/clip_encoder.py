"""CLIP ViT-B/32's text tower from a file of weights, through open_clip (optional extra ``hoidata[clip]``).

Only the tower is built, and a sentence is encoded at its own length, at most 24 tokens: CLIP's attention is causal and
features are read at the end-of-text token, so padding behind it changes nothing and costs most of the time. A prompt of
the four forms has at most 17 tokens.

A file of weights is a safetensors archive or a zip file of ``torch.save``. Its names may be those of open_clip,
OpenAI (``transformer.resblocks.0.ln_1.weight``) or transformers (``text_model.encoder.layers.0.layer_norm1.weight``),
below any prefix (``text.``, ``module.``, ``clip_model.``). Everything beside the text tower is never read.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
import torch
from torch import Tensor

from hoidata.annotation.clip_weights import ARCHITECTURE, WeightsName, missing_file, tagged_weights
from hoidata.annotation.encoders import DIMENSIONS, Identity
from hoidata.errors import BadInput, MissingResource
from hoidata.files import sha256_file

CONTEXT_TOKENS = 24
# Of every CLIP text tower.
HEAD_WIDTH = 64
VIT_B_32 = (512, 12)
# Keeps the stand-in operator names registered for as long as the process lives.
_registered: list[torch.library.Library] = []


class ClipEncoder:
    """Un-normalised 512-d text features, as Text2HOI uses them.

    weights: a ViT-B/32 state dict by the names of open_clip, OpenAI or transformers, whole or the text tower alone, in
    safetensors or a zip file of ``torch.save``; or a tag of open_clip's. Towers of other width and depth are built as
    their weights are, as long as they give 512 numbers. QuickGELU is right for OpenAI's weights, not for LAION's; a
    wrong choice goes unnoticed by the network, so it is part of the identity.
    Raises MissingResource when weights or open_clip are missing, BadInput when the file is not such a state dict.
    """

    def __init__(self, weights: WeightsName) -> None:
        if not weights.is_tag and not Path(weights.name).is_file():
            raise missing_file(Path(weights.name))
        open_clip = import_open_clip()
        path, quick_gelu = Path(weights.name), weights.quick_gelu
        if quick_gelu is None:
            path, quick_gelu = tagged_weights(open_clip, weights.name)
        self._tower = _load_tower(open_clip, path, quick_gelu)
        self._mask = self._tower.attn_mask
        self._tokenizer = open_clip.get_tokenizer(ARCHITECTURE)
        size = (self._tower.width, len(self._tower.transformer.resblocks))
        self.identity: Identity = {
            "name": f"clip-{ARCHITECTURE}" if size == VIT_B_32 else f"clip-text-{size[0]}x{size[1]}",
            "version": version("open-clip-torch"),
            "dims": DIMENSIONS,
            "sha256": sha256_file(path),
            "quick_gelu": quick_gelu,
        }

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        """One sentence and one thread at a time: the last bits would depend on neighbours and number of threads."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            rows = [self._feature(sentence) for sentence in sentences]
        finally:
            torch.set_num_threads(threads)
        return np.stack(rows) if rows else np.zeros((0, DIMENSIONS), np.float32)

    @torch.no_grad()
    def _feature(self, sentence: str) -> np.ndarray:
        tokens = self._tokenizer([sentence], CONTEXT_TOKENS)
        length = int(tokens.argmax()) + 1  # the end-of-text token has the largest number
        self._tower.attn_mask = self._mask[:length, :length]
        return self._tower(tokens[:, :length])[0].float().numpy()


def import_open_clip() -> Any:
    """open_clip, imported with PyPI's CUDA build of torchvision beside CPU torch as well.

    That torchvision fails at import because two of its compiled operators are absent; CLIP's text tower uses neither,
    so their names alone are declared.
    """
    if "torchvision" not in sys.modules and not torch.cuda.is_available():
        _declare_torchvision_operators()
    try:
        import open_clip  # pyright: ignore[reportMissingImports]  (optional extra)
    except ImportError as error:
        raise MissingResource("encoder 'clip' needs: pip install 'hoidata[clip]' -c constraints.txt") from error
    except RuntimeError as error:
        raise MissingResource(f"torchvision does not match torch {torch.__version__}: {error}") from error
    return open_clip


def _declare_torchvision_operators() -> None:
    if _registered or hasattr(torch.ops.torchvision, "nms"):
        return
    library = torch.library.Library("torchvision", "DEF")
    library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _registered.append(library)


def _load_tower(open_clip: Any, weights: Path, quick_gelu: bool) -> Any:
    state = read_tower(weights)
    state["positional_embedding"] = state.get("positional_embedding", torch.zeros(0))[:CONTEXT_TOKENS].clone()
    text = {**open_clip.get_model_config(ARCHITECTURE)["text_cfg"], **_size(weights, state)}
    try:
        tower = open_clip.model._build_text_tower(DIMENSIONS, text, quick_gelu=quick_gelu)
        tower.load_state_dict(state)
    except RuntimeError as error:
        expected = f"the text tower of {ARCHITECTURE}"
        raise BadInput(weights, expected, str(error)[:200], "give matching weights") from error
    return tower.eval()


def _size(weights: Path, state: dict[str, torch.Tensor]) -> dict[str, int]:
    """Width, heads and layers of a text tower, as its tensors have them."""
    projection = state.get("text_projection", torch.zeros(0, 0))
    width = projection.shape[0]
    layers = {name.split(".")[2] for name in state if name.startswith("transformer.resblocks.")}
    if tuple(projection.shape) != (width, DIMENSIONS) or width < HEAD_WIDTH or width % HEAD_WIDTH or not layers:
        expected = f"a CLIP text tower that gives {DIMENSIONS} numbers"
        got = f"{len(layers)} layers, text_projection {tuple(projection.shape)}"
        raise BadInput(weights, expected, got, "give matching weights")
    return {
        "context_length": CONTEXT_TOKENS,
        "width": width,
        "heads": width // HEAD_WIDTH,
        "layers": len(layers),
    }


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
