"""A folder of Parquet files for Hugging Face ``datasets``: a row per clip, a file per subset.

``datasets`` derives the features from the Arrow types. README.md names the file of each subset.
"""

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.exports.motion import CLIP_COLUMNS, COLUMNS, ExportedClip, frames_array, row_type

_TEXTS = ("clip_id", "subject", "sequence", "verb", "object", "object_words", "gravity_note")
_SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in _TEXTS),
        ("sentences", pa.list_(pa.string())),
        *((column.name, pa.list_(row_type(column))) for column in COLUMNS),
        *((column.name, row_type(column)) for column in CLIP_COLUMNS),
    ]
)
UNSPLIT = "unsplit"  # the file of clips without subset; datasets refuses "all"


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write data/<subset>.parquet; clips of one subset must follow each other."""
    (folder / "data").mkdir()
    for subset, group in groupby(clips, key=lambda item: item.subset):
        with pq.ParquetWriter(folder / "data" / f"{subset or UNSPLIT}.parquet", _SCHEMA) as parquet:
            for item in group:
                parquet.write_table(_row(item))


def _row(item: ExportedClip) -> pa.Table:
    """One clip as a table of one row."""
    arrays, facts = item.arrays(), item.facts
    values: list[Any] = [pa.array([facts[name]], pa.string()) for name in _TEXTS]
    values.append(pa.array([facts["sentences"]], pa.list_(pa.string())))
    offsets = pa.array(np.array([0, item.clip.n_frames], np.int32))
    values += [pa.ListArray.from_arrays(offsets, frames_array(arrays[c.name], c)) for c in COLUMNS]
    values += [
        pa.array([array.tolist()], row_type(c))
        for c, array in zip(CLIP_COLUMNS, item.clip_arrays().values(), strict=True)
    ]
    return pa.Table.from_arrays(values, schema=_SCHEMA)
