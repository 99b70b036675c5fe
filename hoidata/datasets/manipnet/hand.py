"""ManipNet's hand: 17 joints, 19 capsules, and a skin with 104 proximity sensors. Also a strict reader of BVH files.

The files have the right hand in left-handed decimetres. This module returns it right-handed in metres. The left hand is
its exact mirror image.

A BVH file has a text tree of joints with rotation order Y, X, Z, followed by one line of numbers per frame. The reader
returns angles in radians and everything else in the units of the file.
"""

import gzip
import io
import json
import zlib
from dataclasses import dataclass, replace

import numpy as np

from hoidata.datasets.base import RawTree
from hoidata.errors import BadInput
from hoidata.files.numpy_files import load_npz_arrays
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import JointCapsules, Skin, TrackedHand

ROOT_CHANNELS = "6 Xposition Yposition Zposition Yrotation Xrotation Zrotation"
JOINT_CHANNELS = "3 Yrotation Xrotation Zrotation"
MAX_TEXT_BYTES = 32 * 2**20  # the largest released file has 4.3 MB
MAX_JOINTS = 256
MAX_FRAMES = 1_000_000


@dataclass(frozen=True)
class BvhMotion:
    """A skeleton and its motion in the units and axes of the file."""

    names: tuple[str, ...]  # joints in file order, parents before children, without end sites
    parents: np.ndarray  # (joint,) index of the parent, -1 for the root
    offsets: np.ndarray  # (joint, 3) from the parent, in the parent's frame
    root_position: np.ndarray  # (frame, 3)
    angles_yxz_rad: np.ndarray  # (frame, joint, 3) about Y, X and Z; rotation ``Ry @ Rx @ Rz`` on column vectors
    frame_time_s: float

    @property
    def n_frames(self) -> int:
        return len(self.root_position)

    def at(self, frames: np.ndarray) -> "BvhMotion":
        """The same skeleton at selected frames (index array or slice)."""
        return replace(self, root_position=self.root_position[frames], angles_yxz_rad=self.angles_yxz_rad[frames])

    def seen_in_mirror_x(self) -> "BvhMotion":
        """The motion with x of the world and of every joint negated, which changes handedness."""
        offsets, root_position = self.offsets * MIRROR_X, self.root_position * MIRROR_X
        angles = self.angles_yxz_rad * np.array([-1.0, 1.0, -1.0])
        return replace(self, offsets=offsets, root_position=root_position, angles_yxz_rad=angles)

    def world_joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (frame, joint, 3) in the file's unit and rotations ``world_from_joint`` (frame, joint, 3, 3)."""
        local = angles_yxz_to_rotmat(self.angles_yxz_rad)
        rotations = local.copy()
        positions = np.empty(self.angles_yxz_rad.shape)
        positions[:, 0] = self.root_position + self.offsets[0]
        for joint, parent in enumerate(self.parents[1:], start=1):
            rotations[:, joint] = rotations[:, parent] @ local[:, joint]
            positions[:, joint] = positions[:, parent] + rotations[:, parent] @ self.offsets[joint]
        return positions, rotations


def angles_yxz_to_rotmat(angles_yxz_rad: np.ndarray) -> np.ndarray:
    """Angles about Y, X, Z in radians (..., 3) to ``Ry @ Rx @ Rz`` (..., 3, 3), column vectors."""
    axes = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotation_y, rotation_x, rotation_z = (rotvec_to_rotmat(angles_yxz_rad[..., i, None] * axes[i]) for i in range(3))
    return rotation_y @ rotation_x @ rotation_z


def parse_bvh(text: str, path: str) -> BvhMotion:
    """Parse the text of a BVH file.

    Raises BadInput on anything that is not exactly this dialect: root channels X, Y, Z position and Y, X, Z rotation,
    other joints Y, X, Z rotation; as many frames and columns as announced; finite numbers only.
    """
    lines = text.splitlines()
    motion_line = next((i for i, line in enumerate(lines) if line.strip() == "MOTION"), None)
    if motion_line is None:
        raise BadInput(path, "a line MOTION after the hierarchy", f"none in {len(lines)} lines")
    skeleton = _SkeletonReader("\n".join(lines[:motion_line]), path)
    skeleton.read()
    names = skeleton.names
    frames, frame_time_s = _parse_motion_head(lines[motion_line + 1 : motion_line + 3], path)
    rows = [line for line in lines[motion_line + 3 :] if line.strip()]
    table = _parse_rows(rows, frames, 3 + 3 * len(names), path)
    return BvhMotion(
        names=tuple(names),
        parents=np.array(skeleton.parents),
        offsets=np.array(skeleton.offsets),
        root_position=table[:, :3],
        angles_yxz_rad=np.deg2rad(table[:, 3:].reshape(frames, len(names), 3)),
        frame_time_s=frame_time_s,
    )


def unpack_text(data: bytes, path: str, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Unpack gzipped text of at most ``max_bytes``. Raises BadInput if it is larger or unreadable."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            unpacked = stream.read(max_bytes + 1)
        text = unpacked.decode("utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise BadInput(path, "gzipped text", f"{type(error).__name__}: {error}") from error
    if len(unpacked) > max_bytes:
        raise BadInput(path, f"at most {max_bytes} bytes of text", "more", "check that it is the released file")
    return text


class _SkeletonReader:
    """Recursive descent parser of the words before MOTION. Checks end sites and drops them."""

    def __init__(self, text: str, path: str) -> None:
        self.words = text.split()
        self.position = 0
        self.path = path
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []

    def read(self) -> None:
        self.expect("HIERARCHY", "ROOT")
        self.read_joint(-1)
        if self.position < len(self.words):
            raise self.wrong("MOTION after the one root", self.words[self.position])

    def read_joint(self, parent: int) -> None:
        joint = len(self.names)
        if joint >= MAX_JOINTS:
            raise self.wrong(f"at most {MAX_JOINTS} joints", "more")
        self.names.append(self.take())
        self.parents.append(parent)
        self.expect("{", "OFFSET")
        self.offsets.append(self.read_numbers())
        self.expect("CHANNELS", *(ROOT_CHANNELS if parent < 0 else JOINT_CHANNELS).split())
        while (word := self.take()) != "}":
            if word == "JOINT":
                self.read_joint(joint)
            elif word == "End":
                self.expect("Site", "{", "OFFSET")
                self.read_numbers()
                self.expect("}")
            else:
                raise self.wrong("JOINT, End Site or a closing brace", word)

    def read_numbers(self) -> list[float]:
        words = [self.take() for _ in range(3)]
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            raise self.wrong("three numbers after OFFSET", " ".join(words)) from None
        if not np.isfinite(numbers).all():
            raise self.wrong("finite numbers after OFFSET", " ".join(words))
        return numbers

    def expect(self, *words: str) -> None:
        for word in words:
            if (got := self.take()) != word:
                raise self.wrong(f"{word} (in {' '.join(words)})", got)

    def take(self) -> str:
        if self.position >= len(self.words):
            raise self.wrong("more of the hierarchy", "its end")
        self.position += 1
        return self.words[self.position - 1]

    def wrong(self, expected: str, got: str) -> BadInput:
        after = f"after joint {self.names[-1][:40]}" if self.names else "at the start"
        return BadInput(f"{self.path} {after}", expected, repr(got[:40]))


def _parse_motion_head(lines: list[str], path: str) -> tuple[int, float]:
    words = " ".join(lines).split()
    try:
        if words[0] != "Frames:" or words[2:4] != ["Frame", "Time:"]:
            raise ValueError
        frames, frame_time_s = int(words[1]), float(words[4])
    except (ValueError, IndexError):
        raise BadInput(path, "lines 'Frames: N' and 'Frame Time: seconds'", repr(" ".join(lines)[:80])) from None
    if not 0 < frames <= MAX_FRAMES or not 1e-4 < frame_time_s < 1:
        raise BadInput(path, f"1 to {MAX_FRAMES} frames of 0.0001 to 1 s", f"{frames} frames of {frame_time_s} s")
    return frames, frame_time_s


def _parse_rows(rows: list[str], frames: int, columns: int, path: str) -> np.ndarray:
    if len(rows) != frames:
        raise BadInput(path, f"{frames} motion lines as announced", f"{len(rows)}")
    words = [line.split() for line in rows]
    wrong = next((i for i, numbers in enumerate(words) if len(numbers) != columns), None)
    if wrong is not None:
        raise BadInput(path, f"{columns} columns", f"{len(words[wrong])} in frame {wrong}")
    try:
        table = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise BadInput(path, "numbers", str(error)) from error
    if not np.isfinite(table).all():
        frame, column = np.argwhere(~np.isfinite(table))[0]
        raise BadInput(path, "finite numbers", f"{table[frame, column]} in frame {frame}, column {column}")
    return table


HAND_REFERENCE = "hand/hand_reference.json"
LARGEST_REFERENCE = 1 << 20  # bytes
HAND_SKIN = "hand/right_hand_skin.npz"
METRES_PER_UNIT = 0.1
MIRROR_X = np.array([-1.0, 1.0, 1.0])
N_CAPSULES, N_SENSORS = 19, 104
_MIRROR = np.diag([*MIRROR_X, 1.0])
THUMB_BASE = 1  # THUMB_CMC_FE, whose bone the skin does not know: that bone's place is the wrist's
# ManipNet's limits about the neutral pose, degrees, by the end of the joint's name: its measured ranges widened by 10
# below and 30 above (HandIK). Hinges turn about the local z axis of the files.
LIMITS_DEG = {
    "THUMB_MCP_FE": (-10.0, 103.8), "THUMB_IP_FE": (-24.8, 92.3), "PIP_FE": (-10.0, 137.9), "DIP_FE": (-10.0, 112.1),
}  # fmt: skip
_SHAPES = {
    "vertices": (788, 3), "normals": (788, 3), "bone_indices": (788, 4), "bone_weights": (788, 4),
    "bind_poses": (17, 4, 4),
}  # fmt: skip


def read_hand(raw: RawTree, skeleton: BvhMotion) -> TrackedHand:
    """Read the right hand. skeleton: motion of a right hand, right-handed. Raises BadInput."""
    capsules, sensors = _read_reference(raw, skeleton.names)
    skin = _read_skin(raw)
    joint_from_skin = _MIRROR @ _rigid(skin["bind_poses"]) @ _MIRROR
    offset_m = skeleton.offsets * METRES_PER_UNIT
    offset_m[0] = 0.0
    # Joints without children, one per finger: thumb, index, middle, ring, pinky.
    last_joints = np.setdiff1d(np.arange(len(skeleton.parents)), skeleton.parents)
    tips = np.array([np.flatnonzero(capsules.joint == joint)[0] for joint in last_joints])
    rest = _rest_rotmats(joint_from_skin, skeleton)
    hinge, limits = _hinges(skeleton.names)
    to_joint = RigidTransform(joint_from_skin[:, :3, :3], joint_from_skin[:, :3, 3] * METRES_PER_UNIT)
    return TrackedHand(
        side="right",
        layout="manipnet",
        joint_names=skeleton.names,
        parents=skeleton.parents,
        offset_m=offset_m,
        rest_rotmats=rest,
        skin=_sensing_skin(skin, sensors, capsules.joint[tips], capsules.end_m[tips], to_joint),
        tip_joint=capsules.joint[tips],
        capsules=capsules,
        middle_knuckle=skeleton.names.index("MIDDLE_MCP"),
        wrist_from_canonical=np.eye(3),
        hinge_axis=hinge,
        limit_rad=limits,
    )


def _read_reference(raw: RawTree, names: tuple[str, ...]) -> tuple[JointCapsules, np.ndarray]:
    """Read the 19 capsules and the 104 skin vertices of the proximity sensors."""
    try:
        reference = json.loads(raw.read(HAND_REFERENCE, LARGEST_REFERENCE))
        capsule_entries = reference["capsules"]
        joint = np.array([names.index(capsule["joint"]) for capsule in capsule_entries])
        ends = ("start_local", "end_local")
        start, end = (np.array([entry[key] for entry in capsule_entries], dtype=np.float64) for key in ends)
        radius = np.array([capsule["radius"] for capsule in capsule_entries], dtype=np.float64)
        sensors = np.array(reference["proximity_vertices"], dtype=np.int64)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        expected = "capsules with joint, start_local, end_local and radius, and proximity_vertices"
        raise BadInput(HAND_REFERENCE, expected, f"{type(error).__name__}: {error}") from error
    has_shapes = start.shape == end.shape == (N_CAPSULES, 3) and radius.shape == (N_CAPSULES,)
    if not has_shapes or not np.isfinite([*start.flat, *end.flat, *radius]).all() or not (radius > 0).all():
        expected = f"{N_CAPSULES} capsules of finite numbers with positive radii"
        raise BadInput(HAND_REFERENCE, expected, f"arrays {start.shape}, {end.shape}, {radius.shape}")
    if sensors.shape != (N_SENSORS,) or sensors.min() < 0 or sensors.max() >= _SHAPES["vertices"][0]:
        raise BadInput(HAND_REFERENCE, f"{N_SENSORS} vertices of the skin", f"{sensors.shape}")
    start, end = (ends * MIRROR_X * METRES_PER_UNIT for ends in (start, end))
    return JointCapsules(joint, start, end, radius * METRES_PER_UNIT), sensors


def _read_skin(raw: RawTree) -> dict[str, np.ndarray]:
    arrays = load_npz_arrays(raw.file(HAND_SKIN))
    for name, shape in _SHAPES.items():
        if name not in arrays or arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            got = "nothing" if name not in arrays else f"{arrays[name].shape}"
            raise BadInput(f"{HAND_SKIN}: {name}", f"finite numbers of shape {shape}", got)
    bones = arrays["bone_indices"]
    if bones.min() < 0 or bones.max() > 16 or np.abs(arrays["bone_weights"].sum(axis=1) - 1).max() > 1e-4:
        raise BadInput(HAND_SKIN, "bones 0 to 16 and weights that sum to 1", "others")
    kind = {name: np.int64 if name == "bone_indices" else np.float64 for name in _SHAPES}
    return {name: np.asarray(arrays[name], kind[name]) for name in _SHAPES}


def _rigid(poses: np.ndarray) -> np.ndarray:
    """Project the rotations of float32 poses (..., 4, 4) to the closest exact rotations."""
    u, _, v = np.linalg.svd(poses[..., :3, :3])
    poses = poses.copy()
    poses[..., :3, :3] = u @ v
    return poses


def _sensing_skin(
    skin: dict[str, np.ndarray], sensors: np.ndarray, tip_joint: np.ndarray, tip_m: np.ndarray, to_joint: RigidTransform
) -> Skin:
    """Skin points: the fingertips, each attached to its finger's last joint, then the sensors."""
    bones, values = skin["bone_indices"][sensors], skin["bone_weights"][sensors]
    weight = np.zeros((len(tip_joint) + len(sensors), 17))
    weight[np.arange(len(tip_joint)), tip_joint] = 1.0
    bones = np.where(bones == THUMB_BASE, 0, bones)
    np.add.at(weight, (len(tip_joint) + np.arange(len(sensors))[:, None], bones), values)
    weight /= weight.sum(axis=1, keepdims=True)
    tips = (to_joint[tip_joint].inverse() @ tip_m[:, None])[:, 0]
    points = skin["vertices"][sensors] * MIRROR_X * METRES_PER_UNIT
    normals = np.concatenate([np.tile([1.0, 0.0, 0.0], (len(tips), 1)), skin["normals"][sensors] * MIRROR_X])
    return Skin(np.concatenate([tips, points]), normals, weight, to_joint)


def _rest_rotmats(joint_from_skin: np.ndarray, skeleton: BvhMotion) -> np.ndarray:
    """(16, 3, 3) local rotations of the bind pose; the thumb's base, which the skin lacks, rotates minimally."""
    skin_from_joint = np.linalg.inv(joint_from_skin)
    rotation, position = skin_from_joint[:, :3, :3], skin_from_joint[:, :3, 3]
    knuckle_offset = rotation[0].T @ (position[THUMB_BASE + 1] - position[0]) - skeleton.offsets[THUMB_BASE]
    rotation[THUMB_BASE] = rotation[0] @ _smallest_rotation(skeleton.offsets[THUMB_BASE + 1], knuckle_offset)
    return rotation[skeleton.parents[1:]].swapaxes(1, 2) @ rotation[1:]


def _smallest_rotation(from_direction: np.ndarray, to_direction: np.ndarray) -> np.ndarray:
    """The smallest rotation from one direction to another, which must not be opposite."""
    a, b = from_direction / np.linalg.norm(from_direction), to_direction / np.linalg.norm(to_direction)
    x, y, z = np.cross(a, b)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def _hinges(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Hinge axes (17, 3) and limits (17, 2) in radians. Negating x turns an angle about z into one about -z."""
    axis, limit = np.zeros((len(names), 3)), np.zeros((len(names), 2))
    for joint, name in enumerate(names):
        for ending, degrees in LIMITS_DEG.items():
            if name.endswith(ending):
                axis[joint, 2], limit[joint] = -1.0, np.deg2rad(degrees)
    return axis, limit
