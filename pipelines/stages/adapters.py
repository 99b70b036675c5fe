"""The adapter of a dataset with the settings of params.yaml: what scanning, checking and converting share.

One raw dataset may be converted several times side by side: a word in `datasets` with a hyphen, such as `arctic-whole`,
is a variant of what stands before it. It has the same adapter and raw files; settings, split and folders are its own.
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
from pipelines.stages.base import StagePaths, load_settings, own_root, raw_root


@dataclass(frozen=True)
class ConvertSettings:
    """margin_frames: kept before and after each interaction at 30 fps, None: as each adapter does by itself.

    adapters: by dataset, the fields of its adapter's class that are to differ.
    """

    margin_frames: int | None = None
    adapters: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.margin_frames is not None and self.margin_frames < 0:
            raise BadInput("convert.margin_frames", "0 or more frames", f"{self.margin_frames}", "correct it")

    def adapter(self, name: str) -> Adapter:
        """The adapter of that dataset with its settings; its own ``margin_frames`` wins over the common one."""
        # Without a margin nothing is said of it, so that an adapter without that setting works too.
        common = {"margin_frames": self.margin_frames} if self.margin_frames else {}
        return get_adapter(source_of(name), **{**common, **(self.adapters.get(name) or {})})


def manifest_of(paths: StagePaths) -> Manifest:
    """What is known of a dataset's raw files; that it is absent where nothing has been scanned.

    Of a variant that has no manifest of its own: what is known of its source. An experiment in a temporary copy of the
    project reads manifests that git does not know yet where they were written.
    """
    written = (paths.manifest, source_paths(paths).manifest)
    known = [folder / path for path in written for folder in (Path(), machine_folder()) if (folder / path).is_file()]
    return read_manifest(known[0]) if known else absent_manifest(configured_adapter(paths.dataset))


def source_of(name: str) -> str:
    """The dataset that one of params.yaml is a variant of; itself where it has an adapter."""
    return name if "-" not in name or name in adapter_names() else name.partition("-")[0]


def source_paths(paths: StagePaths) -> StagePaths:
    """Where the files of a variant's source lie."""
    return replace(paths, dataset=source_of(paths.dataset))


def raw_files(paths: StagePaths) -> Path:
    """The raw folder of a dataset that is present; of a variant of the user's own data that of its source.

    A generated corpus is written for each variant, as its manifest may hold another recipe. Raises MissingResource.
    """
    shared = not paths.is_generated and own_root(paths.dataset) is None
    return raw_root(source_paths(paths) if shared else paths)


def ensure_manifests(profile: str, datasets: Sequence[str]) -> None:
    """Write the manifests the graph depends on where nobody has: those datasets, and the hand, are absent."""
    for paths in (StagePaths(profile, name) for name in datasets):
        if not paths.manifest.is_file():
            write_manifest(paths.manifest, manifest_of(paths))
    hand = StagePaths(profile).hand_manifest
    if not hand.is_file():
        scanned = machine_folder() / hand
        write_manifest(hand, read_manifest(scanned) if scanned.is_file() else ABSENT_HAND)


def configured_adapter(name: str) -> Adapter:
    """The adapter with the settings of params.yaml. Raises MissingResource for an unknown name, BadInput else."""
    return load_settings(ConvertSettings, "convert").adapter(name)
