"""Keyframes of an object's motion, from CSV or JSON.

CSV has one row per keyframe; JSON is a list of objects, or ``{"keyframes": [...]}``. Column names carry the unit:

- ``time_s`` or ``time_ms``.
- ``x_m y_m z_m`` (or ``_cm``, ``_mm``): translation from the start; z is the height above the table.
- ``qw qx qy qz``, or an axis-angle ``rx_deg ry_deg rz_deg`` (or ``_rad``): rotation about the object's centre.
- ``hinge_deg`` (or ``hinge_rad``): hinge angle; 0 is the angle of the mesh file.
- ``slide_cm`` (or ``_m``, ``_mm``) instead: displacement of a drawer.

Missing columns are zero. Rotations about a single axis may exceed half a turn: ``rz_deg`` 0, then 360 is a full turn.
"""

import csv
import difflib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.object_paths.path import (
    MAX_S,
    ObjectPath,
    PathStep,
    check_mean_rate,
    checked_path,
    frame_times,
    joint_rate,
    smooth,
)
from hoidata.objects.model import ObjectModel

MAX_BYTES, MAX_KEYS = 2**20, 5000
# Between keyframes about different axes. Near half a turn the direction of the rotation is ambiguous.
MAX_ROTATION_RAD = np.radians(170)
SAME_AXIS_RAD = 1e-6
_FACTORS = {"s": 1.0, "ms": 1e-3, "m": 1.0, "cm": 0.01, "mm": 0.001, "rad": 1.0, "deg": float(np.pi / 180)}
_UNITS = {name: ("m", "cm", "mm") for name in (*"xyz", "slide")} | {
    name: ("deg", "rad") for name in ("rx", "ry", "rz", "hinge")
}
_COLUMNS = {f"{name}_{unit}": (name, _FACTORS[unit]) for name, units in _UNITS.items() for unit in units} | {
    "time_s": ("time", 1.0),
    "time_ms": ("time", 1e-3),
    **{name: (name, 1.0) for name in ("qw", "qx", "qy", "qz")},
}


@dataclass(frozen=True, eq=False)
class Keyframes:
    """Keyframes of one object; rotation and translation are relative to its pose at the start."""

    time_s: np.ndarray  # (key,) ascending from 0
    shift_m: np.ndarray  # (key, 3)
    rotmats: np.ndarray  # (key, 3, 3)
    hinge_rad: np.ndarray | None  # (key,), metres of a slide; None without a column for the joint
    rotvec_rad: np.ndarray | None = None  # (key, 3) axis-angles of any length, None for quaternions
    is_slide: bool = False  # whether ``hinge_rad`` is a slide


def read_keyframes(path: str | Path) -> Keyframes:
    """Read keyframes from a .csv or .json file. Raises BadInput for a file or value that cannot be used."""
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "a .csv or .json file of keyframes", "no file", "correct the path")
    if path.stat().st_size > MAX_BYTES:
        raise BadInput(path, f"at most {MAX_BYTES} bytes", f"{path.stat().st_size}", "use fewer keyframes")
    return parse_keyframes(path.read_bytes(), str(path))


def parse_keyframes(data: bytes, source: str) -> Keyframes:
    """Parse JSON if ``data`` begins with a bracket, else CSV. source: where it is from, for messages."""
    try:
        text = data.decode("utf-8-sig")
        rows = _json_rows(text, source) if text.lstrip()[:1] in ("[", "{") else _csv_rows(text, source)
    except (UnicodeDecodeError, csv.Error, json.JSONDecodeError, RecursionError) as error:
        raise BadInput(source, "CSV or JSON text", f"{type(error).__name__}: {error}", "export it again") from error
    if not 2 <= len(rows) <= MAX_KEYS:
        raise BadInput(source, f"2 to {MAX_KEYS} keyframes", f"{len(rows)}", "add or remove keyframes")
    return _keyframes(_columns(rows, source), len(rows), source)


def keyframed_path(
    model: ObjectModel,
    keys: Keyframes,
    limits_rad: tuple[float, float] | None = None,
    source: str = "keyframes",
    standing: np.ndarray | None = None,
) -> ObjectPath:
    """Interpolate keyframes to 30 frames per second; the object reaches each keyframe at its time.

    Args:
        limits_rad: smallest and largest joint position, radians or metres, if known.
        source: where the keyframes are from, for messages.
        standing: as in ``checked_path``.

    Raises BadInput: joint positions that do not fit the object's joint, an ambiguous rotation, or a path that
    ``checked_path`` refuses.
    """
    _check_joint(model, keys, source)
    steps = [
        PathStep(f"keyframes {number + 1} to {number + 2}", float(start), float(end))
        for number, (start, end) in enumerate(zip(keys.time_s[:-1], keys.time_s[1:], strict=True))
    ]
    hinge = np.zeros(len(keys.time_s)) if keys.hinge_rad is None else keys.hinge_rad
    rotations = _rotations_between(keys, source)
    for step, shift, rotation, swing in zip(
        steps, np.diff(keys.shift_m, axis=0), rotations, np.diff(hinge)[:, None], strict=True
    ):
        check_mean_rate(step, shift, "m/s")
        check_mean_rate(step, rotation, "rad/s")
        check_mean_rate(step, swing, joint_rate(model))
    at_s = frame_times(float(keys.time_s[-1]))
    shift_m, hinge_rad = smooth(keys.time_s, keys.shift_m, at_s), smooth(keys.time_s, hinge, at_s)
    rotmats = _interpolated_rotations(keys, rotations, at_s)
    return checked_path(model, shift_m, rotmats, hinge_rad, steps, limits_rad, standing)


def _check_joint(model: ObjectModel, keys: Keyframes, source: str) -> None:
    if keys.hinge_rad is None or not keys.hinge_rad.any():
        return
    if model.hinge is None:
        remedy = (
            'give the hinge (a mesh file: --hinge "px,py,pz dx,dy,dz"; a URDF: a movable joint), or remove the column'
        )
        raise BadInput(source, f"no hinge angle: {model.name!r} is rigid", "a column hinge_...", remedy)
    if model.hinge.is_prismatic != keys.is_slide:
        columns = ("hinge_deg", "slide_cm")
        expected, got = columns[model.hinge.is_prismatic], columns[keys.is_slide]
        kind = "slides" if model.hinge.is_prismatic else "turns"
        raise BadInput(source, f"a column {expected}: {model.name!r} {kind}", f"a column {got}", "rename the column")


def _rotations_between(keys: Keyframes, source: str) -> np.ndarray:
    """(key - 1, 3) axis-angle from each keyframe to the next.

    About a single axis the written angle counts, so that it may exceed half a turn. Otherwise it is the smaller
    rotation. Raises BadInput if that is ambiguous.
    """
    shorter = rotmat_to_rotvec(keys.rotmats[1:] @ keys.rotmats[:-1].swapaxes(1, 2))
    written = shorter if keys.rotvec_rad is None else np.diff(keys.rotvec_rad, axis=0)
    if keys.rotvec_rad is not None and _common_axis(keys.rotvec_rad) is not None:
        return written
    size = np.linalg.norm(written, axis=1)
    if size.max() > MAX_ROTATION_RAD:
        key, got = int(size.argmax()) + 2, f"{np.degrees(size.max()):.0f} deg"
        remedy = "add a key in between, or rotate about one axis alone"
        raise BadInput(f"{source}: key {key}", "rotations of less than 170 deg from key to key", got, remedy)
    return shorter


def _interpolated_rotations(keys: Keyframes, rotations: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Interpolate rotations at times ``at_s``: (frame, 3, 3). About a common axis if they have one, else by slerp."""
    axis = _common_axis(rotations)
    if axis is not None:
        angle = smooth(keys.time_s, np.append(0.0, np.cumsum(rotations @ axis)), at_s)
        return Rotation.from_rotvec(angle[:, None] * axis).as_matrix() @ keys.rotmats[0]
    quaternions = Rotation.from_matrix(keys.rotmats).as_quat()
    # A quaternion and its negative are the same rotation; successive ones get the same sign.
    flips = np.cumprod(np.concatenate(([1.0], np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0))))
    return Rotation.from_quat(smooth(keys.time_s, quaternions * flips[:, None], at_s)).as_matrix()


def _common_axis(rotvec_rad: np.ndarray) -> np.ndarray | None:
    """(3,) the single axis of all axis-angles (key, 3), or None; the z axis without any rotation."""
    size = np.linalg.norm(rotvec_rad, axis=1)
    longest = rotvec_rad[size.argmax()]
    axis = longest / size.max() if size.max() > SAME_AXIS_RAD else np.array([0.0, 0.0, 1.0])
    across = rotvec_rad - (rotvec_rad @ axis)[:, None] * axis
    return axis if np.abs(across).max() < SAME_AXIS_RAD else None


def _csv_rows(text: str, source: str) -> list[dict[str, object]]:
    table = [cells for cells in csv.reader(io.StringIO(text)) if cells and not cells[0].lstrip().startswith("#")]
    names = [name.strip() for name in table[0]] if table else []
    if len(set(names)) < len(names):
        raise BadInput(source, "a header with each column once", ", ".join(names)[:200], "correct the header")
    for number, cells in enumerate(table[1:], 1):
        if len(cells) != len(names):
            raise BadInput(f"{source}: key {number}", f"{len(names)} numbers", f"{len(cells)}", "correct the row")
    return [dict(zip(names, cells, strict=True)) for cells in table[1:]]


def _json_rows(text: str, source: str) -> list[dict[str, object]]:
    content = json.loads(text)
    rows = content.get("keyframes") if isinstance(content, dict) else content
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise BadInput(source, 'a list of objects, or {"keyframes": [...]}', text[:80], "see the README")
    first = rows[0].keys() if rows else ()
    if any(row.keys() != first for row in rows):
        raise BadInput(source, "the same names in every keyframe", "other names", "write all names in each keyframe")
    return rows


def _columns(rows: Sequence[Mapping[str, object]], source: str) -> dict[str, np.ndarray]:
    """Values (key,) by column name without unit, in metres, radians and seconds."""
    columns = {}
    for header in rows[0]:
        if header not in _COLUMNS:
            raise BadInput(source, f"columns named {', '.join(_COLUMNS)}", str(header)[:40], _better_name(str(header)))
        name, factor = _COLUMNS[header]
        if name in columns:
            raise BadInput(source, f"{name} in one unit", f"{header} and another unit", "remove one of the columns")
        columns[name] = np.array(
            [_number(row[header], f"{source}: key {k}: {header}") for k, row in enumerate(rows, 1)]
        )
        _check_radians(header, columns[name], source)
        columns[name] *= factor
    return columns


def _check_radians(header: str, values: np.ndarray, source: str) -> None:
    """Raise BadInput for an angle in radians that is probably in degrees."""
    if header.endswith("_rad") and np.abs(values).max() > 2 * np.pi + SAME_AXIS_RAD:
        key = int(np.abs(values).argmax())
        remedy = f"call it {header.replace('_rad', '_deg')}, if these are degrees"
        raise BadInput(f"{source}: key {key + 1}: {header}", "at most one turn, 6.283 rad", f"{values[key]:g}", remedy)


def _better_name(name: str) -> str:
    lower = name.lower()
    if lower in ("time", "t", *_UNITS):
        with_unit = [column for column, (name, _) in _COLUMNS.items() if name[:1] == lower[:1]]
        return f"write the unit in the name: {', '.join(with_unit)}"
    matches = difflib.get_close_matches(lower, _COLUMNS, 1, 0.5)
    return f"did you mean {matches[0]}?" if matches else "correct the name, or remove the column"


def _number(value: object, source: str) -> float:
    try:
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise ValueError
        number = float(value)
        if not abs(number) < 1e6:
            raise ValueError
    except (ValueError, OverflowError) as error:
        raise BadInput(source, "a number below a million", str(value)[:40], "correct it") from error
    return number


def _keyframes(columns: dict[str, np.ndarray], count: int, source: str) -> Keyframes:
    if "time" not in columns:
        raise BadInput(source, "a column time_s", ", ".join(columns), "add the time of every key")
    zero = np.zeros(count)
    time_s = columns["time"] - columns["time"][0]
    if (np.diff(time_s) < 1e-3).any():
        key = int((np.diff(time_s) < 1e-3).argmax()) + 2
        got = f"{columns['time'][key - 1]:g} s"
        raise BadInput(f"{source}: key {key}", "a time after the key before", got, "sort the keyframes by time")
    if time_s[-1] > MAX_S:
        remedy = "they look like milliseconds: call the column time_ms" if time_s[-1] > 1000 else "shorten it"
        raise BadInput(f"{source}: time_s", f"at most {MAX_S:g} s", f"{time_s[-1]:g} s", remedy)
    shift = np.stack([columns.get(name, zero) for name in "xyz"], axis=1)
    if np.abs(shift).max() > 5:
        got = f"{np.abs(shift).max():g} m"
        raise BadInput(source, "positions within 5 m", got, "write the unit of the numbers: x_cm or x_mm")
    if "hinge" in columns and "slide" in columns:
        raise BadInput(source, "hinge_... or slide_...", "both", "an object has one joint: remove one of the columns")
    joint = columns.get("hinge", columns.get("slide"))
    rotation = _rotation_columns(columns, count, source)
    if isinstance(rotation, Rotation):
        return Keyframes(time_s, shift, rotation.as_matrix(), joint, is_slide="slide" in columns)
    rotmats = Rotation.from_rotvec(rotation).as_matrix()
    return Keyframes(time_s, shift, rotmats, joint, rotation, is_slide="slide" in columns)


def _rotation_columns(columns: dict[str, np.ndarray], count: int, source: str) -> np.ndarray | Rotation:
    """Axis-angles (key, 3) in radians without reduction to half a turn, or the rotations of quaternion columns."""
    zero, quaternion, axis_angle = np.zeros(count), ("qx", "qy", "qz", "qw"), ("rx", "ry", "rz")
    present = [name for name in quaternion if name in columns]
    if not present:
        return np.stack([columns.get(name, zero) for name in axis_angle], axis=1)
    if len(present) < 4 or any(name in columns for name in axis_angle):
        raise BadInput(source, "qw, qx, qy and qz, or rx, ry and rz", ", ".join(columns), "write one of the two, whole")
    values = np.stack([columns[name] for name in quaternion], axis=1)
    length = np.linalg.norm(values, axis=1)
    if np.abs(length - 1).max() > 0.01:
        key = int(np.abs(length - 1).argmax())
        got = f"one of length {length[key]:.3g} in key {key + 1}"
        raise BadInput(source, "quaternions of length 1", got, "write w, x, y, z of a rotation")
    return Rotation.from_quat(values)
