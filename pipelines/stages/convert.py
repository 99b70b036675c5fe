"""Stage convert: raw files to a store of clips; sequences that cannot be used are left out with their reason."""

from typing import Any

from pydantic import Field

from hoidata.adapters.base import Adapter
from hoidata.adapters.convert import convert_dataset
from hoidata.adapters.registry import get_adapter
from hoidata.lineage.manifests import read_manifest
from pipelines.stages.base import Place, StageParams, jobs, load_hands, load_params, note_empty, raw_root


class ConvertParams(StageParams):
    """margin_frames: kept before and after each interaction, at 30 fps. adapters: settings of single datasets."""

    margin_frames: int = Field(default=0, ge=0)
    adapters: dict[str, dict[str, Any] | None] = Field(default_factory=dict)

    def adapter(self, name: str) -> Adapter:
        """The adapter of that dataset with its settings; its own ``margin_frames`` wins over the common one."""
        # Without a margin nothing is said of it, so that an adapter without that setting works too.
        common = {"margin_frames": self.margin_frames} if self.margin_frames else {}
        return get_adapter(name, **{**common, **(self.adapters.get(name) or {})})


def run(place: Place) -> None:
    """Convert the dataset with its adapter, each raw file checked against the manifest; none present, none read."""
    params = load_params(ConvertParams, "convert")
    manifest = read_manifest(place.raw_manifest)
    try:
        summary = convert_dataset(
            params.adapter(place.dataset),
            raw_root(place) if manifest.present else None,
            load_hands(place.profile),
            place.clips,
            jobs=jobs(),
            manifest=manifest.files,
            synthetic=manifest.present and manifest.synthetic,
        )
    except KeyboardInterrupt:
        raise SystemExit(f"convert of {place}: interrupted; run it again, finished sequences are kept") from None
    if not manifest.present:
        note_empty(place.clips, f"{place.dataset} is not present in the profile {place.profile}")
    elif not summary.clips:
        note_empty(place.clips, f"none of {summary.sequences} sequences gave a clip")
