"""Time offset between hands and object: a grasped object moves with the hand, so a lag shows in their velocities.

The velocity of the joint closest to the object is compared with the velocity of the object at this joint, at each lag:
the normalised cross-correlation of velocity vectors. Vectors give a sharper peak than speeds. A lag so large that the
hand is not close to the object gives no sample.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from hoidata.clips.clip import FPS

NEAR_M = 0.05
MOVING_M_S = 0.05
LARGEST_LAG = 10
FEWEST_SAMPLES = 15


class TimeOffset(NamedTuple):
    """Time offset of a clip."""

    frames: float  # lag of the hands behind the object; NaN with too few samples
    confidence: float  # correlation at that lag; 1: joints move exactly with the object
    samples: int  # number of pairs of a hand and a frame in which the object moves close to it


class ObjectMotion(NamedTuple):
    """Surface points and part poses of an object, world frame."""

    points_m: np.ndarray  # (frame, point, 3) surface samples, metres
    part: np.ndarray  # (point,)
    rotmats: np.ndarray  # (part, frame, 3, 3) world_from_part
    positions_m: np.ndarray  # (part, frame, 3)


def time_offset(hands: Sequence[tuple[np.ndarray, np.ndarray]], motion: ObjectMotion) -> TimeOffset:
    """Find the lag of -10 to 10 frames at which the hands' velocities agree best with the object's.

    Samples are frames in which a joint is within 5 cm of the object and the object moves there at 5 cm/s or more; 15
    are needed. Score at lag ``L``: ``sum u(t) . v(t + L) / sqrt(sum |u(t)|^2 sum |v(t + L)|^2)``, where v is the
    velocity of the joint and u that of the object's part at the joint's position at t; central differences.

    Args:
        hands: of each hand, joints (frame, 21, 3), metres, and valid frames (frame,) bool.
        motion: motion of the object.
    """
    pairs = [_near_pairs(joints, usable, motion) for joints, usable in hands]
    samples = sum(len(object_m_s) for object_m_s, _ in pairs)
    if samples < FEWEST_SAMPLES:
        return TimeOffset(float("nan"), float("nan"), samples)
    moved = np.concatenate([object_m_s for object_m_s, _ in pairs])
    hand = np.concatenate([hand_m_s for _, hand_m_s in pairs], axis=1)
    energy = np.sqrt((moved**2).sum() * (hand**2).sum(axis=(1, 2)))
    score = (hand * moved).sum(axis=(1, 2)) / np.maximum(energy, 1e-12)
    best = int(score.argmax())
    return TimeOffset(float(best - LARGEST_LAG), float(score[best]), samples)


def _near_pairs(joints_m: np.ndarray, usable: np.ndarray, motion: ObjectMotion) -> tuple[np.ndarray, np.ndarray]:
    """Return velocities (sample, 3) of the object and (lag, sample, 3) of the closest joint."""
    n_frames, margin = len(joints_m), LARGEST_LAG + 1
    # Each lag uses the same frames. Otherwise a lag could win by skipping frames that disagree.
    complete_frames = [
        frame for frame in range(margin, n_frames - margin) if usable[frame - margin : frame + margin + 1].all()
    ]
    frame, joint, point = _nearest(joints_m, motion.points_m, complete_frames)
    object_m_s = _carried_velocity(motion, motion.part[point], frame, joints_m[frame, joint])
    moving = np.linalg.norm(object_m_s, axis=-1) >= MOVING_M_S
    frame, joint = frame[moving], joint[moving]
    shifted = frame[None] + np.arange(-LARGEST_LAG, LARGEST_LAG + 1)[:, None]
    hand_m_s = (joints_m[shifted + 1, joint] - joints_m[shifted - 1, joint]) * (FPS / 2)
    return object_m_s[moving], hand_m_s


def _nearest(
    joints_m: np.ndarray, points_m: np.ndarray, frames: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frame, joint and point of the closest pair, for frames in which they are within 5 cm."""
    pairs = []
    for frame in frames:
        distances_m = cdist(joints_m[frame], points_m[frame])
        joint, point = np.unravel_index(distances_m.argmin(), distances_m.shape)
        if distances_m[joint, point] < NEAR_M:
            pairs.append((frame, joint, point))
    columns = np.array(pairs, dtype=np.int64).reshape(-1, 3).T
    return columns[0], columns[1], columns[2]


def _carried_velocity(motion: ObjectMotion, part: np.ndarray, frame: np.ndarray, positions_m: np.ndarray) -> np.ndarray:
    """Return (sample, 3) m/s of points fixed to a part, at ``positions_m (sample, 3)`` in ``frame (sample,)``."""
    local_m = np.einsum("sij,si->sj", motion.rotmats[part, frame], positions_m - motion.positions_m[part, frame])
    before, after = (
        np.einsum("sij,sj->si", motion.rotmats[part, neighbour], local_m) + motion.positions_m[part, neighbour]
        for neighbour in (frame - 1, frame + 1)
    )
    return (after - before) * (FPS / 2)
