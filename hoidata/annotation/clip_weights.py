"""Where the weights of ``clip:FILE`` or ``clip:TAG`` lie. Only a tag that is not on this machine is ever downloaded.

A tag is one of open_clip's for ViT-B-32 (``openai``, ``laion2b_s34b_b79k``); it says which activation its weights were
trained with. A file does not, so its name may: ``clip:FILE?quick_gelu=false``.
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
# What a machine that is online needs at most to open a connection; the answer must come within two seconds.
PROBE_S = 1.0
TAG = re.compile(r"[a-z0-9_]+")


@dataclass(frozen=True)
class WeightsName:
    """What stands behind ``clip:``. quick_gelu: None where the tag decides."""

    name: str
    quick_gelu: bool | None

    @property
    def is_tag(self) -> bool:
        return TAG.fullmatch(self.name) is not None and not Path(self.name).is_file()


def parse_weights_name(text: str) -> WeightsName:
    """``FILE``, ``FILE?quick_gelu=true`` (the default), ``FILE?quick_gelu=false`` or ``TAG``. Raises BadInput."""
    name, mark, option = text.partition("?")
    if mark and option not in ("quick_gelu=true", "quick_gelu=false"):
        raise BadInput("text encoder", "?quick_gelu=true or false", option, "correct the encoder's name")
    found = WeightsName(name, option != "quick_gelu=false")
    if not found.is_tag:
        return found
    if mark:
        raise BadInput("text encoder", "a tag alone", text, "leave out the option: the tag knows its activation")
    return WeightsName(name, None)


def missing_file(weights: Path) -> MissingResource:
    return MissingResource(f"CLIP weights {weights} are not on this machine. {_ways_out('true')}")


def tagged_weights(open_clip: Any, tag: str) -> tuple[Path, bool]:
    """The weights of a tag and whether they need QuickGELU: from the local cache, else downloaded where that can be.

    Raises BadInput for a tag open_clip does not know, MissingResource within two seconds when offline.
    """
    config = open_clip.get_pretrained_cfg(ARCHITECTURE, tag)
    repository = _repository(config)
    if repository is None:
        known = [name for name in open_clip.list_pretrained_tags_by_model(ARCHITECTURE)
                 if _repository(open_clip.get_pretrained_cfg(ARCHITECTURE, name))]  # fmt: skip
        raise BadInput("text encoder", f"a tag of {ARCHITECTURE}: {', '.join(known)}", tag, "correct the tag")
    quick_gelu = bool(config.get("quick_gelu", False))
    return _cached(*repository) or _downloaded(*repository, tag, quick_gelu), quick_gelu


def _repository(config: dict) -> tuple[str, str] | None:
    """Repository and safetensors file of a tag; pickled weights are never taken."""
    if not config.get("hf_hub"):
        return None
    name, _, file = config["hf_hub"].rpartition("/")
    return name, re.sub(r"\.(bin|pth?)$", ".safetensors", file) or WEIGHTS_FILE


def _cached(repository: str, file: str) -> Path | None:
    from huggingface_hub import try_to_load_from_cache

    found = try_to_load_from_cache(repository, file)
    return Path(found) if isinstance(found, str) else None


def _downloaded(repository: str, file: str, tag: str, quick_gelu: bool) -> Path:
    from huggingface_hub import constants, hf_hub_download

    ways_out = _ways_out(str(quick_gelu).lower())
    here = f"CLIP weights '{tag}' ({repository}) are not on this machine and"
    if constants.HF_HUB_OFFLINE:
        raise MissingResource(f"{here} HF_HUB_OFFLINE forbids to download them. {ways_out}")
    if not is_reachable(constants.ENDPOINT):
        raise MissingResource(f"{here} {constants.ENDPOINT} cannot be reached (offline?). {ways_out}")
    try:
        return Path(hf_hub_download(repository, file))
    except Exception as error:  # of several libraries below, without a common base
        raise MissingResource(f"{here} could not be downloaded: {error}. {ways_out}") from error


def is_reachable(address: str, within_s: float = PROBE_S) -> bool:
    """Whether a connection to a web address, or to the proxy set for it, opens in time; a silent name server counts."""
    found = threading.Event()
    # A name look-up has no time limit of its own, so it is left behind in a thread.
    threading.Thread(target=_connect, args=(address, within_s, found), daemon=True).start()
    return found.wait(within_s)


def _connect(address: str, within_s: float, found: threading.Event) -> None:
    address_fields = urlsplit(address)
    proxy = getproxies().get(address_fields.scheme)
    target = urlsplit(proxy if proxy and "://" in proxy else f"http://{proxy}" if proxy else address)
    port = target.port or (443 if target.scheme == "https" else 80)
    try:
        with socket.create_connection((target.hostname or "", port), timeout=within_s):
            found.set()
    except OSError:
        return


def _ways_out(quick_gelu: str) -> str:
    return (
        f"Do one of: give a local open_clip {ARCHITECTURE} state dict, annotate.encoder: "
        f"clip:FILE.safetensors?quick_gelu={quick_gelu}; run once with internet access; or use the built-in offline "
        "encoder, annotate.encoder: use. Features of different encoders cannot be mixed."
    )
