"""What the files of one recording, or of one clip cut from it, say: the full release and HOT3D-Clips, read alike.

HOT3D-Clips: 150 frames as a tar with JSON files of each, and images, which are not read; its own clock is 30 Hz.
UmeTrack's hand (Han et al. 2022) goes from joint angles and a person's profile to joints. A profile describes a left
hand in millimetres, its wrist at the origin; a right hand is the same, x mirrored. Each digit has four hinges one after
the other, given by an axis and a point at rest; after the second, third and fourth a bone follows. Landmarks hang on
bones with weights.
"""

import io
import re
import tarfile
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.datasets import checks
from hoidata.datasets.base import DatasetPart, RawTree, SequenceKey
from hoidata.datasets.hot3d import files
from hoidata.datasets.hot3d.files import (
    LARGEST_JSON,
    LARGEST_ROWS,
    HandFormat,
    Poses,
    checked_name,
    headset_of,
    poses_of,
    read_json,
    row_of,
    small_table,
)
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform

OBJECTS, METADATA, PROFILE = "dynamic_objects.csv", "metadata.json", "umetrack_hand_user_profile.json"
HANDS: Mapping[HandFormat, str] = {kind: f"{kind}_hand_pose_trajectory.jsonl" for kind in get_args(HandFormat)}
ASSETS, CHECKED = "assets", "masks/mask_qa_pass.csv"
DEFINITIONS, MODEL_FOLDERS = "clip_definitions.json", ("object_models_eval", "object_models")
WITHHELD = "nothing to do: of some participants the makers withhold the ground truth"
PARTS = (
    DatasetPart(
        "hand motion",
        (*(f"P*/{name}" for name in HANDS.values()), "*_*/clip-*.tar"),
        "Aria and Quest downloads, or HOT3D-Clips",
    ),
    DatasetPart(
        "object motion and headset",
        (f"P*/{OBJECTS}", f"P*/{METADATA}", DEFINITIONS),
        "Aria and Quest downloads, or HOT3D-Clips",
    ),
    DatasetPart(
        "object meshes and names",
        (f"{ASSETS}/*.glb", f"{ASSETS}/instance.json", *(f"{folder}/obj_*.glb" for folder in MODEL_FOLDERS)),
        "Assets download, or HOT3D-Clips",
    ),
    DatasetPart("UmeTrack's profiles", (f"P*/{PROFILE}",), "Aria and Quest downloads", optional=True),
    DatasetPart("frames the makers checked", (f"P*/{CHECKED}",), "Aria and Quest downloads", optional=True),
)


class Source(NamedTuple):
    """What the files of one sequence say. place: below the raw root. subject: the participant.

    placed: by object; models: name and mesh of each. profile: UmeTrack's, where its hands are used.
    """

    place: str
    subject: str
    headset: str
    poses: dict[Side, Poses]
    profile: "Profile | None"
    placed: dict[str, Poses]
    models: dict[str, tuple[str, str]]
    failed_ns: np.ndarray


def read_source(raw: RawTree, key: SequenceKey, wanted: HandFormat) -> Source:
    """One sequence with hands of the format, or UmeTrack's where MANO's are wanted and not there."""
    return _packed(raw, key, wanted) if "/" in key.name else _folder(raw, key, wanted)


def _folder(raw: RawTree, key: SequenceKey, wanted: HandFormat) -> Source:
    """One recording of the full release."""

    def read(path: str, largest: int) -> tuple[bytes, str]:
        return raw.read(path, largest), path

    headset = files.headset(*read(f"{key.name}/{METADATA}", LARGEST_JSON))
    poses, profile = dict[Side, Poses](), None
    for kind in _formats(wanted):
        path = f"{key.name}/{HANDS[kind]}"
        if not poses and raw.has(path):
            poses = files.hand_poses(*read(path, LARGEST_ROWS), kind)
            if poses and kind == "umetrack":
                profile = parse_profile(*read(f"{key.name}/{PROFILE}", LARGEST_JSON))
    if not poses:
        raise BadInput(f"{key.name}/{HANDS[wanted]}", "poses of a hand", "none", WITHHELD)
    placed = files.object_poses(*read(f"{key.name}/{OBJECTS}", LARGEST_ROWS))
    names = files.object_names(*read(f"{ASSETS}/instance.json", LARGEST_JSON))
    if unknown := sorted(placed.keys() - names.keys()):
        raise BadInput(f"{ASSETS}/instance.json", f"the object {unknown[0]}", f"{len(names)} others")
    failed_ns, path = np.zeros(0, np.int64), f"{key.name}/{CHECKED}"
    if raw.has(path):
        failed_ns = files.failed_times(*read(path, LARGEST_ROWS))
    models = {uid: (names[uid], f"{ASSETS}/{uid}.glb") for uid in placed}
    return Source(key.name, key.subject, headset, poses, profile, placed, models, failed_ns)


def _packed(raw: RawTree, key: SequenceKey, wanted: HandFormat) -> Source:
    """One of HOT3D-Clips, whose recording stands in a table of all."""
    path, number = f"{key.name}.tar", int(key.name.rpartition("-")[2])
    recording, headset = definition(raw.read(DEFINITIONS, LARGEST_JSON), DEFINITIONS, number)
    found = read_packed(raw.read(path), path)
    kinds: list[HandFormat] = [kind for kind in _formats(wanted) if found.hands[kind]]
    if not kinds:
        raise BadInput(path, "poses of a hand", "none", WITHHELD)
    kind = kinds[0]
    shape, profile = checks.entry(f"{path}/{SHAPES}", found.shapes, kind), None
    poses: dict[Side, Poses] = dict(found.hands[kind])
    if kind == "umetrack":
        profile = profile_of(shape, f"{path}/{SHAPES}")
    else:
        betas = files.small_table(f"{path}/{SHAPES}: mano", [shape], 10, 1)
        for side, own in poses.items():
            poses[side] = own._replace(numbers={**own.numbers, "betas": np.repeat(betas, len(own.time_ns), axis=0)})
    folder = next((folder for folder in MODEL_FOLDERS if raw.names(folder, ".glb")), MODEL_FOLDERS[0])
    models = {thing: (name, f"{folder}/obj_{int(thing):06d}.glb") for thing, name in found.names.items()}
    return Source(
        path, recording.partition("_")[0], headset, poses, profile, found.objects, models, np.zeros(0, np.int64)
    )


def _formats(wanted: HandFormat) -> tuple[HandFormat, ...]:
    """In the order in which they are tried."""
    return ("mano", "umetrack") if wanted == "mano" else ("umetrack",)


SHAPES = "__hand_shapes.json__"
MEMBER = re.compile(r"([0-9]{6})\.(hands|objects)\.json|" + SHAPES)
STEP_NS = 1e9 / 30
MOST_MEMBERS = 2000  # a clip has 301
WRIST_NUMBERS = 6  # axis-angle, then place
COLUMNS = {"t_xyz": 3, "q_wxyz": 4}
Rows = dict[Any, list[tuple[int, list]]]


class Packed(NamedTuple):
    """hands: by format and side; objects and names: by the number of the benchmark; shapes: MANO's and UmeTrack's."""

    hands: dict[HandFormat, dict[Side, Poses]]
    objects: dict[str, Poses]
    names: dict[str, str]
    shapes: Any


def definition(data: bytes, where: str, number: int) -> tuple[str, str]:
    """The recording a clip is from, and its headset, of ``clip_definitions.json``."""
    about = checks.entry(where, read_json(data, where), str(number))
    recording = checks.entry(f"{where}: {number}", about, "sequence_id")
    if not isinstance(recording, str) or not re.fullmatch(r"P[0-9]{4}_[0-9a-f]+", recording):
        raise BadInput(f"{where}: {number}.sequence_id", "a recording such as P0003_c701bd11", repr(recording)[:40])
    return recording, headset_of(f"{where}: {number}", checks.entry(f"{where}: {number}", about, "device"))


def read_packed(data: bytes, where: str) -> Packed:
    """The JSON files of one clip. Raises BadInput where it has no hands or objects: of test clips they are withheld."""
    shapes: Any = {}
    hands: dict[HandFormat, Rows] = {"mano": {}, "umetrack": {}}
    objects: Rows = {}
    names: dict[str, str] = {}
    for name, content in _members(data, where):
        place, value = f"{where}/{name}", read_json(content, f"{where}/{name}")
        time_ns = round(int(name[:6]) * STEP_NS) if name != SHAPES else 0
        if name == SHAPES:
            shapes = value
        elif name.endswith("hands.json"):
            _add_hands(place, value, time_ns, hands)
        else:
            _add_objects(place, value, time_ns, objects, names)
    if not objects:
        raise BadInput(where, "poses of hands and objects", "none", "nothing to do: of test clips they are withheld")
    columns: dict[HandFormat, dict[str, int]] = {
        "mano": {**COLUMNS, "pose": 15},
        "umetrack": {**COLUMNS, "joint_angles": 20},
    }
    poses: dict[HandFormat, dict[Side, Poses]] = {
        kind: {side: poses_of(f"{where}: {side} hand", rows, columns[kind]) for side, rows in found.items()}
        for kind, found in hands.items()
    }
    placed = {key: poses_of(f"{where}: object {key}", rows, COLUMNS) for key, rows in sorted(objects.items())}
    return Packed(poses, placed, names, shapes)


def _members(data: bytes, where: str) -> Iterator[tuple[str, bytes]]:
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            wanted = (m for m in archive if MEMBER.fullmatch(m.name) and m.isfile() and m.size <= LARGEST_JSON)
            for number, member in enumerate(wanted):
                if number > MOST_MEMBERS:
                    raise BadInput(where, f"at most {MOST_MEMBERS} JSON files", "more")
                stream = archive.extractfile(member)
                yield member.name, stream.read() if stream else b""
    except (tarfile.TarError, OSError, EOFError, ValueError, OverflowError) as error:
        raise BadInput(where, "a whole .tar archive", f"{type(error).__name__}: {str(error)[:80]}") from error


def _add_hands(where: str, value: Any, time_ns: int, hands: Mapping[HandFormat, Rows]) -> None:
    """A side that is null or not there was not tracked; MANO may be missing where UmeTrack is there."""
    for side in SIDES:
        hand = value.get(side) if isinstance(value, dict) else checks.entry(where, value, side)
        if hand is None:
            continue
        place = f"{where}: {side}"
        if isinstance(hand, dict) and "mano_pose" in hand:
            orient_and_place = row_of(f"{place}.mano_pose", hand["mano_pose"], "wrist_xform", WRIST_NUMBERS)
            turn = np.roll(Rotation.from_rotvec(np.clip(orient_and_place[:3], -100, 100)).as_quat(), 1).tolist()
            pose = row_of(f"{place}.mano_pose", hand["mano_pose"], "thetas", 15)
            hands["mano"].setdefault(side, []).append((time_ns, [*orient_and_place[3:], *turn, *pose]))
        own = checks.entry(place, hand, "umetrack_pose")
        angles = row_of(f"{place}.umetrack_pose", own, "joint_angles", 20)
        placed = _placed(f"{place}.umetrack_pose", checks.entry(place, own, "T_world_from_wrist"))
        hands["umetrack"].setdefault(side, []).append((time_ns, [*placed, *angles]))


def _add_objects(where: str, value: Any, time_ns: int, objects: Rows, names: dict[str, str]) -> None:
    if not isinstance(value, dict):
        raise BadInput(where, "a dictionary of objects by number", type(value).__name__)
    for key, things in value.items():
        if not re.fullmatch(r"[0-9]{1,6}", key) or not isinstance(things, list) or len(things) != 1:
            raise BadInput(f"{where}: {key}", "a number, and one object in a list", repr(things)[:40])
        place = _placed(f"{where}: {key}", checks.entry(f"{where}: {key}", things[0], "T_world_from_object"))
        objects.setdefault(key, []).append((time_ns, place))
        names[key] = checked_name(f"{where}: {key}", checks.entry(f"{where}: {key}", things[0], "object_name"))


def _placed(where: str, value: Any) -> list:
    return [*row_of(where, value, "translation_xyz", 3), *row_of(where, value, "quaternion_wxyz", 4)]


N_DIGITS, HINGES = 5, 4
N_BONES = 2 + 3 * N_DIGITS  # root and wrist, which lie in the same place, then three of each digit from the thumb on
N_ANGLES = N_DIGITS * HINGES
MILLIMETRES = 1e-3
# The landmark of each of our 21 joints: wrist; index, middle, pinky, ring from the knuckle out; thumb; tips. UmeTrack
# has no landmark at the base of the thumb.
LANDMARKS = (5, 8, 9, 10, 11, 12, 13, 17, 18, 19, 14, 15, 16, None, 6, 7, 1, 2, 4, 3, 0)


class Profile(NamedTuple):
    """axes: (20, 3) unit; places_m: (20, 3) a point of each hinge at rest; landmarks_m: (21, 3) at rest.

    skin: (21, 17) weight of each bone for each landmark.
    """

    axes: np.ndarray
    places_m: np.ndarray
    landmarks_m: np.ndarray
    skin: np.ndarray


def parse_profile(data: bytes, where: str) -> Profile:
    """``umetrack_hand_user_profile.json``; the mesh it also holds is not looked at."""
    return profile_of(checks.entry(where, read_json(data, where), "hand_model"), where)


def profile_of(hand: Any, where: str) -> Profile:
    """From what a file says of the hand."""

    def rows(name: str, count: int) -> np.ndarray:
        return small_table(f"{where}: {name}", checks.entry(where, hand, name), 3, count)

    axes, places = (rows(f"joint_{name}", N_ANGLES + 2)[:N_ANGLES] for name in ("rotation_axes", "rest_positions"))
    if (np.abs(np.linalg.norm(axes, axis=1) - 1) > 1e-3).any():
        raise BadInput(f"{where}: joint_rotation_axes", "axes of length 1", "another length")
    landmarks = rows("landmark_rest_positions", len(LANDMARKS))
    bones, weights = (rows(f"landmark_rest_bone_{name}", len(LANDMARKS)) for name in ("indices", "weights"))
    if not np.isin(bones, range(N_BONES)).all() or (np.abs(weights.sum(axis=1) - 1) > 1e-3).any():
        raise BadInput(f"{where}: landmark_rest_bone_*", f"bones 0 to {N_BONES - 1}, weights that sum to 1", "others")
    skin = np.zeros((len(LANDMARKS), N_BONES))
    np.add.at(skin, (np.arange(len(LANDMARKS))[:, None], bones.astype(int)), weights)
    return Profile(axes, places * MILLIMETRES, landmarks * MILLIMETRES, skin)


def joints_m(profile: Profile, poses: Poses, side: Side) -> np.ndarray:
    """(row, 21, 3) joints and tips in our order and the file's world, metres; NaN for the base of the thumb."""
    bones = _bones(profile, poses.numbers["joint_angles"][:, :N_ANGLES])
    moved = np.stack([bone @ profile.landmarks_m for bone in bones], axis=-2)  # (row, landmark, bone, 3)
    local = np.einsum("lb,rlbc->rlc", profile.skin, moved)
    if side == "right":
        local = local * (-1.0, 1.0, 1.0)
    world = local @ poses.rotation.transpose(0, 2, 1) + poses.translation_m[:, None]
    found = [np.full_like(world[:, 0], np.nan) if landmark is None else world[:, landmark] for landmark in LANDMARKS]
    return np.stack(found, axis=1)


def _bones(profile: Profile, angles: np.ndarray) -> list[RigidTransform]:
    """Each bone's turn about the hinges before it, (row,) transforms in the wrist's frame; angles: (row, 20)."""
    still = RigidTransform(np.tile(np.eye(3), (len(angles), 1, 1)))
    bones = [still, still]
    for first in range(0, N_ANGLES, HINGES):
        bone = still
        for hinge in range(first, first + HINGES):
            turn = rotvec_to_rotmat(profile.axes[hinge] * angles[:, hinge, None])
            bone = bone @ RigidTransform(turn, profile.places_m[hinge], profile.places_m[hinge])
            if hinge > first:
                bones.append(bone)
    return bones
