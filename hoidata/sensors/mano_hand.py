"""MANO-layout hand as a ``TrackedHand``: 16 joints, 5 tips, 19 capsules, 104 proximity sensors on the palm side."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import JOINT_NAMES, PARENTS, TIP_VERTICES, HandModel, HandPair
from hoidata.hands.embedded import vertex_normals
from hoidata.hands.model import N_ROTATIONS, Side
from hoidata.hands.tracked_hand import JointCapsules, Skin, TrackedHand
from hoidata.objects.sampling import farthest_points
from hoidata.physics.mano_capsules import fit_capsules

N_SENSORS = 104
_INDEX, _MIDDLE, _PINKY, _THUMB = 1, 4, 7, 13
_MIDDLE_TIP_BONE = 5
# Least cosine of a sensor's normal with the palm direction. The pad of the thumb faces the fingers and is rounder.
_FACING, _THUMB_FACING = 0.8, 0.6
# Fraction of the distance from wrist to middle knuckle. Skin closer to the wrist rarely touches objects.
_WRIST_FRACTION = 0.4


def mano_hand(
    hands: HandPair, side: Side, betas: np.ndarray | None = None, template_m: np.ndarray | None = None
) -> TrackedHand:
    """A MANO-layout hand of one shape; its joints, tips and skin equal those of ``hoidata.hands.track_vertices``.

    Args:
        betas: (10,) shape coefficients, zeros by default.
        template_m: (778, 3) personal rest mesh instead of the model's template.
    """
    model, betas = hands[side], np.zeros(10) if betas is None else np.asarray(betas, dtype=np.float64)
    template = model.template_m if template_m is None else np.asarray(template_m, dtype=np.float64)
    joints = model.rest_joints_m(betas, template_m)
    vertices = template + model.shape_directions @ betas
    points = [*TIP_VERTICES, *sensor_vertices(hands.right)]
    parents = np.array(PARENTS)
    return TrackedHand(
        side=side,
        layout="mano",
        joint_names=JOINT_NAMES[:N_ROTATIONS],
        parents=parents,
        offset_m=np.concatenate([np.zeros((1, 3)), joints[1:] - joints[parents[1:]]]),
        rest_rotmats=rotvec_to_rotmat(model.mean_pose.reshape(-1, 3)),
        skin=Skin(
            point_m=vertices[points],
            normal=vertex_normals(vertices, model.faces)[points],
            weight=model.skin_weights[points],
            joint_from_skin=RigidTransform(np.tile(np.eye(3), (N_ROTATIONS, 1, 1)), -joints),
            corrective_m=model.pose_directions[points],
        ),
        tip_joint=np.array([3, 6, 9, 12, 15]),
        capsules=JointCapsules(*fit_capsules(model, betas, template_m)),
        middle_knuckle=_MIDDLE,
        wrist_from_canonical=canonical_axes(model),
        hinge_axis=np.zeros((N_ROTATIONS, 3)),
        limit_rad=np.zeros((N_ROTATIONS, 2)),
    )


def mano_hands(
    pair: HandPair, betas: np.ndarray | None = None, templates_m: np.ndarray | None = None
) -> Mapping[Side, TrackedHand]:
    """Both hands of a person; betas: (2, 10), zeros by default; templates_m: personal rest meshes (2, 778, 3)."""
    betas = np.zeros((2, 10), np.float32) if betas is None else betas
    templates = [None, None] if templates_m is None else [template.tobytes() for template in templates_m]
    sides: tuple[Side, ...] = ("left", "right")
    return {side: _cached_hand(pair, side, betas[i].tobytes(), templates[i]) for i, side in enumerate(sides)}


@lru_cache(maxsize=64)
def _cached_hand(pair: HandPair, side: Side, betas: bytes, template: bytes | None) -> TrackedHand:
    """Cached, because a person's hand is in many clips and takes long to build."""
    shape = np.frombuffer(betas, np.float32).astype(np.float64)
    rest = None if template is None else np.frombuffer(template, np.float32).reshape(-1, 3).astype(np.float64)
    return mano_hand(pair, side, shape, rest)


def canonical_axes(model: HandModel) -> np.ndarray:
    """(3, 3) canonical axes in columns, in the wrist's axes, from the rest joints of the mean shape."""
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
    """104 evenly spread vertices of the palm side, ascending; the left hand has sensors at the same vertices."""
    axes, joints = canonical_axes(right), right.rest_joints_m(np.zeros(10))
    vertices, bones = (right.template_m - joints[0]) @ axes, (joints - joints[0]) @ axes
    normals = vertex_normals(right.template_m, right.faces) @ axes
    segment = right.skin_weights.argmax(axis=1)
    palmar = -normals[:, 2] > _FACING
    for joint in range(_THUMB, _THUMB + 3):
        # The pad faces the middle finger, across the bone of the thumb.
        thumb = bones[_THUMB + 2] - bones[_THUMB]
        pad = bones[_MIDDLE_TIP_BONE] - bones[joint]
        pad = pad - (pad @ thumb) / (thumb @ thumb) * thumb
        palmar = np.where(segment == joint, normals @ pad > _THUMB_FACING * np.linalg.norm(pad), palmar)
    candidates = np.flatnonzero(palmar & (vertices[:, 0] > _WRIST_FRACTION * bones[_MIDDLE, 0]))
    chosen = farthest_points(vertices[candidates], N_SENSORS)
    return tuple(sorted(int(vertex) for vertex in candidates[chosen]))
