"""A small tracked hand without licensed data: wrist, thumb and four fingers of one joint, eight sensors."""

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import JointCapsules, Skin, TrackedHand

SENSORS = 8


def small_hand(seed: int = 0) -> TrackedHand:
    """A right hand of 6 joints; fingers to +x, thumb to +y. seed: of the sensors."""
    random = np.random.default_rng(seed)
    offset = np.array([[0, 0, 0], [3, 3, -1], [10, 2.5, 0], [10.5, 0.5, 0.5], [10, -1.5, 0], [9, -3.5, -0.5]]) / 100
    tips = offset + np.array([0.06, 0.0, -0.005])
    points = random.uniform([0, -0.05, -0.03], [0.16, 0.05, 0.0], (SENSORS, 3))
    normals = random.normal(size=(SENSORS, 3)) - [0, 0, 2]
    weight = np.zeros((5 + SENSORS, 6))
    weight[np.arange(5), np.arange(1, 6)] = 1
    weight[5:] = random.dirichlet(np.ones(6), SENSORS)
    skin = Skin(
        np.concatenate([tips[1:], points]),
        np.concatenate([np.tile([1.0, 0, 0], (5, 1)), normals / np.linalg.norm(normals, axis=1, keepdims=True)]),
        weight,
        RigidTransform(np.tile(np.eye(3), (6, 1, 1)), -offset),
    )
    joint = np.arange(6)
    start, end = np.zeros((6, 3)), np.where(joint[:, None] > 0, [0.06, 0.0, -0.005], [0.08, 0.0, 0.0])
    return TrackedHand(
        side="right",
        layout="small",
        joint_names=("wrist", "thumb", "index", "middle", "ring", "pinky"),
        parents=np.array([-1, 0, 0, 0, 0, 0]),
        offset_m=offset,
        rest_rotmats=np.tile(np.eye(3), (5, 1, 1)),
        skin=skin,
        tip_joint=np.arange(1, 6),
        capsules=JointCapsules(joint, start, end, np.full(6, 0.01)),
        middle_knuckle=3,
        wrist_from_canonical=np.eye(3),
        hinge_axis=np.zeros((6, 3)),
        limit_rad=np.zeros((6, 2)),
    )


def random_rotations(count: int, size_rad: float, seed: int) -> np.ndarray:
    """(count, 3, 3) random rotations; ``size_rad`` is the standard deviation of each axis-angle component."""
    return Rotation.from_rotvec(np.random.default_rng(seed).normal(0, size_rad, (count, 3))).as_matrix()
