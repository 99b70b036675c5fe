"""Trajectories of wrists and an object from files: CSV, NPZ, and the text files of ManipNet's demo.

CSV: a header, then one line per frame, columns in any order: ``time_s``, and for each of ``object``, ``left`` and
``right`` (one hand may be left out) the seven ``<body>_x _y _z _qw _qx _qy _qz``; ``hinge_rad`` for a hinged object.
NPZ: ``time_s (frame,)``, ``<body>_position (frame, 3)``, ``<body>_quaternion (frame, 4)`` with w first, ``hinge_rad``.
Positions in metres, or in the unit that is told; a right-handed world. The object's are those of its mesh file's origin
and axes; a wrist's are those of the hand model's wrist joint, or, where told, x to the fingers, y to the thumb and z
out of the back of a right hand, a left hand its mirror image with x away from the fingers.

ManipNet's: the frame rate, then object, left wrist, right wrist, each ``qx qy qz qw px py pz``, in left-handed
decimetres with y up; the object's position is the middle of its bounding box.
"""

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.files.numpy_files import load_npz_arrays
from hoidata.objects.user_mesh import UNITS_M

Axes = Literal["model", "canonical"]
BODIES = ("object", *SIDES)
PARTS = ("x", "y", "z", "qw", "qx", "qy", "qz")
ENDINGS = (".csv", ".npz", ".txt")
FASTEST_HZ, SLOWEST_HZ = 1000.0, 5.0
LONGEST_STEP_S = 1.0  # over a longer pause nobody knows where hands were
LARGEST = 1e30  # of any number: squares of it are numbers still
MOST_BYTES, MOST_FRAMES, LONGEST_LINE = 64 * 2**20, 200_000, 1 << 16
MANIPNET_UNIT = "dm"  # of the release's trajectories and meshes
_MIRROR_POSITION, _MIRROR_QUATERNION = np.array([-1.0, 1, 1]), np.array([1.0, 1, -1, -1])


@dataclass(frozen=True, eq=False)
class Body:
    """position_m: (frame, 3). rotmats: (frame, 3, 3), world_from_body."""

    position_m: np.ndarray
    rotmats: np.ndarray


@dataclass(frozen=True, eq=False)
class TrajectoryFile:
    """What a file says. axes: of the wrists. at_box: the object's position is the middle of its bounding box.

    up: (3,) where the file's kind says so, else None. mesh_unit: of the meshes that come with files of this kind. unit:
    of the positions, as it was told; "" where the file's kind says unit and axes.
    """

    where: str
    time_s: np.ndarray
    wrists: Mapping[Side, Body]
    thing: Body
    hinge_rad: np.ndarray | None = None
    axes: Axes = "model"
    at_box: bool = False
    up: tuple[float, float, float] | None = None
    mesh_unit: str = ""
    unit: str = "m"


def read_trajectories(path: Path, unit: str = "", axes: Axes = "model") -> TrajectoryFile:
    """Read a file by its ending. Raises BadInput that names the line, column or array and what to do.

    unit, axes: as they are told of a CSV or NPZ file; metres where no unit is.
    """
    if unit and unit not in UNITS_M:
        raise BadInput("--trajectory-unit", f"one of {', '.join(UNITS_M)}", unit, "name the unit of the positions")
    if path.suffix.lower() not in ENDINGS:
        is_packed = path.suffix.lower() == ".gz"
        remedy = f"unpack it: gunzip --keep {path}" if is_packed else "export it as one of these"
        raise BadInput(path, f"a file of trajectories ({', '.join(ENDINGS)})", f"{path.suffix or 'no ending'}", remedy)
    if not path.is_file():
        raise BadInput(path, f"a file of trajectories ({', '.join(ENDINGS)})", "nothing there", "correct the path")
    if path.stat().st_size > MOST_BYTES:
        raise BadInput(path, f"at most {MOST_BYTES} bytes", f"{path.stat().st_size}", "cut it into pieces")
    if path.suffix.lower() == ".npz":
        found = from_arrays(load_npz_arrays(path), str(path), unit or "m")
    elif path.suffix.lower() == ".csv":
        found = parse_csv(path.read_bytes(), str(path), unit or "m")
    elif unit or axes != "model":
        told = f"--trajectory-unit {unit}" if unit else f"--wrist-axes {axes}"
        raise BadInput(path, "no unit or axes beside ManipNet's text, which says both", told, "leave it out")
    else:
        return parse_manipnet(path.read_bytes(), str(path))
    return replace(found, axes=axes)


def parse_csv(data: bytes, where: str, unit: str = "m") -> TrajectoryFile:
    """The CSV form, of any bytes."""
    try:
        # One more than there may be, so that too many are noticed and not kept.
        rows = list(islice(filter(None, csv.reader(_lines(data))), MOST_FRAMES + 2))
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadInput(where, "CSV text", f"{type(error).__name__}: {error}", "export it anew") from error
    names = [name.strip() for name in rows[0]] if rows else []
    if len(set(names)) < len(names):
        raise BadInput(where, "a header with each column once", ", ".join(names)[:200], "correct the header")
    table = _numbers(rows[1:], len(names), where)
    columns = dict(zip(names, table.T, strict=True))
    bodies = [body for body in BODIES if body == "object" or any(f"{body}_{part}" in columns for part in PARTS)]
    wanted = ["time_s", *(f"{body}_{part}" for body in bodies for part in PARTS)]
    if missing := [name for name in wanted if name not in columns]:
        got = f"none named {', '.join(missing)}"
        raise BadInput(where, "columns time_s and <object, left or right>_<x, y, z, qw, qx, qy, qz>", got, "add them")
    arrays = {"time_s": columns["time_s"]}
    for body in bodies:
        own = np.stack([columns[f"{body}_{part}"] for part in PARTS], axis=1)
        arrays |= {f"{body}_position": own[:, :3], f"{body}_quaternion": own[:, 3:]}
    if "hinge_rad" in columns:
        arrays["hinge_rad"] = columns["hinge_rad"]
    return from_arrays(arrays, where, unit)


def _lines(data: bytes) -> Iterator[str]:
    for line in io.StringIO(data.decode("utf-8-sig"), newline=""):
        if len(line) > LONGEST_LINE:
            raise csv.Error(f"a line of more than {LONGEST_LINE} characters")
        yield line


def from_arrays(arrays: Mapping[str, np.ndarray], where: str, unit: str = "m") -> TrajectoryFile:
    """The NPZ form; also what the CSV form becomes."""
    if "time_s" not in arrays:
        raise BadInput(where, "an array time_s", f"{', '.join(arrays) or 'none'}"[:200], "add the time of every frame")
    time_s = _array(arrays, "time_s", (), where)
    _check_times(time_s, where)
    there: list[Side] = [side for side in SIDES if f"{side}_position" in arrays]
    wrists: dict[Side, Body] = {side: _body(arrays, side, len(time_s), where, UNITS_M[unit]) for side in there}
    if not wrists:
        raise BadInput(where, "the wrist of a hand, left or right", "neither", "add left_... or right_...")
    thing = _body(arrays, "object", len(time_s), where, UNITS_M[unit])
    hinge = _array(arrays, "hinge_rad", (), where, len(time_s)) if "hinge_rad" in arrays else None
    return TrajectoryFile(where, time_s, wrists, thing, hinge, unit=unit)


def parse_manipnet(data: bytes, where: str) -> TrajectoryFile:
    """ManipNet's text files (packed ones are to be unpacked first), of any bytes."""
    told = (line for line in io.StringIO(data.decode("utf-8", "replace"), newline=None) if line.strip())
    lines = list(islice(told, MOST_FRAMES + 2))
    rate = _numbers([[lines[0]]], 1, where)[0, 0] if lines else 0.0
    if not SLOWEST_HZ <= rate <= FASTEST_HZ:
        remedy = "the first line of ManipNet's files is 120; other trajectories belong into a .csv or .npz"
        raise BadInput(where, "a frame rate in the first line", f"{lines[0][:40] if lines else 'nothing'}", remedy)
    table = _numbers([line.split(",") for line in lines[1:]], 21, where)
    arrays = {"time_s": np.arange(len(table)) / rate}
    for number, body in enumerate(BODIES):
        own = table[:, 7 * number : 7 * number + 7]
        arrays[f"{body}_quaternion"] = own[:, [3, 0, 1, 2]] * _MIRROR_QUATERNION
        arrays[f"{body}_position"] = own[:, 4:] * _MIRROR_POSITION
    found = from_arrays(arrays, where, MANIPNET_UNIT)
    return replace(found, axes="canonical", at_box=True, up=(0.0, 1.0, 0.0), mesh_unit=MANIPNET_UNIT, unit="")


def _numbers(rows: list[list[str]], count: int, where: str) -> np.ndarray:
    """(row, count) finite numbers."""
    if len(rows) > MOST_FRAMES:
        raise BadInput(where, f"at most {MOST_FRAMES} frames", f"{len(rows)}", "cut it into pieces")
    for number, row in enumerate(rows):
        if len(row) != count:
            raise BadInput(f"{where}: row {number + 1}", f"{count} numbers", f"{len(row)}", "correct the row")
    try:
        table = np.array([[float(word) for word in row] for row in rows], dtype=np.float64).reshape(len(rows), count)
    except ValueError as error:
        raise BadInput(where, "numbers", str(error)[:200], "correct the file") from error
    if not (sane := np.abs(table) < LARGEST).all():
        row = int(np.flatnonzero(~sane.all(axis=1))[0])
        raise BadInput(f"{where}: row {row + 1}", "finite numbers", "NaN or infinity", "cut the file there")
    return table


def _array(
    arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], where: str, count: int | None = None
) -> np.ndarray:
    """(frame, *shape) finite float64."""
    if name not in arrays:
        raise BadInput(where, f"an array {name}", "none", "add it")
    array = np.asarray(arrays[name])
    fits = array.ndim == 1 + len(shape) and array.shape[1:] == shape and len(array) == (count or len(array))
    if not fits or array.dtype.kind not in "fiu" or not (np.abs(array) < LARGEST).all():
        expected = f"finite numbers of shape ({count or 'frame'}, {', '.join(map(str, shape))})"
        raise BadInput(f"{where}: {name}", expected, f"{array.dtype} {array.shape}", "correct it")
    return array.astype(np.float64)


def _check_times(time_s: np.ndarray, where: str) -> None:
    steps = np.diff(time_s)
    if len(time_s) < 3 or (steps <= 0).any() or len(time_s) > MOST_FRAMES:
        expected = f"3 to {MOST_FRAMES} frames whose times rise"
        late = "" if len(time_s) < 2 or (steps > 0).all() else f", not after row {int((steps <= 0).argmax()) + 1}"
        raise BadInput(f"{where}: time_s", expected, f"{len(time_s)} frames{late}", "correct the times")
    step = float(np.median(steps))
    if not 1 / FASTEST_HZ <= step <= 1 / SLOWEST_HZ:
        likely = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
        found = [name for factor, name in likely.items() if 1 / FASTEST_HZ <= step * factor <= 1 / SLOWEST_HZ]
        remedy = f"they look like {found[0]}: divide them" if found else "write seconds"
        if np.allclose(steps, 1):
            remedy = "they look like frame numbers: divide them by the frame rate"
        expected = f"seconds, {SLOWEST_HZ:g} to {FASTEST_HZ:g} frames in each"
        raise BadInput(f"{where}: time_s", expected, f"a step of {step:g}", remedy)
    if steps.max() > LONGEST_STEP_S:
        row = int(steps.argmax()) + 1
        expected = f"steps of at most {LONGEST_STEP_S:g} s"
        raise BadInput(f"{where}: time_s", expected, f"{steps[row - 1]:g} s after row {row}", "cut the file there")


def _body(arrays: Mapping[str, np.ndarray], body: str, count: int, where: str, unit_m: float) -> Body:
    position = _array(arrays, f"{body}_position", (3,), where, count)
    quaternion = _array(arrays, f"{body}_quaternion", (4,), where, count)
    length = np.linalg.norm(quaternion, axis=1)
    if np.abs(length - 1).max() > 0.01:
        row = int(np.abs(length - 1).argmax())
        got = f"one of length {length[row]:.3g} in row {row + 1}"
        raise BadInput(f"{where}: {body}", "quaternions of length 1", got, "write w, x, y, z of a rotation")
    return Body(position * unit_m, Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix())
