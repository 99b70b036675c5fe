"""Places open hands over a surface and closes their fingers until they touch, for many candidates in one call.

For the right hand. For a left hand the caller mirrors the field and the result in x.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hoidata.objects.distance_grid import interpolated
from hoidata.objects.surface_index import PartSurface
from hoidata.synthetic.hand_capsules import (
    CURL_RATIO,
    LIMITS_RAD,
    N_FINGERS,
    OPEN_RAD,
    THUMB,
    CapsuleHands,
    capsule_points,
)

_GRADIENT_STEP_M = 1e-3


# Signed distance in metres, negative inside, of points (..., 3).
Field = Callable[[np.ndarray], np.ndarray]


def mirrored(field: Field) -> Field:
    """Mirror a field in x, so that left hands can be searched as right hands."""
    return lambda points_m: field(points_m * np.array([-1.0, 1.0, 1.0]))


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
    return Placement(
        rotmats=rotmats,
        target_m=surface,
        blend=palm_to_fingers,
        gap_m=gap_m,
        spread_rad=spread_rad,
        hand=np.zeros(count, dtype=int),
    )


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
    for _ in range(_LARGEST_STEPS):
        clearance = _finger_clearance(field, hands, placement, wrist, flexion)
        stopped |= clearance <= -PRESS_M
        # A stopped segment also stops all joints between itself and the palm.
        free = ~np.logical_or.accumulate(stopped[..., ::-1], axis=-1)[..., ::-1] & (flexion < LIMITS_RAD - 1e-9)
        if not free.any():
            break
        # All segments from the first free joint to the tip move.
        moves = np.logical_or.accumulate(free, axis=-1)
        nearest = np.where(moves, clearance + PRESS_M, np.inf).min(-1, keepdims=True)
        step = np.clip(0.9 * nearest / 0.10, 0.006, 0.10)
        flexion = np.minimum(np.where(free, flexion + step * CURL_RATIO, flexion), LIMITS_RAD)
    return wrist, flexion


def _finger_clearance(
    field: Field, hands: CapsuleHands, placement: Placement, wrist: np.ndarray, flexion: np.ndarray
) -> np.ndarray:
    points = capsule_points(hands, placement.rotmats, wrist, flexion, placement.spread_rad)[:, :15]
    return (field(points).min(-1) - hands.radii[:, :15]).reshape(-1, N_FINGERS, 3)
