"""Faults in motion: shaking, jumps, frozen intervals, hands that are lost for a while. Pure functions on arrays.

points_m: (frame, point, 3) positions of points fixed to a body (joints of a hand, corners of an object), metres, one
frame of reference. usable: (frame,) bool, which frames mean something. Everything is at ``FPS`` frames per second.
"""

from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import FPS
from hoidata.geometry.intervals import runs, sudden_steps

# A tracker repeats its last numbers exactly; float32 storage of equal numbers stays within this.
EQUAL = 1e-7


class Jump(NamedTuple):
    """size_m: the step, metres, 0 where there is no jump; frame: the one before it, -1 where there is no jump."""

    size_m: float
    frame: int


def accelerations_m_s2(points_m: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """(frame,) mean over the points of ``|x[t+1] - 2 x[t] + x[t-1]| * FPS^2``, m/s^2.

    NaN at both ends, and where one of the three frames is not usable. White noise of ``s`` metres per axis gives
    ``3518 s`` on average at 30 fps (1 mm: 3.5 m/s^2): sqrt(6) s per axis, times sqrt(8/pi) for the length in 3D.
    """
    found = np.full(len(points_m), np.nan)
    if len(points_m) >= 3:
        second = points_m[2:] - 2 * points_m[1:-1] + points_m[:-2]
        found[1:-1] = np.linalg.norm(second, axis=-1).mean(axis=-1) * FPS**2
        found[1:-1][~(usable[2:] & usable[1:-1] & usable[:-2])] = np.nan
    return found


def steps_m(points_m: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """(frame - 1,) largest way of any point from a frame to the next, metres; 0 where one of them is not usable."""
    step = np.linalg.norm(np.diff(points_m, axis=0), axis=-1).max(axis=-1)
    return np.where(usable[1:] & usable[:-1], step, 0.0)


def largest_jump(step_m: np.ndarray, notable_m: float, large_m: float, ratio: float) -> Jump:
    """The largest sudden step (see ``sudden_steps``) of ``step_m (frame - 1,)``."""
    sudden = np.where(sudden_steps(step_m, notable_m, large_m, ratio), step_m, 0.0)
    if not sudden.any():
        return Jump(0.0, -1)
    return Jump(float(sudden.max()), int(sudden.argmax()))


def equal_steps(parameters: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """(frame - 1,) booleans: no number of ``parameters (frame, channel)`` changes by more than 1e-7; both usable."""
    same = (np.abs(np.diff(parameters, axis=0)) <= EQUAL).all(axis=1)
    return same & usable[1:] & usable[:-1]


def longest_frozen(same: np.ndarray) -> int:
    """Frames of the longest run of equal ones, given (frame - 1,) equal steps; 0 where no two are equal."""
    return max((stop - start + 1 for start, stop in runs(same)), default=0)


def gap_share(valid: np.ndarray) -> float:
    """Share of the frames between a hand's first and last valid one in which it is not valid; 0 for a hand never seen.

    A hand that comes late or leaves early is no fault: lost in between, it is.
    """
    seen = np.flatnonzero(valid)
    return float((~valid[seen[0] : seen[-1] + 1]).mean()) if len(seen) else 0.0
