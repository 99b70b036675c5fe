"""Reads recordings of the full HOT3D release and clips of HOT3D-Clips into one common type.

The full release has JSON lines of hand poses, CSV tables of object poses and checks, and JSON metadata. HOT3D-Clips has
150 frames per tar archive, each with JSON files and images (not read), at 30 Hz. The files do not state actions.

UmeTrack's hand (Han et al. 2022) computes joints from joint angles and a person's profile. A profile describes a left
hand in millimetres, with the wrist at the origin. A right hand is the left one with x mirrored. Each digit is a chain
of four hinges, each given by an axis and a point at rest. A bone follows the second, third and fourth hinge. Landmarks
are attached to bones by weights.
"""

import io
import re
import tarfile
from collections.abc import Iterator, Mapping
from itertools import chain
from operator import itemgetter
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.datasets import checks
from hoidata.datasets.base import DatasetPart, RawTree, SequenceKey
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform

# Object names of instance.json that differ from plain words.
NOUNS = {
    "aria_small": "smart glasses", "birdhouse_toy": "toy birdhouse", "bottle_bbq": "barbecue sauce bottle",
    "bottle_mustard": "mustard bottle", "bottle_ranch": "ranch dressing bottle", "can_parmesan": "parmesan can",
    "can_soup": "soup can", "can_tomato_sauce": "tomato sauce can", "carton_milk": "milk carton",
    "carton_oj": "orange juice carton", "dino_toy": "toy dinosaur", "dumbbell_5lb": "dumbbell",
    "dvd_remote": "remote control", "food_vegetables": "toy vegetables", "food_waffles": "toy waffles",
    "holder_black": "black holder", "holder_gray": "gray holder", "mug_patterned": "patterned mug",
    "mug_white": "white mug", "plate_bamboo": "bamboo plate", "spatula_red": "red spatula",
    "spoon_wooden": "wooden spoon",
}  # fmt: skip


def object_words(name: str) -> str:
    """An object of instance.json in words: ``mug_white`` -> "white mug", ``coffee_pot`` -> "coffee pot"."""
    return NOUNS.get(name, name.replace("_", " "))


HandFormat = Literal["mano", "umetrack"]
# Numbers of one hand in addition to its pose. UmeTrack also has two angles of the wrist, which are zero and unused.
HAND_COLUMNS: Mapping[HandFormat, Mapping[str, int]]
HAND_COLUMNS = {"mano": {"pose": 15, "betas": 10}, "umetrack": {"joint_angles": 22}}
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
            holders = [(wrist if name in WRIST else hand, name, count) for name, count in columns.items()]
            values = chain.from_iterable(list_of_numbers(hand_location, *holder) for holder in holders)
            rows[SIDE_OF_KEY[key]].append((time_ns, list(values)))
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


OBJECTS, METADATA, PROFILE = "dynamic_objects.csv", "metadata.json", "umetrack_hand_user_profile.json"
HANDS: Mapping[HandFormat, str] = {kind: f"{kind}_hand_pose_trajectory.jsonl" for kind in get_args(HandFormat)}
ASSETS, CHECKED = "assets", "masks/mask_qa_pass.csv"
DEFINITIONS, MODEL_FOLDERS = "clip_definitions.json", ("object_models_eval", "object_models")
WITHHELD = "nothing to do: of some participants the makers withhold the ground truth"
_DOWNLOADS = "Aria and Quest downloads, or HOT3D-Clips"
PARTS = (
    DatasetPart("hand motion", (*(f"P*/{name}" for name in HANDS.values()), "*_*/clip-*.tar"), _DOWNLOADS),
    DatasetPart("object motion and headset", (f"P*/{OBJECTS}", f"P*/{METADATA}", DEFINITIONS), _DOWNLOADS),
    DatasetPart(
        "object meshes and names",
        (f"{ASSETS}/*.glb", f"{ASSETS}/instance.json", *(f"{folder}/obj_*.glb" for folder in MODEL_FOLDERS)),
        "Assets download, or HOT3D-Clips",
    ),
    DatasetPart("UmeTrack's profiles", (f"P*/{PROFILE}",), "Aria and Quest downloads", optional=True),
    DatasetPart("frames the makers checked", (f"P*/{CHECKED}",), "Aria and Quest downloads", optional=True),
)


class Source(NamedTuple):
    """Content of the files of one sequence."""

    path: str  # below the raw root
    subject: str  # the participant
    headset: str
    poses: dict[Side, Poses]  # of hands
    profile: "Profile | None"  # of UmeTrack's hands; None for MANO hands
    object_poses: dict[str, Poses]  # by object id
    models: dict[str, tuple[str, str]]  # name and mesh path by object id
    failed_ns: np.ndarray  # (time,) ns at which the authors' check failed


def read_source(raw: RawTree, key: SequenceKey, hand_format: HandFormat) -> Source:
    """Read one sequence with hands of the format. Falls back to UmeTrack if MANO is requested and missing."""
    return _packed(raw, key, hand_format) if "/" in key.name else _folder(raw, key, hand_format)


def _folder(raw: RawTree, key: SequenceKey, hand_format: HandFormat) -> Source:
    """Read one recording of the full release."""

    def read(path: str, max_bytes: int) -> tuple[bytes, str]:
        return raw.read(path, max_bytes), path

    poses, profile = dict[Side, Poses](), None
    for kind in _formats(hand_format):
        path = f"{key.name}/{HANDS[kind]}"
        if not poses and raw.has(path):
            poses = hand_poses(*read(path, MAX_TABLE_BYTES), kind)
            if poses and kind == "umetrack":
                profile = parse_profile(*read(f"{key.name}/{PROFILE}", MAX_JSON_BYTES))
    if not poses:
        raise BadInput(f"{key.name}/{HANDS[hand_format]}", "poses of a hand", "none", WITHHELD)
    objects = object_poses(*read(f"{key.name}/{OBJECTS}", MAX_TABLE_BYTES))
    names = object_names(*read(f"{ASSETS}/instance.json", MAX_JSON_BYTES))
    if unknown := sorted(objects.keys() - names.keys()):
        raise BadInput(f"{ASSETS}/instance.json", f"the object {unknown[0]}", f"{len(names)} others")
    failed_ns, path = np.zeros(0, np.int64), f"{key.name}/{CHECKED}"
    if raw.has(path):
        failed_ns = failed_times(*read(path, MAX_TABLE_BYTES))
    return Source(
        path=key.name,
        subject=key.subject,
        headset=headset(*read(f"{key.name}/{METADATA}", MAX_JSON_BYTES)),
        poses=poses,
        profile=profile,
        object_poses=objects,
        models={uid: (names[uid], f"{ASSETS}/{uid}.glb") for uid in objects},
        failed_ns=failed_ns,
    )


def _packed(raw: RawTree, key: SequenceKey, hand_format: HandFormat) -> Source:
    """Read one clip of HOT3D-Clips. ``clip_definitions.json`` names its recording."""
    path, clip_number = f"{key.name}.tar", int(key.name.rpartition("-")[2])
    recording, device = clip_definition(raw.read(DEFINITIONS, MAX_JSON_BYTES), DEFINITIONS, clip_number)
    packed = read_packed(raw.read(path), path)
    kinds: list[HandFormat] = [kind for kind in _formats(hand_format) if packed.hands[kind]]
    if not kinds:
        raise BadInput(path, "poses of a hand", "none", WITHHELD)
    kind = kinds[0]
    shape, profile = checks.entry(f"{path}/{SHAPES}", packed.shapes, kind), None
    poses: dict[Side, Poses] = dict(packed.hands[kind])
    if kind == "umetrack":
        profile = profile_of(shape, f"{path}/{SHAPES}")
    else:
        betas = small_table(f"{path}/{SHAPES}: mano", [shape], 10, 1)
        for side, side_poses in poses.items():
            betas_of_rows = np.repeat(betas, len(side_poses.time_ns), axis=0)
            poses[side] = side_poses._replace(numbers={**side_poses.numbers, "betas": betas_of_rows})
    folder = next((folder for folder in MODEL_FOLDERS if raw.names(folder, ".glb")), MODEL_FOLDERS[0])
    models = {number: (name, f"{folder}/obj_{int(number):06d}.glb") for number, name in packed.names.items()}
    return Source(
        path=path,
        subject=recording.partition("_")[0],
        headset=device,
        poses=poses,
        profile=profile,
        object_poses=packed.objects,
        models=models,
        failed_ns=np.zeros(0, np.int64),
    )


def _formats(hand_format: HandFormat) -> tuple[HandFormat, ...]:
    """Formats in the order in which they are tried."""
    return ("mano", "umetrack") if hand_format == "mano" else ("umetrack",)


SHAPES = "__hand_shapes.json__"
MEMBER = re.compile(r"([0-9]{6})\.(hands|objects)\.json|" + SHAPES)
STEP_NS = 1e9 / 30
MAX_MEMBERS = 2000  # a clip has 301
WRIST_NUMBERS = 6  # axis-angle, then position
Rows = dict[Any, list[tuple[int, list]]]


class Packed(NamedTuple):
    """Content of one tar archive of HOT3D-Clips."""

    hands: dict[HandFormat, dict[Side, Poses]]
    objects: dict[str, Poses]  # by object number of the benchmark
    names: dict[str, str]  # by object number
    shapes: Any  # hand shapes for MANO and UmeTrack, as in the file


def clip_definition(data: bytes, path: str, number: int) -> tuple[str, str]:
    """Recording and headset of a clip, from ``clip_definitions.json``."""
    entry = checks.entry(path, checks.json_value(path, data), str(number))
    recording = checks.entry(f"{path}: {number}", entry, "sequence_id")
    if not isinstance(recording, str) or not re.fullmatch(r"P[0-9]{4}_[0-9a-f]+", recording):
        raise BadInput(f"{path}: {number}.sequence_id", "a recording such as P0003_c701bd11", repr(recording)[:40])
    return recording, checked_headset(f"{path}: {number}", checks.entry(f"{path}: {number}", entry, "device"))


def read_packed(data: bytes, path: str) -> Packed:
    """Read the JSON files of one clip. Raises BadInput without hands or objects, which test clips withhold."""
    shapes: Any = {}
    hands: dict[HandFormat, Rows] = {"mano": {}, "umetrack": {}}
    objects: Rows = {}
    names: dict[str, str] = {}
    for name, content in _members(data, path):
        location, value = f"{path}/{name}", checks.json_value(f"{path}/{name}", content)
        time_ns = round(int(name[:6]) * STEP_NS) if name != SHAPES else 0
        if name == SHAPES:
            shapes = value
        elif name.endswith("hands.json"):
            _add_hands(location, value, time_ns, hands)
        else:
            _add_objects(location, value, time_ns, objects, names)
    if not objects:
        raise BadInput(path, "poses of hands and objects", "none", "nothing to do: of test clips they are withheld")
    columns = {"mano": {**WRIST, "pose": 15}, "umetrack": {**WRIST, "joint_angles": 20}}
    poses: dict[HandFormat, dict[Side, Poses]] = {
        kind: {side: poses_of(f"{path}: {side} hand", rows, columns[kind]) for side, rows in rows_by_side.items()}
        for kind, rows_by_side in hands.items()
    }
    object_poses = {key: poses_of(f"{path}: object {key}", rows, WRIST) for key, rows in sorted(objects.items())}
    return Packed(poses, object_poses, names, shapes)


def _members(data: bytes, path: str) -> Iterator[tuple[str, bytes]]:
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            members = (m for m in archive if MEMBER.fullmatch(m.name) and m.isfile() and m.size <= MAX_JSON_BYTES)
            for number, member in enumerate(members):
                if number > MAX_MEMBERS:
                    raise BadInput(path, f"at most {MAX_MEMBERS} JSON files", "more")
                stream = archive.extractfile(member)
                yield member.name, stream.read() if stream else b""
    except (tarfile.TarError, OSError, EOFError, ValueError, OverflowError) as error:
        raise BadInput(path, "a whole .tar archive", f"{type(error).__name__}: {str(error)[:80]}") from error


def _add_hands(path: str, value: Any, time_ns: int, hands: Mapping[HandFormat, Rows]) -> None:
    """Add the hands of one frame. An untracked side is null or missing; MANO may be missing next to UmeTrack."""
    for side in SIDES:
        hand = value.get(side) if isinstance(value, dict) else checks.entry(path, value, side)
        if hand is None:
            continue
        location = f"{path}: {side}"
        if isinstance(hand, dict) and "mano_pose" in hand:
            mano_pose, mano_location = hand["mano_pose"], f"{location}.mano_pose"
            wrist = list_of_numbers(mano_location, mano_pose, "wrist_xform", WRIST_NUMBERS)
            xyzw = Rotation.from_rotvec(np.clip(wrist[:3], -100, 100)).as_quat()
            pose = list_of_numbers(mano_location, mano_pose, "thetas", 15)
            hands["mano"].setdefault(side, []).append((time_ns, [*wrist[3:], *np.roll(xyzw, 1).tolist(), *pose]))
        umetrack_pose, umetrack_location = checks.entry(location, hand, "umetrack_pose"), f"{location}.umetrack_pose"
        angles = list_of_numbers(umetrack_location, umetrack_pose, "joint_angles", 20)
        wrist_pose = checks.entry(location, umetrack_pose, "T_world_from_wrist")
        wrist = _translation_and_quaternion(umetrack_location, wrist_pose)
        hands["umetrack"].setdefault(side, []).append((time_ns, [*wrist, *angles]))


def _add_objects(path: str, value: Any, time_ns: int, objects: Rows, names: dict[str, str]) -> None:
    if not isinstance(value, dict):
        raise BadInput(path, "a dictionary of objects by number", type(value).__name__)
    for key, entries in value.items():
        if not re.fullmatch(r"[0-9]{1,6}", key) or not isinstance(entries, list) or len(entries) != 1:
            raise BadInput(f"{path}: {key}", "a number, and one object in a list", repr(entries)[:40])
        pose = checks.entry(f"{path}: {key}", entries[0], "T_world_from_object")
        objects.setdefault(key, []).append((time_ns, _translation_and_quaternion(f"{path}: {key}", pose)))
        names[key] = checked_name(f"{path}: {key}", checks.entry(f"{path}: {key}", entries[0], "object_name"))


def _translation_and_quaternion(location: str, value: Any) -> list:
    columns = {"translation_xyz": 3, "quaternion_wxyz": 4}
    return [number for name, count in columns.items() for number in list_of_numbers(location, value, name, count)]


N_DIGITS, HINGES = 5, 4
N_BONES = 2 + 3 * N_DIGITS  # root and wrist at the same position, then three per digit from the thumb on
N_ANGLES = N_DIGITS * HINGES
MILLIMETRES = 1e-3
# Landmark of each of the 21 joints: wrist; index, middle, pinky, ring from the knuckle out; thumb; tips. UmeTrack has
# none at the base of the thumb.
LANDMARKS = (5, 8, 9, 10, 11, 12, 13, 17, 18, 19, 14, 15, 16, None, 6, 7, 1, 2, 4, 3, 0)


class Profile(NamedTuple):
    """UmeTrack's left hand of one person at rest, in the wrist frame."""

    axes: np.ndarray  # (20, 3) unit vectors of the hinges
    hinge_points_m: np.ndarray  # (20, 3) a point on each hinge axis
    landmarks_m: np.ndarray  # (21, 3)
    skin: np.ndarray  # (21, 17) weight of each bone for each landmark


def parse_profile(data: bytes, path: str) -> Profile:
    """Read ``umetrack_hand_user_profile.json``, without its mesh."""
    return profile_of(checks.entry(path, checks.json_value(path, data), "hand_model"), path)


def profile_of(hand: Any, location: str) -> Profile:
    """Convert a file's description of the hand."""

    def rows(name: str, count: int) -> np.ndarray:
        return small_table(f"{location}: {name}", checks.entry(location, hand, name), 3, count)

    names = ("joint_rotation_axes", "joint_rest_positions")
    axes, hinge_points = (rows(name, N_ANGLES + 2)[:N_ANGLES] for name in names)
    if (np.abs(np.linalg.norm(axes, axis=1) - 1) > 1e-3).any():
        raise BadInput(f"{location}: joint_rotation_axes", "axes of length 1", "another length")
    landmarks = rows("landmark_rest_positions", len(LANDMARKS))
    bones, weights = (rows(f"landmark_rest_bone_{name}", len(LANDMARKS)) for name in ("indices", "weights"))
    if not np.isin(bones, range(N_BONES)).all() or (np.abs(weights.sum(axis=1) - 1) > 1e-3).any():
        expected = f"bones 0 to {N_BONES - 1}, weights that sum to 1"
        raise BadInput(f"{location}: landmark_rest_bone_*", expected, "others")
    skin = np.zeros((len(LANDMARKS), N_BONES))
    np.add.at(skin, (np.arange(len(LANDMARKS))[:, None], bones.astype(int)), weights)
    return Profile(axes, hinge_points * MILLIMETRES, landmarks * MILLIMETRES, skin)


def joints_m(profile: Profile, poses: Poses, side: Side) -> np.ndarray:
    """Joints and tips in hoidata's order, (row, 21, 3) in the file's world, metres. The thumb's base is NaN."""
    bones = _bones(profile, poses.numbers["joint_angles"][:, :N_ANGLES])
    moved = np.stack([bone @ profile.landmarks_m for bone in bones], axis=-2)  # (row, landmark, bone, 3)
    local = np.einsum("lb,rlbc->rlc", profile.skin, moved)
    if side == "right":
        local = local * (-1.0, 1.0, 1.0)
    world = local @ poses.rotation.transpose(0, 2, 1) + poses.translation_m[:, None]
    columns = [np.full_like(world[:, 0], np.nan) if landmark is None else world[:, landmark] for landmark in LANDMARKS]
    return np.stack(columns, axis=1)


def _bones(profile: Profile, angles: np.ndarray) -> list[RigidTransform]:
    """Pose of each bone in the wrist frame by forward kinematics, (row,) transforms. angles: (row, 20) radians."""
    identity = RigidTransform(np.tile(np.eye(3), (len(angles), 1, 1)))
    bones = [identity, identity]
    for first in range(0, N_ANGLES, HINGES):
        bone = identity
        for hinge in range(first, first + HINGES):
            rotation = rotvec_to_rotmat(profile.axes[hinge] * angles[:, hinge, None])
            bone = bone @ RigidTransform(rotation, profile.hinge_points_m[hinge], profile.hinge_points_m[hinge])
            if hinge > first:
                bones.append(bone)
    return bones
