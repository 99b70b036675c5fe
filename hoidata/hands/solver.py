"""Batched damped least squares for hand poses, with Schur complements over fingers and palm.

A keypoint of one finger depends on that finger and the palm only. Each step therefore eliminates five 9 x 9 finger
blocks, then the 6 x 6 palm, then the shape, all frames in one batch. Derivatives are analytic.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from hoidata.geometry.rotations import rotvec_to_rotmat, skew
from hoidata.hands.kinematics import HandKinematics
from hoidata.hands.model import N_SHAPE

# Three joints and the tip of each finger: index, middle, pinky, ring, thumb.
FINGER_POINTS = [[3 * finger + 1, 3 * finger + 2, 3 * finger + 3, 16 + finger] for finger in range(5)]


@dataclass(frozen=True)
class Pose:
    """Hand poses, world frame."""

    wrist: Tensor  # (frame, 3) metres
    orient: Tensor  # (frame, 3, 3) world-from-hand
    fingers: Tensor  # (frame, 5, 3, 3): finger, joint, axis-angle

    def where(self, chosen: Tensor, other: "Pose") -> "Pose":
        """In each frame this pose if ``chosen (frame,)``, else the other one."""
        return Pose(
            torch.where(chosen[:, None], self.wrist, other.wrist),
            torch.where(chosen[:, None, None], self.orient, other.orient),
            torch.where(chosen[:, None, None, None], self.fingers, other.fingers),
        )


@dataclass(frozen=True)
class _Step:
    """Normal equations after elimination of the fingers; outer unknowns: palm 6, then shape if it is fitted.

    The fingers' step is ``finger_free - finger_of_outer @ outer step``.
    """

    matrix: Tensor  # (frame, n, n)
    vector: Tensor  # (frame, n)
    finger_of_outer: Tensor  # (frame, 5, 9, n)
    finger_free: Tensor  # (frame, 5, 9)


@dataclass
class Problem:
    """Data and priors of one hand, float64; precisions are in squared metres."""

    layer: HandKinematics
    keypoints: Tensor  # (frame, 21, 3) metres, finite
    weights: Tensor  # (frame, 21), zero for an unknown keypoint
    rest: Tensor  # (21, 3) the model's keypoints at shape and pose zero
    prior_mean: Tensor  # (5, 9) finger axis-angles
    prior: Tensor  # (5, 9, 9) their precision
    smooth: float  # precision of the finger angles' deviation from their mean in time
    damping: Tensor = field(init=False)  # (frame,) Marquardt's damping, which persists between steps

    def __post_init__(self) -> None:
        self.damping = self.keypoints.new_full((len(self.keypoints),), 1e-6)


def predict(layer: HandKinematics, pose: Pose, betas: Tensor) -> Tensor:
    """(frame, 21, 3) keypoints of the model; betas: (1, 10)."""
    local = rotvec_to_rotmat(pose.fingers).reshape(-1, 15, 3, 3)
    return layer.joints(pose.wrist, torch.cat((pose.orient[:, None], local), 1), betas)


def pose_step(problem: Problem, pose: Pose, betas: Tensor) -> Pose:
    """One damped step of each frame. A frame whose cost would rise is unchanged and gets more damping."""
    target = _mean_in_time(pose.fingers)
    step = _normal_equations(problem, pose, betas, target, None)
    trial = _moved(pose, step, torch.linalg.solve(step.matrix, step.vector))
    is_better = _cost(problem, trial, betas, target) < _cost(problem, pose, betas, target)
    problem.damping = torch.where(is_better, problem.damping / 4, problem.damping * 16).clamp(1e-8, 1e4)
    return trial.where(is_better, pose)


def better_pose(problem: Problem, trial: Pose, previous: Pose, betas: Tensor) -> Pose:
    """After a shape step: in each frame the better of two poses, followed by a pose step."""
    is_better = _cost(problem, trial, betas, trial.fingers) < _cost(problem, previous, betas, previous.fingers)
    return pose_step(problem, trial.where(is_better, previous), betas)


def shape_step(problems: list[Problem], poses: list[Pose], betas: Tensor, prior: float) -> tuple[Tensor, list[Pose]]:
    """One joint Gauss-Newton step of the shape (1, 10) and all poses; prior: precision of the shape."""
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
    """(frame, 21, 3, 10) metres per unit of beta; keypoints are linear in the shape at a fixed pose."""
    zero = torch.zeros(1, N_SHAPE, dtype=pose.wrist.dtype)
    base = predict(layer, pose, zero)
    units = torch.eye(N_SHAPE, dtype=zero.dtype)
    return torch.stack([predict(layer, pose, unit[None]) - base for unit in units], -1)


def _moved_with_shape(pose: Pose, step: _Step, shape_change: Tensor) -> Pose:
    vector = step.vector[:, :6] - step.matrix[:, :6, 6:] @ shape_change
    palm = torch.linalg.solve(step.matrix[:, :6, :6], vector)
    return _moved(pose, step, torch.cat((palm, shape_change.expand(len(palm), -1)), 1))


def _moved(pose: Pose, step: _Step, outer: Tensor) -> Pose:
    fingers = step.finger_free - (step.finger_of_outer @ outer[:, None, :, None])[..., 0]
    return Pose(
        pose.wrist + outer[:, :3],
        rotvec_to_rotmat(outer[:, 3:6]) @ pose.orient,
        pose.fingers + fingers.reshape(pose.fingers.shape),
    )


def _mean_in_time(fingers: Tensor) -> Tensor:
    """Mean of each frame and its two neighbours; the first and last frame are unchanged."""
    smooth = fingers.clone()
    smooth[1:-1] = (fingers[:-2] + fingers[1:-1] + fingers[2:]) / 3
    return smooth


def _cost(problem: Problem, pose: Pose, betas: Tensor, target: Tensor) -> Tensor:
    """(frame,) weighted squared error plus priors, in squared metres."""
    squared_error = (predict(problem.layer, pose, betas) - problem.keypoints).square().sum(-1)
    deviation = pose.fingers.flatten(2) - problem.prior_mean
    shake = (pose.fingers - target).flatten(1).square().sum(1)
    prior = (deviation[..., None, :] @ problem.prior @ deviation[..., None]).sum((1, 2, 3))
    return (problem.weights * squared_error).sum(1) + prior + problem.smooth * shake


def _normal_equations(
    problem: Problem, pose: Pose, betas: Tensor, target: Tensor, shape_derivative: Tensor | None
) -> _Step:
    """Gauss-Newton equations at a pose. target: (frame, 5, 3, 3) smoothed finger angles."""
    predicted = predict(problem.layer, pose, betas)
    residual = problem.keypoints - predicted
    n_frames = len(residual)
    finger = _finger_derivative(pose, predicted)
    outer = _palm_derivative(predicted)
    if shape_derivative is not None:
        outer = torch.cat((outer, shape_derivative), -1)
    on_fingers = outer[:, FINGER_POINTS].reshape(n_frames, 5, 12, -1)
    weights = problem.weights[:, FINGER_POINTS].repeat_interleave(3, -1)[..., None]
    weighted = (weights * finger).transpose(-1, -2)
    deviation = (problem.prior_mean - pose.fingers.flatten(2))[..., None]
    # Blocks (frame, 5, 9, 9) of the fingers.
    inner = weighted @ finger + problem.prior + problem.smooth * torch.eye(9, dtype=residual.dtype)
    inner = inner + problem.damping[:, None, None, None] * torch.diag_embed(inner.diagonal(dim1=-2, dim2=-1))
    gradient = weighted @ residual[:, FINGER_POINTS].reshape(n_frames, 5, 12, 1) + problem.prior @ deviation
    gradient = gradient + problem.smooth * (target - pose.fingers).flatten(2)[..., None]
    mixed = weighted @ on_fingers
    # Schur complement: the fingers are eliminated first, for the columns of the outer unknowns and for the gradient.
    solved = torch.linalg.solve(inner, torch.cat((mixed, gradient), -1))
    of_outer, free = solved[..., :-1], solved[..., -1:]
    outer_all = outer.flatten(1, 2)
    weighted_all = (problem.weights.repeat_interleave(3, -1)[..., None] * outer_all).transpose(1, 2)
    matrix = weighted_all @ outer_all - (mixed.transpose(-1, -2) @ of_outer).sum(1)
    vector = weighted_all @ residual.flatten(1)[..., None] - (mixed.transpose(-1, -2) @ free).sum(1)
    return _Step(matrix, vector[..., 0], of_outer, free[..., 0])


def _palm_derivative(predicted: Tensor) -> Tensor:
    """(frame, 21, 3, 6) derivative of keypoints by wrist position and a small hand rotation about it, world axes."""
    identity = torch.eye(3, dtype=predicted.dtype).expand(*predicted.shape, 3)
    return torch.cat((identity, -skew(predicted - predicted[:, :1])), -1)


def _finger_derivative(pose: Pose, predicted: Tensor) -> Tensor:
    """(frame, 5, 12, 9) derivative of a finger's keypoints by its axis-angles; the tip moves with its last bone."""
    local = rotvec_to_rotmat(pose.fingers)
    first = pose.orient[:, None].expand(-1, 5, -1, -1)
    second = first @ local[:, :, 0]
    parents = torch.stack((first, second, second @ local[:, :, 1]), 2)
    axes = parents @ left_jacobian(pose.fingers)
    points = predicted[:, FINGER_POINTS]
    lever = points[:, :, :, None] - points[:, :, None, :3]
    is_descendant = torch.ones(4, 3, dtype=predicted.dtype).tril(-1)[..., None, None]
    derivative = -skew(lever) @ axes[:, :, None] * is_descendant
    return derivative.transpose(3, 4).reshape(len(predicted), 5, 12, 9)


def left_jacobian(rotvec: Tensor) -> Tensor:
    """(..., 3, 3) J with ``R(v + dv) = R(J dv) R(v)`` to first order (Barfoot 2017, Eq. 7.77)."""
    angle = rotvec.norm(dim=-1)[..., None, None].clamp_min(1e-4)
    cross = skew(rotvec)
    versine = (1 - torch.cos(angle)) / angle**2
    sine = (angle - torch.sin(angle)) / angle**3
    return torch.eye(3, dtype=rotvec.dtype) + versine * cross + sine * (cross @ cross)
