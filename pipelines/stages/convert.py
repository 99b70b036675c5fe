"""Stage convert: raw files to a store of clips; sequences that cannot be used are left out with their reason."""

from hoidata.lineage.manifests import read_manifest
from pipelines.stages.base import Place, StageParams, empty_reason, jobs, load_hands, load_params, raw_root, write_empty


class ConvertParams(StageParams):
    """Nothing to set yet: every rule of conversion is the source dataset's own."""


def run(place: Place) -> None:
    """Convert the dataset of ``place``; a dataset that is not present gives an empty output."""
    load_params(ConvertParams, "convert")
    manifest = read_manifest(place.raw_manifest)
    if not manifest.present:
        write_empty(place.clips, f"{place.dataset} is not present in the profile {place.profile}")
        return
    convert(place, manifest)


def convert(place: Place, manifest) -> None:
    """Read every sequence of the raw folder with its adapter, each file checked against the manifest."""
    from hoidata.adapters.convert import convert_dataset
    from hoidata.adapters.registry import get_adapter

    adapter, root = get_adapter(place.dataset), raw_root(place)
    convert_dataset(adapter, root, load_hands(place.profile), place.clips, manifest.by_path, jobs())
