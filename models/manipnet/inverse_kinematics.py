"""Inverse kinematics of fingers: damped least squares (Levenberg-Marquardt) within joint limits.

ManipNet uses cyclic coordinate descent for the same targets (Sec. 6.3). The wrist is fixed, so the fingers are
independent: a step solves five small linear systems.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from hoidata.geometry.rotations import mirror_rotvec_x, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands.tracked_hand import HandState, TrackedHand

STEPS = 6
# Damping: a rotation by one radian costs as much as a position error of 5.5 mm.
DAMPING_M2 = 3e-5


@dataclass(frozen=True, eq=False)
class Limits:
    """Joint limits, as axis-angle from the neutral pose in each joint's local axes."""

    rest: np.ndarray  # (joint - 1, 3, 3) the neutral pose
    low_rad: np.ndarray  # (joint - 1, 3); equal to ``high_rad``: the axis is fixed
    high_rad: np.ndarray  # (joint - 1, 3)

    @classmethod
    def of(cls, hand: TrackedHand, low_rad: np.ndarray, high_rad: np.ndarray) -> "Limits":
        """Limits of one hand from those of a right hand, (joint - 1, 3); hinge joints have the hand model's limits."""
        if hand.side == "left":
            mirrored = mirror_rotvec_x(np.stack([low_rad, high_rad]))
            low_rad, high_rad = mirrored.min(axis=0), mirrored.max(axis=0)
        is_hinge = np.abs(hand.hinge_axis[1:]).sum(axis=1, keepdims=True) > 0
        hinge_limits_rad = hand.hinge_axis[1:, None] * hand.limit_rad[1:, :, None]
        low_rad = np.where(is_hinge, hinge_limits_rad.min(axis=1), low_rad)
        return cls(hand.rest_rotmats, low_rad, np.where(is_hinge, hinge_limits_rad.max(axis=1), high_rad))

    def within(self, finger_rotmats: np.ndarray) -> np.ndarray:
        """Clamp finger rotations (..., joint - 1, 3, 3) to the limits."""
        rotvec = rotmat_to_rotvec(self.rest.swapaxes(-1, -2) @ finger_rotmats)
        return self.rest @ rotvec_to_rotmat(np.clip(rotvec, self.low_rad, self.high_rad))


def rotvecs_from_rest(hand: TrackedHand, finger_rotmats: np.ndarray) -> np.ndarray:
    """(..., joint - 1, 3) axis-angle from the neutral pose; that of a left hand is mirrored."""
    rotvec = rotmat_to_rotvec(hand.rest_rotmats.swapaxes(-1, -2) @ finger_rotmats)
    return mirror_rotvec_x(rotvec) if hand.side == "left" else rotvec


def reach(
    hand: TrackedHand, limits: Limits, state: HandState, target_m: np.ndarray, weight: np.ndarray, steps: int = STEPS
) -> np.ndarray:
    """Finger rotations (1, joint - 1, 3, 3) with which points reach ``target_m`` (point, 3), joints then tips.

    All is in the wrist's frame. state: one frame, the start. weight: (point,) of the squared error; 0: no target. The
    wrist and the knuckles cannot move.
    """
    last = hand.tip_joint
    from_last = state.joint_rotmats[0, last].swapaxes(-1, -2)
    tips = (from_last @ (state.tip_m[0] - state.joint_m[0, last])[..., None])[..., 0]
    fingers = hand.finger_rotmats(state.joint_rotmats)[0]
    rest, low, high = (np.ascontiguousarray(values) for values in (limits.rest, limits.low_rad, limits.high_rad))
    return _reach(fingers, _chains(hand), hand.offset_m, tips, rest, low, high, target_m, weight, steps)[None]


@lru_cache(maxsize=64)
def _chains(hand: TrackedHand) -> np.ndarray:
    """(5, longest) joints of each finger from the knuckle on, padded with -1."""
    chains = []
    for joint in hand.tip_joint:
        chain = [int(joint)]
        while hand.parents[chain[0]] > 0:
            chain.insert(0, int(hand.parents[chain[0]]))
        chains.append(chain)
    longest = max(map(len, chains))
    return np.array([chain + [-1] * (longest - len(chain)) for chain in chains])


# Compiled with numba, float64, one thread: it runs for each hand in each frame.


@njit(cache=True)
def _reach(fingers, chains, offsets, tips, rest, low, high, target, weight, steps):  # pragma: no cover (compiled)
    """Finger rotations (joint - 1, 3, 3) after ``steps`` damped Gauss-Newton steps; arguments as of ``reach``."""
    fingers, longest, n_joints = fingers.copy(), chains.shape[1], len(fingers) + 1
    positions, rotations = np.empty((longest + 1, 3)), np.empty((longest, 3, 3))
    for finger in range(len(chains)):
        chain, size = chains[finger], 0
        while size < longest and chain[size] > 0:
            size += 1
        for _ in range(steps):
            # Forward kinematics of this finger, wrist frame, the tip last.
            for index in range(size):
                joint = chain[index]
                if index == 0:
                    positions[0], rotations[0] = offsets[joint], fingers[joint - 1]
                else:
                    positions[index] = positions[index - 1] + rotations[index - 1] @ offsets[joint]
                    rotations[index] = _product(rotations[index - 1], fingers[joint - 1])
            positions[size] = positions[size - 1] + rotations[size - 1] @ tips[finger]
            # Normal equations, (J^T W J + damping) x = J^T W error.
            matrix, vector = DAMPING_M2 * np.eye(3 * longest), np.zeros(3 * longest)
            for point in range(1, size + 1):
                number = chain[point] if point < size else n_joints + finger  # joints, then the tip
                if weight[number] > 0:
                    jacobian = _jacobian(point, positions, rotations, low, high, chain)
                    matrix += weight[number] * (jacobian.T @ jacobian)
                    vector += weight[number] * (jacobian.T @ (target[number] - positions[point]))
            change = np.linalg.solve(matrix, vector)
            for index in range(size):
                joint = chain[index] - 1
                # Rotate in the joint's local axes, then clamp the rotation from the neutral pose.
                rotated = _product(fingers[joint], _exp(change[3 * index : 3 * index + 3]))
                from_rest = _log(_product(rest[joint].T, rotated))
                fingers[joint] = _product(rest[joint], _exp(np.minimum(np.maximum(from_rest, low[joint]), high[joint])))
    return fingers


@njit(cache=True)
def _product(a, b):  # pragma: no cover (compiled)
    """Product of two (3, 3) matrices, faster than BLAS."""
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += a[i, k] * b[k, j]
    return out


@njit(cache=True)
def _jacobian(point, positions, rotations, low, high, chain):  # pragma: no cover (compiled)
    """(3, 3 joints) of a point's position for small rotations of the joints before it; 0 for fixed axes."""
    jacobian = np.zeros((3, 3 * len(chain)))
    for joint in range(point):
        (x, y, z), limits = positions[point] - positions[joint], chain[joint] - 1
        for axis in range(3):
            if high[limits, axis] > low[limits, axis]:
                a, b, c = rotations[joint, :, axis]  # the axis x the lever arm
                jacobian[:, 3 * joint + axis] = b * z - c * y, c * x - a * z, a * y - b * x
    return jacobian


@njit(cache=True)
def _exp(rotvec):  # pragma: no cover (compiled)
    """Axis-angle to rotation (Rodrigues' formula)."""
    x, y, z = rotvec
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    # Limits of sin(a) / a and (1 - cos(a)) / a^2 at 0.
    sine = np.sin(angle) / angle if angle > 1e-8 else 1.0
    versine = (1 - np.cos(angle)) / square if angle > 1e-4 else 0.5
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sine * skew + versine * _product(skew, skew)


@njit(cache=True)
def _log(matrix):  # pragma: no cover (compiled)
    """Rotation to axis-angle by the largest component of its quaternion, which is exact near 180 degrees too."""
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
