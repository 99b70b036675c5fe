"""ManipNet's own hand: 17 joints, 19 capsules, and the skin its 104 proximity sensors sit on.

The files hold the right hand in left-handed decimetres; here it is seen in the mirror, in metres. Its left hand is
this one in a mirror again, exactly.
"""

import json

import numpy as np

from hoidata.datasets.base import RawTree
from hoidata.datasets.manipnet.bvh import BvhMotion
from hoidata.errors import BadInput
from hoidata.files.numpy_files import load_npz_arrays
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import JointCapsules, Skin, TrackedHand

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
    "THUMB_MCP_FE": (-10.0, 103.8),
    "THUMB_IP_FE": (-24.8, 92.3),
    "PIP_FE": (-10.0, 137.9),
    "DIP_FE": (-10.0, 112.1),
}
_SHAPES = {
    "vertices": (788, 3),
    "normals": (788, 3),
    "bone_indices": (788, 4),
    "bone_weights": (788, 4),
    "bind_poses": (17, 4, 4),
}


def read_hand(raw: RawTree, skeleton: BvhMotion) -> TrackedHand:
    """The right hand. skeleton: of a right hand's motion, already seen in the mirror. Raises BadInput."""
    capsules, sensors = _read_reference(raw, skeleton.names)
    skin = _read_skin(raw)
    joint_from_skin = _MIRROR @ _rigid(skin["bind_poses"]) @ _MIRROR
    offset_m = skeleton.offsets * METRES_PER_UNIT
    offset_m[0] = 0.0
    tips = np.array([np.flatnonzero(capsules.joint == joint)[0] for joint in _last_joints(skeleton.parents)])
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
    """The 19 capsules and the 104 vertices of the proximity sensors."""
    try:
        reference = json.loads(raw.read(HAND_REFERENCE, LARGEST_REFERENCE))
        rows = reference["capsules"]
        joint = np.array([names.index(row["joint"]) for row in rows])
        start, end = (np.array([row[key] for row in rows], dtype=np.float64) for key in ("start_local", "end_local"))
        radius = np.array([row["radius"] for row in rows], dtype=np.float64)
        sensors = np.array(reference["proximity_vertices"], dtype=np.int64)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        expected = "capsules with joint, start_local, end_local and radius, and proximity_vertices"
        raise BadInput(HAND_REFERENCE, expected, f"{type(error).__name__}: {error}") from error
    right = start.shape == end.shape == (N_CAPSULES, 3) and radius.shape == (N_CAPSULES,)
    if not right or not np.isfinite([*start.flat, *end.flat, *radius]).all() or not (radius > 0).all():
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
    """Float32 poses (..., 4, 4) with the nearest exact rotations."""
    u, _, v = np.linalg.svd(poses[..., :3, :3])
    poses = poses.copy()
    poses[..., :3, :3] = u @ v
    return poses


def _sensing_skin(
    skin: dict[str, np.ndarray], sensors: np.ndarray, tip_joint: np.ndarray, tip_m: np.ndarray, to_joint: RigidTransform
) -> Skin:
    """The tips, each fixed to its finger's last joint, then the sensors."""
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
    """(16, 3, 3) of the bind pose. The skin says nothing of the thumb's base: it turns as little as can be."""
    skin_from_joint = np.linalg.inv(joint_from_skin)
    turn, place = skin_from_joint[:, :3, :3], skin_from_joint[:, :3, 3]
    wanted = turn[0].T @ (place[THUMB_BASE + 1] - place[0]) - skeleton.offsets[THUMB_BASE]
    turn[THUMB_BASE] = turn[0] @ _least_turn(skeleton.offsets[THUMB_BASE + 1], wanted)
    return turn[skeleton.parents[1:]].swapaxes(1, 2) @ turn[1:]


def _least_turn(start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """The smallest turn that takes one direction to another, not opposite, one."""
    a, b = start / np.linalg.norm(start), stop / np.linalg.norm(stop)
    x, y, z = np.cross(a, b)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def _last_joints(parents: np.ndarray) -> np.ndarray:
    """Those without children, one a finger: thumb, index, middle, ring, pinky."""
    return np.setdiff1d(np.arange(len(parents)), parents)


def _hinges(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Axes (17, 3) and limits (17, 2): an angle about the files' z axis is one about -z in the mirror."""
    axis, limit = np.zeros((len(names), 3)), np.zeros((len(names), 2))
    for joint, name in enumerate(names):
        for ending, degrees in LIMITS_DEG.items():
            if name.endswith(ending):
                axis[joint, 2], limit[joint] = -1.0, np.deg2rad(degrees)
    return axis, limit
