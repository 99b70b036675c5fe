"""A MANO-layout hand to sense with: 16 joints, 5 tips, 19 capsules, and 104 points of its palm side."""

from functools import lru_cache

import numpy as np

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import JOINT_NAMES, PARENTS, TIP_VERTICES, HandModel, HandPair
from hoidata.hands.embedded import vertex_normals
from hoidata.hands.model import N_ROTATIONS, Side
from hoidata.hands.tracked_hand import JointCapsules, Skin, TrackedHand
from hoidata.objects.farthest import farthest_points
from hoidata.physics.mano_capsules import fit_capsules

N_SENSORS = 104
_INDEX, _MIDDLE, _PINKY, _THUMB = 1, 4, 7, 13
_MIDDLE_TIP_BONE = 5
# How straight a vertex must look out of the palm (cosine); the thumb's pad looks to the fingers, and is rounder.
_FACING, _THUMB_FACING = 0.8, 0.6
_WRIST_ENDS_AT = 0.4  # of the way from the wrist to the middle knuckle: skin nearer to the wrist touches little


def mano_hand(
    hands: HandPair, side: Side, betas: np.ndarray | None = None, template_m: np.ndarray | None = None
) -> TrackedHand:
    """One side of a hand of shape ``betas (10,)``; template_m (778, 3) replaces the model's rest mesh.

    Pose blend shapes are those of the model: joints, tips and skin are those of ``hoidata.hands.track_vertices``.
    """
    model, betas = hands[side], np.zeros(10) if betas is None else np.asarray(betas, dtype=np.float64)
    template = model.template_m if template_m is None else np.asarray(template_m, dtype=np.float64)
    joints = model.rest_joints_m(betas, template_m)
    vertices = template + model.shape_directions @ betas
    points = [*TIP_VERTICES, *sensor_vertices(hands.right)]
    fitted = fit_capsules(model, betas, template_m)
    parents = np.array(PARENTS)
    return TrackedHand(
        side=side,
        layout="mano",
        joint_names=JOINT_NAMES[:N_ROTATIONS],
        parents=parents,
        offset_m=np.concatenate([np.zeros((1, 3)), joints[1:] - joints[parents[1:]]]),
        rest_rotmats=rotvec_to_rotmat(model.mean_pose.reshape(-1, 3)),
        skin=Skin(
            vertices[points],
            vertex_normals(vertices, model.faces)[points],
            model.skin_weights[points],
            RigidTransform(np.tile(np.eye(3), (N_ROTATIONS, 1, 1)), -joints),
            model.pose_directions[points],
        ),
        tip_joint=np.array([3, 6, 9, 12, 15]),
        capsules=JointCapsules(*fitted),
        middle_knuckle=_MIDDLE,
        wrist_from_canonical=canonical_axes(model),
        hinge_axis=np.zeros((N_ROTATIONS, 3)),
        limit_rad=np.zeros((N_ROTATIONS, 2)),
    )


def canonical_axes(model: HandModel) -> np.ndarray:
    """(3, 3) columns: to the fingers, to the thumb, out of the back, in the wrist's axes; of the flat mean hand."""
    joints = model.rest_joints_m(np.zeros(10))
    x = joints[_MIDDLE] - joints[0]
    x = x / np.linalg.norm(x)
    y = joints[_INDEX] - joints[_PINKY]
    y = y - (y @ x) * x
    y = y / np.linalg.norm(y)
    z = np.cross(x, y)
    return np.stack([x, y, z if model.side == "right" else -z], axis=1)


@lru_cache(maxsize=4)
def sensor_vertices(right: HandModel) -> tuple[int, ...]:
    """104 vertices of the palm side, evenly spread, rising; the left hand's have the same numbers."""
    axes, joints = canonical_axes(right), right.rest_joints_m(np.zeros(10))
    places, bones = (right.template_m - joints[0]) @ axes, (joints - joints[0]) @ axes
    normals = vertex_normals(right.template_m, right.faces) @ axes
    owner = right.skin_weights.argmax(axis=1)
    palmar = -normals[:, 2] > _FACING
    for joint in range(_THUMB, _THUMB + 3):
        along = bones[_THUMB + 2] - bones[_THUMB]
        pad = bones[_MIDDLE_TIP_BONE] - bones[joint]
        pad = pad - (pad @ along) / (along @ along) * along
        palmar = np.where(owner == joint, normals @ pad > _THUMB_FACING * np.linalg.norm(pad), palmar)
    candidates = np.flatnonzero(palmar & (places[:, 0] > _WRIST_ENDS_AT * bones[_MIDDLE, 0]))
    chosen = farthest_points(places[candidates], N_SENSORS)
    return tuple(sorted(int(vertex) for vertex in candidates[chosen]))
