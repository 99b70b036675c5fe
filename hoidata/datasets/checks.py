"""Checks every adapter makes on raw numbers: each failure is a BadInput that names the file, expected and got."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import numpy as np

from hoidata.clips.clip import BodyTrack
from hoidata.errors import BadInput

BODY_COLUMNS = {"transl": 3, "global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}


def table(where: str, value: Any, columns: int, rows: int | None = None, row: str = "frames") -> np.ndarray:
    """``value`` as a finite float64 array (row, column).

    rows: how many are expected, None for any number from 1. row: what they are called in errors.
    """
    try:
        array = np.asarray(value)
    except ValueError as error:  # nested lists of unequal lengths
        raise BadInput(where, "rows of equal length", str(error)[:80]) from error
    if array.dtype.kind not in "fiu":
        raise BadInput(where, "numbers", f"an array of type {array.dtype}")
    if array.ndim != 2 or array.shape[1] != columns:
        raise BadInput(where, f"an array of {columns} columns", f"shape {array.shape}")
    if rows is not None and len(array) != rows:
        raise BadInput(where, f"{rows} {row}", f"{len(array)}")
    if not len(array):
        raise BadInput(where, "at least one frame", "none")
    finite(where, array)
    return array.astype(np.float64)


def finite(where: str, array: np.ndarray) -> None:
    """Refuse NaN and infinity, naming the first frame that holds one."""
    good = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if not good.all():
        raise BadInput(where, "finite numbers", f"NaN or infinity in row {int(np.argmin(good))}")


def body_track(where: str, params: Any, n_frames: int, further: Mapping[str, int] | None = None) -> BodyTrack:
    """The parameters of the person's SMPL-X body, float32.

    further: columns of the entries not every source has.
    """
    values = {
        name: table(f"{where}: {name}", entry(where, params, name), columns, n_frames).astype(np.float32)
        for name, columns in {**BODY_COLUMNS, **(further or {})}.items()
    }
    face = np.concatenate([values.pop(name) for name in ("jaw_pose", "leye_pose", "reye_pose")], axis=1)
    return BodyTrack(values.pop("transl"), face_pose=face, **values)


def rigid_transforms(folder: str, names: Sequence[str], matrices: np.ndarray) -> None:
    """Refuse 4x4 matrices (frame, 4, 4) that do not turn and shift column vectors, to 1e-3; names: file of each frame.

    A matrix written column by column has its shift in the last row, so it is noticed.
    """
    rotation, last_row = matrices[:, :3, :3], matrices[:, 3]
    turn_error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    error = np.maximum(turn_error, np.abs(last_row - (0, 0, 0, 1)).max(axis=1))
    bad = (error > 1e-3) | (np.linalg.det(rotation) < 0)
    if bad.any():
        first = int(bad.argmax())
        got = f"one off by {error[first]:.3g}" if error[first] > 1e-3 else "a mirror"
        raise BadInput(f"{folder}/{names[first]}", "a rotation and a shift above the row 0 0 0 1", got)


def entry(where: str, mapping: Any, key: str) -> Any:
    """``mapping[key]``, naming the file and the keys there are when it is missing."""
    if not isinstance(mapping, Mapping):
        raise BadInput(where, f"a dictionary with {key!r}", type(mapping).__name__)
    if key not in mapping:
        raise BadInput(where, f"the entry {key!r}", f"only {', '.join(sorted(map(str, mapping))) or 'none'}")
    return mapping[key]


def settings(adapter: Any) -> None:
    """Refuse a value that the type of its setting excludes: a whole number of 0 or more, true or false, a choice."""
    for name, kind in get_type_hints(type(adapter)).items():
        value = getattr(adapter, name)
        if kind is int and (isinstance(value, bool) or not isinstance(value, int) or value < 0):
            refuse_setting(adapter.name, name, "a whole number of 0 or more", value)
        if kind is bool and not isinstance(value, bool):
            refuse_setting(adapter.name, name, "true or false", value)
        if get_origin(kind) is Literal and value not in get_args(kind):
            refuse_setting(adapter.name, name, " or ".join(get_args(kind)), value)


def refuse_setting(adapter: str, name: str, expected: str, value: Any) -> NoReturn:
    raise BadInput(f"settings of the adapter {adapter}: {name}", expected, repr(value)[:40], "correct params.yaml")
