"""A folder of Parquet files for Hugging Face ``datasets``: a row per clip, a file per subset.

The schema's metadata has the features in the format of ``datasets`` before release 4, which later releases also read.
README.md names the file of each subset.
"""

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.exports.motion import CLIP_COLUMNS, COLUMNS, Column, ExportedClip, frames_array, row_type

_TEXTS = ("clip_id", "subject", "sequence", "verb", "object", "object_words", "gravity_note")
UNSPLIT = "unsplit"  # the file of clips without subset; datasets refuses "all"


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write data/<subset>.parquet; clips of one subset must follow each other."""
    (folder / "data").mkdir()
    for subset, group in groupby(clips, key=lambda item: item.subset):
        with pq.ParquetWriter(folder / "data" / f"{subset or UNSPLIT}.parquet", _schema()) as parquet:
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
    return pa.Table.from_arrays(values, schema=_schema())


def _schema() -> pa.Schema:
    columns = [(name, pa.string(), _value("string")) for name in _TEXTS]
    columns += [("sentences", pa.list_(pa.string()), _list(_value("string")))]
    columns += [(column.name, pa.list_(row_type(column)), _list(_feature(column))) for column in COLUMNS]
    columns += [(column.name, row_type(column), _feature(column)) for column in CLIP_COLUMNS]
    # Nested fields are called "item", as datasets calls them.
    features = {name: feature for name, _, feature in columns}
    metadata = {"huggingface": orjson.dumps({"info": {"features": features}}).decode()}
    return pa.schema([(name, dtype) for name, dtype, _ in columns], metadata)


def _feature(column: Column) -> dict[str, Any]:
    feature = _value(column.dtype)
    for length in reversed(column.shape):
        feature = _list(feature, length)
    return feature


def _value(dtype: str) -> dict[str, Any]:
    return {"dtype": dtype, "_type": "Value"}


def _list(feature: dict[str, Any], length: int = -1) -> dict[str, Any]:
    """A list feature; length -1 means any. Its type is Sequence, since datasets before release 4 does not read List."""
    return {"feature": feature, "length": length, "_type": "Sequence"}
