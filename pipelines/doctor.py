"""`hoidata doctor`: the state of installed packages, raw files, hand models, text encoder and GPU."""

import os
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from hoidata.errors import HoidataError
from pipelines.lineage.manifests import Manifest
from pipelines.params import PROFILES, read_params
from pipelines.stages.adapters import manifest_of, source_of
from pipelines.stages.base import HAND, StagePaths, load_hands, load_settings, registered_root, root_variable

NEEDED = ("torch", "numpy", "scipy", "pandas", "pyarrow", "trimesh", "libigl", "safetensors", "dvc", "prefect")


@dataclass(frozen=True)
class Finding:
    """The state of one part."""

    part: str
    state: Literal["ok", "absent", "broken"]  # absent: optional and missing; broken: required and not usable
    detail: str


def examine() -> list[Finding]:
    """Examine everything that a run depends on, without opening raw files."""
    params = read_params(Path())
    python = Finding("python", "ok", f"{sys.version.split()[0]}, {len(os.sched_getaffinity(0))} cores")
    profile = Finding("profile", "ok", params["profile"])
    findings = [python, *map(_package, NEEDED), _prefect_server(), _gpu(), profile]
    findings += [_raw(kind, name) for kind in PROFILES for name in params["datasets"]]
    return [*findings, *map(_hand, PROFILES), _encoder(), _clip()]


def _package(name: str) -> Finding:
    try:
        return Finding(name, "ok", version(name))
    except PackageNotFoundError:
        return Finding(name, "broken", "not installed; run `make install`")


def _prefect_server() -> Finding:
    """Whether Prefect's server can be imported: too new a FastAPI breaks it, which `pip check` does not detect."""
    try:
        import prefect.server.api.server  # noqa: F401
    except (ImportError, TypeError) as error:
        return Finding("prefect server", "broken", f"{error}; install with the versions of constraints.txt")
    return Finding("prefect server", "ok", "can be started with `hoidata up`")


def _gpu() -> Finding:
    import torch

    if torch.cuda.is_available():
        return Finding("gpu", "ok", torch.cuda.get_device_name(0))
    return Finding("gpu", "absent", f"none; torch uses {torch.get_num_threads()} threads of the CPU")


def _raw(profile: str, dataset: str) -> Finding:
    part, paths = f"raw {dataset} ({profile})", StagePaths(profile, dataset)
    try:
        manifest = manifest_of(paths)
    except HoidataError as error:
        return Finding(part, "broken", str(error))
    root = registered_root(dataset) or registered_root(source_of(dataset)) if profile == "own" else paths.generated_raw
    if not manifest.present:
        return Finding(part, "absent", _why_absent(profile, manifest, root))
    if root is None or not root.is_dir():
        remedy = f"set {root_variable(dataset)}" if profile == "own" else "the stage raw writes them"
        return Finding(part, "absent", f"the manifest exists, the files do not; {remedy}")
    return Finding(part, "ok", f"{root}{' (synthetic)' if manifest.synthetic else ''}")


def _why_absent(profile: str, manifest: Manifest, root: Path | None) -> str:
    if profile != "own":
        return f"the profile {profile} has no corpus of it"
    if root:
        return f"{root} is not scanned; run `hoidata raw scan {manifest.dataset} --root {root}`"
    return f"get it at: {manifest.where_to_register}"


def _hand(profile: str) -> Finding:
    part = f"hand ({profile})"
    try:
        hands = load_hands(profile)
    except HoidataError as error:
        return Finding(part, "broken", str(error))
    note = f"; {root_variable(HAND)} or `hoidata raw scan mano` for MANO" if profile == "own" else ""
    return Finding(part, "ok", f"{hands.name}, sha256 {hands.digest[:12]}{note if hands.name == 'embedded' else ''}")


def _encoder() -> Finding:
    from hoidata.annotation.encoders import load_encoder
    from hoidata.annotation.settings import AnnotationSettings

    name = load_settings(AnnotationSettings, "annotate").encoder
    try:
        identity = load_encoder(name).identity
        return Finding("text encoder", "ok", ", ".join(f"{key} {str(value)[:16]}" for key, value in identity.items()))
    except HoidataError as error:
        return Finding("text encoder", "broken", str(error))


def _clip() -> Finding:
    if find_spec("open_clip") is None:
        return Finding("CLIP", "absent", "optional; pip install -c constraints.txt -e '.[clip]'")
    return Finding("CLIP", "ok", f"open_clip {version('open_clip_torch')}; you provide the weights")
