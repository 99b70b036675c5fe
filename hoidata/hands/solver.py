"""Damped least squares for many hands at once, exploiting how a hand is built.

A keypoint of one finger depends on that finger and the palm only. Each step therefore eliminates five 9 x 9 finger
blocks, then the 6 x 6 palm, then the shape (Schur complements), all frames in one batch. Derivatives are analytic.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from hoidata.geometry.rotations import rotvec_to_rotmat, skew
from hoidata.hands.kinematics import HandKinematics
from hoidata.hands.model import N_SHAPE

# The four keypoints of each finger, index, middle, pinky, ring, thumb: three joints and the tip.
FINGER_POINTS = [[3 * finger + 1, 3 * finger + 2, 3 * finger + 3, 16 + finger] for finger in range(5)]


@dataclass(frozen=True)
class Pose:
    """wrist (frame, 3); orient (frame, 3, 3) world-from-hand; fingers (frame, 5, 3, 3): finger, joint, axis-angle."""

    wrist: Tensor
    orient: Tensor
    fingers: Tensor

    def where(self, chosen: Tensor, other: "Pose") -> "Pose":
        return Pose(
            torch.where(chosen[:, None], self.wrist, other.wrist),
            torch.where(chosen[:, None, None], self.orient, other.orient),
            torch.where(chosen[:, None, None, None], self.fingers, other.fingers),
        )


@dataclass(frozen=True)
class _Step:
    """Normal equations of all frames after the fingers are eliminated, and how to get the fingers' step back.

    matrix (frame, n, n), vector (frame, n) of the outer unknowns: palm 6, then shape if it is fitted.
    finger_of_outer (frame, 5, 9, n), finger_free (frame, 5, 9): finger step = free - of_outer @ outer step.
    """

    matrix: Tensor
    vector: Tensor
    finger_of_outer: Tensor
    finger_free: Tensor


@dataclass
class Problem:
    """One hand's data and priors; float64, metres.

    keypoints: (frame, 21, 3) finite everywhere; weights: (frame, 21), zero where a keypoint is unknown.
    rest: (21, 3) the model's own keypoints at shape and pose zero.
    prior_mean: (5, 9) finger axis-angles; prior: (5, 9, 9) their precision in squared metres; smooth: the precision of
    their distance from the mean in time. damping: (frame,) Marquardt's, kept from step to step.
    """

    layer: HandKinematics
    keypoints: Tensor
    weights: Tensor
    rest: Tensor
    prior_mean: Tensor
    prior: Tensor
    smooth: float
    damping: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.damping = self.keypoints.new_full((len(self.keypoints),), 1e-6)


def predict(layer: HandKinematics, pose: Pose, betas: Tensor) -> Tensor:
    """(frame, 21, 3) keypoints of the model; betas: (1, 10)."""
    local = rotvec_to_rotmat(pose.fingers).reshape(-1, 15, 3, 3)
    return layer.joints(pose.wrist, torch.cat((pose.orient[:, None], local), 1), betas)


def pose_step(problem: Problem, pose: Pose, betas: Tensor) -> Pose:
    """One damped step of every frame; a frame that would get worse stays and is damped more."""
    target = _mean_in_time(pose.fingers)
    step = _normal_equations(problem, pose, betas, target, None)
    moved = _moved(pose, step, torch.linalg.solve(step.matrix, step.vector))
    better = _cost(problem, moved, betas, target) < _cost(problem, pose, betas, target)
    problem.damping = torch.where(better, problem.damping / 4, problem.damping * 16).clamp(1e-8, 1e4)
    return moved.where(better, pose)


def settled(problem: Problem, moved: Pose, before: Pose, betas: Tensor) -> Pose:
    """After a step of the shape: per frame the better of both poses, then a damped step of its own."""
    better = _cost(problem, moved, betas, moved.fingers) < _cost(problem, before, betas, before.fingers)
    return pose_step(problem, moved.where(better, before), betas)


def shape_step(problems: list[Problem], poses: list[Pose], betas: Tensor, prior: float) -> tuple[Tensor, list[Pose]]:
    """One Gauss-Newton step of the shape (1, 10) and all poses together; prior: precision of the shape."""
    matrix, vector = prior * torch.eye(N_SHAPE, dtype=betas.dtype), -prior * betas[0]
    steps = []
    for problem, pose in zip(problems, poses, strict=True):
        step = _normal_equations(problem, pose, betas, pose.fingers, _shape_derivative(problem.layer, pose))
        steps.append(step)
        palm, mixed, shape = step.matrix[:, :6, :6], step.matrix[:, :6, 6:], step.matrix[:, 6:, 6:]
        solved = torch.linalg.solve(palm, torch.cat((mixed, step.vector[:, :6, None]), -1))
        matrix = matrix + (shape - mixed.transpose(1, 2) @ solved[..., :-1]).sum(0)
        vector = vector + (step.vector[:, 6:, None] - mixed.transpose(1, 2) @ solved[..., -1:]).sum(0)[:, 0]
    change = torch.linalg.solve(matrix, vector)
    moved = [_moved_with_shape(pose, step, change) for pose, step in zip(poses, steps, strict=True)]
    return betas + change, moved


def _shape_derivative(layer: HandKinematics, pose: Pose) -> Tensor:
    """(frame, 21, 3, 10) metres per unit of beta: keypoints are linear in the shape at a fixed pose."""
    zero = torch.zeros(1, N_SHAPE, dtype=pose.wrist.dtype)
    base = predict(layer, pose, zero)
    units = torch.eye(N_SHAPE, dtype=zero.dtype)
    return torch.stack([predict(layer, pose, unit[None]) - base for unit in units], -1)


def _moved_with_shape(pose: Pose, step: _Step, shape_change: Tensor) -> Pose:
    rest = step.vector[:, :6] - step.matrix[:, :6, 6:] @ shape_change
    palm = torch.linalg.solve(step.matrix[:, :6, :6], rest)
    return _moved(pose, step, torch.cat((palm, shape_change.expand(len(palm), -1)), 1))


def _moved(pose: Pose, step: _Step, outer: Tensor) -> Pose:
    fingers = step.finger_free - (step.finger_of_outer @ outer[:, None, :, None])[..., 0]
    return Pose(
        pose.wrist + outer[:, :3],
        rotvec_to_rotmat(outer[:, 3:6]) @ pose.orient,
        pose.fingers + fingers.reshape(pose.fingers.shape),
    )


def _mean_in_time(fingers: Tensor) -> Tensor:
    """Mean of each frame and its two neighbours; the first and last frame stay."""
    smooth = fingers.clone()
    smooth[1:-1] = (fingers[:-2] + fingers[1:-1] + fingers[2:]) / 3
    return smooth


def _cost(problem: Problem, pose: Pose, betas: Tensor, target: Tensor) -> Tensor:
    """(frame,) weighted squared error plus priors, in squared metres."""
    miss = (predict(problem.layer, pose, betas) - problem.keypoints).square().sum(-1)
    off = pose.fingers.flatten(2) - problem.prior_mean
    shake = (pose.fingers - target).flatten(1).square().sum(1)
    prior = (off[..., None, :] @ problem.prior @ off[..., None]).sum((1, 2, 3))
    return (problem.weights * miss).sum(1) + prior + problem.smooth * shake


def _normal_equations(
    problem: Problem, pose: Pose, betas: Tensor, target: Tensor, shape_derivative: Tensor | None
) -> _Step:
    predicted = predict(problem.layer, pose, betas)
    miss = problem.keypoints - predicted
    n_frames = len(miss)
    finger = _finger_derivative(pose, predicted)
    outer = _palm_derivative(predicted)
    if shape_derivative is not None:
        outer = torch.cat((outer, shape_derivative), -1)
    on_fingers = outer[:, FINGER_POINTS].reshape(n_frames, 5, 12, -1)
    weights = problem.weights[:, FINGER_POINTS].repeat_interleave(3, -1)[..., None]
    weighted = (weights * finger).transpose(-1, -2)
    off = (problem.prior_mean - pose.fingers.flatten(2))[..., None]
    inner = weighted @ finger + problem.prior + problem.smooth * torch.eye(9, dtype=miss.dtype)
    inner = inner + problem.damping[:, None, None, None] * torch.diag_embed(inner.diagonal(dim1=-2, dim2=-1))
    gradient = weighted @ miss[:, FINGER_POINTS].reshape(n_frames, 5, 12, 1) + problem.prior @ off
    gradient = gradient + problem.smooth * (target - pose.fingers).flatten(2)[..., None]
    mixed = weighted @ on_fingers
    solved = torch.linalg.solve(inner, torch.cat((mixed, gradient), -1))
    of_outer, free = solved[..., :-1], solved[..., -1:]
    outer_all = outer.flatten(1, 2)
    weighted_all = (problem.weights.repeat_interleave(3, -1)[..., None] * outer_all).transpose(1, 2)
    matrix = weighted_all @ outer_all - (mixed.transpose(-1, -2) @ of_outer).sum(1)
    vector = weighted_all @ miss.flatten(1)[..., None] - (mixed.transpose(-1, -2) @ free).sum(1)
    return _Step(matrix, vector[..., 0], of_outer, free[..., 0])


def _palm_derivative(predicted: Tensor) -> Tensor:
    """(frame, 21, 3, 6) of every keypoint by the wrist's position and a small turn of the hand about it, world axes."""
    identity = torch.eye(3, dtype=predicted.dtype).expand(*predicted.shape, 3)
    return torch.cat((identity, -skew(predicted - predicted[:, :1])), -1)


def _finger_derivative(pose: Pose, predicted: Tensor) -> Tensor:
    """(frame, 5, 12, 9) of a finger's four keypoints by its three axis-angles; the tip as if fixed to its last bone."""
    local = rotvec_to_rotmat(pose.fingers)
    first = pose.orient[:, None].expand(-1, 5, -1, -1)
    second = first @ local[:, :, 0]
    parents = torch.stack((first, second, second @ local[:, :, 1]), 2)
    axes = parents @ left_jacobian(pose.fingers)
    points = predicted[:, FINGER_POINTS]
    lever = points[:, :, :, None] - points[:, :, None, :3]
    beyond = torch.ones(4, 3, dtype=predicted.dtype).tril(-1)[..., None, None]
    turned = -skew(lever) @ axes[:, :, None] * beyond
    return turned.transpose(3, 4).reshape(len(predicted), 5, 12, 9)


def left_jacobian(rotvec: Tensor) -> Tensor:
    """(..., 3, 3): ``R(v + dv) = R(J dv) R(v)`` to first order (Barfoot 2017, eq. 7.77)."""
    angle = rotvec.norm(dim=-1)[..., None, None].clamp_min(1e-4)
    cross = skew(rotvec)
    versine = (1 - torch.cos(angle)) / angle**2
    sine = (angle - torch.sin(angle)) / angle**3
    return torch.eye(3, dtype=rotvec.dtype) + versine * cross + sine * (cross @ cross)
