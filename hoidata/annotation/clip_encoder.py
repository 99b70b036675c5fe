"""CLIP ViT-B/32's text tower from a file of weights, through open_clip (optional extra ``hoidata[clip]``).

Only the tower is built, and a sentence is encoded at its own length, at most 24 tokens: CLIP's attention is causal and
features are read at the end-of-text token, so padding behind it changes nothing and costs most of the time. A prompt of
the four forms has at most 17 tokens.
"""

import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hoidata.annotation.clip_tensors import read_tower
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
