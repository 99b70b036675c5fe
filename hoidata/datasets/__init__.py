"""Adapters of the source datasets, one folder each: they convert raw files to clips."""

from hoidata.dataset_folders import outside_folders

# A user's dataset folder is importable as a subpackage like the built-in ones, in worker processes too.
__path__.extend(sorted({str(folder.parent) for folder in outside_folders().values()} - set(__path__)))

from hoidata.datasets.base import Adapter, AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey  # noqa: E402
from hoidata.datasets.registry import adapter_names, get_adapter  # noqa: E402

__all__ = [
    "Adapter",
    "AdapterBase",
    "DatasetPart",
    "Quarantined",
    "RawTree",
    "SequenceKey",
    "adapter_names",
    "get_adapter",
]
