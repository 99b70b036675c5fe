"""Where post-processing wants the joints: the paper's Algorithm 1, and ours.

Points are in the wrist's frame, metres. Distances here are of points themselves: a predicted distance that stops at
the skin has the radius added before it comes here.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

Rule = Literal["off", "paper", "ours"]
ACTIVE_SHARE = 0.8  # of the range of predicted distances: the paper's 2.8 of 3.5 cm, the demo's 2.4 of 3 cm
NEAR_M = 0.06  # the demo looks at no point farther away; nor do we, or a wrong distance pulls at a hand in the air
# Ours, chosen on the validation tenths of the real recordings, whose touching points are 4 to 8 mm deep in 5 %.
DEEPEST_M = 0.008  # a finger gives way by so much and no more
PRESS_M = 0.007  # and is brought so much nearer than it is said to be
FADE_SHARE = 0.3  # of the range below the active share: the nearer it is said to be, the more it counts
HOLD = 0.5  # weight of the network's own pose, where it says nothing of the object


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


def paper_targets(points_m: np.ndarray, predicted: np.ndarray, radius_m: np.ndarray, range_m: float,
                  found: Nearest) -> Targets:  # fmt: skip
    """Algorithm 1: near points to a mixture of predicted and true distance, the others to where they are.

    points_m: (..., point, 3) as the network has them. predicted: (..., point) its distances, 0 to 1 of range_m from the
    skin, which is radius_m (point,) from the point.
    """
    distance_m = predicted * range_m + radius_m
    inside = found.distance_m < 0
    mixed = np.where(inside, 0.8 * distance_m + 0.2 * found.distance_m, 0.2 * distance_m + 0.8 * found.distance_m)
    wanted = found.closest_m + mixed[..., None] * found.normal
    return Targets(np.where(_active(predicted, found)[..., None], wanted, points_m), np.ones(predicted.shape))


def our_targets(points_m: np.ndarray, predicted: np.ndarray, radius_m: np.ndarray, range_m: float,
                near: np.ndarray, cover_m: np.ndarray, seen: Nearest) -> Targets:  # fmt: skip
    """Fingers go where the network has them and press what it says is near; none enters the object or is drawn off it.

    The rules above stop at the surface, where a contact carries nothing; a distance that is a mean of many takes off
    the object what touches it; and from a pose that is deep in a thin thing the nearest way out may be the far side.
    So the surface is what the hand sees from the pose that it comes from: ``seen``, of its points there, and what lies
    below the plane of the nearest place is inside. Arguments else as in ``paper_targets``. near: (point,) bool, the
    network's points are at the object or in it. cover_m: (point,) how thick the finger is there.
    """
    wanted_m = predicted * range_m + radius_m - PRESS_M
    least_m = cover_m - DEEPEST_M
    height_m = ((points_m - seen.closest_m) * seen.normal).sum(axis=-1)
    up_m = np.maximum(np.minimum(wanted_m, height_m), least_m) - height_m
    is_seen = seen.distance_m < NEAR_M
    sure = np.clip((ACTIVE_SHARE - predicted) / FADE_SHARE, 0, 1) * is_seen
    enters = (height_m < least_m) & is_seen & near
    share = np.where(enters, 1.0, sure)
    target = points_m + (share * up_m)[..., None] * seen.normal
    return Targets(target, np.where(enters, 1.0, np.maximum(sure, HOLD)))


def _active(predicted: np.ndarray, found: Nearest) -> np.ndarray:
    return (predicted < ACTIVE_SHARE) & (found.distance_m < NEAR_M)
