"""Readers of source datasets: one file each, raw files in, clips out. The only room that knows a dataset's quirks."""

from hoidata.datasets.base import Adapter, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.datasets.registry import adapter_names, get_adapter

__all__ = ["Adapter", "DatasetPart", "Quarantined", "RawTree", "SequenceKey", "adapter_names", "get_adapter"]
