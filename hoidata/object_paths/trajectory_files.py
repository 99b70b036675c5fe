"""Trajectories of wrists and an object from files: CSV, NPZ, and the text files of ManipNet's demo.

CSV, with commas, semicolons or tabs: a header, then one line per frame, columns in any order: ``time_s``, and for each
of ``object``, ``left`` and ``right`` (one hand may be missing) the seven ``<body>_x _y _z _qw _qx _qy _qz``;
``hinge_rad`` for a hinged object. With an object in each hand, ``left_object`` is the left hand's, and ``object`` the
right hand's. Other columns are ignored, unless they are named like those of a body. After semicolons, decimals may have
commas.
NPZ: ``time_s (frame,)``, ``<body>_position (frame, 3)``, ``<body>_quaternion (frame, 4)`` with w first, ``hinge_rad``.
A body is lost in frames with an empty cell or NaN, or if it jumps to 0, 0, 0 unrotated, as some trackers write; gaps of
up to ``MAX_STEP_S`` are interpolated.
Positions are in metres or the given unit, in a right-handed world. The object's pose is that of its mesh file's frame.
A wrist's pose has the axes of the hand model's wrist joint ("model"), or "canonical" axes: x to the fingers, y to the
thumb and z out of the back of a right hand; a left hand is the mirror image with x away from the fingers.

ManipNet's text: the frame rate, then object, left wrist, right wrist, each ``qx qy qz qw px py pz``, in left-handed
decimetres with y up; the object's position is the centre of its bounding box.
"""

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.files.numpy_files import load_npz_arrays
from hoidata.geometry.motion import Motion
from hoidata.objects.user_mesh import UNITS_M

Axes = Literal["model", "canonical"]
BODIES = ("object", *SIDES, "left_object")
PARTS = ("x", "y", "z", "qw", "qx", "qy", "qz")
ENDINGS = (".csv", ".npz", ".txt")
MAX_RATE_HZ, MIN_RATE_HZ = 1000.0, 5.0
MAX_STEP_S = 1.0  # interpolation over a longer pause would be a guess
MAX_SPEED_M_S = 10.0  # a faster body has jumped; recorded wrists reach 4 m/s
MAX_ABS_VALUE = 1e30  # its square is still finite
MIN_FRAMES, MAX_FRAMES = 3, 200_000
MAX_BYTES, MAX_LINE_LENGTH = 64 * 2**20, 1 << 16
MANIPNET_UNIT = "dm"  # of the release's trajectories and meshes
_MIRROR_POSITION, _MIRROR_QUATERNION = np.array([-1.0, 1, 1]), np.array([1.0, 1, -1, -1])


@dataclass(frozen=True, eq=False)
class TrajectoryFile:
    """The content of a trajectory file."""

    source: str  # its name, for errors
    wrists: Mapping[Side, Motion]  # one or both
    object_body: Motion
    hinge_rad: np.ndarray | None = None  # (frame,)
    left_object: Motion | None = None  # if the left hand has another object than ``object_body``
    axes: Axes = "model"  # of the wrists
    is_calibrated: bool = False  # whether a calibration has changed the wrists
    at_box: bool = False  # whether the object's position is the centre of its bounding box
    up: tuple[float, float, float] | None = None  # of the world; None if the format does not define it
    mesh_unit: str = ""  # of the meshes that belong to this format
    unit: str = "m"  # of the positions as given by the user; "" if the format defines unit and axes
    notes: tuple[str, ...] = ()  # for the user

    def with_bodies(self, change: Callable[[Motion], Motion]) -> "TrajectoryFile":
        wrists: dict[Side, Motion] = {side: change(body) for side, body in self.wrists.items()}
        return replace(self, wrists=wrists, object_body=change(self.object_body))

    def of(self, side: Side) -> "TrajectoryFile":
        """One hand of a file with two objects, with its object."""
        wrists: dict[Side, Motion] = {side: self.wrists[side]}
        if side == "right" or self.left_object is None:
            return replace(self, wrists=wrists, left_object=None)
        return replace(self, wrists=wrists, object_body=self.left_object, hinge_rad=None, left_object=None)


def read_trajectories(path: Path, unit: str = "", axes: Axes = "model") -> TrajectoryFile:
    """Read a file in the format of its suffix. Raises BadInput that names the line, column or array, and the remedy.

    unit, axes: of positions and wrists in a CSV or NPZ file; "": metres.
    """
    expected, suffix = f"a file of trajectories ({', '.join(ENDINGS)})", path.suffix.lower()
    if unit and unit not in UNITS_M:
        raise BadInput("--trajectory-unit", f"one of {', '.join(UNITS_M)}", unit, "name the unit of the positions")
    if suffix not in ENDINGS:
        remedy = f"unpack it: gunzip --keep {path}" if suffix == ".gz" else "export it as one of these"
        raise BadInput(path, expected, f"{path.suffix or 'no suffix'}", remedy)
    if not path.is_file():
        raise BadInput(path, expected, "nothing there", "correct the path")
    if path.stat().st_size > MAX_BYTES:
        raise BadInput(path, f"at most {MAX_BYTES} bytes", f"{path.stat().st_size}", "cut it into pieces")
    if suffix == ".npz":
        trajectories = from_arrays(load_npz_arrays(path), str(path), unit or "m")
    elif suffix == ".csv":
        trajectories = parse_csv(path.read_bytes(), str(path), unit or "m")
    elif unit or axes != "model":
        option = f"--trajectory-unit {unit}" if unit else f"--wrist-axes {axes}"
        raise BadInput(path, "no unit or axes for ManipNet's text, which defines both", option, "leave it out")
    else:
        return parse_manipnet(path.read_bytes(), str(path))
    return replace(trajectories, axes=axes)


def parse_csv(data: bytes, source: str, unit: str = "m") -> TrajectoryFile:
    """Parse the CSV format from any bytes."""
    try:
        lines = _lines(data)
        header = next(lines, "")
        separator = max(",;\t", key=header.count)
        # One row more than allowed shows that there are too many, without reading them all.
        rows = list(islice(filter(None, csv.reader(chain([header], lines), delimiter=separator)), MAX_FRAMES + 2))
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadInput(source, "CSV text", f"{type(error).__name__}: {error}", "export it again") from error
    names = [name.strip() for name in rows[0]] if rows else []
    if len(set(names)) < len(names):
        raise BadInput(source, "a header with each column once", ", ".join(names)[:200], "correct the header")
    bodies = [body for body in BODIES if body == "object" or any(f"{body}_{part}" in names for part in PARTS)]
    required = ["time_s", *(f"{body}_{part}" for body in bodies for part in PARTS)]
    expected = "columns time_s and <object, left or right>_<x, y, z, qw, qx, qy, qz>"
    if missing := [name for name in required if name not in names]:
        raise BadInput(source, expected, f"none named {', '.join(missing)}", "add them")
    read = [*required, *({"hinge_rad"} & set(names))]
    if unknown := [name for name in names if name not in read and name.rpartition("_")[2] in PARTS and "_" in name]:
        raise BadInput(source, expected, f"{', '.join(unknown)}"[:200], "correct the names, or remove the columns")
    if separator == ";":
        rows = [[cell.replace(",", ".") for cell in cells] for cells in rows]
    chosen = [names.index(name) for name in read]
    columns = dict(zip(read, _numbers(rows[1:], names, source, chosen).T, strict=True))
    arrays = {"time_s": columns["time_s"]}
    for body in bodies:
        values = np.stack([columns[f"{body}_{part}"] for part in PARTS], axis=1)
        arrays |= {f"{body}_position": values[:, :3], f"{body}_quaternion": values[:, 3:]}
    if "hinge_rad" in columns:
        arrays["hinge_rad"] = columns["hinge_rad"]
    return from_arrays(arrays, source, unit)


def _lines(data: bytes) -> Iterator[str]:
    for line in io.StringIO(data.decode("utf-8-sig"), newline=""):
        if len(line) > MAX_LINE_LENGTH:
            raise csv.Error(f"a line of more than {MAX_LINE_LENGTH} characters")
        yield line


def from_arrays(arrays: Mapping[str, np.ndarray], source: str, unit: str = "m") -> TrajectoryFile:
    """Build from the arrays of the NPZ format, which the CSV format is converted to."""
    if "time_s" not in arrays:
        raise BadInput(source, "an array time_s", f"{', '.join(arrays) or 'none'}"[:200], "add the time of every frame")
    time_s = _array(arrays, "time_s", (), source)
    _check_times(time_s, source)
    sides: list[Side] = [side for side in SIDES if f"{side}_position" in arrays]
    bodies: dict[Side, Motion] = {side: _body(arrays, side, time_s, source, UNITS_M[unit]) for side in sides}
    wrists: dict[Side, Motion] = {side: body for side, body in bodies.items() if len(body.time_s)}
    if not wrists:
        raise BadInput(source, "the wrist of a hand, left or right", "neither", "add left_... or right_...")
    object_body, hinge = _body(arrays, "object", time_s, source, UNITS_M[unit]), None
    if "hinge_rad" in arrays:
        angles = _array(arrays, "hinge_rad", (), source, len(time_s), may_be_lost=True)
        hinge = _array({"hinge_rad": angles[np.isin(time_s, object_body.time_s)]}, "hinge_rad", (), source)
    objects = {"object": object_body}
    if "left_object_position" in arrays:
        objects["left_object"] = _body(arrays, "left_object", time_s, source, UNITS_M[unit])
    for name, body in {**wrists, **objects}.items():
        gap_s = np.diff(np.r_[time_s[0], body.time_s, time_s[-1]]).max()
        if gap_s > MAX_STEP_S or not len(body.time_s):
            expected, got = f"gaps of at most {MAX_STEP_S:g} s", f"{name} lost for {gap_s:.2f} s"
            raise BadInput(source, expected, got, "cut the file there")
    first_s, last_s = object_body.time_s[[0, -1]]
    is_cut = first_s > time_s[0] or last_s < time_s[-1]
    notes = (f"the motion is cut to {first_s:.2f} to {last_s:.2f} s, where the object is tracked",) if is_cut else ()
    return TrajectoryFile(source, wrists, object_body, hinge, objects.get("left_object"), unit=unit, notes=notes)


def parse_manipnet(data: bytes, source: str) -> TrajectoryFile:
    """Parse ManipNet's text format, uncompressed, from any bytes."""
    nonempty_lines = (line for line in io.StringIO(data.decode("utf-8", "replace"), newline=None) if line.strip())
    lines = list(islice(nonempty_lines, MAX_FRAMES + 2))
    rate = _numbers([[lines[0]]], ["frame rate"], source)[0, 0] if lines else 0.0
    if not MIN_RATE_HZ <= rate <= MAX_RATE_HZ:
        remedy = "the first line of ManipNet's files is 120; other trajectories need the format .csv or .npz"
        raise BadInput(source, "a frame rate in the first line", f"{lines[0][:40] if lines else 'nothing'}", remedy)
    names = [f"number {number + 1}" for number in range(21)]
    table = _numbers([line.split(",") for line in lines[1:]], names, source)
    arrays = {"time_s": np.arange(len(table)) / rate}
    for number, body in enumerate(BODIES[:3]):
        columns = table[:, 7 * number : 7 * number + 7]
        arrays[f"{body}_quaternion"] = columns[:, [3, 0, 1, 2]] * _MIRROR_QUATERNION
        arrays[f"{body}_position"] = columns[:, 4:] * _MIRROR_POSITION
    trajectories = from_arrays(arrays, source, MANIPNET_UNIT)
    return replace(trajectories, axes="canonical", at_box=True, up=(0.0, 1.0, 0.0), mesh_unit=MANIPNET_UNIT, unit="")


def _numbers(
    rows: list[list[str]], names: Sequence[str], source: str, chosen: Sequence[int] | None = None
) -> np.ndarray:
    """(row, chosen column) numbers; NaN for an empty cell. names: of all columns."""
    chosen = range(len(names)) if chosen is None else chosen
    if len(rows) > MAX_FRAMES:
        raise BadInput(source, f"at most {MAX_FRAMES} frames", f"{len(rows)}", "cut it into pieces")
    table = np.empty((len(rows), len(chosen)))
    for number, cells in enumerate(rows):
        row_source = f"{source}: row {number + 1}"
        if len(cells) != len(names):
            raise BadInput(row_source, f"{len(names)} numbers", f"{len(cells)}", "correct the row")
        for index, column in enumerate(chosen):
            try:
                table[number, index] = float(cells[column]) if cells[column].strip() else np.nan
            except ValueError as error:
                got = ascii(cells[column][:40])
                raise BadInput(f"{row_source}, {names[column]}", "a number", got, "correct it") from error
    return table


def _array(
    arrays: Mapping[str, np.ndarray],
    name: str,
    shape: tuple[int, ...],
    source: str,
    count: int | None = None,
    may_be_lost: bool = False,
) -> np.ndarray:
    """(frame, *shape) finite float64, or NaN in frames in which a body is lost."""
    if name not in arrays:
        raise BadInput(source, f"an array {name}", "none", "add it")
    array = np.asarray(arrays[name])
    fits = array.ndim == 1 + len(shape) and array.shape[1:] == shape and len(array) == (count or len(array))
    is_number = array.dtype.kind in "fiu"
    is_usable = (np.abs(array) < MAX_ABS_VALUE) | (may_be_lost & np.isnan(array)) if is_number else np.zeros(1, bool)
    if not fits or not is_usable.all():
        expected = f"finite numbers of shape ({count or 'frame'}, {', '.join(map(str, shape))})"
        got = f"{array.dtype} {array.shape}"
        if fits and is_number:
            row_number = int(is_usable.reshape(len(array), -1).all(axis=1).argmin())
            got = f"{array[row_number]} in row {row_number + 1}"
        raise BadInput(f"{source}: {name}", expected, got, "correct it")
    return array.astype(np.float64)


def _check_times(time_s: np.ndarray, source: str) -> None:
    steps = np.diff(time_s)
    if len(time_s) < MIN_FRAMES or (steps <= 0).any() or len(time_s) > MAX_FRAMES:
        expected = f"{MIN_FRAMES} to {MAX_FRAMES} frames whose times rise"
        late = "" if len(time_s) < 2 or (steps > 0).all() else f", not after row {int((steps <= 0).argmax()) + 1}"
        raise BadInput(f"{source}: time_s", expected, f"{len(time_s)} frames{late}", "correct the times")
    step = float(np.median(steps))
    if not 1 / MAX_RATE_HZ <= step <= 1 / MIN_RATE_HZ:
        units_by_factor = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
        scaled = {name: step * factor for factor, name in units_by_factor.items()}
        units = [name for name, step_s in scaled.items() if 1 / MAX_RATE_HZ <= step_s <= 1 / MIN_RATE_HZ]
        remedy = f"they look like {units[0]}: divide them" if units else "write seconds"
        if np.allclose(steps, 1):
            remedy = "they look like frame numbers: divide them by the frame rate"
        expected = f"seconds, {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} frames in each"
        raise BadInput(f"{source}: time_s", expected, f"a step of {step:g}", remedy)
    if steps.max() > MAX_STEP_S:
        expected, got = f"steps of at most {MAX_STEP_S:g} s", f"{steps.max():g} s after row {int(steps.argmax()) + 1}"
        raise BadInput(f"{source}: time_s", expected, got, "cut the file there")


def _body(arrays: Mapping[str, np.ndarray], body: str, time_s: np.ndarray, source: str, unit_m: float) -> Motion:
    """The motion of a body in the frames in which it is tracked."""
    position, quaternion = (
        _array(arrays, f"{body}_{name}", (count,), source, len(time_s), may_be_lost=True)
        for name, count in (("position", 3), ("quaternion", 4))
    )
    is_lost = np.isnan(np.c_[position, quaternion]).any(axis=1)
    is_lost |= _jumps_to_zero(position * unit_m, quaternion, time_s)
    quaternion[is_lost] = [1.0, 0.0, 0.0, 0.0]
    length = np.linalg.norm(quaternion, axis=1)
    if np.abs(length - 1).max() > 0.01:
        row_number = int(np.abs(length - 1).argmax())
        got = f"one of length {length[row_number]:.3g} in row {row_number + 1}"
        raise BadInput(f"{source}: {body}", "quaternions of length 1", got, "write w, x, y, z of a rotation")
    rotmats = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
    return Motion(time_s[~is_lost], rotmats[~is_lost], position[~is_lost] * unit_m)


def _jumps_to_zero(position_m: np.ndarray, quaternion: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """(frame,) bool: position 0 and no rotation, if the body is too fast to have been there."""
    is_zero = (np.c_[position_m, quaternion] == [0.0, 0, 0, 1, 0, 0, 0]).all(axis=1)
    is_border = is_zero[1:] != is_zero[:-1]
    speed_m_s = np.linalg.norm(np.diff(position_m, axis=0), axis=1) / np.diff(time_s)
    return is_zero & bool((speed_m_s[is_border] > MAX_SPEED_M_S).any())
