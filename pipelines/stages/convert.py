"""Stage convert: raw files to a store of clips; unusable sequences are quarantined with their reason."""

from hoidata.conversion.convert import convert_dataset
from pipelines.lineage.manifests import read_manifest
from pipelines.stages.adapters import configured_adapter, raw_files
from pipelines.stages.base import StagePaths, jobs, load_hands, note_empty


def run(paths: StagePaths) -> None:
    """Convert the dataset with its adapter and check all raw files against the manifest."""
    adapter = configured_adapter(paths.dataset)
    manifest = read_manifest(paths.raw_manifest)
    summary = convert_dataset(
        adapter,
        raw_files(paths) if manifest.present else None,
        load_hands(paths.profile),
        paths.clips,
        jobs=jobs(),
        manifest=manifest.files,
        synthetic=manifest.present and manifest.synthetic,
        stop_on_change=True,
    )
    if not manifest.present:
        note_empty(paths.clips, f"{paths.dataset} is not present in the profile {paths.profile}")
    elif not summary.clips:
        note_empty(paths.clips, f"none of {summary.sequences} sequences gave a clip")
