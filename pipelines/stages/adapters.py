"""Adapters with the settings of params.yaml, and manifests of datasets.

A name in `datasets` with a hyphen, such as `arctic-whole`, is a variant of the dataset before the hyphen. A variant
uses the adapter and raw files of that dataset, with separate settings, split and folders.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hoidata.datasets.base import Adapter
from hoidata.datasets.registry import adapter_names, get_adapter
from hoidata.errors import BadInput
from hoidata.machine_folder import machine_folder
from pipelines.lineage.manifests import ABSENT_HAND, Manifest, absent_manifest, read_manifest, write_manifest
from pipelines.stages.base import StagePaths, load_settings, raw_root, registered_root


@dataclass(frozen=True)
class ConvertSettings:
    """The section ``convert`` of params.yaml."""

    margin_frames: int | None = None  # frames at 30 fps before and after each interaction; None: the adapter's default
    adapters: Mapping[str, Any] = field(default_factory=dict)  # by dataset, fields of the adapter's class to set

    def __post_init__(self) -> None:
        if self.margin_frames is not None and self.margin_frames < 0:
            raise BadInput("convert.margin_frames", "0 or more frames", f"{self.margin_frames}", "correct it")

    def adapter(self, name: str) -> Adapter:
        """The adapter of a dataset with its settings; its ``margin_frames`` overrides the common one."""
        # No margin is passed if none is set, because an adapter may lack that field.
        common = {"margin_frames": self.margin_frames} if self.margin_frames else {}
        return get_adapter(source_of(name), **{**common, **(self.adapters.get(name) or {})})


def manifest_of(paths: StagePaths) -> Manifest:
    """The manifest of a dataset; if no files were scanned, a manifest that marks it as absent.

    A variant without a manifest has that of its source. An experiment in a temporary copy of the project reads
    uncommitted manifests from the original project.
    """
    names = (paths.manifest, source_paths(paths).manifest)
    candidates = (folder / name for name in names for folder in (Path(), machine_folder()))
    existing = next((path for path in candidates if path.is_file()), None)
    return read_manifest(existing) if existing else absent_manifest(configured_adapter(paths.dataset))


def source_of(name: str) -> str:
    """The dataset that a name in params.yaml is a variant of; the name itself if it has an adapter."""
    return name if "-" not in name or name in adapter_names() else name.partition("-")[0]


def source_paths(paths: StagePaths) -> StagePaths:
    """The paths of the dataset that a variant such as ``arctic-whole`` is converted from."""
    return replace(paths, dataset=source_of(paths.dataset))


def raw_files(paths: StagePaths) -> Path:
    """The raw folder of a dataset; for a variant of the user's data, that of its source.

    A generated corpus is written for each variant, as its manifest may have another recipe. Raises MissingResource if
    the folder does not exist.
    """
    shared = not paths.is_generated and registered_root(paths.dataset) is None
    return raw_root(source_paths(paths) if shared else paths)


def ensure_manifests(profile: str, datasets: Sequence[str]) -> None:
    """Write missing manifests of datasets and hand model, which the graph depends on; they mark them as absent."""
    for paths in (StagePaths(profile, name) for name in datasets):
        if not paths.manifest.is_file():
            write_manifest(paths.manifest, manifest_of(paths))
    hand = StagePaths(profile).hand_manifest
    if not hand.is_file():
        scanned = machine_folder() / hand
        write_manifest(hand, read_manifest(scanned) if scanned.is_file() else ABSENT_HAND)


def configured_adapter(name: str) -> Adapter:
    """The adapter with the settings of params.yaml. Raises MissingResource for an unknown name."""
    return load_settings(ConvertSettings, "convert").adapter(name)
