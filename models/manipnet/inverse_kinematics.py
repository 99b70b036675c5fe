"""Joints of a hand to targets: damped least squares within limits, each finger by itself.

ManipNet solves by cyclic coordinate descent (Sec. 6.3); the targets are its, the solver is ours. The wrist is fixed, so
no finger knows of another: a step is five small systems of equations.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

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


@dataclass(frozen=True, eq=False)
class _Chains:
    """joints: (5, longest) of each finger from the knuckle on, points: (5, longest + 1) those and the tip; 0 fills up.

    moves: (5, point, joint) whether a joint's turn moves a point.
    """

    joints: np.ndarray
    points: np.ndarray
    moves: np.ndarray


@lru_cache(maxsize=64)
def _chains(hand: TrackedHand) -> _Chains:
    found = []
    for joint in hand.tip_joint:
        chain = [int(joint)]
        while hand.parents[chain[0]] > 0:
            chain.insert(0, int(hand.parents[chain[0]]))
        found.append(chain)
    longest = max(map(len, found))
    joints = np.array([chain + [0] * (longest - len(chain)) for chain in found])
    points = np.concatenate([joints, hand.n_joints + np.arange(len(joints))[:, None]], axis=1)
    moves = np.tri(longest + 1, longest, -1)[None] * (joints > 0)[:, None] * (points > 0)[:, :, None]
    return _Chains(joints, points, moves)


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
    chains = _chains(hand)
    free = np.concatenate([np.zeros((1, 3), bool), limits.high_rad > limits.low_rad])[chains.joints]
    own_weight = np.repeat(weight[chains.points], 3, axis=-1)[..., None]
    rotmats, joints = state.joint_rotmats[0], state.joint_m[0]
    last = rotmats[hand.tip_joint]
    tips = (last.swapaxes(-1, -2) @ (state.tip_m[0] - joints[hand.tip_joint])[..., None])[..., 0]
    fingers = hand.finger_rotmats(state.joint_rotmats)[0]
    for _ in range(steps):
        points = np.concatenate([joints, joints[hand.tip_joint] + (rotmats[hand.tip_joint] @ tips[..., None])[..., 0]])
        jacobian = _jacobian(chains, points, rotmats) * free.reshape(len(free), 1, -1)
        miss = (target_m - points)[chains.points].reshape(len(free), -1, 1)
        weighted = (own_weight * jacobian).swapaxes(-1, -2)
        matrix = weighted @ jacobian + DAMPING_M2 * np.eye(jacobian.shape[-1])
        turns = np.zeros((hand.n_joints, 3))
        turns[chains.joints] = np.linalg.solve(matrix, weighted @ miss).reshape(*chains.joints.shape, 3)
        fingers = limits.within(fingers @ rotvec_to_rotmat(turns[1:]))
        joints, rotmats = _placed(hand, fingers)
    return fingers[None]


def _placed(hand: TrackedHand, fingers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (joint, 3) and rotations (joint, 3, 3) in the wrist's frame, without the skin."""
    rotation, position = hand._chain(fingers[None])
    return position[0], rotation[0]


def _jacobian(chains: _Chains, points: np.ndarray, rotmats: np.ndarray) -> np.ndarray:
    """(5, 3 x point, 3 x joint) of the points of each finger by small turns of its joints about their own axes."""
    lever = points[chains.points][:, :, None] - points[chains.joints][:, None]
    axes = rotmats[chains.joints].swapaxes(-1, -2)[:, None]
    moved = np.cross(axes, lever[..., None, :]) * chains.moves[..., None, None]
    return moved.transpose(0, 1, 4, 2, 3).reshape(len(points[chains.joints]), 3 * moved.shape[1], -1)
