"""Readers of HOT3D's text files: hand poses (JSON lines), object poses and quality checks (CSV), metadata (JSON).

Also the names of objects in words. The files do not state actions.
"""

import io
import re
from collections.abc import Iterator, Mapping
from itertools import chain
from operator import itemgetter
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.datasets import checks
from hoidata.errors import BadInput

# Object names of instance.json that differ from plain words.
NOUNS = {
    "aria_small": "smart glasses",
    "birdhouse_toy": "toy birdhouse",
    "bottle_bbq": "barbecue sauce bottle",
    "bottle_mustard": "mustard bottle",
    "bottle_ranch": "ranch dressing bottle",
    "can_parmesan": "parmesan can",
    "can_soup": "soup can",
    "can_tomato_sauce": "tomato sauce can",
    "carton_milk": "milk carton",
    "carton_oj": "orange juice carton",
    "dino_toy": "toy dinosaur",
    "dumbbell_5lb": "dumbbell",
    "dvd_remote": "remote control",
    "food_vegetables": "toy vegetables",
    "food_waffles": "toy waffles",
    "holder_black": "black holder",
    "holder_gray": "gray holder",
    "mug_patterned": "patterned mug",
    "mug_white": "white mug",
    "plate_bamboo": "bamboo plate",
    "spatula_red": "red spatula",
    "spoon_wooden": "wooden spoon",
}


def object_words(name: str) -> str:
    """An object of instance.json in words: ``mug_white`` -> "white mug", ``coffee_pot`` -> "coffee pot"."""
    return NOUNS.get(name, name.replace("_", " "))


HandFormat = Literal["mano", "umetrack"]
# Numbers of one hand in addition to its pose. UmeTrack also has two angles of the wrist, which are zero and unused.
HAND_COLUMNS: Mapping[HandFormat, Mapping[str, int]] = {
    "mano": {"pose": 15, "betas": 10},
    "umetrack": {"joint_angles": 22},
}
WRIST = {"t_xyz": 3, "q_wxyz": 4}
SIDE_OF_KEY: Mapping[str, Side] = {"0": "left", "1": "right"}
POSE_COLUMNS = ("object_uid", "timestamp[ns]", *(f"t_wo_{axis}[m]" for axis in "xyz"), *(f"q_wo_{i}" for i in "wxyz"))
MASK_COLUMNS = ("timestamp[ns]", "stream_id", "mask")
UID = re.compile(r"[0-9]{1,20}")
TIME = re.compile(r"[0-9]{1,18}")
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
MAX_JSON_BYTES, MAX_TABLE_BYTES = 4 << 20, 32 << 20  # real ones have 0.6 and 12 MB
MAX_ROWS = 100_000  # real ones have 43,000
MAX_LINE_BYTES = 1 << 16  # of hand poses; a real one has 3 kB
MAX_NUMBER = 1000
HEADSETS = ("Aria", "Quest3")


class Poses(NamedTuple):
    """Poses of one hand or object, one row per time."""

    time_ns: np.ndarray  # (row,) int64, increasing
    rotation: np.ndarray  # (row, 3, 3) world from hand or object
    translation_m: np.ndarray  # (row, 3)
    numbers: Mapping[str, np.ndarray]  # further numbers of a hand by name, (row, number)


def hand_poses(data: bytes, path: str, kind: HandFormat) -> dict[Side, Poses]:
    """Read ``mano_hand_pose_trajectory.jsonl`` or the file for UmeTrack. A side without poses has no entry."""
    columns = {**WRIST, **HAND_COLUMNS[kind]}
    rows: dict[Side, list[tuple[int, list]]] = {side: [] for side in SIDES}
    for location, line in _lines(data, path):
        time_ns, hands = checks.entry(location, line, "timestamp_ns"), checks.entry(location, line, "hand_poses")
        if type(time_ns) is not int or not 0 <= time_ns < 10**18:
            raise BadInput(f"{location}: timestamp_ns", "a time in nanoseconds", repr(time_ns)[:40])
        if not isinstance(hands, dict) or not hands.keys() <= SIDE_OF_KEY.keys():
            raise BadInput(f"{location}: hand_poses", "hands 0 (left) and 1 (right)", repr(hands)[:40])
        for key, hand in hands.items():
            hand_location = f"{location}: hand {key}"
            wrist = checks.entry(hand_location, hand, "wrist_xform")
            values = [
                list_of_numbers(hand_location, wrist if name in WRIST else hand, name, count)
                for name, count in columns.items()
            ]
            rows[SIDE_OF_KEY[key]].append((time_ns, list(chain.from_iterable(values))))
    return {side: poses_of(f"{path}: {side} hand", rows[side], columns) for side in SIDES if rows[side]}


def object_poses(data: bytes, path: str) -> dict[str, Poses]:
    """Read ``dynamic_objects.csv``: poses by object id."""
    rows: dict[str, list[tuple[int, list]]] = {}
    for location, cells in _table(data, path, POSE_COLUMNS):
        uid, time, *numbers = cells
        if not UID.fullmatch(uid):
            raise BadInput(location, "an object id of digits", repr(uid)[:40])
        wrong = next((text for text in numbers if not NUMBER.fullmatch(text)), None)
        if wrong is not None:
            raise BadInput(location, "numbers", repr(wrong)[:40])
        rows.setdefault(uid, []).append((_time(location, time), [float(text) for text in numbers]))
    if not rows:
        raise BadInput(path, "poses of an object", "none")
    columns = {"t_wo": 3, "q_wo": 4}
    return {uid: poses_of(f"{path}: object {uid}", uid_rows, columns) for uid, uid_rows in sorted(rows.items())}


def failed_times(data: bytes, path: str) -> np.ndarray:
    """Sorted times in ns at which a mask file has False for any camera stream."""
    failed = set[int]()
    for location, (time, _, flag) in _table(data, path, MASK_COLUMNS):
        if flag not in ("True", "False"):
            raise BadInput(location, "True or False", repr(flag)[:40])
        time_ns = _time(location, time)
        if flag == "False":
            failed.add(time_ns)
    return np.array(sorted(failed), dtype=np.int64)


def headset(data: bytes, path: str) -> str:
    """Read the device from ``metadata.json``; it determines the axes of the world."""
    return checked_headset(f"{path}: headset", checks.entry(path, checks.json_value(path, data), "headset"))


def checked_headset(location: str, value: Any) -> str:
    """Raise BadInput unless the value is a known headset."""
    if value not in HEADSETS:
        raise BadInput(location, " or ".join(HEADSETS), repr(value)[:40])
    return value


def object_names(data: bytes, path: str) -> dict[str, str]:
    """Read ``assets/instance.json``: names by object id."""
    content = checks.json_value(path, data)
    if not isinstance(content, dict):
        raise BadInput(path, "a dictionary of objects by id", type(content).__name__)
    names = {uid: checks.entry(f"{path}: {uid}", entry, "instance_name") for uid, entry in content.items()}
    return {uid: checked_name(f"{path}: {uid}", name) for uid, name in names.items()}


def checked_name(location: str, name: Any) -> str:
    """Raise BadInput unless an object's name can be part of a clip id."""
    if not isinstance(name, str) or not re.fullmatch(r"[a-z0-9]+(_[a-z0-9]+)*", name):
        raise BadInput(location, "a name of lower-case words", repr(name)[:40])
    return name


def small_table(location: str, value: Any, columns: int, rows: int | None = None) -> np.ndarray:
    """``checks.table`` with a limit of 1,000, which valid metres, angles, weights and hand millimetres keep."""
    numbers = checks.table(location, value, columns, rows, "rows")
    if np.abs(numbers).max() > MAX_NUMBER:
        raise BadInput(location, f"numbers up to {MAX_NUMBER}", f"{np.abs(numbers).max():.3g}")
    return numbers


def _lines(data: bytes, path: str) -> Iterator[tuple[str, Any]]:
    for number, line in enumerate(io.BytesIO(data), 1):
        _check_row_count(path, number)
        if len(line) > MAX_LINE_BYTES:
            raise BadInput(f"{path}:{number}", f"a line of at most {MAX_LINE_BYTES} bytes", f"{len(line)} bytes")
        yield f"{path}:{number}", checks.json_value(f"{path}:{number}", line)


def list_of_numbers(location: str, mapping: Any, name: str, count: int) -> list:
    """The entry ``name`` of ``mapping``. Raises BadInput unless it is a list of ``count`` numbers."""
    values = checks.entry(location, mapping, name)
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        raise BadInput(f"{location}: {name}", f"{count} numbers", repr(values)[:40])
    if len(values) != count:
        raise BadInput(f"{location}: {name}", f"{count} numbers", f"{len(values)}")
    return values


def _table(data: bytes, path: str, columns: tuple[str, ...]) -> Iterator[tuple[str, list[str]]]:
    """Yield location and cells of each row, with the cells in the order of ``columns``."""
    lines = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", errors="replace")
    header = lines.readline().rstrip().split(",")
    if sorted(header) != sorted(columns):
        raise BadInput(path, f"the columns {','.join(columns)}", repr(",".join(header))[:80])
    order = [header.index(name) for name in columns]
    for number, line in enumerate(lines, 2):
        _check_row_count(path, number)
        cells = line.rstrip().split(",", len(columns))
        if len(cells) != len(columns):
            raise BadInput(f"{path}:{number}", f"{len(columns)} cells", f"{len(cells)}")
        yield f"{path}:{number}", [cells[at] for at in order]


def _check_row_count(path: str, number: int) -> None:
    if number > MAX_ROWS:
        raise BadInput(path, f"at most {MAX_ROWS} rows", "more")


def _time(location: str, text: str) -> int:
    if not TIME.fullmatch(text):
        raise BadInput(location, "a time in nanoseconds", repr(text)[:40])
    return int(text)


def poses_of(location: str, rows: list[tuple[int, list]], columns: Mapping[str, int]) -> Poses:
    """Sort rows by time and split their numbers into translation, quaternion and further columns.

    Args:
        location: file and entry, for errors.
        rows: time in ns and numbers. The first 7 numbers are translation in metres and quaternion, w first.
        columns: number of values per name, in the order of the numbers.
    """
    rows = sorted(rows, key=itemgetter(0))
    time_ns = np.array([time for time, _ in rows], dtype=np.int64)
    if (np.diff(time_ns) == 0).any():
        raise BadInput(location, "each time once", f"{time_ns[:-1][np.diff(time_ns) == 0][0]} twice")
    numbers = small_table(location, [values for _, values in rows], sum(columns.values()))
    edges = np.cumsum([*columns.values()])[:-1]
    translation_m, quaternion_wxyz, *further_numbers = np.split(numbers, edges, axis=1)
    length = np.linalg.norm(quaternion_wxyz, axis=1)
    if (np.abs(length - 1) > 1e-3).any():
        worst = length[np.abs(length - 1).argmax()]
        raise BadInput(location, "quaternions of length 1", f"one of length {worst:.3g}")
    rotation = Rotation.from_quat(quaternion_wxyz[:, [1, 2, 3, 0]]).as_matrix()
    return Poses(time_ns, rotation, translation_m, dict(zip(list(columns)[2:], further_numbers, strict=True)))
