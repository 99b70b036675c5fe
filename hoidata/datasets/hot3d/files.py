"""HOT3D's text files: hand poses line by line, tables of object poses and of what the makers checked, JSON.

Also objects in words; nothing in the files says what is done with them.
"""

import io
import re
from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any, Literal, NamedTuple

import numpy as np
import orjson
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.datasets import checks
from hoidata.errors import BadInput

# Where the name of instance.json does not read as words.
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
# Numbers of one hand besides its place; UmeTrack states the two angles of the wrist too, which are zero and unused.
HAND_NUMBERS: Mapping[HandFormat, Mapping[str, int]] = {
    "mano": {"pose": 15, "betas": 10},
    "umetrack": {"joint_angles": 22},
}
WRIST = {"t_xyz": 3, "q_wxyz": 4}
OF_KEY: Mapping[str, Side] = {"0": "left", "1": "right"}
POSE_COLUMNS = ("object_uid", "timestamp[ns]", *(f"t_wo_{axis}[m]" for axis in "xyz"), *(f"q_wo_{i}" for i in "wxyz"))
MASK_COLUMNS = ("timestamp[ns]", "stream_id", "mask")
UID = re.compile(r"[0-9]{1,20}")
TIME = re.compile(r"[0-9]{1,18}")
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
LARGEST_JSON, LARGEST_ROWS = 4 << 20, 32 << 20  # real ones have 0.6 and 12 MB
MOST_ROWS = 100_000  # real ones have 43,000
LONGEST_LINE = 1 << 16  # of hand poses; a real one has 3 kB
LARGEST_NUMBER = 1000
HEADSETS = ("Aria", "Quest3")


class Poses(NamedTuple):
    """Rows of one hand or object in the order of their times. time_ns: (row,) int64, rising.

    rotation: (row, 3, 3) and translation_m: (row, 3) of world from hand or object. numbers: further ones of a hand by
    name, (row, number).
    """

    time_ns: np.ndarray
    rotation: np.ndarray
    translation_m: np.ndarray
    numbers: Mapping[str, np.ndarray]


def hand_poses(data: bytes, where: str, kind: HandFormat) -> dict[Side, Poses]:
    """Both hands of ``mano_hand_pose_trajectory.jsonl`` or its UmeTrack sister; a side no line has has no entry."""
    columns = {**WRIST, **HAND_NUMBERS[kind]}
    rows: dict[Side, list[tuple[int, list]]] = {side: [] for side in SIDES}
    for place, line in _lines(data, where):
        time_ns, hands = checks.entry(place, line, "timestamp_ns"), checks.entry(place, line, "hand_poses")
        if type(time_ns) is not int or not 0 <= time_ns < 10**18:
            raise BadInput(f"{place}: timestamp_ns", "a time in nanoseconds", repr(time_ns)[:40])
        if not isinstance(hands, dict) or not hands.keys() <= OF_KEY.keys():
            raise BadInput(f"{place}: hand_poses", "hands 0 (left) and 1 (right)", repr(hands)[:40])
        for key, hand in hands.items():
            own = f"{place}: hand {key}"
            wrist = checks.entry(own, hand, "wrist_xform")
            values = [row_of(own, wrist if name in WRIST else hand, name, count) for name, count in columns.items()]
            rows[OF_KEY[key]].append((time_ns, list(chain.from_iterable(values))))
    return {side: poses_of(f"{where}: {side} hand", rows[side], columns) for side in SIDES if rows[side]}


def object_poses(data: bytes, where: str) -> dict[str, Poses]:
    """Poses by object id of ``dynamic_objects.csv``."""
    rows: dict[str, list[tuple[int, list]]] = {}
    for place, cells in _table(data, where, POSE_COLUMNS):
        uid, time, *numbers = cells
        if not UID.fullmatch(uid):
            raise BadInput(place, "an object id of digits", repr(uid)[:40])
        wrong = next((text for text in numbers if not NUMBER.fullmatch(text)), None)
        if wrong is not None:
            raise BadInput(place, "numbers", repr(wrong)[:40])
        rows.setdefault(uid, []).append((_time(place, time), [float(text) for text in numbers]))
    if not rows:
        raise BadInput(where, "poses of an object", "none")
    columns = {"t_wo": 3, "q_wo": 4}
    return {uid: poses_of(f"{where}: object {uid}", own, columns) for uid, own in sorted(rows.items())}


def failed_times(data: bytes, where: str) -> np.ndarray:
    """Sorted times, ns, at which some camera stream of a mask file says False."""
    failed = set[int]()
    for place, (time, _, flag) in _table(data, where, MASK_COLUMNS):
        if flag not in ("True", "False"):
            raise BadInput(place, "True or False", repr(flag)[:40])
        time_ns = _time(place, time)
        if flag == "False":
            failed.add(time_ns)
    return np.array(sorted(failed), dtype=np.int64)


def headset(data: bytes, where: str) -> str:
    """The device of ``metadata.json``, whose world's axes the recording has."""
    return headset_of(f"{where}: headset", checks.entry(where, read_json(data, where), "headset"))


def headset_of(where: str, found: Any) -> str:
    """Checked to be one of the two."""
    if found not in HEADSETS:
        raise BadInput(where, " or ".join(HEADSETS), repr(found)[:40])
    return found


def object_names(data: bytes, where: str) -> dict[str, str]:
    """Name by object id of ``assets/instance.json``."""
    content = read_json(data, where)
    if not isinstance(content, dict):
        raise BadInput(where, "a dictionary of objects by id", type(content).__name__)
    names = {uid: checks.entry(f"{where}: {uid}", about, "instance_name") for uid, about in content.items()}
    return {uid: checked_name(f"{where}: {uid}", name) for uid, name in names.items()}


def checked_name(where: str, name: Any) -> str:
    """An object's name, which becomes part of a clip's."""
    if not isinstance(name, str) or not re.fullmatch(r"[a-z0-9]+(_[a-z0-9]+)*", name):
        raise BadInput(where, "a name of lower-case words", repr(name)[:40])
    return name


def small_table(where: str, value: Any, columns: int, rows: int | None = None) -> np.ndarray:
    """``checks.table`` of numbers up to 1,000: no metre, angle or weight, and no millimetre of a hand, is larger."""
    table = checks.table(where, value, columns, rows, "rows")
    if np.abs(table).max() > LARGEST_NUMBER:
        raise BadInput(where, f"numbers up to {LARGEST_NUMBER}", f"{np.abs(table).max():.3g}")
    return table


def read_json(data: bytes, where: str) -> Any:
    """What a JSON file holds. Raises BadInput that names it."""
    try:
        return orjson.loads(data)
    except orjson.JSONDecodeError as error:
        raise BadInput(where, "JSON text", str(error)[:80]) from error


def _lines(data: bytes, where: str) -> Iterator[tuple[str, Any]]:
    for number, line in enumerate(io.BytesIO(data), 1):
        _not_too_many(where, number)
        if len(line) > LONGEST_LINE:
            raise BadInput(f"{where}:{number}", f"a line of at most {LONGEST_LINE} bytes", f"{len(line)} bytes")
        yield f"{where}:{number}", read_json(line, f"{where}:{number}")


def row_of(where: str, mapping: Any, name: str, count: int) -> list:
    """So many numbers of a list that is an entry of ``mapping``."""
    values = checks.entry(where, mapping, name)
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        raise BadInput(f"{where}: {name}", f"{count} numbers", repr(values)[:40])
    if len(values) != count:
        raise BadInput(f"{where}: {name}", f"{count} numbers", f"{len(values)}")
    return values


def _table(data: bytes, where: str, columns: tuple[str, ...]) -> Iterator[tuple[str, list[str]]]:
    """Name and cells of each row, in the order of ``columns``, whatever the file's own is."""
    lines = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", errors="replace")
    header = lines.readline().rstrip().split(",")
    if sorted(header) != sorted(columns):
        raise BadInput(where, f"the columns {','.join(columns)}", repr(",".join(header))[:80])
    order = [header.index(name) for name in columns]
    for number, line in enumerate(lines, 2):
        _not_too_many(where, number)
        cells = line.rstrip().split(",", len(columns))
        if len(cells) != len(columns):
            raise BadInput(f"{where}:{number}", f"{len(columns)} cells", f"{len(cells)}")
        yield f"{where}:{number}", [cells[at] for at in order]


def _not_too_many(where: str, number: int) -> None:
    if number > MOST_ROWS:
        raise BadInput(where, f"at most {MOST_ROWS} rows", "more")


def _time(where: str, text: str) -> int:
    if not TIME.fullmatch(text):
        raise BadInput(where, "a time in nanoseconds", repr(text)[:40])
    return int(text)


def poses_of(where: str, rows: list[tuple[int, list]], columns: Mapping[str, int]) -> Poses:
    """Rows of a time and all numbers: three of the place, four of the turn (w first), then the further ones."""
    rows = sorted(rows, key=lambda row: row[0])
    time_ns = np.array([time for time, _ in rows], dtype=np.int64)
    if (np.diff(time_ns) == 0).any():
        raise BadInput(where, "each time once", f"{time_ns[:-1][np.diff(time_ns) == 0][0]} twice")
    numbers = small_table(where, [values for _, values in rows], sum(columns.values()))
    edges = np.cumsum([*columns.values()])[:-1]
    translation_m, turn, *further = np.split(numbers, edges, axis=1)
    length = np.linalg.norm(turn, axis=1)
    if (np.abs(length - 1) > 1e-3).any():
        worst = length[np.abs(length - 1).argmax()]
        raise BadInput(where, "quaternions of length 1", f"one of length {worst:.3g}")
    rotation = Rotation.from_quat(turn[:, [1, 2, 3, 0]]).as_matrix()
    return Poses(time_ns, rotation, translation_m, dict(zip(list(columns)[2:], further, strict=True)))
