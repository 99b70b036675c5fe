"""World joints in the frame of each part of a moving object, compiled: one pass, nothing in between in memory.

The same formulas in the same order as ``ObjectTrack.world_from_object`` and ``ObjectModel.object_from_part``, so that
distances are the same to the last bit: SciPy's rotation by way of the unit quaternion, and products added up as
OpenBLAS does.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.clips import ObjectTrack
from hoidata.contact.intrinsics import fused

_SMALL_RAD = 1e-3  # below it SciPy takes a series of sin(angle / 2) / angle


class PartMotion(NamedTuple):
    """An object's motion, all float64. rotvec, translation_m: (frame, 3). hinge_rad: (frame,), empty without a hinge.

    axis, origin_m: (3,) of the hinge. moves: (part,) bool, whether the hinge turns the part.
    """

    rotvec: np.ndarray
    translation_m: np.ndarray
    hinge_rad: np.ndarray
    axis: np.ndarray
    origin_m: np.ndarray
    moves: np.ndarray


def part_motion(track: ObjectTrack, parts: Sequence[int]) -> PartMotion:
    """The motion of the parts with these numbers; any but 0 is turned by the hinge, if there is one."""
    hinge = track.model.hinge if track.hinge_rad is not None else None
    return PartMotion(
        rotvec=_numbers(track.rotvec),
        translation_m=_numbers(track.translation_m),
        hinge_rad=_numbers(np.zeros(0) if hinge is None or track.hinge_rad is None else track.hinge_rad),
        axis=_numbers(np.zeros(3) if hinge is None else hinge.axis),
        origin_m=_numbers(np.zeros(3) if hinge is None else hinge.origin_m),
        moves=np.array([part != 0 and hinge is not None for part in parts], bool),
    )


def _numbers(values: np.ndarray) -> np.ndarray:
    """A copy in the one type and layout the compiled code is made for."""
    return np.array(values, dtype=np.float64, order="C")


@njit(cache=True)
def places_of_frame(joints_m, motion, frame, turns, places):  # pragma: no cover (compiled)
    """One frame's (joint, 3) world joints into ``places`` (part, joint, 3). turns: (2, 3, 3), room."""
    rotvec, translation_m, hinge_rad, axis, origin_m, moves = motion
    _rotation(rotvec[frame, 0], rotvec[frame, 1], rotvec[frame, 2], turns[0])
    if len(hinge_rad):
        angle = hinge_rad[frame]
        _rotation(axis[0] * angle, axis[1] * angle, axis[2] * angle, turns[1])
    for joint in range(len(joints_m)):
        x, y, z = _turned_back(
            joints_m[joint, 0] - translation_m[frame, 0],
            joints_m[joint, 1] - translation_m[frame, 1],
            joints_m[joint, 2] - translation_m[frame, 2],
            turns[0],
        )
        for part in range(len(moves)):
            own = places[part, joint]
            own[0], own[1], own[2] = x, y, z
            if moves[part]:
                ox, oy, oz = _turned_back(x - origin_m[0], y - origin_m[1], z - origin_m[2], turns[1])
                own[0], own[1], own[2] = ox + origin_m[0], oy + origin_m[1], oz + origin_m[2]


@njit(cache=True)
def _turned_back(x, y, z, turn):  # pragma: no cover (compiled)
    """``(x, y, z) @ turn``."""
    return (
        fused(z, turn[2, 0], fused(y, turn[1, 0], x * turn[0, 0])),
        fused(z, turn[2, 1], fused(y, turn[1, 1], x * turn[0, 1])),
        fused(z, turn[2, 2], fused(y, turn[1, 2], x * turn[0, 2])),
    )


@njit(cache=True)
def _rotation(x, y, z, turn):  # pragma: no cover (compiled)
    """Rotation matrix of an axis-angle, into ``turn`` (3, 3)."""
    angle = np.sqrt(x * x + y * y + z * z)
    if angle <= _SMALL_RAD:
        square = angle * angle
        scale = 0.5 - square / 48 + square * square / 3840
    else:
        scale = np.sin(angle / 2) / angle
    x, y, z, w = scale * x, scale * y, scale * z, np.cos(angle / 2)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    turn[0, 0], turn[1, 1], turn[2, 2] = xx - yy - zz + ww, -xx + yy - zz + ww, -xx - yy + zz + ww
    turn[1, 0], turn[0, 1] = 2 * (x * y + z * w), 2 * (x * y - z * w)
    turn[2, 0], turn[0, 2] = 2 * (x * z - y * w), 2 * (x * z + y * w)
    turn[2, 1], turn[1, 2] = 2 * (y * z + x * w), 2 * (y * z - x * w)
