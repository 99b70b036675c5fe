"""Checks of raw numbers for all adapters. A failed check raises BadInput with file, expected and actual value."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import numpy as np
import orjson

from hoidata.clips.clip import BodyTrack
from hoidata.errors import BadInput

BODY_COLUMNS = {"transl": 3, "global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}


def table(location: str, value: Any, columns: int, rows: int | None = None, row_name: str = "frames") -> np.ndarray:
    """Convert nested lists or an array to a finite float64 array of shape (rows, columns); else raise BadInput.

    location: file and entry, for errors. rows: required number; None accepts any number from 1. row_name: for errors.
    """
    try:
        array = np.asarray(value)
    except ValueError as error:  # nested lists of unequal lengths
        raise BadInput(location, "rows of equal length", str(error)[:80]) from error
    if array.dtype.kind not in "fiu":
        raise BadInput(location, "numbers", f"an array of type {array.dtype}")
    if array.ndim != 2 or array.shape[1] != columns:
        raise BadInput(location, f"an array of {columns} columns", f"shape {array.shape}")
    if rows is not None and len(array) != rows:
        raise BadInput(location, f"{rows} {row_name}", f"{len(array)}")
    if not len(array):
        raise BadInput(location, "at least one frame", "none")
    finite(location, array)
    return array.astype(np.float64)


def finite(location: str, array: np.ndarray) -> None:
    """Raise BadInput that names the first row with NaN or infinity. array: (row, ...)."""
    good = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if not good.all():
        raise BadInput(location, "finite numbers", f"NaN or infinity in row {int(np.argmin(good))}")


def body_track(location: str, params: Any, n_frames: int, further: Mapping[str, int] | None = None) -> BodyTrack:
    """The person's SMPL-X body, float32. params: entries of ``BODY_COLUMNS`` and ``further``, each (frame, column)."""
    values = {
        name: table(f"{location}: {name}", entry(location, params, name), columns, n_frames).astype(np.float32)
        for name, columns in {**BODY_COLUMNS, **(further or {})}.items()
    }
    face = np.concatenate([values.pop(name) for name in ("jaw_pose", "leye_pose", "reye_pose")], axis=1)
    return BodyTrack(values.pop("transl"), face_pose=face, **values)


def rigid_transforms(folder: str, names: Sequence[str], matrices: np.ndarray) -> None:
    """Raise BadInput unless all matrices (frame, 4, 4) are rigid transforms of column vectors, to 1e-3.

    Detects transposed matrices, because these have the translation in the last row. names: file of each frame.
    """
    rotation, last_row = matrices[:, :3, :3], matrices[:, 3]
    rotation_error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    error = np.maximum(rotation_error, np.abs(last_row - (0, 0, 0, 1)).max(axis=1))
    bad = (error > 1e-3) | (np.linalg.det(rotation) < 0)
    if bad.any():
        first = int(bad.argmax())
        got = f"one off by {error[first]:.3g}" if error[first] > 1e-3 else "a mirror"
        raise BadInput(f"{folder}/{names[first]}", "a rotation and a shift above the row 0 0 0 1", got)


def json_value(location: str, data: bytes) -> Any:
    """Parse JSON. Raises BadInput that names the location."""
    try:
        return orjson.loads(data)
    except ValueError as error:  # orjson.JSONDecodeError, or text in another encoding
        raise BadInput(location, "JSON text", str(error)[:80]) from error


def entry(location: str, mapping: Any, key: str) -> Any:
    """``mapping[key]``. Raises BadInput that lists the present keys if it is missing."""
    if not isinstance(mapping, Mapping):
        raise BadInput(location, f"a dictionary with {key!r}", type(mapping).__name__)
    if key not in mapping:
        raise BadInput(location, f"the entry {key!r}", f"only {', '.join(sorted(map(str, mapping))) or 'none'}")
    return mapping[key]


def settings(adapter: Any) -> None:
    """Raise BadInput if a setting's value does not fit its type: int of 0 or more, bool or a Literal."""
    for name, kind in get_type_hints(type(adapter)).items():
        value = getattr(adapter, name)
        if kind is int and (isinstance(value, bool) or not isinstance(value, int) or value < 0):
            refuse_setting(adapter.name, name, "a whole number of 0 or more", value)
        if kind is bool and not isinstance(value, bool):
            refuse_setting(adapter.name, name, "true or false", value)
        if get_origin(kind) is Literal and value not in get_args(kind):
            refuse_setting(adapter.name, name, " or ".join(get_args(kind)), value)


def refuse_setting(adapter: str, name: str, expected: str, value: Any) -> NoReturn:
    """Raise BadInput for the value of an adapter's setting."""
    raise BadInput(f"settings of the adapter {adapter}: {name}", expected, repr(value)[:40], "correct params.yaml")
