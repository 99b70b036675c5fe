"""How far joints are from the truth, and how smoothly they move. Each function gives the values of one motion."""

import numpy as np

from hoidata.clips.clip import FPS, Side
from hoidata.metrics.pair import Pair
from hoidata.physics.mano_capsules import world_rotmats
from hoidata.physics.realism import has_acceleration, smoothness_m_s2


def joint_error_mm(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) mean distance of the 21 joints from those of the reference, millimetres, in its world."""
    each = []
    for side in pair.sides:
        frames = pair.frames(side, every)
        apart = pair.predicted.joints_m[side][frames] - pair.reference.joints_m[side][frames]
        each.append(np.linalg.norm(apart.astype(np.float64), axis=-1).mean(axis=-1))
    return 1000 * _joined(each)


def smoothness(pair: Pair, every: int) -> np.ndarray:
    """(hand,) mean acceleration of the joints in the wrist's frame, m/s^2, of hands seen in three frames in a row."""
    del every  # a derivative needs every frame
    found = []
    for side in pair.sides:
        joints = _seen(pair, side)
        if has_acceleration(joints, FPS):
            wrist = world_rotmats(pair.predicted.clip.hands[side])[:, 0]
            found.append(smoothness_m_s2(joints, wrist, FPS))
    return np.array(found)


def jitter_m_s3(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) mean over the joints of the third difference of world positions, m/s^3."""
    del every  # a derivative needs every frame
    each = []
    for side in pair.sides:
        third = np.linalg.norm(np.diff(_seen(pair, side), n=3, axis=0), axis=-1).mean(axis=-1) * FPS**3
        each.append(third[np.isfinite(third)])
    return _joined(each)


def _seen(pair: Pair, side: Side) -> np.ndarray:
    """(frame, 21, 3) float64 predicted joints, NaN in frames without the hand."""
    valid = pair.reference.clip.hands[side].valid
    return np.where(valid[:, None, None], pair.predicted.joints_m[side].astype(np.float64), np.nan)


def _joined(each: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *each])
