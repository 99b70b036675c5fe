"""Fit a MANO-layout hand to 3D keypoints: one shape, and wrist, orientation and finger pose per frame.

Least squares by Levenberg-Marquardt with analytic derivatives, all frames at once. A keypoint of one finger depends on
that finger and the palm only, so each step eliminates five 9 x 9 finger blocks, then the 6 x 6 palm, then the shape
(Schur complements); 10,000 hands take seconds on one core. Deterministic: no random numbers.

Units metres and radians; keypoints in the order of the 21 joints (``hoidata.hands.JOINT_NAMES``).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat, skew
from hoidata.hands.kinematics import HandKinematics
from hoidata.hands.model import N_SHAPE, TIP_VERTICES, HandModel, HandPair, Side
from hoidata.hands.tracks import kinematics_of

KNUCKLES = [1, 4, 7, 10, 13]
FINGER_POINTS = [[3 * finger + 1, 3 * finger + 2, 3 * finger + 3, 16 + finger] for finger in range(5)]
N_KEYPOINTS = 21
THUMB = 4
# Fingertips touch things, so they count most; knuckles and wrist are where datasets disagree about what a joint is.
DEFAULT_WEIGHTS = (1.0, *(1.0, 2.0, 3.0) * 5, *(6.0,) * 5)


@dataclass(frozen=True)
class FitSettings:
    """weights: one per keypoint, of its squared error.

    noise_m: error of a keypoint of weight 1 that is as (un)likely as one standard deviation of the priors.
    bend_rad, spread_rad, twist_rad: standard deviations of a finger joint about its hinge axis, sideways, and about
    its bone, around the model's mean pose; thumb_rad: of the thumb about either axis across its bone.
    shake_rad: standard deviation of a finger joint from its mean over three neighbouring frames.
    shape_frames: at most so many frames per hand, evenly spaced, decide the shape.
    shape_prior: weight per frame of a standard normal prior on the shape. It grows with the frames because joint
    definitions differ in the same way in all of them: without it, ManipNet's hands drive betas to 14.
    """

    weights: tuple[float, ...] = DEFAULT_WEIGHTS
    noise_m: float = 0.003
    bend_rad: float = 1.5
    spread_rad: float = 0.25
    twist_rad: float = 0.2
    thumb_rad: float = 1.0
    shake_rad: float = 0.1
    shape_frames: int = 100
    shape_prior: float = 0.3
    shape_steps: int = 12
    pose_steps: int = 15


@dataclass(frozen=True)
class HandFit:
    """wrist_m: (frame, 3); global_orient: (frame, 3); hand_pose: (frame, 45) absolute; betas: (1, 10).

    error_m: (frame, 21) distance of each keypoint from the fitted hand; NaN where none was given.
    """

    wrist_m: np.ndarray
    global_orient: np.ndarray
    hand_pose: np.ndarray
    betas: np.ndarray
    error_m: np.ndarray


@dataclass(frozen=True)
class _Pose:
    """wrist (frame, 3); orient (frame, 3, 3) world-from-hand; fingers (frame, 5, 3, 3): finger, joint, axis-angle."""

    wrist: Tensor
    orient: Tensor
    fingers: Tensor

    def where(self, chosen: Tensor, other: "_Pose") -> "_Pose":
        return _Pose(
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
class _Problem:
    """The keypoints of one hand, (frame, 21, 3), finite everywhere, with weights (frame, 21), zero where unknown."""

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


def fit_hands(
    keypoints_m: Mapping[Side, np.ndarray],
    hands: HandPair,
    betas: np.ndarray | None = None,
    settings: FitSettings | None = None,
) -> dict[Side, HandFit]:
    """Fit both (or one) of a person's hands over consecutive frames.

    keypoints_m: per side (frame, 21, 3) world positions, metres; NaN where a keypoint is unknown.
    betas: (10,) the known shape; by default it is fitted first (``fit_shape``), one for both sides.
    Raises BadInput for another shape of array or a frame without at least three known keypoints on the palm.
    """
    settings = settings or FitSettings()
    if betas is None:
        betas = fit_shape(keypoints_m, hands, settings)
    shape = torch.as_tensor(np.asarray(betas, dtype=np.float64)).reshape(1, N_SHAPE)
    return {side: _fit_side(side, points, hands[side], shape, settings) for side, points in keypoints_m.items()}


def fit_shape(
    keypoints_m: Mapping[Side, np.ndarray], hands: HandPair, settings: FitSettings | None = None
) -> np.ndarray:
    """The one shape (10,) that explains the keypoints of both sides best, under a standard normal prior.

    Frames need not be consecutive; ``settings.shape_frames`` of them per side, evenly spaced, are used.
    """
    settings = replace(settings or FitSettings(), shake_rad=np.inf)
    problems, poses = [], []
    betas = torch.zeros(1, N_SHAPE, dtype=torch.float64)
    for side, points in keypoints_m.items():
        chosen = np.unique(np.linspace(0, len(points) - 1, min(settings.shape_frames, len(points))).astype(int))
        problems.append(_problem(side, points[chosen], hands[side], settings))
        poses.append(_initial_pose(problems[-1]))
    n_frames = sum(len(problem.keypoints) for problem in problems)
    prior = settings.noise_m**2 * max(1.0, settings.shape_prior * n_frames)
    for _ in range(settings.shape_steps):
        betas, moved = _shape_step(problems, poses, betas, prior)
        poses = [_settled(*pair, betas) for pair in zip(problems, moved, poses, strict=True)]
    return betas[0].numpy()


def _fit_side(side: Side, points: np.ndarray, model: HandModel, betas: Tensor, settings: FitSettings) -> HandFit:
    problem = _problem(side, points, model, settings)
    pose = _initial_pose(problem)
    for _ in range(settings.pose_steps):
        pose = _pose_step(problem, pose, betas)
    error = (_predict(problem.layer, pose, betas) - problem.keypoints).norm(dim=-1)
    error[problem.weights == 0] = torch.nan
    return HandFit(
        wrist_m=pose.wrist.numpy(),
        global_orient=rotmat_to_rotvec(pose.orient.numpy()),
        hand_pose=pose.fingers.reshape(-1, 45).numpy(),
        betas=betas.numpy().copy(),
        error_m=error.numpy(),
    )


def _problem(side: Side, points: np.ndarray, model: HandModel, settings: FitSettings) -> _Problem:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 3 or points.shape[1:] != (N_KEYPOINTS, 3) or not len(points):
        raise BadInput(f"{side} hand keypoints", "an array (frame, 21, 3)", f"shape {points.shape}", "check the caller")
    known = np.asarray(np.isfinite(points).all(axis=-1))
    palm = known[:, [0, *KNUCKLES]].sum(axis=1)
    if palm.min() < 3:
        got = f"{palm.min()} in frame {palm.argmin()}"
        raise BadInput(f"{side} hand keypoints", "3 known ones on the palm", got, "leave such frames out")
    rest = np.concatenate((model.rest_joints_m(np.zeros((1, N_SHAPE)))[0], model.template_m[list(TIP_VERTICES)]))
    return _Problem(
        layer=kinematics_of(model, torch.float64),
        keypoints=torch.from_numpy(np.where(known[..., None], points, 0.0)),
        weights=torch.from_numpy(known * np.asarray(settings.weights)),
        rest=torch.from_numpy(rest),
        prior_mean=torch.from_numpy(model.mean_pose.reshape(5, 9)),
        prior=torch.from_numpy(_pose_prior(rest, settings)),
        smooth=(settings.noise_m / settings.shake_rad) ** 2,
    )


def _pose_prior(rest: np.ndarray, settings: FitSettings) -> np.ndarray:
    """Precision (5, 9, 9) of each finger's axis-angles, in units of squared metres.

    The hinge axis lies across the bone in the plane of the palm; a thumb bends about any axis across its bone.
    """
    palm_normal = _unit(np.cross(rest[1] - rest[0], rest[7] - rest[0]))
    precision = np.zeros((5, 9, 9))
    for finger, points in enumerate(FINGER_POINTS):
        across = (settings.thumb_rad,) * 2 if finger == THUMB else (settings.bend_rad, settings.spread_rad)
        for joint in range(3):
            bone = _unit(rest[points[joint + 1]] - rest[points[joint]])
            hinge = _unit(np.cross(palm_normal, bone))
            axes = np.stack((hinge, np.cross(bone, hinge), bone))
            rows = slice(3 * joint, 3 * joint + 3)
            precision[finger, rows, rows] = axes.T @ np.diag(np.array([*across, settings.twist_rad]) ** -2.0) @ axes
    return precision * settings.noise_m**2


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def _initial_pose(problem: _Problem) -> _Pose:
    """Palm by the best rigid fit of wrist and knuckles, fingers by turning each rest bone onto the observed one."""
    wrist, orient = _rigid_fit(problem)
    fingers = torch.zeros(len(wrist), 5, 3, 3, dtype=wrist.dtype)
    chain = torch.tensor(FINGER_POINTS)
    parent = orient[:, None].expand(-1, 5, -1, -1)
    for joint in range(3):
        start, end = chain[:, joint], chain[:, joint + 1]
        bone = problem.keypoints[:, end] - problem.keypoints[:, start]
        known = (problem.weights[:, end] > 0) & (problem.weights[:, start] > 0) & (bone.norm(dim=-1) > 1e-6)
        local = (parent.transpose(-1, -2) @ bone[..., None])[..., 0]
        turn = _shortest_turn(problem.rest[end] - problem.rest[start], local)
        fingers[:, :, joint] = torch.where(known[..., None], turn, 0.0)
        parent = parent @ rotvec_to_rotmat(fingers[:, :, joint])
    return _Pose(wrist, orient, fingers)


def _rigid_fit(problem: _Problem) -> tuple[Tensor, Tensor]:
    """Wrist (frame, 3) and world-from-hand (frame, 3, 3) that lay the rest palm on the keypoints (Kabsch 1976)."""
    palm = [0, *KNUCKLES]
    weight = (problem.weights[:, palm] > 0).to(problem.keypoints.dtype)[..., None]
    total = weight.sum(1)
    rest = problem.rest[palm].expand(len(weight), -1, -1)
    rest_centre, seen_centre = (rest * weight).sum(1) / total, (problem.keypoints[:, palm] * weight).sum(1) / total
    spread = ((problem.keypoints[:, palm] - seen_centre[:, None]) * weight).transpose(1, 2) @ (
        rest - rest_centre[:, None]
    )
    left, _, right = torch.linalg.svd(spread)
    sign = torch.ones_like(total).expand(-1, 3).clone()
    sign[:, 2] = torch.linalg.det(left @ right)
    orient = left @ (sign[..., None] * right)
    offset = problem.rest[0] - rest_centre
    return seen_centre + (orient @ offset[..., None])[..., 0], orient


def _shortest_turn(bone: Tensor, target: Tensor) -> Tensor:
    """Axis-angle (frame, 5, 3) that turns ``bone`` (5, 3) into the direction of ``target`` (frame, 5, 3)."""
    bone, target = torch.broadcast_tensors(bone, target)
    axis = torch.linalg.cross(bone, target, dim=-1)
    angle = torch.atan2(axis.norm(dim=-1), (bone * target).sum(-1))
    return axis / axis.norm(dim=-1, keepdim=True).clamp_min(1e-12) * angle[..., None]


def _predict(layer: HandKinematics, pose: _Pose, betas: Tensor) -> Tensor:
    local = rotvec_to_rotmat(pose.fingers).reshape(-1, 15, 3, 3)
    return layer.joints(pose.wrist, torch.cat((pose.orient[:, None], local), 1), betas)


def _pose_step(problem: _Problem, pose: _Pose, betas: Tensor) -> _Pose:
    """One damped step of every frame; a frame that would get worse stays and is damped more."""
    target = _mean_in_time(pose.fingers)
    step = _normal_equations(problem, pose, betas, target, None)
    moved = _moved(pose, step, torch.linalg.solve(step.matrix, step.vector))
    better = _cost(problem, moved, betas, target) < _cost(problem, pose, betas, target)
    problem.damping = torch.where(better, problem.damping / 4, problem.damping * 16).clamp(1e-8, 1e4)
    return moved.where(better, pose)


def _settled(problem: _Problem, moved: _Pose, before: _Pose, betas: Tensor) -> _Pose:
    """After a step of the shape: per frame the better of both poses, then a damped step of its own."""
    better = _cost(problem, moved, betas, moved.fingers) < _cost(problem, before, betas, before.fingers)
    return _pose_step(problem, moved.where(better, before), betas)


def _shape_step(
    problems: list[_Problem], poses: list[_Pose], betas: Tensor, prior: float
) -> tuple[Tensor, list[_Pose]]:
    """One Gauss-Newton step of the shape and all poses together."""
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


def _shape_derivative(layer: HandKinematics, pose: _Pose) -> Tensor:
    """(frame, 21, 3, 10) metres per unit of beta: keypoints are linear in the shape at a fixed pose."""
    zero = torch.zeros(1, N_SHAPE, dtype=pose.wrist.dtype)
    base = _predict(layer, pose, zero)
    units = torch.eye(N_SHAPE, dtype=zero.dtype)
    return torch.stack([_predict(layer, pose, unit[None]) - base for unit in units], -1)


def _moved_with_shape(pose: _Pose, step: _Step, shape_change: Tensor) -> _Pose:
    rest = step.vector[:, :6] - step.matrix[:, :6, 6:] @ shape_change
    palm = torch.linalg.solve(step.matrix[:, :6, :6], rest)
    return _moved(pose, step, torch.cat((palm, shape_change.expand(len(palm), -1)), 1))


def _moved(pose: _Pose, step: _Step, outer: Tensor) -> _Pose:
    fingers = step.finger_free - (step.finger_of_outer @ outer[:, None, :, None])[..., 0]
    return _Pose(
        pose.wrist + outer[:, :3],
        rotvec_to_rotmat(outer[:, 3:6]) @ pose.orient,
        pose.fingers + fingers.reshape(pose.fingers.shape),
    )


def _mean_in_time(fingers: Tensor) -> Tensor:
    """Mean of each frame and its two neighbours; the first and last frame stay."""
    smooth = fingers.clone()
    smooth[1:-1] = (fingers[:-2] + fingers[1:-1] + fingers[2:]) / 3
    return smooth


def _cost(problem: _Problem, pose: _Pose, betas: Tensor, target: Tensor) -> Tensor:
    """(frame,) weighted squared error plus priors, in squared metres."""
    miss = (_predict(problem.layer, pose, betas) - problem.keypoints).square().sum(-1)
    off = pose.fingers.flatten(2) - problem.prior_mean
    shake = (pose.fingers - target).flatten(1).square().sum(1)
    prior = (off[..., None, :] @ problem.prior @ off[..., None]).sum((1, 2, 3))
    return (problem.weights * miss).sum(1) + prior + problem.smooth * shake


def _normal_equations(
    problem: _Problem, pose: _Pose, betas: Tensor, target: Tensor, shape_derivative: Tensor | None
) -> _Step:
    predicted = _predict(problem.layer, pose, betas)
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
    """(frame, 21, 3, 6) of every keypoint by the wrist's place and a small turn of the hand about it, world axes."""
    identity = torch.eye(3, dtype=predicted.dtype).expand(*predicted.shape, 3)
    return torch.cat((identity, -skew(predicted - predicted[:, :1])), -1)


def _finger_derivative(pose: _Pose, predicted: Tensor) -> Tensor:
    """(frame, 5, 12, 9) of a finger's four keypoints by its three axis-angles; the tip as if fixed to its last bone."""
    local = rotvec_to_rotmat(pose.fingers)
    first = pose.orient[:, None].expand(-1, 5, -1, -1)
    second = first @ local[:, :, 0]
    parents = torch.stack((first, second, second @ local[:, :, 1]), 2)
    axes = parents @ _left_jacobian(pose.fingers)
    points = predicted[:, FINGER_POINTS]
    lever = points[:, :, :, None] - points[:, :, None, :3]
    beyond = torch.ones(4, 3, dtype=predicted.dtype).tril(-1)[..., None, None]
    turned = -skew(lever) @ axes[:, :, None] * beyond
    return turned.transpose(3, 4).reshape(len(predicted), 5, 12, 9)


def _left_jacobian(rotvec: Tensor) -> Tensor:
    """(..., 3, 3): ``R(v + dv) = R(J dv) R(v)`` to first order (Barfoot 2017, eq. 7.77)."""
    angle = rotvec.norm(dim=-1)[..., None, None].clamp_min(1e-4)
    cross = skew(rotvec)
    versine = (1 - torch.cos(angle)) / angle**2
    sine = (angle - torch.sin(angle)) / angle**3
    return torch.eye(3, dtype=rotvec.dtype) + versine * cross + sine * (cross @ cross)
