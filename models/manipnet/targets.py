"""Where post-processing wants the joints: the paper's Algorithm 1, and the rule of the released demo.

Points are in the wrist's frame, metres. Distances here are of points themselves: a predicted distance that stops at
the skin has the radius added before it comes here.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

Rule = Literal["paper", "released"]
PAPER_ACTIVE_M = 0.028
RELEASED_ACTIVE_M, RELEASED_NEAR_M = 0.024, 0.06


@dataclass(frozen=True)
class Nearest:
    """What the object is like at points (..., point): signed distance, nearest surface point, outward gradient."""

    distance_m: np.ndarray
    closest_m: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class Targets:
    """point_m: (..., point, 3). weight: (..., point), 0 where there is nothing to reach."""

    point_m: np.ndarray
    weight: np.ndarray


def paper_targets(points_m: np.ndarray, predicted_m: np.ndarray, found: Nearest) -> Targets:
    """Algorithm 1: near points to a mixture of predicted and true distance, the others to where they are.

    points_m: (..., point, 3) as the network has them; predicted_m: (..., point) its distances from the object.
    """
    inside = found.distance_m < 0
    mixed = np.where(inside, 0.8 * predicted_m + 0.2 * found.distance_m, 0.2 * predicted_m + 0.8 * found.distance_m)
    near = predicted_m <= PAPER_ACTIVE_M
    wanted = found.closest_m + mixed[..., None] * found.normal
    return Targets(np.where(near[..., None], wanted, points_m), np.ones(near.shape))


def released_targets(points_m: np.ndarray, predicted_m: np.ndarray, radius_m: np.ndarray, found: Nearest) -> Targets:
    """The demo's rule: out of the object by the radius of the capsule, or a third of the way to the predicted distance.

    predicted_m: (..., point) as in ``paper_targets``, radius_m: (point,) of the capsule, 0 for tips.
    """
    active = (predicted_m - radius_m < RELEASED_ACTIVE_M) & (found.distance_m < RELEASED_NEAR_M)
    inside = found.distance_m < radius_m
    away = points_m - found.closest_m
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    away = np.where(length > 1e-6, away / np.maximum(length, 1e-6), found.normal)
    mixed = 0.35 * predicted_m + 0.65 * found.distance_m
    out = found.closest_m + radius_m[:, None] * found.normal
    wanted = np.where(inside[..., None], out, found.closest_m + mixed[..., None] * away)
    return Targets(wanted, np.where(inside, 0.8, 0.5) * active)
