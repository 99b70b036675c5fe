"""Readers of source datasets: a folder each, raw files in, clips out. The only room that knows a dataset's quirks."""

from hoidata.dataset_folders import outside_folders

# A folder of the user's own is a package of this room like the others, in worker processes too.
__path__.extend(sorted({str(folder.parent) for folder in outside_folders().values()} - set(__path__)))

from hoidata.datasets.base import Adapter, DatasetPart, Described, Quarantined, RawTree, SequenceKey  # noqa: E402
from hoidata.datasets.registry import adapter_names, get_adapter  # noqa: E402

__all__ = [
    "Adapter",
    "DatasetPart",
    "Described",
    "Quarantined",
    "RawTree",
    "SequenceKey",
    "adapter_names",
    "get_adapter",
]
