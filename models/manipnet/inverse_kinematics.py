"""Joints of a hand to targets: damped least squares within limits, each finger by itself.

ManipNet solves by cyclic coordinate descent (Sec. 6.3); the targets are its, the solver is ours. The wrist is fixed, so
no finger knows of another: a step is five small systems of equations.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from hoidata.geometry.rotations import mirror_rotvec_x, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands.tracked_hand import HandState, TrackedHand

STEPS = 6
# A turn by one radian costs as much as an error of 5.5 mm: what leads nowhere is not turned.
DAMPING_M2 = 3e-5


@dataclass(frozen=True, eq=False)
class Limits:
    """How far the finger joints may turn, as the axis-angle from the neutral pose about each joint's own axes.

    rest: (joint - 1, 3, 3) the neutral pose. low_rad, high_rad: (joint - 1, 3); equal: no turn about that axis.
    """

    rest: np.ndarray
    low_rad: np.ndarray
    high_rad: np.ndarray

    @classmethod
    def of(cls, hand: TrackedHand, low_rad: np.ndarray, high_rad: np.ndarray) -> "Limits":
        """Of one hand; its hinges keep their own limits, the other joints get these of a right hand, (joint - 1, 3)."""
        if hand.side == "left":
            flipped = mirror_rotvec_x(np.stack([low_rad, high_rad]))
            low_rad, high_rad = flipped.min(axis=0), flipped.max(axis=0)
        is_hinge = np.abs(hand.hinge_axis[1:]).sum(axis=1, keepdims=True) > 0
        ends = hand.hinge_axis[1:, None] * hand.limit_rad[1:, :, None]
        low_rad = np.where(is_hinge, ends.min(axis=1), low_rad)
        return cls(hand.rest_rotmats, low_rad, np.where(is_hinge, ends.max(axis=1), high_rad))

    def within(self, finger_rotmats: np.ndarray) -> np.ndarray:
        """Finger rotations (..., joint - 1, 3, 3), those beyond a limit put back to it."""
        turn = rotmat_to_rotvec(self.rest.swapaxes(-1, -2) @ finger_rotmats)
        return self.rest @ rotvec_to_rotmat(np.clip(turn, self.low_rad, self.high_rad))


def turns_from_rest(hand: TrackedHand, finger_rotmats: np.ndarray) -> np.ndarray:
    """(..., joint - 1, 3) axis-angles from the neutral pose, those of a left hand as its mirror image's."""
    turn = rotmat_to_rotvec(hand.rest_rotmats.swapaxes(-1, -2) @ finger_rotmats)
    return mirror_rotvec_x(turn) if hand.side == "left" else turn


def target_points(hand: TrackedHand) -> np.ndarray:
    """(15,) the points that post-processing moves: the last two joints of every finger, and its tip."""
    parents = hand.parents[hand.tip_joint]
    return np.concatenate([np.sort(np.r_[parents, hand.tip_joint]), hand.n_joints + np.arange(len(parents))])


def reach(
    hand: TrackedHand, limits: Limits, state: HandState, target_m: np.ndarray, weight: np.ndarray, steps: int = STEPS
) -> np.ndarray:
    """(1, joint - 1, 3, 3) finger rotations of ``state`` turned so that points come near their targets.

    state: one frame, in the wrist's frame. target_m: (point, 3) in it, joints then tips. weight: (point,) of the
    squared error; 0: anywhere.
    """
    last = hand.tip_joint
    from_last = state.joint_rotmats[0, last].swapaxes(-1, -2)
    tips = (from_last @ (state.tip_m[0] - state.joint_m[0, last])[..., None])[..., 0]
    fingers = hand.finger_rotmats(state.joint_rotmats)[0]
    rest, low, high = (np.ascontiguousarray(values) for values in (limits.rest, limits.low_rad, limits.high_rad))
    return _reach(fingers, _chains(hand), hand.offset_m, tips, rest, low, high, target_m, weight, steps)[None]


@lru_cache(maxsize=64)
def _chains(hand: TrackedHand) -> np.ndarray:
    """(5, longest) joints of each finger from the knuckle on; -1 fills up."""
    found = []
    for joint in hand.tip_joint:
        chain = [int(joint)]
        while hand.parents[chain[0]] > 0:
            chain.insert(0, int(hand.parents[chain[0]]))
        found.append(chain)
    longest = max(map(len, found))
    return np.array([chain + [-1] * (longest - len(chain)) for chain in found])


# Compiled with numba, float64, one thread: it runs for every hand in every frame.


@njit(cache=True)
def _reach(fingers, chains, offsets, tips, rest, low, high, target, weight, steps):  # pragma: no cover (compiled)
    """Finger rotations (joint - 1, 3, 3) after ``steps`` damped steps; arguments as in ``reach``."""
    fingers, longest = fingers.copy(), chains.shape[1]
    n_joints = len(fingers) + 1
    place, turn = np.empty((longest + 1, 3)), np.empty((longest, 3, 3))
    matrix, vector, rows = np.empty((3 * longest, 3 * longest)), np.empty(3 * longest), np.empty((3, 3 * longest))
    for finger in range(len(chains)):
        chain, size = chains[finger], 0
        while size < longest and chain[size] > 0:
            size += 1
        for _ in range(steps):
            _place(fingers, chain, size, offsets, tips[finger], place, turn)
            matrix[:], vector[:] = 0.0, 0.0
            for index in range(3 * size):
                matrix[index, index] = DAMPING_M2
            for point in range(1, size + 1):
                number = chain[point] if point < size else n_joints + finger
                if weight[number] > 0:
                    _set_levers(rows, point, place, turn, low, high, chain)
                    _add_point(matrix, vector, rows, 3 * point, weight[number], target[number], place[point])
            _solve(matrix, vector, 3 * size)
            for index in range(size):
                joint = chain[index] - 1
                turned = _times(fingers[joint], _exp(vector[3 * index : 3 * index + 3]))
                from_rest = _log(_times(rest[joint].T, turned))
                for axis in range(3):
                    from_rest[axis] = min(max(from_rest[axis], low[joint, axis]), high[joint, axis])
                fingers[joint] = _times(rest[joint], _exp(from_rest))
    return fingers


@njit(cache=True)
def _times(a, b):  # pragma: no cover (compiled)
    """Product of two (3, 3) matrices."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@njit(cache=True)
def _place(fingers, chain, size, offsets, tip, place, turn):  # pragma: no cover (compiled)
    """Of one finger: positions, the tip last, and rotations in the wrist's frame, into ``place`` and ``turn``."""
    for index in range(size + 1):
        for axis in range(3):
            if index == 0:
                place[0, axis] = offsets[chain[0], axis]
            else:
                way, above = offsets[chain[index]] if index < size else tip, turn[index - 1, axis]
                place[index, axis] = place[index - 1, axis] + above[0] * way[0] + above[1] * way[1] + above[2] * way[2]
        if index < size:
            own = fingers[chain[index] - 1]
            turn[index] = own if index == 0 else _times(turn[index - 1], own)


@njit(cache=True)
def _set_levers(rows, point, place, turn, low, high, chain):  # pragma: no cover (compiled)
    """How a point moves with small turns of the joints before it about their axes, as far as these are free."""
    for joint in range(point):
        x, y, z = place[point] - place[joint]
        for axis in range(3):
            column, own = 3 * joint + axis, turn[joint, :, axis]
            free = 1.0 if high[chain[joint] - 1, axis] > low[chain[joint] - 1, axis] else 0.0
            rows[0, column] = free * (own[1] * z - own[2] * y)
            rows[1, column] = free * (own[2] * x - own[0] * z)
            rows[2, column] = free * (own[0] * y - own[1] * x)


@njit(cache=True)
def _add_point(matrix, vector, rows, size, weight, target, place):  # pragma: no cover (compiled)
    """Add a point's share to the normal equations."""
    for i in range(size):
        for axis in range(3):
            vector[i] += weight * rows[axis, i] * (target[axis] - place[axis])
            for j in range(size):
                matrix[i, j] += weight * rows[axis, i] * rows[axis, j]


@njit(cache=True)
def _solve(matrix, vector, size):  # pragma: no cover (compiled)
    """Solve in place by elimination; the matrix is symmetric and positive, so no rows need change places."""
    for i in range(size):
        for j in range(i + 1, size):
            factor = matrix[j, i] / matrix[i, i]
            for k in range(i, size):
                matrix[j, k] -= factor * matrix[i, k]
            vector[j] -= factor * vector[i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]


@njit(cache=True)
def _exp(turn):  # pragma: no cover (compiled)
    """Axis-angle to rotation (Rodrigues' formula)."""
    x, y, z = turn
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    sine = np.sin(angle) / angle if angle > 1e-8 else 1.0
    versine = (1 - np.cos(angle)) / square if angle > 1e-4 else 0.5
    out = np.empty((3, 3))
    out[0, 0], out[1, 1], out[2, 2] = (
        1 - versine * (y * y + z * z),
        1 - versine * (x * x + z * z),
        1 - versine * (x * x + y * y),
    )
    out[0, 1], out[1, 0] = versine * x * y - sine * z, versine * x * y + sine * z
    out[0, 2], out[2, 0] = versine * x * z + sine * y, versine * x * z - sine * y
    out[1, 2], out[2, 1] = versine * y * z - sine * x, versine * y * z + sine * x
    return out


@njit(cache=True)
def _log(matrix):  # pragma: no cover (compiled)
    """Rotation to axis-angle by the largest number of its quaternion, so that half turns are as exact as others."""
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    i = 0
    for axis in range(1, 3):
        if matrix[axis, axis] > matrix[i, i]:
            i = axis
    j, k = (i + 1) % 3, (i + 2) % 3
    out = np.empty(3)
    if trace > matrix[i, i]:
        real = 1 + trace
        out[0], out[1], out[2] = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
    else:
        real = matrix[k, j] - matrix[j, k]
        out[i] = 1 + 2 * matrix[i, i] - trace
        out[j], out[k] = matrix[j, i] + matrix[i, j], matrix[k, i] + matrix[i, k]
    if real < 0:
        real = -real
        out = -out
    half = np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    return out * (2 * np.arctan2(half, real) / half) if half > 1e-8 * real else out * (2 / real)
