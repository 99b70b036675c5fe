"""Joints and fingertips of a recorded hand track, without skinning the mesh and compiled with numba.

The same formulas as ``HandKinematics.joints`` in float64 (Romero et al. 2017, eqs. 1-4), for reading and measuring many
clips. ``track_joints`` stays what the embedded corpora are generated with: the two differ by rounding, in the last bit
of a float32 if at all.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.hands.model import N_JOINTS, N_ROTATIONS, PARENTS, TIP_VERTICES, HandModel
from hoidata.hands.tracks import HandTrackLike

_CHUNK_FRAMES = 256  # the rotations of so many frames stay in the processor's cache
_TIPS = list(TIP_VERTICES)
_PARENTS = np.array(PARENTS)


def fast_track_joints(track: HandTrackLike, model: HandModel) -> np.ndarray:
    """(frame, 21, 3) float32 world joints, metres, of every frame of the track, valid or not."""
    tips = _tips_of(model)
    betas = np.asarray(track.betas, dtype=np.float64)
    rest_joints = model.rest_joints_m(betas, track.template_m)
    template = model.template_m if track.template_m is None else np.asarray(track.template_m, dtype=np.float64)
    rest_tips = template[_TIPS] + tips.pose_origin_m + (betas @ tips.shape).reshape(-1, 5, 3)
    out = np.empty((len(track.wrist_m), N_JOINTS, 3), dtype=np.float32)
    for start in range(0, len(out), _CHUNK_FRAMES):
        frames = slice(start, start + _CHUNK_FRAMES)
        own = frames if len(betas) > 1 else slice(None)
        turns = _rotations(track.global_orient[frames], track.hand_pose[frames])
        # Blend shapes of the pose act on R - I; the share of -I lies in ``pose_origin_m``.
        moved_tips = (turns[:, 9:] @ tips.pose).reshape(-1, 5, 3) + rest_tips[own]
        _place_joints(track.wrist_m[frames], turns, rest_joints[own], moved_tips, tips.weights, out[frames])
    return out


class _Tips(NamedTuple):
    """Of the five tip vertices: shape (10, 15), pose (135, 15), pose_origin_m (5, 3), skinning weights (5, 16)."""

    shape: np.ndarray
    pose: np.ndarray
    pose_origin_m: np.ndarray
    weights: np.ndarray


@lru_cache(maxsize=8)
def _tips_of(model: HandModel) -> _Tips:
    pose = model.pose_directions[_TIPS].reshape(15, -1).T
    identity = np.tile(np.eye(3).ravel(), N_ROTATIONS - 1)
    return _Tips(
        shape=np.ascontiguousarray(model.shape_directions[_TIPS].reshape(15, -1).T),
        pose=np.ascontiguousarray(pose),
        pose_origin_m=-(identity @ pose).reshape(5, 3),
        weights=np.ascontiguousarray(model.skin_weights[_TIPS]),
    )


@njit(cache=True)
def _rotations(global_orient, hand_pose):  # pragma: no cover (compiled)
    """(frame, 144) float64 local rotation matrices of 16 joints, row by row (Rodrigues' formula)."""
    turns = np.empty((len(global_orient), 144))
    for frame in range(len(turns)):
        _rotation(global_orient[frame, 0], global_orient[frame, 1], global_orient[frame, 2], turns[frame, :9])
        for joint in range(15):
            x, y, z = hand_pose[frame, 3 * joint], hand_pose[frame, 3 * joint + 1], hand_pose[frame, 3 * joint + 2]
            _rotation(x, y, z, turns[frame, 9 * joint + 9 : 9 * joint + 18])
    return turns


@njit(cache=True)
def _rotation(x, y, z, turn):  # pragma: no cover (compiled)
    x, y, z = np.float64(x), np.float64(y), np.float64(z)
    square = x * x + y * y + z * z
    if square < 1e-12:  # two terms of each series: the next is below 1e-24
        sine, versine = 1 - square / 6, 0.5 - square / 24
    else:
        angle = np.sqrt(square)
        sine, half = np.sin(angle) / angle, np.sin(angle / 2)
        versine = 2 * half * half / square
    turn[0], turn[4], turn[8] = (
        1 - versine * (y * y + z * z),
        1 - versine * (x * x + z * z),
        1 - versine * (x * x + y * y),
    )
    turn[1], turn[3] = versine * x * y - sine * z, versine * x * y + sine * z
    turn[2], turn[6] = versine * x * z + sine * y, versine * x * z - sine * y
    turn[5], turn[7] = versine * y * z - sine * x, versine * y * z + sine * x


@njit(cache=True)
def _place_joints(wrist, turns, rest_joints, rest_tips, weights, out):  # pragma: no cover (compiled)
    """World positions of joints and tips. rest_joints: (frame or 1, 16, 3); rest_tips: (frame, 5, 3), blended."""
    world, positions = np.empty((16, 9)), np.empty((16, 3))
    for frame in range(len(out)):
        rest = rest_joints[frame if len(rest_joints) > 1 else 0]
        world[0] = turns[frame, :9]
        for axis in range(3):
            positions[0, axis] = wrist[frame, axis]
        for joint in range(1, 16):
            _hang(joint, _PARENTS[joint], turns[frame, 9 * joint : 9 * joint + 9], rest, world, positions)
        out[frame, :16] = positions
        for tip in range(5):
            _skin(rest_tips[frame, tip], weights[tip], rest, world, positions, out[frame, 16 + tip])


@njit(cache=True)
def _hang(joint, parent, turn, rest, world, positions):  # pragma: no cover (compiled)
    """World rotation and position of a joint from its parent's."""
    x, y, z = rest[joint, 0] - rest[parent, 0], rest[joint, 1] - rest[parent, 1], rest[joint, 2] - rest[parent, 2]
    for row in range(3):
        a, b, c = world[parent, 3 * row], world[parent, 3 * row + 1], world[parent, 3 * row + 2]
        positions[joint, row] = positions[parent, row] + a * x + b * y + c * z
        for column in range(3):
            world[joint, 3 * row + column] = a * turn[column] + b * turn[3 + column] + c * turn[6 + column]


@njit(cache=True)
def _skin(point, weights, rest, world, positions, out):  # pragma: no cover (compiled)
    """Linear blend skinning of one vertex, over the joints that have a weight in it."""
    x, y, z = 0.0, 0.0, 0.0
    for joint in range(16):
        if weights[joint] != 0:
            dx, dy, dz = point[0] - rest[joint, 0], point[1] - rest[joint, 1], point[2] - rest[joint, 2]
            turn, weight = world[joint], weights[joint]
            x += weight * (turn[0] * dx + turn[1] * dy + turn[2] * dz + positions[joint, 0])
            y += weight * (turn[3] * dx + turn[4] * dy + turn[5] * dz + positions[joint, 1])
            z += weight * (turn[6] * dx + turn[7] * dy + turn[8] * dz + positions[joint, 2])
    out[0], out[1], out[2] = x, y, z
