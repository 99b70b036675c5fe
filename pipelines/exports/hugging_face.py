"""A folder of Parquet that Hugging Face ``datasets`` loads: a row per clip, a file per subset.

The features stand in the schema's metadata, as ``datasets`` writes them; README.md names the file of each subset.
"""

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.exports.motion import COLUMNS, ExportedClip
from pipelines.exports.tables import frames_array, row_type

_TEXTS = ("clip_id", "subject", "sequence", "verb", "object", "object_words")
WHOLE = "all"  # the file of clips that are in no subset


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write data/<subset>.parquet; clips of one subset follow each other."""
    (folder / "data").mkdir()
    for subset, group in groupby(clips, key=lambda item: item.subset):
        with pq.ParquetWriter(folder / "data" / f"{subset or WHOLE}.parquet", _schema()) as parquet:
            for item in group:
                parquet.write_table(_row(item))


def _row(item: ExportedClip) -> pa.Table:
    """One clip as a table of one row."""
    arrays, facts = item.arrays(), item.facts
    values: list[Any] = [pa.array([facts[name]], pa.string()) for name in _TEXTS]
    values.append(pa.array([facts["sentences"]], pa.list_(pa.string())))
    offsets = pa.array(np.array([0, item.clip.n_frames], np.int32))
    values += [pa.ListArray.from_arrays(offsets, frames_array(arrays[c.name], c)) for c in COLUMNS]
    return pa.Table.from_arrays(values, schema=_schema())


def _schema() -> pa.Schema:
    fields: list[Any] = [(name, pa.string()) for name in _TEXTS]
    fields += [("sentences", pa.list_(pa.string()))]
    fields += [(column.name, pa.list_(row_type(column))) for column in COLUMNS]
    # Nested fields are called "item", as datasets calls them.
    features: dict[str, Any] = {name: _value("string") for name in _TEXTS} | {"sentences": _list(_value("string"))}
    for column in COLUMNS:
        feature = _value(column.dtype)
        for length in reversed(column.shape):
            feature = _list(feature, length)
        features[column.name] = _list(feature)
    return pa.schema(fields, {"huggingface": orjson.dumps({"info": {"features": features}}).decode()})


def _value(dtype: str) -> dict[str, Any]:
    return {"dtype": dtype, "_type": "Value"}


def _list(feature: dict[str, Any], length: int | None = None) -> dict[str, Any]:
    return {"feature": feature, "_type": "List"} | ({} if length is None else {"length": length})
