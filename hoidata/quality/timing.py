"""Do hand and object tell the same time? A held object moves as the hand does; a lag between them shows as an offset.

For the joint nearest to the object, its velocity is compared with the one it would have if it were fixed to the object,
both as vectors, at every lag: the normalised cross-correlation of velocities. Unlike speeds, velocities disagree about
direction too, which makes the peak sharp. A lag so large that the hand is away from where the object was is not found:
there is no sample.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from hoidata.clips.clip import FPS

NEAR_M = 0.05
MOVING_M_S = 0.05
LARGEST_LAG = 10
FEWEST_SAMPLES = 15


class TimeOffset(NamedTuple):
    """frames: by how many frames the hands come after the object (negative: before); NaN where it cannot be told.

    confidence: the correlation at that lag, 1 for joints that move exactly with the object; NaN likewise.
    samples: how many pairs of a hand and a frame in which the object moves near it this rests on.
    """

    frames: float
    confidence: float
    samples: int


class ObjectMotion(NamedTuple):
    """An object for this purpose. points_m: (frame, point, 3) spread over its surface, world, metres; part: (point,).

    rotmats: (part, frame, 3, 3) and positions_m: (part, frame, 3), each part's world pose; the parts share no frame of
    reference but the world.
    """

    points_m: np.ndarray
    part: np.ndarray
    rotmats: np.ndarray
    positions_m: np.ndarray


def time_offset(hands: Sequence[tuple[np.ndarray, np.ndarray]], thing: ObjectMotion) -> TimeOffset:
    """The lag in -10 to 10 frames at which the hands' velocities agree best with the object's.

    hands: of each, joints (frame, 21, 3), metres, and usable (frame,) bool. Samples are frames in which a joint is
    within 5 cm of one of the object's points and the object moves there at 5 cm/s or more; fewer than 15 of them tell
    nothing. At lag ``L``: ``sum u(t) . v(t + L) / sqrt(sum |u(t)|^2 sum |v(t + L)|^2)``, v of the joint, u of the point
    of the object (or of its part) that lies where the joint is at t; central differences.
    """
    pairs = [_near_pairs(joints, usable, thing) for joints, usable in hands]
    samples = sum(len(object_m_s) for object_m_s, _ in pairs)
    if samples < FEWEST_SAMPLES:
        return TimeOffset(float("nan"), float("nan"), samples)
    moved = np.concatenate([object_m_s for object_m_s, _ in pairs])
    hand = np.concatenate([hand_m_s for _, hand_m_s in pairs], axis=1)
    energy = np.sqrt((moved**2).sum() * (hand**2).sum(axis=(1, 2)))
    score = (hand * moved).sum(axis=(1, 2)) / np.maximum(energy, 1e-12)
    best = int(score.argmax())
    return TimeOffset(float(best - LARGEST_LAG), float(score[best]), samples)


def _near_pairs(joints_m: np.ndarray, usable: np.ndarray, thing: ObjectMotion) -> tuple[np.ndarray, np.ndarray]:
    """Velocities (sample, 3) of the object and (lag, sample, 3) of the joint near it, where a moving object is near."""
    n_frames, margin = len(joints_m), LARGEST_LAG + 1
    # Every lag sees the same frames, so that none wins by leaving out those that disagree.
    whole = [frame for frame in range(margin, n_frames - margin) if usable[frame - margin : frame + margin + 1].all()]
    frame, joint, point = _nearest(joints_m, thing.points_m, whole)
    object_m_s = _carried_velocity(thing, thing.part[point], frame, joints_m[frame, joint])
    moving = np.linalg.norm(object_m_s, axis=-1) >= MOVING_M_S
    frame, joint = frame[moving], joint[moving]
    then = frame[None] + np.arange(-LARGEST_LAG, LARGEST_LAG + 1)[:, None]
    hand_m_s = (joints_m[then + 1, joint] - joints_m[then - 1, joint]) * (FPS / 2)
    return object_m_s[moving], hand_m_s


def _nearest(
    joints_m: np.ndarray, points_m: np.ndarray, frames: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the frames in which they are within 5 cm: the frame, the joint and the point nearest to each other."""
    found = []
    for frame in frames:
        distance, point = map(np.asarray, KDTree(points_m[frame]).query(joints_m[frame], distance_upper_bound=NEAR_M))
        joint = int(distance.argmin())
        if np.isfinite(distance[joint]):
            found.append((frame, joint, int(point[joint])))
    columns = np.array(found, dtype=np.int64).reshape(-1, 3).T
    return columns[0], columns[1], columns[2]


def _carried_velocity(thing: ObjectMotion, part: np.ndarray, frame: np.ndarray, positions_m: np.ndarray) -> np.ndarray:
    """(sample, 3) m/s of points fixed to a part that lie at ``positions_m (sample, 3)`` in ``frame (sample,)``."""
    fixed = np.einsum("sij,si->sj", thing.rotmats[part, frame], positions_m - thing.positions_m[part, frame])
    before, after = (
        np.einsum("sij,sj->si", thing.rotmats[part, then], fixed) + thing.positions_m[part, then]
        for then in (frame - 1, frame + 1)
    )
    return (after - before) * (FPS / 2)
