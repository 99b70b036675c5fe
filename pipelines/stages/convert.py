"""Stage convert: raw files to a store of clips; sequences that cannot be used are left out with their reason."""

from hoidata.adapters.convert import convert_dataset
from hoidata.adapters.registry import get_adapter
from hoidata.lineage.manifests import read_manifest
from pipelines.stages.base import Place, StageParams, jobs, load_hands, load_params, note_empty, raw_root


class ConvertParams(StageParams):
    """Nothing to set yet: every rule of conversion is the source dataset's own."""


def run(place: Place) -> None:
    """Convert the dataset with its adapter, each raw file checked against the manifest; none present, none read."""
    load_params(ConvertParams, "convert")
    manifest = read_manifest(place.raw_manifest)
    summary = convert_dataset(
        get_adapter(place.dataset),
        raw_root(place) if manifest.present else None,
        load_hands(place.profile),
        place.clips,
        jobs=jobs(),
        manifest=manifest.files,
        synthetic=manifest.present and manifest.synthetic,
    )
    if not manifest.present:
        note_empty(place.clips, f"{place.dataset} is not present in the profile {place.profile}")
    elif not summary.clips:
        note_empty(place.clips, f"none of {summary.sequences} sequences gave a clip")
