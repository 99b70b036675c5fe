"""Checks every adapter makes on raw numbers: each failure is a BadInput that names the file, expected and got."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hoidata.errors import BadInput


def table(where: str, value: Any, columns: int, rows: int | None = None) -> np.ndarray:
    """``value`` as a finite float64 array (row, column). rows: how many are expected, None for any number from 1."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise BadInput(where, "numbers", f"an array of type {array.dtype}")
    if array.ndim != 2 or array.shape[1] != columns:
        raise BadInput(where, f"an array of {columns} columns", f"shape {array.shape}")
    if rows is not None and len(array) != rows:
        raise BadInput(where, f"{rows} frames", f"{len(array)}")
    if not len(array):
        raise BadInput(where, "at least one frame", "none")
    finite(where, array)
    return array.astype(np.float64)


def finite(where: str, array: np.ndarray) -> None:
    """Refuse NaN and infinity, naming the first frame that holds one."""
    good = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if not good.all():
        raise BadInput(where, "finite numbers", f"NaN or infinity in row {int(np.argmin(good))}")


def rotations(where: str, matrices: np.ndarray) -> np.ndarray:
    """Refuse 3x3 matrices (frame, 3, 3) that are not proper rotations to 1e-3."""
    error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (error > 1e-3) | (np.linalg.det(matrices) < 0)
    if bad.any():
        raise BadInput(where, "rotation matrices", f"a matrix off by {error[bad].max():.3g} in row {int(bad.argmax())}")
    return matrices


def entry(where: str, mapping: Any, key: str) -> Any:
    """``mapping[key]``, naming the file and the keys there are when it is missing."""
    if not isinstance(mapping, Mapping):
        raise BadInput(where, f"a dictionary with {key!r}", type(mapping).__name__)
    if key not in mapping:
        raise BadInput(where, f"the entry {key!r}", f"only {', '.join(sorted(map(str, mapping))) or 'none'}")
    return mapping[key]
