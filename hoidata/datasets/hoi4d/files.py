"""HOI4D's files: object poses, action events, camera trajectory, hand pickles, hinges. Nothing in them is run.

Its words: categories by their number, events of the action files, phrases of the makers' task table.
"""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import orjson
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import HandType
from hoidata.datasets import checks
from hoidata.errors import BadInput
from hoidata.files import ARRAYS, restricted_load


class Category(NamedTuple):
    """folder: of its meshes. words: the noun without article. hinged: its meshes lie below ``articulated``."""

    folder: str
    words: str
    hinged: bool


CATEGORIES = {
    "C1": Category("ToyCar", "toy car", False),
    "C2": Category("Mug", "mug", False),
    "C3": Category("Laptop", "laptop", True),
    "C4": Category("StorageFurniture", "storage cabinet", True),
    "C5": Category("Bottle", "bottle", False),
    "C6": Category("Safe", "safe", True),
    "C7": Category("Bowl", "bowl", False),
    "C8": Category("Bucket", "bucket", True),
    "C9": Category("Scissors", "scissors", True),
    "C11": Category("Pliers", "pliers", True),
    "C12": Category("Kettle", "kettle", False),
    "C13": Category("Knife", "knife", False),
    "C14": Category("TrashCan", "trash can", True),
    "C17": Category("Lamp", "lamp", True),
    "C18": Category("Stapler", "stapler", True),
    "C20": Category("Chair", "chair", False),
}
# Event of color.json in lower case -> verb and the hand it names; None: nothing is done to the object.
EVENTS: dict[str, tuple[str, HandType | None] | None] = {
    **dict.fromkeys(("rest", "reachout", "stop", "go", "lookaround")),
    "grasp": ("grasp", None),
    "pickup": ("pick up", None),
    "putdown": ("put down", None),
    "carry": ("carry", None),
    "carrywithbothhands": ("carry", "both"),
    "open": ("open", None),
    "close": ("close", None),
    "push": ("push", None),
    "pull": ("pull", None),
    "press": ("press", None),
    "turn&on&the&switch": ("turn on", None),
    "cut": ("cut", None),
    "paper-cut": ("cut", None),
    "binding": ("bind", None),
    "dump": ("dump", None),
}
# Of the makers' table what is known here, by category and task; a whole recording of another task has no verb.
TASKS = {("C6", "T1"): "open and close", ("C9", "T2"): "cut", ("C11", "T4"): "clamp"}


VIDEO_FRAMES = 300  # of every recording, whatever its clock says
CLOCKS_S = (10.0, 20.0)
LARGEST_HAND_BYTES = 1 << 16
REVOLUTE, FIXED = "铰链（旋转）", ("自由", "静态", "沉重")  # "hinge (rotation)"; "free", "static", "heavy"
FRAME_NAME = re.compile(r"(\d{1,6})\.(?:json|pickle)")


class PartPose(NamedTuple):
    """One entry of an object file, camera frame: label, centre_m (3,), extents_m (3,) along its own axes, rotation."""

    label: str
    centre_m: np.ndarray
    extents_m: np.ndarray
    rotation: np.ndarray


class Event(NamedTuple):
    """What an action file says of some frames: half-open, counted at 15 per second."""

    word: str
    start: int
    stop: int


class HandFrame(NamedTuple):
    """pose (48,) axis-angles, the global one first; betas (10,); translation_m (3,); camera frame."""

    pose: np.ndarray
    betas: np.ndarray
    translation_m: np.ndarray


class ShortPose(BadInput):
    """A hand file of the release whose pose has fewer numbers than 48: a known fault, which costs its frame alone."""


class Joint(NamedTuple):
    """The one hinge of an object, in its whole mesh's coordinates. base, moving: names of its meshes (``new-0``)."""

    base: str
    moving: str
    axis: np.ndarray
    origin_m: np.ndarray


def frame_numbers(folder: str, names: list[str]) -> dict[int, str]:
    """File name by frame, of ``0.json`` or ``00000.json``. Raises BadInput for a frame with both, or another name."""
    found: dict[int, str] = {}
    for name in names:
        match = FRAME_NAME.fullmatch(name)
        if match is None:
            raise BadInput(f"{folder}/{name}", "a frame number as name", name, "remove the file")
        if int(match[1]) in found:
            got = f"{found[int(match[1])]} and {name}"
            raise BadInput(folder, "one file per frame", got, "remove one of them")
        found[int(match[1])] = name
    return found


def read_json(data: bytes, where: str) -> Any:
    try:
        return orjson.loads(data)
    except ValueError as error:  # orjson.JSONDecodeError is one; text in another encoding too
        raise BadInput(where, "JSON", str(error)[:80]) from error


def object_poses(data: bytes, where: str) -> list[PartPose]:
    """The entries of one frame, in the order of their labels."""
    value = read_json(data, where)
    name = "dataList" if isinstance(value, Mapping) and "dataList" in value else "objects"
    entries = checks.entry(where, value, name)
    if not isinstance(entries, list) or not entries:
        raise BadInput(f"{where}: {name}", "at least one object", repr(entries)[:40])
    poses = [_part_pose(f"{where}: {name}[{number}]", entry) for number, entry in enumerate(entries)]
    labels = [pose.label for pose in poses]
    if len(set(labels)) < len(labels):
        raise BadInput(f"{where}: {name}", "a label of its own for every part", ", ".join(labels))
    return sorted(poses, key=lambda pose: pose.label)


def _part_pose(where: str, entry: Any) -> PartPose:
    label = checks.entry(where, entry, "label")
    if not isinstance(label, str):
        raise BadInput(f"{where}.label", "a word", repr(label)[:40])
    centre, angles = (_numbers(where, entry, name, ("x", "y", "z")) for name in ("center", "rotation"))
    extents = _numbers(where, entry, "dimensions", ("length", "width", "height"))
    if not (extents > 0).all():
        raise BadInput(f"{where}.dimensions", "lengths above 0", str(extents.tolist()))
    return PartPose(label, centre, extents, Rotation.from_euler("XYZ", angles).as_matrix())  # Rx Ry Rz


def _numbers(where: str, entry: Any, name: str, keys: tuple[str, ...]) -> np.ndarray:
    values = checks.entry(where, entry, name)
    row = [checks.entry(f"{where}.{name}", values, key) for key in keys]
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in row):
        raise BadInput(f"{where}.{name}", "numbers", repr(row)[:40])
    return checks.table(f"{where}.{name}", [row], len(keys))[0]


def action_events(data: bytes, where: str) -> list[Event]:
    """Events in both forms of the file; frames counted by the clock of the file, of 10 or 20 seconds."""
    if not data.strip():
        raise BadInput(where, "the events of the recording", "an empty file", "nothing to do: one such file is known")
    value = read_json(data, where)
    marked = isinstance(value, Mapping) and "markResult" in value
    holder = checks.entry(where, value, "markResult") if marked else value
    listed = checks.entry(where, holder, "marks" if marked else "events")
    if not isinstance(listed, list) or not listed:
        raise BadInput(where, "at least one event", repr(listed)[:40])
    ends = ("hdTimeStart", "hdTimeEnd") if marked else ("startTime", "endTime")
    times = [_numbers_of(where, item, ends) for item in listed]
    words = [checks.entry(where, item, "event") for item in listed]
    if not all(isinstance(word, str) for word in words):
        raise BadInput(where, "a word for every event", repr(words)[:40])
    per_second = VIDEO_FRAMES / _clock_s(where, value, max(float(time[1]) for time in times))
    frames = np.rint(np.array(times) * per_second).astype(np.int64)
    return [Event(word, int(start), int(stop)) for word, (start, stop) in zip(words, frames, strict=True)]


def _numbers_of(where: str, item: Any, names: tuple[str, ...]) -> np.ndarray:
    row = [checks.entry(where, item, name) for name in names]
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in row):
        raise BadInput(where, "times in seconds", repr(row)[:40])
    times = checks.table(where, [row], len(names))[0]
    if not 0 <= times[0] <= times[1] <= 2 * CLOCKS_S[1]:
        raise BadInput(where, "times from 0 on, start before end", str(times.tolist()))
    return times


def _clock_s(where: str, value: Mapping[str, Any], last_s: float) -> float:
    """How long the file takes the 300 frames to be: what it says, else 10 or 20 seconds, as the last end tells."""
    info = value.get("info")
    said = [info[name] for name in ("duration", "Duration") if isinstance(info, Mapping) and name in info]
    if not said:
        return CLOCKS_S[0] if last_s <= 1.05 * CLOCKS_S[0] else CLOCKS_S[1]
    length = said[0]
    if isinstance(length, bool) or not isinstance(length, int | float) or not 1 <= length <= 100:
        raise BadInput(f"{where}: duration", "seconds, 1 to 100", repr(length)[:40])
    return min(CLOCKS_S, key=lambda clock: abs(clock - length))


def camera_poses(data: bytes, where: str) -> np.ndarray:
    """(frame, 4, 4) world from camera, of an Open3D trajectory: three whole numbers, then four rows, per frame."""
    lines = [line.split() for line in data.decode("utf-8", "replace").splitlines() if line.strip()]
    if not lines or len(lines) % 5:
        raise BadInput(where, "five lines per frame", f"{len(lines)} lines")
    if any(len(line) != 3 for line in lines[::5]):
        raise BadInput(
            where, "three numbers above each matrix", " ".join(next(r for r in lines[::5] if len(r) != 3))[:40]
        )
    try:
        rows = [[float(word) for word in line] for number, line in enumerate(lines) if number % 5]
    except ValueError as error:
        raise BadInput(where, "numbers", str(error)[:80]) from error
    poses = checks.table(where, rows, 4).reshape(-1, 4, 4)
    checks.rigid_transforms(where, [f"frame {frame}" for frame in range(len(poses))], poses)
    return poses


def hand_frame(data: bytes, where: str) -> HandFrame:
    """One frame of one hand, of a pickle that Python 2 wrote."""
    if len(data) > LARGEST_HAND_BYTES:
        raise BadInput(where, f"at most {LARGEST_HAND_BYTES} bytes", f"{len(data)}")
    value = restricted_load(data, ARRAYS, encoding="latin1", where=where)
    pose = np.asarray(checks.entry(where, value, "poseCoeff"))
    if pose.dtype.kind in "fiu" and 0 < pose.size < 48:
        raise ShortPose(f"{where}: poseCoeff", "48 numbers", f"{pose.size}", "nothing to do: a known fault")
    rows = [
        checks.table(f"{where}: {name}", np.atleast_2d(np.asarray(checks.entry(where, value, name))), columns, 1)[0]
        for name, columns in (("poseCoeff", 48), ("beta", 10), ("trans", 3))
    ]
    return HandFrame(*rows)


def hinge_joint(mobility: bytes, tree: bytes, where: str, tree_where: str) -> Joint:
    """The one revolute joint of an object of two parts. Raises BadInput for drawers and for more parts."""
    nodes = read_json(mobility, where)
    if not isinstance(nodes, list) or not all(isinstance(node, Mapping) for node in nodes):
        raise BadInput(where, "a list of parts", repr(nodes)[:40])
    kinds = [str(checks.entry(where, node, "joint")) for node in nodes]
    moving = [node for node, kind in zip(nodes, kinds, strict=True) if kind == REVOLUTE]
    fixed = [node for node, kind in zip(nodes, kinds, strict=True) if kind in FIXED]
    if len(moving) != 1 or len(fixed) != 1 or len(nodes) != 2:
        remedy = "nothing to do: objects of two parts with one hinge are read, no drawers and no further parts"
        raise BadInput(where, "one base and one part that turns", ", ".join(kinds) or "none", remedy)
    meshes = _meshes_by_id(read_json(tree, tree_where), tree_where)
    axis = checks.entry(where, checks.entry(where, moving[0], "jointData"), "axis")
    origin, direction = (
        checks.table(f"{where}: {name}", [checks.entry(where, axis, name)], 3)[0] for name in ("origin", "direction")
    )
    length = float(np.linalg.norm(direction))
    if not 1e-6 < length < 1e6:
        raise BadInput(f"{where}: direction", "a direction", str(direction.tolist()))
    base, turned = (_mesh_of(node, meshes, where) for node in (fixed[0], moving[0]))
    return Joint(base, turned, direction / length, origin)


def _meshes_by_id(tree: Any, where: str) -> dict[Any, list[str]]:
    """By id of a node the meshes below it."""
    found: dict[Any, list[str]] = {}

    def visit(node: Any, depth: int) -> list[str]:
        if not isinstance(node, Mapping) or depth > 50:
            raise BadInput(where, "a tree of parts", repr(node)[:40])
        objs, children = node.get("objs", []), node.get("children", [])
        if not isinstance(objs, list) or not isinstance(children, list):
            raise BadInput(where, "lists of meshes and children", repr(node)[:40])
        names = [str(name) for name in objs] + [name for child in children for name in visit(child, depth + 1)]
        found[str(node.get("id"))] = names
        return names

    for root in tree if isinstance(tree, list) else [tree]:
        visit(root, 0)
    return found


def _mesh_of(node: Mapping[str, Any], meshes: Mapping[Any, list[str]], where: str) -> str:
    parts = checks.entry(where, node, "parts")
    ids = [str(checks.entry(where, part, "id")) for part in parts] if isinstance(parts, list) else []
    names = sorted({name for own in ids for name in meshes.get(own, [])})
    if len(names) != 1:
        remedy = "nothing to do: which mesh a pose belongs to cannot be told"
        raise BadInput(where, "one mesh for each part", ", ".join(names) or "none", remedy)
    return names[0]
