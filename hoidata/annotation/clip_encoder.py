"""CLIP ViT-B/32's text tower from a local safetensors file, through open_clip (optional extra ``hoidata[clip]``).

Only the tower is built, and for 24 tokens: CLIP's attention is causal and features are read at the end-of-text token,
so later padding changes nothing and costs most of the time. A prompt of the four forms has at most 17 tokens.
"""

import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

from hoidata.annotation.encoders import DIMENSIONS, Identity
from hoidata.errors import BadInput, MissingResource
from hoidata.files import sha256_file

ARCHITECTURE = "ViT-B-32"
CONTEXT_TOKENS = 24
BATCH = 64
# Keeps the stand-in operator names registered for as long as the process lives.
_registered: list[torch.library.Library] = []


class ClipEncoder:
    """Un-normalised 512-d text features, as Text2HOI uses them.

    weights: an open_clip ViT-B/32 state dict in safetensors, whole or text keys alone. quick_gelu: True for OpenAI's
    weights, False for LAION's; a wrong choice goes unnoticed by the network, so it is part of the identity.
    Raises MissingResource when the file or open_clip is missing, BadInput when the file is not such a state dict.
    """

    def __init__(self, weights: Path, quick_gelu: bool = True) -> None:
        if not weights.is_file():
            raise MissingResource(
                f"CLIP weights {weights} are not on this machine. Give a local file (clip:FILE.safetensors, an "
                "open_clip ViT-B-32 state dict) or use the built-in offline encoder: text.encoder=use. "
                "Features of different encoders cannot be mixed."
            )
        open_clip = import_open_clip()
        self._tower = _load_tower(open_clip, weights, quick_gelu)
        self._tokenizer = open_clip.get_tokenizer(ARCHITECTURE)
        self.identity: Identity = {
            "name": f"clip-{ARCHITECTURE}",
            "version": version("open-clip-torch"),
            "dims": DIMENSIONS,
            "sha256": sha256_file(weights),
            "quick_gelu": quick_gelu,
        }

    @torch.no_grad()
    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        batches = [sentences[start : start + BATCH] for start in range(0, len(sentences), BATCH)]
        features = [self._tower(self._tokenizer(list(batch), CONTEXT_TOKENS)).float().numpy() for batch in batches]
        return np.concatenate(features) if features else np.zeros((0, DIMENSIONS), np.float32)


def import_open_clip():
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


def _load_tower(open_clip, weights: Path, quick_gelu: bool) -> torch.nn.Module:
    config = open_clip.get_model_config(ARCHITECTURE)
    text = {**config["text_cfg"], "context_length": CONTEXT_TOKENS}
    tower = open_clip.model._build_text_tower(config["embed_dim"], text, quick_gelu=quick_gelu)
    try:
        tower.load_state_dict(_text_state(weights))
    except RuntimeError as error:
        raise BadInput(
            weights, f"the text tower of {ARCHITECTURE}", str(error)[:200], "give matching weights"
        ) from error
    return tower.eval()


def _text_state(weights: Path) -> dict[str, torch.Tensor]:
    """The text tower's tensors as float32; the image tower is never read."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(weights, framework="pt") as archive:
            names = [name for name in archive.keys() if not name.startswith(("visual.", "logit_"))]  # noqa: SIM118
            state = {name: archive.get_tensor(name).float() for name in names}
    except SafetensorError as error:
        raise BadInput(weights, "a safetensors file", str(error), "convert the weights with open_clip") from error
    if "positional_embedding" in state:
        state["positional_embedding"] = state["positional_embedding"][:CONTEXT_TOKENS].clone()
    return state
