"""Hands against each other. Each function gives the values of one motion."""

import numpy as np

from hoidata.clips.clip import SIDES
from hoidata.metrics.pair import Pair
from hoidata.metrics.unmeasured import Unmeasured, Values
from hoidata.physics.capsules import Capsules
from hoidata.physics.mano_capsules import hand_capsules


def hand_hand_mm(pair: Pair, every: int) -> Values:
    """(frame,) depth of the deepest capsule of one hand in one of the other, millimetres, 0 where they are apart.

    None where one hand acts alone.
    """
    frames = np.flatnonzero(pair.valid("left") & pair.valid("right"))[::every]
    if pair.sides != SIDES:
        return Unmeasured("one hand acts alone")
    if not len(frames):
        return np.zeros(0)
    clip, hands = pair.predicted.clip.take(frames), pair.predicted.hands
    left, right = (hand_capsules(clip.hands[side], hands[side]) for side in SIDES)
    return 1000 * depth_m(left, right)


def depth_m(one: Capsules, other: Capsules) -> np.ndarray:
    """(frame,) how deep two sets of capsules overlap at most: the sum of two radii less the distance of their axes."""
    apart = _axis_distances_m(*(ends[:, :, None] for ends in one[:2]), *(ends[:, None] for ends in other[:2]))
    depth = one.radius_m[:, None] + other.radius_m - apart
    return np.maximum(depth.max(axis=(1, 2)), 0.0)


def _axis_distances_m(
    start: np.ndarray, stop: np.ndarray, other_start: np.ndarray, other_stop: np.ndarray
) -> np.ndarray:
    """Least distance of segments by their ends (..., 3), as in Ericson 2005, Real-Time Collision Detection, 5.1.9."""
    way, other_way, between = stop - start, other_stop - other_start, start - other_start
    a, e, b = (way * way).sum(-1), (other_way * other_way).sum(-1), (way * other_way).sum(-1)
    c, f = (way * between).sum(-1), (other_way * between).sum(-1)
    cross = a * e - b * b
    along = np.clip(np.where(cross > 0, (b * f - c * e) / np.where(cross > 0, cross, 1), 0), 0, 1)
    beside = np.clip((b * along + f) / np.where(e > 0, e, 1), 0, 1)
    along = np.clip((b * beside - c) / np.where(a > 0, a, 1), 0, 1)
    return np.linalg.norm(between + along[..., None] * way - beside[..., None] * other_way, axis=-1)
