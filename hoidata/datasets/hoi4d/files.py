"""Readers of HOI4D's files: object poses, action events, camera trajectory, hand pickles (loaded without code), hinges.

Also categories, events and tasks in words, the match of tracked boxes to meshes by size, and upsampling from 15 to 30
fps: one frame is interpolated between every two source frames. Rotations use the midpoint of the shortest rotation
(slerp). Positions use the cubic through four neighbours, and the line between two neighbours at the ends. An
interpolated frame has the number of the source frame before it, so ``Clip.recorded`` is False and metrics skip it.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import HandTrack, HandType
from hoidata.datasets import checks
from hoidata.datasets.hinge import rigid_fit
from hoidata.errors import BadInput
from hoidata.files import ARRAYS, restricted_load
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat

MAX_SIZE_ERROR = 0.15  # relative, of a part's extents: annotated boxes are accurate to some per cent
MIN_AMBIGUITY_RATIO = 2.0  # the second best assignment must be this many times worse


def match_boxes(
    location: str, tracked_m: np.ndarray, names: Sequence[str], meshes_m: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """Assign a tracked box to each mesh by size: its index, and (mesh, 3) ratio of box to mesh extents.

    tracked_m: (box, 3) and meshes_m: (mesh, 3) extents along their axes. Raises BadInput if no assignment is accurate
    to 15 %, or two are about equally good.
    """
    log_ratio = np.abs(np.log(tracked_m[None] / meshes_m[:, None])).max(axis=2)  # (mesh, box)
    assignments = sorted(
        (max(log_ratio[mesh, box] for mesh, box in enumerate(assignment)), assignment)
        for assignment in permutations(range(len(tracked_m)), len(names))
    )
    if not assignments or assignments[0][0] > np.log1p(MAX_SIZE_ERROR):
        got = "none" if not assignments else f"at best {np.expm1(assignments[0][0]):.0%} off"
        remedy = "nothing to do: poses of other objects, or fewer than its parts"
        raise BadInput(location, f"boxes of the size of {', '.join(names)}", got, remedy)
    if len(assignments) > 1 and assignments[1][0] < MIN_AMBIGUITY_RATIO * max(assignments[0][0], np.log1p(0.02)):
        got = f"parts of nearly the same size: {assignments[0][0]:.1%} and {assignments[1][0]:.1%} off"
        remedy = "nothing to do: which is which cannot be told"
        raise BadInput(location, "parts that their sizes tell apart", got, remedy)
    chosen = list(assignments[0][1])
    return chosen, tracked_m[chosen] / meshes_m


def aligned_from_whole(path: str, aligned_m: np.ndarray, whole_m: np.ndarray) -> np.ndarray:
    """(4, 4) rigid transform from the whole object to an aligned copy of a mesh. Raises BadInput for another mesh."""
    if aligned_m.shape != whole_m.shape:
        raise BadInput(path, f"{len(whole_m)} vertices as in the whole object", f"{len(aligned_m)}")
    transform = rigid_fit(whole_m[None], aligned_m[None])[0]
    max_error_m = float(np.abs(whole_m @ transform[:3, :3].T + transform[:3, 3] - aligned_m).max())
    if max_error_m > 1e-4 * max(1.0, float(np.ptp(whole_m))):
        got = f"one {max_error_m:.3g} m off"
        raise BadInput(path, "the same mesh, turned and moved", got, "download the models again")
    return transform


def upsample_frames(n_frames: int) -> np.ndarray:
    """(2 n - 1,) source frame of each frame; interpolated frames have that of the frame before."""
    return np.arange(2 * n_frames - 1) // 2


def upsample_values(values: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """(2 n - 1, ...) cubic interpolation. valid: (n,) bool; next to invalid frames the interpolation is linear."""
    valid = np.ones(len(values), bool) if valid is None else valid
    middle = (values[:-1] + values[1:]) / 2
    if len(values) > 3:
        cubic = (9 * (values[1:-2] + values[2:-1]) - values[:-3] - values[3:]) / 16
        usable = valid[:-3] & valid[1:-2] & valid[2:-1] & valid[3:]
        middle[1:-1][usable] = cubic[usable]
    return _interleave(values, middle)


def upsample_rotvecs(rotvec: np.ndarray) -> np.ndarray:
    """(2 n - 1, 3) axis-angles, interpolated along the shortest rotation."""
    rotation = rotvec_to_rotmat(rotvec.astype(np.float64))
    half = rotmat_to_rotvec(rotation[:-1].swapaxes(-1, -2) @ rotation[1:]) / 2
    middle = rotmat_to_rotvec(rotation[:-1] @ rotvec_to_rotmat(half))
    return _interleave(rotvec, middle.astype(rotvec.dtype))


def upsample_hand(track: HandTrack) -> HandTrack:
    """Upsample a hand. An interpolated frame is valid if both of its neighbours are."""
    fingers = track.hand_pose.reshape(-1, 15, 3)
    pose = np.stack([upsample_rotvecs(fingers[:, joint]) for joint in range(15)], axis=1)
    valid = _interleave(track.valid, track.valid[:-1] & track.valid[1:])

    def zero_if_invalid(values: np.ndarray) -> np.ndarray:
        return np.where(valid[:, None], values, 0).astype(np.float32)

    return HandTrack(
        wrist_m=zero_if_invalid(upsample_values(track.wrist_m, track.valid)),
        global_orient=zero_if_invalid(upsample_rotvecs(track.global_orient)),
        hand_pose=zero_if_invalid(pose.reshape(len(valid), 45)),
        betas=track.betas if len(track.betas) == 1 else upsample_values(track.betas, track.valid).astype(np.float32),
        valid=valid,
    )


def _interleave(values: np.ndarray, middle: np.ndarray) -> np.ndarray:
    woven = np.empty((2 * len(values) - 1, *values.shape[1:]), values.dtype)
    woven[::2], woven[1::2] = values, middle
    return woven


class Category(NamedTuple):
    """A category of objects."""

    folder: str  # of its meshes
    words: str  # noun without article
    hinged: bool  # its meshes are below ``articulated``


CATEGORIES = {
    "C1": Category("ToyCar", "toy car", False), "C2": Category("Mug", "mug", False),
    "C3": Category("Laptop", "laptop", True), "C4": Category("StorageFurniture", "storage cabinet", True),
    "C5": Category("Bottle", "bottle", False), "C6": Category("Safe", "safe", True),
    "C7": Category("Bowl", "bowl", False), "C8": Category("Bucket", "bucket", True),
    "C9": Category("Scissors", "scissors", True), "C11": Category("Pliers", "pliers", True),
    "C12": Category("Kettle", "kettle", False), "C13": Category("Knife", "knife", False),
    "C14": Category("TrashCan", "trash can", True), "C17": Category("Lamp", "lamp", True),
    "C18": Category("Stapler", "stapler", True), "C20": Category("Chair", "chair", False),
}  # fmt: skip
# Verb and hand by event of color.json in lower case; None if the event does not act on the object.
EVENTS: dict[str, tuple[str, HandType | None] | None] = {
    **dict.fromkeys(("rest", "reachout", "stop", "go", "lookaround")), "grasp": ("grasp", None),
    "pickup": ("pick up", None), "putdown": ("put down", None), "carry": ("carry", None),
    "carrywithbothhands": ("carry", "both"), "open": ("open", None), "close": ("close", None), "push": ("push", None),
    "pull": ("pull", None), "press": ("press", None), "turn&on&the&switch": ("turn on", None), "cut": ("cut", None),
    "paper-cut": ("cut", None), "binding": ("bind", None), "dump": ("dump", None),
}  # fmt: skip
# Verbs of whole recordings by category and task. A recording of another task has no verb.
TASKS = {("C6", "T1"): "open and close", ("C9", "T2"): "cut", ("C11", "T4"): "clamp"}


VIDEO_FRAMES = 300  # of every recording, for either clock
CLOCKS_S = (10.0, 20.0)
MAX_HAND_BYTES = 1 << 16
REVOLUTE, FIXED = "铰链（旋转）", ("自由", "静态", "沉重")  # "hinge (rotation)"; "free", "static", "heavy"
FRAME_NAME = re.compile(r"(\d{1,6})\.(?:json|pickle)")


class PartPose(NamedTuple):
    """Box of one part in the camera frame."""

    label: str
    centre_m: np.ndarray  # (3,)
    extents_m: np.ndarray  # (3,) along the axes of the box
    rotation: np.ndarray  # (3, 3)


class Event(NamedTuple):
    """A labelled range of frames at 15 fps."""

    word: str
    start: int
    stop: int  # exclusive


class HandFrame(NamedTuple):
    """MANO parameters of one hand and frame, in the camera frame."""

    pose: np.ndarray  # (48,) axis-angles, global orientation first
    betas: np.ndarray  # (10,)
    translation_m: np.ndarray  # (3,)


class ShortPose(BadInput):
    """A hand file with fewer than 48 pose numbers, a known fault of the release. Only its frame is excluded."""


class Joint(NamedTuple):
    """The only hinge of an object."""

    base: str  # name of the mesh, ``new-0``
    moving: str
    axis: np.ndarray  # (3,) unit vector in the frame of the whole mesh
    origin_m: np.ndarray  # (3,) in the frame of the whole mesh


def frame_numbers(folder: str, names: list[str]) -> dict[int, str]:
    """File name by frame, from ``0.json`` or ``00000.json``. Raises BadInput for duplicates and other names."""
    names_by_frame: dict[int, str] = {}
    for name in names:
        match = FRAME_NAME.fullmatch(name)
        if match is None:
            raise BadInput(f"{folder}/{name}", "a frame number as name", name, "remove the file")
        if int(match[1]) in names_by_frame:
            got = f"{names_by_frame[int(match[1])]} and {name}"
            raise BadInput(folder, "one file per frame", got, "remove one of them")
        names_by_frame[int(match[1])] = name
    return names_by_frame


def object_poses(data: bytes, path: str) -> list[PartPose]:
    """Read the object poses of one frame, sorted by label."""
    value = checks.json_value(path, data)
    key = "dataList" if isinstance(value, Mapping) and "dataList" in value else "objects"
    entries = checks.entry(path, value, key)
    if not isinstance(entries, list) or not entries:
        raise BadInput(f"{path}: {key}", "at least one object", repr(entries)[:40])
    poses = [_part_pose(f"{path}: {key}[{number}]", entry) for number, entry in enumerate(entries)]
    labels = [pose.label for pose in poses]
    if len(set(labels)) < len(labels):
        raise BadInput(f"{path}: {key}", "a label of its own for every part", ", ".join(labels))
    return sorted(poses, key=lambda pose: pose.label)


def _part_pose(location: str, entry: Any) -> PartPose:
    label = checks.entry(location, entry, "label")
    if not isinstance(label, str):
        raise BadInput(f"{location}.label", "a word", repr(label)[:40])
    centre, angles = (_numbers(location, entry, name, ("x", "y", "z")) for name in ("center", "rotation"))
    extents = _numbers(location, entry, "dimensions", ("length", "width", "height"))
    if not (extents > 0).all():
        raise BadInput(f"{location}.dimensions", "lengths above 0", str(extents.tolist()))
    return PartPose(label, centre, extents, Rotation.from_euler("XYZ", angles).as_matrix())  # Rx Ry Rz


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(location: str, entry: Any, name: str, keys: tuple[str, ...]) -> np.ndarray:
    values = checks.entry(location, entry, name)
    numbers = [checks.entry(f"{location}.{name}", values, key) for key in keys]
    if not all(map(_is_number, numbers)):
        raise BadInput(f"{location}.{name}", "numbers", repr(numbers)[:40])
    return checks.table(f"{location}.{name}", [numbers], len(keys))[0]


def action_events(data: bytes, path: str) -> list[Event]:
    """Read the events of either file format. The file's clock counts the recording as 10 or 20 seconds."""
    if not data.strip():
        raise BadInput(path, "the events of the recording", "an empty file", "nothing to do: one such file is known")
    value = checks.json_value(path, data)
    marked = isinstance(value, Mapping) and "markResult" in value
    holder = checks.entry(path, value, "markResult") if marked else value
    events = checks.entry(path, holder, "marks" if marked else "events")
    if not isinstance(events, list) or not events:
        raise BadInput(path, "at least one event", repr(events)[:40])
    ends = ("hdTimeStart", "hdTimeEnd") if marked else ("startTime", "endTime")
    times = [_times(path, item, ends) for item in events]
    words = [checks.entry(path, item, "event") for item in events]
    if not all(isinstance(word, str) for word in words):
        raise BadInput(path, "a word for every event", repr(words)[:40])
    per_second = VIDEO_FRAMES / _clock_s(path, value, max(float(time[1]) for time in times))
    frames = np.rint(np.array(times) * per_second).astype(np.int64)
    return [Event(word, int(start), int(stop)) for word, (start, stop) in zip(words, frames, strict=True)]


def _times(location: str, item: Any, names: tuple[str, ...]) -> np.ndarray:
    numbers = [checks.entry(location, item, name) for name in names]
    if not all(map(_is_number, numbers)):
        raise BadInput(location, "times in seconds", repr(numbers)[:40])
    times = checks.table(location, [numbers], len(names))[0]
    if not 0 <= times[0] <= times[1] <= 2 * CLOCKS_S[1]:
        raise BadInput(location, "times from 0 on, start before end", str(times.tolist()))
    return times


def _clock_s(path: str, value: Mapping[str, Any], last_s: float) -> float:
    """Duration of the 300 frames by the file's clock: as stated, else 10 or 20 s depending on the last event's end."""
    info = value.get("info")
    stated = [info[name] for name in ("duration", "Duration") if isinstance(info, Mapping) and name in info]
    if not stated:
        return CLOCKS_S[0] if last_s <= 1.05 * CLOCKS_S[0] else CLOCKS_S[1]
    length = stated[0]
    if not _is_number(length) or not 1 <= length <= 100:
        raise BadInput(f"{path}: duration", "seconds, 1 to 100", repr(length)[:40])
    return min(CLOCKS_S, key=lambda clock: abs(clock - length))


def camera_poses(data: bytes, path: str) -> np.ndarray:
    """Read an Open3D trajectory: three integers and four matrix rows per frame. (frame, 4, 4) world from camera."""
    lines = [line.split() for line in data.decode("utf-8", "replace").splitlines() if line.strip()]
    if not lines or len(lines) % 5:
        raise BadInput(path, "five lines per frame", f"{len(lines)} lines")
    if wrong := next((line for line in lines[::5] if len(line) != 3), None):
        raise BadInput(path, "three numbers above each matrix", " ".join(wrong)[:40])
    try:
        rows = [[float(word) for word in line] for number, line in enumerate(lines) if number % 5]
    except ValueError as error:
        raise BadInput(path, "numbers", str(error)[:80]) from error
    poses = checks.table(path, rows, 4).reshape(-1, 4, 4)
    checks.rigid_transforms(path, [f"frame {frame}" for frame in range(len(poses))], poses)
    return poses


def hand_frame(data: bytes, path: str) -> HandFrame:
    """Read one frame of one hand from a pickle of Python 2."""
    if len(data) > MAX_HAND_BYTES:
        raise BadInput(path, f"at most {MAX_HAND_BYTES} bytes", f"{len(data)}")
    value = restricted_load(data, ARRAYS, encoding="latin1", path=path)
    pose = np.asarray(checks.entry(path, value, "poseCoeff"))
    if pose.dtype.kind in "fiu" and 0 < pose.size < 48:
        raise ShortPose(f"{path}: poseCoeff", "48 numbers", f"{pose.size}", "nothing to do: a known fault")
    rows = [
        checks.table(f"{path}: {name}", np.atleast_2d(np.asarray(checks.entry(path, value, name))), columns, 1)[0]
        for name, columns in (("poseCoeff", 48), ("beta", 10), ("trans", 3))
    ]
    return HandFrame(*rows)


def hinge_joint(mobility: bytes, tree: bytes, path: str, tree_path: str) -> Joint:
    """Read the revolute joint of an object of two parts. Raises BadInput for drawers and for more parts."""
    nodes = checks.json_value(path, mobility)
    if not isinstance(nodes, list) or not all(isinstance(node, Mapping) for node in nodes):
        raise BadInput(path, "a list of parts", repr(nodes)[:40])
    kinds = [str(checks.entry(path, node, "joint")) for node in nodes]
    moving = [node for node, kind in zip(nodes, kinds, strict=True) if kind == REVOLUTE]
    fixed = [node for node, kind in zip(nodes, kinds, strict=True) if kind in FIXED]
    if len(moving) != 1 or len(fixed) != 1 or len(nodes) != 2:
        remedy = "nothing to do: objects of two parts with one hinge are read, no drawers and no further parts"
        raise BadInput(path, "one base and one part that turns", ", ".join(kinds) or "none", remedy)
    meshes = _meshes_by_id(checks.json_value(tree_path, tree), tree_path)
    axis = checks.entry(path, checks.entry(path, moving[0], "jointData"), "axis")
    names = ("origin", "direction")
    origin, direction = (checks.table(f"{path}: {name}", [checks.entry(path, axis, name)], 3)[0] for name in names)
    length = float(np.linalg.norm(direction))
    if not 1e-6 < length < 1e6:
        raise BadInput(f"{path}: direction", "a direction", str(direction.tolist()))
    base, turned = (_mesh_of(node, meshes, path) for node in (fixed[0], moving[0]))
    return Joint(base, turned, direction / length, origin)


def _meshes_by_id(tree: Any, path: str) -> dict[Any, list[str]]:
    """Names of the meshes below each node, by node id."""
    meshes: dict[Any, list[str]] = {}

    def visit(node: Any, depth: int) -> list[str]:
        if not isinstance(node, Mapping) or depth > 50:
            raise BadInput(path, "a tree of parts", repr(node)[:40])
        objs, children = node.get("objs", []), node.get("children", [])
        if not isinstance(objs, list) or not isinstance(children, list):
            raise BadInput(path, "lists of meshes and children", repr(node)[:40])
        names = [str(name) for name in objs] + [name for child in children for name in visit(child, depth + 1)]
        meshes[str(node.get("id"))] = names
        return names

    for root in tree if isinstance(tree, list) else [tree]:
        visit(root, 0)
    return meshes


def _mesh_of(node: Mapping[str, Any], meshes: Mapping[Any, list[str]], location: str) -> str:
    parts = checks.entry(location, node, "parts")
    ids = [str(checks.entry(location, part, "id")) for part in parts] if isinstance(parts, list) else []
    names = sorted({name for part_id in ids for name in meshes.get(part_id, [])})
    if len(names) != 1:
        remedy = "nothing to do: which mesh a pose belongs to cannot be told"
        raise BadInput(location, "one mesh for each part", ", ".join(names) or "none", remedy)
    return names[0]
