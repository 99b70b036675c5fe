"""Joints of a hand to targets: damped least squares within limits, each finger by itself, many hands at once.

ManipNet solves by cyclic coordinate descent (its Sec. 6.3); the targets are its, the solver is ours. The wrist is
fixed, so no finger knows of another: a step is five small systems of equations for each hand.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat

STEPS = 6
# Of a turn by one radian beside an error of one metre: what a joint near its target may be turned for nothing.
DAMPING_M2 = 3e-5


@dataclass(frozen=True)
class Limits:
    """How far each joint may turn from its rest.

    rest: (joint, 3, 3) local rotations. low_rad, high_rad: (joint, 3) of the axis-angle from there; where both are the
    same a joint does not turn about that axis.
    """

    rest: np.ndarray
    low_rad: np.ndarray
    high_rad: np.ndarray

    def within(self, local: np.ndarray) -> np.ndarray:
        """Local rotations (..., joint, 3, 3) with every joint that is beyond its limits put back to them."""
        turn = rotmat_to_rotvec(self.rest.swapaxes(-1, -2) @ local)
        return self.rest @ rotvec_to_rotmat(np.clip(turn, self.low_rad, self.high_rad))

    @classmethod
    def around(cls, rest: np.ndarray, local: np.ndarray, margin_rad: float = 0.1) -> "Limits":
        """The range of recorded local rotations (hand, joint, 3, 3), made wider by the margin."""
        turn = rotmat_to_rotvec(rest.swapaxes(-1, -2) @ local)
        return cls(rest, turn.min(axis=0) - margin_rad, turn.max(axis=0) + margin_rad)


@dataclass(frozen=True)
class Fingers:
    """A skeleton of five chains that hang on the wrist, joint 0.

    parents: (joint,), -1 at the wrist. offsets_m: (joint, 3) in the parent's frame. tip_joints: (5,), tips_m: (5, 3)
    in that joint's frame. Points are all joints, then the tips.
    """

    parents: np.ndarray
    offsets_m: np.ndarray
    tip_joints: np.ndarray
    tips_m: np.ndarray

    @cached_property
    def chains(self) -> np.ndarray:
        """(5, longest) joints of each finger from the knuckle on; short ones end in the wrist, which never turns."""
        chains = []
        for joint in self.tip_joints:
            chain = [int(joint)]
            while self.parents[chain[0]] > 0:
                chain.insert(0, int(self.parents[chain[0]]))
            chains.append(chain)
        longest = max(map(len, chains))
        return np.array([chain + [0] * (longest - len(chain)) for chain in chains])

    @cached_property
    def points(self) -> np.ndarray:
        """(5, longest + 1) the points of each finger: its joints and its tip."""
        tips = len(self.parents) + np.arange(5)
        return np.concatenate([self.chains, tips[:, None]], axis=1)

    @cached_property
    def moves(self) -> np.ndarray:
        """(5, point, joint) 1 where a joint of the chain comes before the point, so that its turn moves it."""
        n_joints = self.chains.shape[1]
        before = np.tri(n_joints + 1, n_joints, -1)[None] * (self.chains > 0)[:, None]
        return before * (self.points > 0)[:, :, None]

    def placed(self, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (..., point, 3), metres, and rotations (..., joint, 3, 3) in the wrist's frame."""
        rotations, positions = np.empty_like(local), np.zeros((*local.shape[:-3], len(self.parents) + 5, 3))
        rotations[..., 0, :, :] = np.eye(3)
        for joint, parent in enumerate(self.parents[1:], start=1):
            rotations[..., joint, :, :] = rotations[..., parent, :, :] @ local[..., joint, :, :]
            positions[..., joint, :] = positions[..., parent, :] + rotations[..., parent, :, :] @ self.offsets_m[joint]
        tips = (rotations[..., self.tip_joints, :, :] @ self.tips_m[..., None])[..., 0]
        positions[..., len(self.parents) :, :] = positions[..., self.tip_joints, :] + tips
        return positions, rotations


def reach(
    fingers: Fingers, limits: Limits, local: np.ndarray, target_m: np.ndarray, weight: np.ndarray, steps: int = STEPS
) -> np.ndarray:
    """Local rotations (hand, joint, 3, 3) turned so that points come near their targets, within the limits.

    target_m: (hand, point, 3) in the wrist's frame. weight: (hand, point), of the squared error; 0: anywhere.
    """
    free = (limits.high_rad > limits.low_rad)[fingers.chains] * (fingers.chains > 0)[..., None]
    local = limits.within(local)
    own_weight = np.repeat(weight[:, fingers.points], 3, axis=-1)[..., None]
    for _ in range(steps):
        points, rotations = fingers.placed(local)
        jacobian = _jacobian(fingers, points, rotations) * np.reshape(free, (5, 1, -1))
        miss = (target_m - points)[:, fingers.points].reshape(len(local), 5, -1, 1)
        weighted = (own_weight * jacobian).swapaxes(-1, -2)
        matrix = weighted @ jacobian + DAMPING_M2 * np.eye(jacobian.shape[-1])
        turn = np.linalg.solve(matrix, weighted @ miss).reshape(*fingers.chains.shape[:0], len(local), -1, 3)
        turns = np.zeros((len(local), len(fingers.parents), 3))
        turns[:, fingers.chains.ravel()] = turn
        local = limits.within(local @ rotvec_to_rotmat(turns))
    return local


def _jacobian(fingers: Fingers, points: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """(hand, 5, 3 x point, 3 x joint) of a finger's points by small turns of its joints about their own axes."""
    lever = points[:, fingers.points][:, :, :, None] - points[:, fingers.chains][:, :, None]
    axes = rotations[:, fingers.chains].swapaxes(-1, -2)[:, :, None]
    moved = np.cross(axes, lever[..., None, :]) * fingers.moves[..., None, None]
    return moved.transpose(0, 1, 2, 5, 3, 4).reshape(len(points), 5, 3 * moved.shape[2], -1)
