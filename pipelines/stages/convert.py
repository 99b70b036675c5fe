"""Stage convert: raw files to a store of clips; sequences that cannot be used are left out with their reason."""

from hoidata.conversion.convert import convert_dataset
from pipelines.lineage.manifests import read_manifest
from pipelines.stages.adapters import configured_adapter
from pipelines.stages.base import Place, jobs, load_hands, note_empty, raw_root


def run(place: Place) -> None:
    """Convert the dataset with its adapter, each raw file checked against the manifest; none present, none read."""
    adapter = configured_adapter(place.dataset)
    manifest = read_manifest(place.raw_manifest)
    try:
        summary = convert_dataset(
            adapter,
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
