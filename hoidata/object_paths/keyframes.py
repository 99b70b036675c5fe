"""Keyframes of an object's motion, from CSV or JSON.

A row (or JSON object) per key; its names carry the unit. ``time_s``; ``x_m y_m z_m`` (or ``_cm``, ``_mm``): the way
from where the object stands at first, z its height above the table; ``qw qx qy qz``, or an axis-angle ``rx_deg ry_deg
rz_deg`` (or ``_rad``): its turn about its middle; ``hinge_deg`` (or ``hinge_rad``): 0 is as the mesh is drawn. What is
left out stays at zero. Turns about one axis are taken as they are written: ``rz_deg`` 0, then 360 is once round. JSON:
a list of such objects, or ``{"keyframes": [...]}``.
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
from hoidata.object_paths.path import MOST_S, ObjectPath, PathStep, check_mean_rate, checked_path, frame_times, smooth
from hoidata.objects.model import ObjectModel

MOST_BYTES, MOST_KEYS = 2**20, 5000
MOST_TURN_RAD = np.radians(170)  # between keys, where the way round is not told
SAME_AXIS_RAD = 1e-6
_FACTORS = {"s": 1.0, "ms": 1e-3, "m": 1.0, "cm": 0.01, "mm": 0.001, "rad": 1.0, "deg": float(np.pi / 180)}
_UNITS = {name: ("m", "cm", "mm") for name in "xyz"} | {name: ("deg", "rad") for name in ("rx", "ry", "rz", "hinge")}
_COLUMNS = {f"{name}_{unit}": (name, _FACTORS[unit]) for name, units in _UNITS.items() for unit in units} | {
    "time_s": ("time", 1.0),
    "time_ms": ("time", 1e-3),
    **{name: (name, 1.0) for name in ("qw", "qx", "qy", "qz")},
}


@dataclass(frozen=True, eq=False)
class Keyframes:
    """time_s (key,) rising from 0; shift_m (key, 3); rotmats (key, 3, 3); hinge_rad (key,), None where not told.

    rotvec_rad: (key, 3) the turns as they were written, of any length; None of quaternions.
    """

    time_s: np.ndarray
    shift_m: np.ndarray
    rotmats: np.ndarray
    hinge_rad: np.ndarray | None
    rotvec_rad: np.ndarray | None = None


def read_keyframes(path: str | Path) -> Keyframes:
    """Keyframes of a .csv or .json file. Raises BadInput that says which row, what was expected, and what to do."""
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "a .csv or .json file of keyframes", "nothing there", "correct the path")
    if path.stat().st_size > MOST_BYTES:
        raise BadInput(path, f"at most {MOST_BYTES} bytes", f"{path.stat().st_size}", "leave keys out")
    return parse_keyframes(path.read_bytes(), str(path))


def parse_keyframes(data: bytes, where: str) -> Keyframes:
    """The same from any bytes: JSON where they begin with a bracket, else CSV."""
    try:
        text = data.decode("utf-8-sig")
        rows = _json_rows(text, where) if text.lstrip()[:1] in ("[", "{") else _csv_rows(text, where)
    except (UnicodeDecodeError, csv.Error, json.JSONDecodeError, RecursionError) as error:
        raise BadInput(where, "CSV or JSON text", f"{type(error).__name__}: {error}", "export it anew") from error
    if not 2 <= len(rows) <= MOST_KEYS:
        raise BadInput(where, f"2 to {MOST_KEYS} keyframes", f"{len(rows)}", "add or leave out keys")
    return _keyframes(_columns(rows, where), len(rows), where)


def keyframed_path(
    model: ObjectModel,
    keys: Keyframes,
    limits_rad: tuple[float, float] | None = None,
    where: str = "keyframes",
    standing: np.ndarray | None = None,
) -> ObjectPath:
    """The motion through keyframes; each is reached at its time. limits_rad: stops of the hinge, where they are known.

    standing: as in ``checked_path``. Raises BadInput for a hinge angle of a rigid object, and for what ``checked_path``
    refuses.
    """
    if keys.hinge_rad is not None and keys.hinge_rad.any() and not model.is_articulated:
        remedy = 'tell the hinge (--hinge "px,py,pz dx,dy,dz"), or leave the column out'
        raise BadInput(where, f"no hinge angle: {model.name!r} is rigid", "a column hinge_...", remedy)
    steps = [
        PathStep(f"keyframes {number + 1} to {number + 2}", float(start), float(end))
        for number, (start, end) in enumerate(zip(keys.time_s[:-1], keys.time_s[1:], strict=True))
    ]
    hinge = np.zeros(len(keys.time_s)) if keys.hinge_rad is None else keys.hinge_rad
    turns = _turns(keys, where)
    for step, way, turn, swing in zip(
        steps, np.diff(keys.shift_m, axis=0), turns, np.diff(hinge)[:, None], strict=True
    ):
        check_mean_rate(step, way, "m/s")
        check_mean_rate(step, turn, "rad/s")
        check_mean_rate(step, swing, "rad/s of the hinge")
    at_s = frame_times(float(keys.time_s[-1]))
    shift, angle = smooth(keys.time_s, keys.shift_m, at_s), smooth(keys.time_s, hinge, at_s)
    turned = _turned(keys, turns, at_s)
    return checked_path(model, shift, turned, angle, steps, limits_rad, standing)


def _turns(keys: Keyframes, where: str) -> np.ndarray:
    """(key - 1, 3) turn from each key to the next: as far round as it is written about one axis, else the shorter way.

    Raises BadInput where the shorter way may not be the one that is meant.
    """
    shorter = rotmat_to_rotvec(keys.rotmats[1:] @ keys.rotmats[:-1].swapaxes(1, 2))
    written = shorter if keys.rotvec_rad is None else np.diff(keys.rotvec_rad, axis=0)
    if keys.rotvec_rad is not None and _common_axis(keys.rotvec_rad) is not None:
        return written
    size = np.linalg.norm(written, axis=1)
    if size.max() > MOST_TURN_RAD:
        key, got = int(size.argmax()) + 2, f"{np.degrees(size.max()):.0f} deg"
        remedy = "add a key in between, or turn about one axis alone"
        raise BadInput(f"{where}: key {key}", "turns of less than 170 deg from key to key", got, remedy)
    return shorter


def _turned(keys: Keyframes, turns: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """(frame, 3, 3) turns at ``at_s``: of the angle where all are about one axis, else of quaternions."""
    axis = _common_axis(turns)
    if axis is not None:
        angle = smooth(keys.time_s, np.append(0.0, np.cumsum(turns @ axis)), at_s)
        return Rotation.from_rotvec(angle[:, None] * axis).as_matrix() @ keys.rotmats[0]
    quaternions = Rotation.from_matrix(keys.rotmats).as_quat()
    flips = np.cumprod(np.concatenate(([1.0], np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0))))
    return Rotation.from_quat(smooth(keys.time_s, quaternions * flips[:, None], at_s)).as_matrix()


def _common_axis(rotvec_rad: np.ndarray) -> np.ndarray | None:
    """(3,) the unit axis that all of (row, 3) turn about, either way; None where there is none, any for no turn."""
    size = np.linalg.norm(rotvec_rad, axis=1)
    longest = rotvec_rad[size.argmax()]
    axis = longest / size.max() if size.max() > SAME_AXIS_RAD else np.array([0.0, 0.0, 1.0])
    across = rotvec_rad - (rotvec_rad @ axis)[:, None] * axis
    return axis if np.abs(across).max() < SAME_AXIS_RAD else None


def _csv_rows(text: str, where: str) -> list[dict[str, object]]:
    table = [row for row in csv.reader(io.StringIO(text)) if row and not row[0].lstrip().startswith("#")]
    names = [name.strip() for name in table[0]] if table else []
    if len(set(names)) < len(names):
        raise BadInput(where, "a header with each column once", ", ".join(names)[:200], "correct the header")
    for number, row in enumerate(table[1:], 1):
        if len(row) != len(names):
            raise BadInput(f"{where}: key {number}", f"{len(names)} numbers", f"{len(row)}", "correct the row")
    return [dict(zip(names, row, strict=True)) for row in table[1:]]


def _json_rows(text: str, where: str) -> list[dict[str, object]]:
    found = json.loads(text)
    rows = found.get("keyframes") if isinstance(found, dict) else found
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise BadInput(where, 'a list of objects, or {"keyframes": [...]}', text[:80], "see the README")
    first = rows[0].keys() if rows else ()
    if any(row.keys() != first for row in rows):
        raise BadInput(where, "the same names in every keyframe", "some that differ", "write all of them in each")
    return rows


def _columns(rows: Sequence[Mapping[str, object]], where: str) -> dict[str, np.ndarray]:
    """(key,) numbers by name without unit: metres, radians, seconds."""
    columns = {}
    for written in rows[0]:
        if written not in _COLUMNS:
            raise BadInput(where, f"columns named {', '.join(_COLUMNS)}", str(written)[:40], _better_name(str(written)))
        name, factor = _COLUMNS[written]
        if name in columns:
            raise BadInput(where, f"{name} in one unit", f"{written} beside another", "leave one of them out")
        columns[name] = np.array(
            [_number(row[written], f"{where}: key {k}: {written}") for k, row in enumerate(rows, 1)]
        )
        _check_radians(written, columns[name], where)
        columns[name] *= factor
    return columns


def _check_radians(written: str, values: np.ndarray, where: str) -> None:
    """Raise BadInput for an angle in radians that only one in degrees can be meant by."""
    if written.endswith("_rad") and np.abs(values).max() > 2 * np.pi + SAME_AXIS_RAD:
        key = int(np.abs(values).argmax())
        remedy = f"call it {written.replace('_rad', '_deg')}, if these are degrees"
        raise BadInput(f"{where}: key {key + 1}: {written}", "at most one turn, 6.283 rad", f"{values[key]:g}", remedy)


def _better_name(name: str) -> str:
    lower = name.lower()
    if lower in ("time", "t", *_UNITS):
        return f"write the unit in the name: {', '.join(c for c, (own, _) in _COLUMNS.items() if own[:1] == lower[:1])}"
    near = difflib.get_close_matches(lower, _COLUMNS, 1, 0.5)
    return f"did you mean {near[0]}?" if near else "correct the name, or leave the column out"


def _number(value: object, where: str) -> float:
    try:
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise ValueError
        number = float(value)
        if not abs(number) < 1e6:
            raise ValueError
    except (ValueError, OverflowError) as error:
        raise BadInput(where, "a number below a million", str(value)[:40], "correct it") from error
    return number


def _keyframes(columns: dict[str, np.ndarray], count: int, where: str) -> Keyframes:
    if "time" not in columns:
        raise BadInput(where, "a column time_s", ", ".join(columns), "add the time of every key")
    zero = np.zeros(count)
    time_s = columns["time"] - columns["time"][0]
    if (np.diff(time_s) < 1e-3).any():
        row = int((np.diff(time_s) < 1e-3).argmax()) + 2
        raise BadInput(
            f"{where}: key {row}", "a time after the key before", f"{columns['time'][row - 1]:g} s", "sort them"
        )
    if time_s[-1] > MOST_S:
        remedy = "they look like milliseconds: call the column time_ms" if time_s[-1] > 1000 else "shorten it"
        raise BadInput(f"{where}: time_s", f"at most {MOST_S:g} s", f"{time_s[-1]:g} s", remedy)
    shift = np.stack([columns.get(name, zero) for name in "xyz"], axis=1)
    if np.abs(shift).max() > 5:
        got = f"{np.abs(shift).max():g} m"
        raise BadInput(where, "places within 5 m", got, "write the unit the numbers have: x_cm or x_mm")
    turn = _written_turns(columns, count, where)
    if isinstance(turn, Rotation):
        return Keyframes(time_s, shift, turn.as_matrix(), columns.get("hinge"))
    return Keyframes(time_s, shift, Rotation.from_rotvec(turn).as_matrix(), columns.get("hinge"), turn)


def _written_turns(columns: dict[str, np.ndarray], count: int, where: str) -> np.ndarray | Rotation:
    """(key, 3) axis-angles as they are written, radians, or the rotations that quaternions are."""
    zero, quaternion, turn = np.zeros(count), ("qx", "qy", "qz", "qw"), ("rx", "ry", "rz")
    given = [name for name in quaternion if name in columns]
    if not given:
        return np.stack([columns.get(name, zero) for name in turn], axis=1)
    if len(given) < 4 or any(name in columns for name in turn):
        raise BadInput(where, "qw, qx, qy and qz, or rx, ry and rz", ", ".join(columns), "write one of the two, whole")
    values = np.stack([columns[name] for name in quaternion], axis=1)
    length = np.linalg.norm(values, axis=1)
    if np.abs(length - 1).max() > 0.01:
        row = int(np.abs(length - 1).argmax())
        got = f"one of length {length[row]:.3g} in key {row + 1}"
        raise BadInput(where, "quaternions of length 1", got, "write w, x, y, z of a rotation")
    return Rotation.from_quat(values)
