"""A hand as 21 capsules with five flexing fingers: a fast approximation for the grasp search.

Right hand, frame of MANO's rest pose rotated about the wrist: fingers along -x, back of the hand +y, thumb +z.
Fingers in MANO's order: index, middle, pinky, ring, thumb. Finger segments are capsules 0-14, palm regions 15-20.
"""

from typing import NamedTuple

import numpy as np

from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands.model import TIP_VERTICES, HandModel

N_FINGERS, THUMB, N_SAMPLES = 5, 4, 4
_RADIUS_FACTOR = 1.25
_LARGEST_THUMB_BASE_M, _LARGEST_PALM_M = 0.014, 0.018
_KNUCKLES = np.array([1, 4, 7, 10, 13])
# Flexion limits in radians, joints from the palm outwards.
LIMITS_RAD = np.array([[1.5, 1.8, 1.2]] * 4 + [[0.9, 0.9, 1.2]])
OPEN_RAD = np.array([[-0.15, 0.0, 0.0]] * 4 + [[-0.35, 0.0, 0.0]])
CURL_RATIO = np.array([[1.0, 1.15, 0.75]] * 4 + [[0.8, 0.6, 0.9]])


class CapsuleHands(NamedTuple):
    """Rest shapes of several hands, wrist at the origin, metres."""

    joints: np.ndarray  # (hand, 16, 3)
    tips: np.ndarray  # (hand, 5, 3) centres of the fingertip spheres
    radii: np.ndarray  # (hand, 21)
    flex_axis: np.ndarray  # (hand, 5, 3) unit axes of flexion
    swing_axis: np.ndarray  # (hand, 5, 3) unit axes of spreading

    def take(self, rows: np.ndarray) -> "CapsuleHands":
        return CapsuleHands(*(array[rows] for array in self))


def capsule_hands(model: HandModel, betas: np.ndarray) -> CapsuleHands:
    """Build the capsules of right hands with ``betas (hand, 10)``."""
    if model.side != "right":
        raise ValueError("capsules are built for the right hand; mirror the scene for a left hand")
    shaped = model.template_m + np.einsum("vck,hk->hvc", model.shape_directions, betas)
    joints = model.joint_regressor @ shaped
    wrist = joints[:, :1]
    shaped, joints = shaped - wrist, joints - wrist
    tips = shaped[:, list(TIP_VERTICES)]
    radii = np.stack([_radii(model, vertices, joint) for vertices, joint in zip(shaped, joints, strict=True)])
    last = tips - joints[:, _KNUCKLES + 2]
    length = np.linalg.norm(last, axis=2, keepdims=True)
    balls = tips - last / length * np.minimum(radii[:, 2:15:3, None], 0.8 * length)
    flex, swing = _axes(joints, tips)
    return CapsuleHands(joints=joints, tips=balls, radii=radii, flex_axis=flex, swing_axis=swing)


def _radii(model: HandModel, vertices: np.ndarray, joints: np.ndarray) -> np.ndarray:
    ends = np.concatenate([joints[_KNUCKLES + 1], joints[_KNUCKLES + 2], vertices[list(TIP_VERTICES)]])
    starts = np.concatenate([joints[_KNUCKLES], joints[_KNUCKLES + 1], joints[_KNUCKLES + 2]])
    radii = np.empty(21)
    for segment_index, (start, end) in enumerate(zip(starts, ends, strict=True)):
        finger, segment = segment_index % 5, segment_index // 5
        weight = model.skin_weights[:, _KNUCKLES[finger] + segment]
        radii[3 * finger + segment] = _RADIUS_FACTOR * _bone_radius(vertices, weight, start, end)
    radii[12] = min(radii[12], _LARGEST_THUMB_BASE_M)
    palm = vertices[model.skin_weights.argmax(1) == 0]
    palm = palm[palm[:, 1] < np.median(palm[:, 1])]
    for index, (start, end) in enumerate(_palm_axes(joints)):
        distance = _axis_distance(palm, start, end)[0]
        radii[15 + index] = min(np.median(np.sort(distance)[:20]), _LARGEST_PALM_M)
    return radii


def _bone_radius(vertices: np.ndarray, weight: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    distance, along = _axis_distance(vertices, start, end)
    for limit in (0.7, 0.4, 0.1):
        of_segment = (weight > limit) & (along > 0.35) & (along < 0.95)
        if of_segment.sum() >= 4:
            return float(np.median(distance[of_segment]))
    raise ValueError("a finger segment has no vertices")


def _axis_distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    axis = end - start
    along = (points - start) @ axis / (axis @ axis)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1), along


def _palm_axes(joints: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the axes of the six palm capsules: four metacarpals, ball and web of the thumb."""
    joint = np.moveaxis(joints, -2, 0)
    wrist = joint[0]
    axes = [(wrist + 0.25 * (joint[k] - wrist), joint[k]) for k in (1, 4, 7, 10)]
    thumb = joint[13]
    return [*axes, (0.3 * thumb + 0.7 * wrist, thumb), (thumb, 0.5 * (thumb + joint[1]))]


def _axes(joints: np.ndarray, tips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return flexion and swing axes. The thumb closes towards a point in front of the palm."""
    bone = tips - joints[:, _KNUCKLES]
    flex = np.cross(bone, [0.0, -1.0, 0.0])
    swing = np.broadcast_to([0.0, 1.0, 0.0], flex.shape).copy()
    opposed = 0.55 * joints[:, 4] + 0.45 * joints[:, 1] + np.array([0.015, -0.05, 0.0])
    flex[:, THUMB] = np.cross(bone[:, THUMB], opposed - joints[:, 13])
    swing[:, THUMB] = np.cross(bone[:, THUMB], flex[:, THUMB])
    return _unit(flex), _unit(swing)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def finger_rotmats(hands: CapsuleHands, flexion_rad: np.ndarray, swing_rad: np.ndarray) -> np.ndarray:
    """Return (hand, 5, 3, 3, 3) local joint rotations; flexion (hand, 5, 3), swing (hand, 5) of the first joint."""
    flex = _axis_rotations(hands.flex_axis[:, :, None], flexion_rad)
    flex[:, :, 0] = _axis_rotations(hands.swing_axis, swing_rad) @ flex[:, :, 0]
    return flex


def _axis_rotations(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    axis = np.broadcast_to(axis, (*angle.shape, 3))
    sine, versine = np.sin(angle)[..., None, None], (1 - np.cos(angle))[..., None, None]
    x, y, z = np.moveaxis(axis, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*angle.shape, 3, 3)
    return np.eye(3) + sine * cross + versine * (cross @ cross)


def hand_pose_rotvec(hands: CapsuleHands, flexion_rad: np.ndarray, swing_rad: np.ndarray) -> np.ndarray:
    """Return (hand, 45) absolute axis-angle poses of right hands in MANO's joint order."""
    local = finger_rotmats(hands, flexion_rad, swing_rad)
    return rotmat_to_rotvec(local).reshape(len(flexion_rad), 45)


def capsule_points(
    hands: CapsuleHands, rotmats: np.ndarray, wrist_m: np.ndarray, flexion_rad: np.ndarray, swing_rad: np.ndarray
) -> np.ndarray:
    """Return (hand, 21, 4, 3) points on the capsule axes, for hands rotated by (hand, 3, 3) about their wrists."""
    local = finger_rotmats(hands, flexion_rad, swing_rad)
    joints = hands.joints
    bones = np.stack(
        [
            joints[:, _KNUCKLES + 1] - joints[:, _KNUCKLES],
            joints[:, _KNUCKLES + 2] - joints[:, _KNUCKLES + 1],
            hands.tips - joints[:, _KNUCKLES + 2],
        ],
        axis=2,
    )
    rotation = np.broadcast_to(np.eye(3), (*bones.shape[:2], 3, 3))
    positions = [joints[:, _KNUCKLES]]
    for segment in range(3):
        rotation = rotation @ local[:, :, segment]
        positions.append(positions[-1] + (rotation @ bones[:, :, segment, :, None])[..., 0])
    chain = np.stack(positions, axis=2)
    starts = chain[:, :, :3].reshape(len(chain), 15, 3)
    ends = chain[:, :, 1:].reshape(len(chain), 15, 3)
    palm = _palm_axes(joints)
    starts = np.concatenate([starts, np.stack([start for start, _ in palm], axis=1)], axis=1)
    ends = np.concatenate([ends, np.stack([end for _, end in palm], axis=1)], axis=1)
    fraction = np.linspace(0, 1, N_SAMPLES)[:, None]
    points = starts[:, :, None] + fraction * (ends - starts)[:, :, None]
    return (points.reshape(len(points), -1, 3) @ rotmats.transpose(0, 2, 1)).reshape(points.shape) + wrist_m[
        :, None, None
    ]
