"""Parquet tables with a stated schema: equal rows, equal bytes (of one pyarrow version)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq


def write_table(path: str | Path, rows: Sequence[dict[str, Any]], schema: pa.Schema) -> None:
    """Write rows as one Parquet file, zstd-compressed. A missing key is null; raises ArrowInvalid for a wrong type."""
    pq.write_table(pa.Table.from_pylist(list(rows), schema), path, compression="zstd")
