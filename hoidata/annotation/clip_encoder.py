"""The text tower of CLIP ViT-B/32 from a file of weights, through open_clip (optional extra ``hoidata[clip]``).

Sentences are encoded without padding, at most 24 tokens. CLIP's attention is causal and the feature is that of the
end-of-text token, so padding changes nothing and would cost most of the time. Sentences of our forms have at most 17
tokens.

A file of weights is a safetensors archive or a zip file of ``torch.save``. Tensor names are those of open_clip,
OpenAI (``transformer.resblocks.0.ln_1.weight``) or transformers (``text_model.encoder.layers.0.layer_norm1.weight``),
with any prefix (``text.``, ``module.``, ``clip_model.``). Only the text tower is read.
Weights are ``clip:FILE`` or ``clip:TAG``. Only a tag that is not in the local cache is downloaded. A tag is one of
open_clip's for ViT-B-32 (``openai``, ``laion2b_s34b_b79k``) and determines the activation function. A file does not, so
its name may: ``clip:FILE?quick_gelu=false``.
"""

import re
import socket
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies
from zipfile import BadZipFile, ZipFile

import numpy as np
import torch
from torch import Tensor

from hoidata.annotation.encoders import DIMENSIONS, Identity
from hoidata.errors import BadInput, MissingResource
from hoidata.files import sha256_file

ARCHITECTURE = "ViT-B-32"
WEIGHTS_FILE = "open_clip_model.safetensors"
# Enough to open a connection when online; the whole check must end within two seconds.
PROBE_S = 1.0
TAG = re.compile(r"[a-z0-9_]+")


@dataclass(frozen=True)
class WeightsName:
    """The part of an encoder name after ``clip:``."""

    name: str
    quick_gelu: bool | None  # None: the tag decides

    @property
    def is_tag(self) -> bool:
        return TAG.fullmatch(self.name) is not None and not Path(self.name).is_file()


def parse_weights_name(text: str) -> WeightsName:
    """Parse ``FILE``, ``FILE?quick_gelu=true`` (the default), ``FILE?quick_gelu=false`` or ``TAG``. Raises BadInput."""
    name, mark, option = text.partition("?")
    if mark and option not in ("quick_gelu=true", "quick_gelu=false"):
        raise BadInput("text encoder", "?quick_gelu=true or false", option, "correct the encoder's name")
    weights = WeightsName(name, option != "quick_gelu=false")
    if not weights.is_tag:
        return weights
    if mark:
        raise BadInput("text encoder", "a tag alone", text, "remove the option: the tag determines the activation")
    return WeightsName(name, None)


def missing_file(weights: Path) -> MissingResource:
    return MissingResource(f"CLIP weights {weights} are not on this machine. {_remedy('true')}")


def tagged_weights(open_clip: Any, tag: str) -> tuple[Path, bool]:
    """Return the weights of a tag, from the local cache or by download, and whether they need QuickGELU.

    Raises BadInput for an unknown tag, and MissingResource within two seconds when offline.
    """
    config = open_clip.get_pretrained_cfg(ARCHITECTURE, tag)
    repository = _repository(config)
    if repository is None:
        tags = [name for name in open_clip.list_pretrained_tags_by_model(ARCHITECTURE)
                 if _repository(open_clip.get_pretrained_cfg(ARCHITECTURE, name))]  # fmt: skip
        raise BadInput("text encoder", f"a tag of {ARCHITECTURE}: {', '.join(tags)}", tag, "correct the tag")
    quick_gelu = bool(config.get("quick_gelu", False))
    return _cached(*repository) or _downloaded(*repository, tag, quick_gelu), quick_gelu


def _repository(config: dict) -> tuple[str, str] | None:
    """Return repository and safetensors file of a tag. Pickled weights are never used."""
    if not config.get("hf_hub"):
        return None
    name, _, file = config["hf_hub"].rpartition("/")
    return name, re.sub(r"\.(bin|pth?)$", ".safetensors", file) or WEIGHTS_FILE


def _cached(repository: str, file: str) -> Path | None:
    from huggingface_hub import try_to_load_from_cache

    path = try_to_load_from_cache(repository, file)
    return Path(path) if isinstance(path, str) else None


def _downloaded(repository: str, file: str, tag: str, quick_gelu: bool) -> Path:
    from huggingface_hub import constants, hf_hub_download

    remedy = _remedy(str(quick_gelu).lower())
    problem = f"CLIP weights '{tag}' ({repository}) are not on this machine and"
    if constants.HF_HUB_OFFLINE:
        raise MissingResource(f"{problem} HF_HUB_OFFLINE forbids to download them. {remedy}")
    if not is_reachable(constants.ENDPOINT):
        raise MissingResource(f"{problem} {constants.ENDPOINT} cannot be reached (offline?). {remedy}")
    try:
        return Path(hf_hub_download(repository, file))
    except Exception as error:  # from several libraries, without a common base class
        raise MissingResource(f"{problem} could not be downloaded: {error}. {remedy}") from error


def is_reachable(address: str, within_s: float = PROBE_S) -> bool:
    """Whether a connection to a web address, or to its proxy, opens in time, including name resolution."""
    connected = threading.Event()
    # Name resolution has no timeout, so it runs in a thread that is abandoned.
    threading.Thread(target=_connect, args=(address, within_s, connected), daemon=True).start()
    return connected.wait(within_s)


def _connect(address: str, within_s: float, connected: threading.Event) -> None:
    url = urlsplit(address)
    proxy = getproxies().get(url.scheme)
    target = urlsplit(proxy if proxy and "://" in proxy else f"http://{proxy}" if proxy else address)
    port = target.port or (443 if target.scheme == "https" else 80)
    try:
        with socket.create_connection((target.hostname or "", port), timeout=within_s):
            connected.set()
    except OSError:
        return


def _remedy(quick_gelu: str) -> str:
    return (
        f"Do one of: pass a local open_clip {ARCHITECTURE} state dict, annotate.encoder: "
        f"clip:FILE.safetensors?quick_gelu={quick_gelu}; run once with internet access; or use the built-in offline "
        "encoder, annotate.encoder: use. Features of different encoders cannot be mixed."
    )


CONTEXT_TOKENS = 24
HEAD_WIDTH = 64  # of all CLIP text towers
VIT_B_32 = (512, 12)
# Keeps the declared operators registered for the lifetime of the process.
_registered: list[torch.library.Library] = []


class ClipEncoder:
    """Un-normalised 512-d text features, as in Text2HOI.

    Width and depth of the tower follow from the weights; the output must have 512 dimensions. OpenAI's weights need
    QuickGELU, LAION's do not. A wrong choice raises no error, so QuickGELU is part of the identity. Raises
    MissingResource if weights or open_clip are missing, BadInput for a file without a CLIP state dict.
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
        """Encode one sentence at a time in one thread, so that the last bits do not depend on batch and threads."""
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
    """Import open_clip, also with a CUDA build of torchvision next to CPU torch.

    Such a torchvision fails at import because two compiled operators are missing. CLIP's text tower uses neither, so
    declaring their names is enough.
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
        raise BadInput(weights, expected, str(error)[:200], "pass matching weights") from error
    return tower.eval()


def _size(weights: Path, state: dict[str, torch.Tensor]) -> dict[str, int]:
    """Return width, heads and layers of a text tower from its tensors."""
    projection = state.get("text_projection", torch.zeros(0, 0))
    width = projection.shape[0]
    layers = {name.split(".")[2] for name in state if name.startswith("transformer.resblocks.")}
    if tuple(projection.shape) != (width, DIMENSIONS) or width < HEAD_WIDTH or width % HEAD_WIDTH or not layers:
        expected = f"a CLIP text tower that gives {DIMENSIONS} numbers"
        got = f"{len(layers)} layers, text_projection {tuple(projection.shape)}"
        raise BadInput(weights, expected, got, "pass matching weights")
    return {"context_length": CONTEXT_TOKENS, "width": width, "heads": width // HEAD_WIDTH, "layers": len(layers)}


Tensors = dict[str, Tensor]
ZIP_BYTES = b"PK\x03\x04"
# The tensor that identifies a text tower; the start of its name is the prefix of all tensors.
OPEN_CLIP, TRANSFORMERS = "token_embedding.weight", "embeddings.token_embedding.weight"
PROJECTION = "text_projection"
NAMINGS = "a CLIP text tower by the names of open_clip, OpenAI or transformers"
# Parts of tensor names: transformers' to open_clip's.
RENAMED = {
    "embeddings.token_embedding.": "token_embedding.", "embeddings.position_embedding.weight": "positional_embedding",
    "final_layer_norm.": "ln_final.", "encoder.layers.": "transformer.resblocks.", ".layer_norm1.": ".ln_1.",
    ".layer_norm2.": ".ln_2.", ".mlp.fc1.": ".mlp.c_fc.", ".mlp.fc2.": ".mlp.c_proj.",
    ".self_attn.out_proj.": ".attn.out_proj.",
}  # fmt: skip
CONVERT = "write the weights' state_dict() as safetensors (docs/words.md says how)"
# Prefixes of tensors outside of the text tower, in a whole model of open_clip or OpenAI.
OTHER_TENSORS = ("visual.", "logit_", "attn_mask", "input_resolution", "context_length", "vocab_size")


def read_tower(path: Path) -> Tensors:
    """Read the tensors of a text tower, float32, with open_clip's names. Raises BadInput for a file without one."""
    names, load = _opened(path)
    embeddings = [name for name in names if f".{name}".endswith(f".{OPEN_CLIP}")]
    if len(embeddings) != 1:
        got = f"{len(embeddings)} towers" if embeddings else f"tensors {', '.join(sorted(names)[:3])}"
        raise BadInput(path, NAMINGS, got, "pass the weights of one CLIP model")
    is_transformers = embeddings[0].endswith(TRANSFORMERS)
    prefix = embeddings[0].removesuffix(TRANSFORMERS if is_transformers else OPEN_CLIP)
    if is_transformers:
        return _of_transformers(path, names, load, prefix)
    others = tuple(prefix + part for part in OTHER_TENSORS)
    tower = [name for name in names if name.startswith(prefix) and not name.startswith(others)]
    return {name.removeprefix(prefix): load(name).float() for name in tower}


def _of_transformers(path: Path, names: list[str], load: Callable[[str], Tensor], prefix: str) -> Tensors:
    """Convert a tower of transformers: other names, separate q, k and v, and a transposed projection."""
    projection = f"{prefix.removesuffix('text_model.')}{PROJECTION}.weight"
    if projection not in names:
        remedy = "take the weights of a CLIPModel or a CLIPTextModelWithProjection"
        raise BadInput(path, f"{projection}, the last layer of the text tower", "a CLIPTextModel without it", remedy)
    parts = tuple(f"{prefix}{part}" for part in ("embeddings.", "encoder.", "final_layer_norm."))
    weights = [name for name in names if name.startswith(parts) and not name.endswith("position_ids")]
    theirs = {name.removeprefix(prefix): load(name).float() for name in weights}
    attention = {name for name in theirs if name.rpartition(".")[0].endswith(("q_proj", "k_proj", "v_proj"))}
    converted = {_renamed(name): tensor for name, tensor in theirs.items() if name not in attention}
    for query in sorted(name for name in attention if ".q_proj." in name):
        layer, kind = query.split(".self_attn.q_proj.")
        three = [query.replace("q_proj", part) for part in ("q_proj", "k_proj", "v_proj")]
        if not theirs.keys() >= set(three):
            raise BadInput(path, f"{prefix}{layer}.self_attn: q_proj, k_proj and v_proj", "not all", "copy it again")
        converted[_renamed(f"{layer}.attn.in_proj_{kind}")] = torch.cat([theirs[name] for name in three])
    return {**converted, PROJECTION: load(projection).float().T.contiguous()}


def _renamed(name: str) -> str:
    for theirs, ours in RENAMED.items():
        name = name.replace(theirs, ours)
    return name


def _opened(path: Path) -> tuple[list[str], Callable[[str], Tensor]]:
    """Return the names of a file's tensors, and a function that reads one."""
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
    """Read the tensors of a zip file of ``torch.save``, at the top level or under "state_dict"."""
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
    items = stored.items() if isinstance(stored, Mapping) else ()
    return {name: tensor for name, tensor in items if isinstance(name, str) and isinstance(tensor, Tensor)}
