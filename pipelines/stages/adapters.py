"""The adapter of a dataset with the settings of params.yaml: what scanning, checking and converting share."""

from typing import Any

from pydantic import Field

from hoidata.datasets.base import Adapter
from hoidata.datasets.registry import get_adapter
from pipelines.lineage.manifests import Manifest, absent_manifest, read_manifest
from pipelines.stages.base import Place, StageParams, load_params


class ConvertParams(StageParams):
    """margin_frames: kept before and after each interaction, at 30 fps. adapters: settings of single datasets."""

    margin_frames: int = Field(default=0, ge=0)
    adapters: dict[str, dict[str, Any] | None] = Field(default_factory=dict)

    def adapter(self, name: str) -> Adapter:
        """The adapter of that dataset with its settings; its own ``margin_frames`` wins over the common one."""
        # Without a margin nothing is said of it, so that an adapter without that setting works too.
        common = {"margin_frames": self.margin_frames} if self.margin_frames else {}
        return get_adapter(name, **{**common, **(self.adapters.get(name) or {})})


def manifest_of(place: Place) -> Manifest:
    """The manifest of a dataset in a profile. Where there is none, the profile does not have the dataset."""
    return (
        read_manifest(place.manifest)
        if place.manifest.is_file()
        else absent_manifest(configured_adapter(place.dataset))
    )


def configured_adapter(name: str) -> Adapter:
    """The adapter with the settings of params.yaml. Raises MissingResource for an unknown name, BadInput else."""
    return load_params(ConvertParams, "convert").adapter(name)
