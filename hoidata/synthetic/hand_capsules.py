"""A hand as 21 capsules with five flexing fingers, a fast approximation for the grasp search, and its closing.

Right hand, frame of MANO's rest pose rotated about the wrist: fingers along -x, back of the hand +y, thumb +z.
Fingers in MANO's order: index, middle, pinky, ring, thumb. Finger segments are capsules 0-14, palm regions 15-20. For a
left hand the caller mirrors the field and the result in x. Open hands are placed over a surface and close their fingers
until they touch, for many candidates in one call.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands.model import TIP_VERTICES, HandModel, Side
from hoidata.objects.distance_grid import interpolated
from hoidata.objects.surface_index import PartSurface

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
    starts, ends = _finger_axes(hands, flexion_rad, swing_rad)
    palm = _palm_axes(hands.joints)
    starts = np.concatenate([starts, np.stack([start for start, _ in palm], axis=1)], axis=1)
    ends = np.concatenate([ends, np.stack([end for _, end in palm], axis=1)], axis=1)
    return _placed_samples(starts, ends, rotmats, wrist_m)


def _finger_axes(hands: CapsuleHands, flexion_rad: np.ndarray, swing_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and ends (hand, 15, 3) of the finger capsules, before the rotation of the hand."""
    local, joints = finger_rotmats(hands, flexion_rad, swing_rad), hands.joints
    at_rest = [*(joints[:, _KNUCKLES + segment] for segment in range(3)), hands.tips]
    bones = np.stack([end - start for start, end in pairwise(at_rest)], axis=2)
    rotation = np.broadcast_to(np.eye(3), (*bones.shape[:2], 3, 3))
    positions = [joints[:, _KNUCKLES]]
    for segment in range(3):
        rotation = rotation @ local[:, :, segment]
        positions.append(positions[-1] + (rotation @ bones[:, :, segment, :, None])[..., 0])
    chain = np.stack(positions, axis=2)
    return chain[:, :, :3].reshape(len(chain), 15, 3), chain[:, :, 1:].reshape(len(chain), 15, 3)


def _placed_samples(starts: np.ndarray, ends: np.ndarray, rotmats: np.ndarray, wrist_m: np.ndarray) -> np.ndarray:
    """Return (hand, capsule, 4, 3) points between starts and ends (hand, capsule, 3), rotated about the wrist."""
    fraction = np.linspace(0, 1, N_SAMPLES)[:, None]
    points = starts[:, :, None] + fraction * (ends - starts)[:, :, None]
    rotated = (points.reshape(len(points), -1, 3) @ rotmats.transpose(0, 2, 1)).reshape(points.shape)
    return rotated + wrist_m[:, None, None]


_GRADIENT_STEP_M = 1e-3


# Signed distance in metres, negative inside, of points (..., 3).
Field = Callable[[np.ndarray], np.ndarray]


def seen_by(side: Side, field: Field) -> Field:
    """Mirror a field in x for a left hand, so that it can be searched as a right hand."""
    return field if side == "right" else lambda points_m: field(points_m * np.array([-1.0, 1.0, 1.0]))


def gradient(field: Field, points_m: np.ndarray) -> np.ndarray:
    """Return unit outward normals (..., 3) at points close to the surface, by central differences."""
    steps = _GRADIENT_STEP_M * np.eye(3)
    slope = np.stack([field(points_m + step) - field(points_m - step) for step in steps], axis=-1)
    return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)


def grid_field(surface: PartSurface) -> Field:
    """Return the signed distance field of a surface, interpolated in its grid; outside the grid a lower bound."""
    grid = surface.grid
    return lambda points_m: interpolated(grid, points_m.reshape(-1, 3)).reshape(points_m.shape[:-1])


PRESS_M = 0.0008
_LARGEST_STEPS = 70
_MARCH_START_M = 0.25
_NORMAL_NOISE = 0.1


class Placement(NamedTuple):
    """Placements of candidate hands at an object; upright object frame, metres and radians."""

    rotmats: np.ndarray  # (candidate, 3, 3) object_from_hand; the y axis is the approach normal
    target_m: np.ndarray  # (candidate, 3) surface point
    blend: np.ndarray  # (candidate,) 0 puts the palm over the target, 1 the fingers
    gap_m: np.ndarray  # (candidate,) clearance at which the hand stops
    spread_rad: np.ndarray  # (candidate, 5) swing of the fingers
    hand: np.ndarray  # (candidate,) index of the hand shape

    def take(self, rows: np.ndarray) -> "Placement":
        return Placement(*(array[rows] for array in self))

    def for_hands(self, n_hands: int) -> "Placement":
        """Combine each placement with each hand shape, placement-major."""
        rows = np.repeat(np.arange(len(self.hand)), n_hands)
        return self.take(rows)._replace(hand=np.tile(np.arange(n_hands), len(self.hand)))


def march_to_surface(field: Field, direction: np.ndarray, through_m: np.ndarray) -> np.ndarray:
    """Return the first surface points (row, 3) along ``-direction`` towards ``through_m``, by sphere tracing."""
    points = through_m + _MARCH_START_M * direction
    for _ in range(40):
        points = points - np.maximum(field(points), 0)[:, None] * direction
    return points


def sample_placements(
    field: Field, direction: np.ndarray, through_m: np.ndarray, blend: tuple[float, float], rng: np.random.Generator
) -> Placement:
    """Sample placements that come from each ``direction (row, 3)``, without those that miss the object."""
    surface = march_to_surface(field, direction, through_m)
    direction, surface = (array[field(surface) < 0.003] for array in (direction, surface))
    count = len(surface)
    normal = gradient(field, surface) + _NORMAL_NOISE * rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    palm_to_fingers = rng.uniform(*blend, size=count)
    is_power_grasp = palm_to_fingers < 0.5
    gap_m = np.where(is_power_grasp, rng.uniform(-0.001, 0.0005, count), rng.uniform(0, 0.035, count))
    spread_rad = rng.uniform(-0.05, 0.05, (count, N_FINGERS))
    spread_rad[:, THUMB] = rng.uniform(-0.25, 0.25, count)
    rotmats = _rolled(normal, rng.uniform(-np.pi, np.pi, count))
    return Placement(rotmats, surface, palm_to_fingers, gap_m, spread_rad=spread_rad, hand=np.zeros(count, dtype=int))


def _rolled(normal: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Return rotations (row, 3, 3) with y axis ``normal``, rotated about it by ``roll``."""
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    x = np.cos(roll)[:, None] * first + np.sin(roll)[:, None] * second
    return np.stack([x, normal, np.cross(x, normal)], axis=2)


def put_over(field: Field, hands: CapsuleHands, placement: Placement) -> np.ndarray:
    """Move open hands along their normals until only the gap is left. Returns wrist positions (row, 3)."""
    middle, index = hands.joints[:, 4], hands.joints[:, 1]
    palm = 0.75 * middle + 0.1 * index
    fingers = middle + np.array([-0.035, 0.0, 0.012])
    anchor = palm + placement.blend[:, None] * (fingers - palm)
    normal = placement.rotmats[:, :, 1]
    wrist = placement.target_m - (placement.rotmats @ anchor[:, :, None])[..., 0] + 0.12 * normal
    opened = np.broadcast_to(OPEN_RAD, (len(wrist), N_FINGERS, 3))
    points = capsule_points(hands, placement.rotmats, wrist, opened, placement.spread_rad)
    slid = np.zeros(len(wrist))
    for _ in range(14):
        moved = points - (slid[:, None] * normal)[:, None, None]
        clearance = (field(moved).min(-1) - hands.radii).min(-1)
        slid += clearance - placement.gap_m
    return wrist - slid[:, None] * normal


def close_fingers(field: Field, hands: CapsuleHands, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
    """Flex all fingers step by step. A segment in contact stops itself and the joints closer to the palm.

    Returns:
        wrist_m (row, 3) and flexion_rad (row, 5, 3).
    """
    wrist = put_over(field, hands, placement)
    flexion = np.broadcast_to(OPEN_RAD, (len(wrist), N_FINGERS, 3)).copy()
    stopped = np.zeros(flexion.shape, dtype=bool)
    rows = np.arange(len(wrist))  # hands with a segment that still moves
    for _ in range(_LARGEST_STEPS):
        clearance = _finger_clearance(field, hands.take(rows), placement.take(rows), wrist[rows], flexion[rows])
        stopped[rows] |= clearance <= -PRESS_M
        # A stopped segment also stops all joints between itself and the palm.
        free = ~np.logical_or.accumulate(stopped[rows, :, ::-1], axis=-1)[..., ::-1]
        free &= flexion[rows] < LIMITS_RAD - 1e-9
        is_moving = free.any((1, 2))
        rows, free, clearance = rows[is_moving], free[is_moving], clearance[is_moving]
        if not len(rows):
            break
        # All segments from the first free joint to the tip move.
        moves = np.logical_or.accumulate(free, axis=-1)
        nearest = np.where(moves, clearance + PRESS_M, np.inf).min(-1, keepdims=True)
        step = np.clip(0.9 * nearest / 0.10, 0.006, 0.10)
        flexion[rows] = np.minimum(np.where(free, flexion[rows] + step * CURL_RATIO, flexion[rows]), LIMITS_RAD)
    return wrist, flexion


def _finger_clearance(
    field: Field, hands: CapsuleHands, placement: Placement, wrist: np.ndarray, flexion: np.ndarray
) -> np.ndarray:
    starts, ends = _finger_axes(hands, flexion, placement.spread_rad)
    points = _placed_samples(starts, ends, placement.rotmats, wrist)
    return (field(points).min(-1) - hands.radii[:, :15]).reshape(-1, N_FINGERS, 3)
