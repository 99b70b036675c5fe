"""Finds the weights of ``clip:FILE`` or ``clip:TAG``. Only a tag that is not in the local cache is downloaded.

A tag is one of open_clip's for ViT-B-32 (``openai``, ``laion2b_s34b_b79k``) and determines the activation function. A
file does not, so its name may: ``clip:FILE?quick_gelu=false``.
"""

import re
import socket
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies

from hoidata.errors import BadInput, MissingResource

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
