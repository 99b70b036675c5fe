"""Faults in motion: shaking, jumps, frozen intervals, temporarily lost hands. Pure functions on arrays.

Arguments of all functions: points_m, (frame, point, 3) positions of points fixed to a body (joints of a hand, corners
of an object), metres; usable, (frame,) bool, the valid frames. The frame rate is ``FPS``.
"""

from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import FPS
from hoidata.geometry.intervals import runs, sudden_steps

# A tracker that lost its target repeats its last numbers. Float32 rounding differs by less than this.
EQUAL = 1e-7


class Jump(NamedTuple):
    """A sudden step."""

    size_m: float  # 0 without a jump
    frame: int  # the frame before the step; -1 without a jump


def accelerations_m_s2(points_m: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Return (frame,) mean over the points of ``|x[t+1] - 2 x[t] + x[t-1]| * FPS^2``, m/s^2.

    NaN at both ends and next to unusable frames. White noise of ``s`` metres per axis gives ``3518 s`` on average at
    30 fps (1 mm: 3.5 m/s^2): sqrt(6) s per axis, times sqrt(8/pi) for the length in 3D.
    """
    accelerations = np.full(len(points_m), np.nan)
    if len(points_m) >= 3:
        second_difference = points_m[2:] - 2 * points_m[1:-1] + points_m[:-2]
        accelerations[1:-1] = np.linalg.norm(second_difference, axis=-1).mean(axis=-1) * FPS**2
        accelerations[1:-1][~(usable[2:] & usable[1:-1] & usable[:-2])] = np.nan
    return accelerations


def steps_m(points_m: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Return (frame - 1,) largest step of a point from frame to frame, metres; 0 next to unusable frames."""
    step = np.linalg.norm(np.diff(points_m, axis=0), axis=-1).max(axis=-1)
    return np.where(usable[1:] & usable[:-1], step, 0.0)


def largest_jump(step_m: np.ndarray, notable_m: float, large_m: float, ratio: float) -> Jump:
    """Return the largest sudden step (see ``sudden_steps``) of ``step_m (frame - 1,)``."""
    sudden = np.where(sudden_steps(step_m, notable_m, large_m, ratio), step_m, 0.0)
    if not sudden.any():
        return Jump(0.0, -1)
    return Jump(float(sudden.max()), int(sudden.argmax()))


def equal_steps(parameters: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Return (frame - 1,) bool: both frames are usable and no parameter (frame, channel) changes by over 1e-7."""
    same = (np.abs(np.diff(parameters, axis=0)) <= EQUAL).all(axis=1)
    return same & usable[1:] & usable[:-1]


def longest_frozen(same: np.ndarray) -> int:
    """Return the length in frames of the longest run of ``equal_steps (frame - 1,)``; 0 without any."""
    return max((stop - start + 1 for start, stop in runs(same)), default=0)


def gap_share(valid: np.ndarray) -> float:
    """Return the fraction of invalid frames between a hand's first and last valid frame; 0 without a valid frame.

    Frames before the first and after the last valid one do not count: a hand may arrive late and leave early.
    """
    tracked = np.flatnonzero(valid)
    return float((~valid[tracked[0] : tracked[-1] + 1]).mean()) if len(tracked) else 0.0
