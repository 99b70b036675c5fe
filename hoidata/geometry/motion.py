"""Motions of rigid bodies at any frame rate, and interpolation of rotations."""

from dataclasses import dataclass

import numpy as np

from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform

_ROUNDING_S = 1e-6
_FRAME_TOLERANCE = 1e-6  # of a frame's duration: a time this close to a frame takes its pose without interpolation


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of one rigid body, world frame."""

    time_s: np.ndarray  # (frame,) increasing
    rotmats: np.ndarray  # (frame, 3, 3) world_from_body
    position_m: np.ndarray  # (frame, 3)

    def covers(self, time_s: np.ndarray) -> np.ndarray:
        """Whether times are within those of the frames."""
        return (time_s >= self.time_s[0] - _ROUNDING_S) & (time_s <= self.time_s[-1] + _ROUNDING_S)

    def at(self, time_s: np.ndarray) -> RigidTransform:
        """Interpolate ``world_from_body`` at times of any shape; constant before the first and after the last frame.

        Rotations are interpolated by slerp, positions linearly. A result depends on its two neighbouring frames only,
        to the last bit, because a stream discards older frames.
        """
        time = np.clip(time_s, self.time_s[0], self.time_s[-1])
        before = np.searchsorted(self.time_s[1:-1], time, side="right")
        after = np.minimum(before + 1, len(self.time_s) - 1)
        since, until = time - self.time_s[before], self.time_s[after] - time
        frame = np.where(since <= until, before, after)
        rotation, position_m = self.rotmats[frame], self.position_m[frame]
        between = np.minimum(since, until) > _FRAME_TOLERANCE * (since + until)
        start, stop, fraction = before[between], after[between], (since / np.maximum(since + until, 1e-12))[between]
        rotation[between] = interpolate_rotations(self.rotmats[start], self.rotmats[stop], fraction)
        start_m = self.position_m[start]
        position_m[between] = start_m + fraction[:, None] * (self.position_m[stop] - start_m)
        return RigidTransform(rotation, position_m)


def interpolate_rotations(start: np.ndarray, stop: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Interpolate rotations (frame, ..., 3, 3) by slerp; fraction (frame,): 0 is ``start``, 1 is ``stop``."""
    rotvec = rotmat_to_rotvec(start.swapaxes(-1, -2) @ stop)
    return start @ rotvec_to_rotmat(fraction.reshape(-1, *[1] * (rotvec.ndim - 1)) * rotvec)


def poses_at(poses: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Poses (frame, joint, 3, 3) at fractional frame numbers (time,): the frame's own bits at whole numbers."""
    before = np.floor(frame + _FRAME_TOLERANCE).astype(int)
    between = np.flatnonzero(frame - before > _FRAME_TOLERANCE)
    start, stop, chosen = before[between], np.minimum(before[between] + 1, len(poses) - 1), poses[before]
    chosen[between] = interpolate_rotations(poses[start], poses[stop], (frame - before)[between])
    return chosen
