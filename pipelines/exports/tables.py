"""Parquet files of the columns of ``motion.COLUMNS``: a row per clip (Hugging Face) or per frame (LeRobot)."""

from typing import Any

import numpy as np
import pyarrow as pa

from pipelines.exports.motion import Column

_ARROW = {"float32": pa.float32(), "int32": pa.int32(), "int64": pa.int64(), "bool": pa.bool_()}


def row_type(column: Column) -> pa.DataType:
    """The Arrow type of one frame: a value, or lists; of a fixed length but for -1, which pyarrow too takes for any."""
    kind: pa.DataType = _ARROW[column.dtype]
    for length in reversed(column.shape):
        kind = pa.list_(kind, length)
    return kind


def frames_array(values: np.ndarray, column: Column) -> pa.Array:
    """(frame, ...) values as an Arrow array with one row per frame."""
    array: Any = pa.array(np.ascontiguousarray(values, column.dtype).ravel())
    for length in reversed(column.shape):
        array = pa.FixedSizeListArray.from_arrays(array, length)
    return array
