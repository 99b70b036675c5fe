"""Fit a MANO-layout hand to 3D keypoints: one shape, and wrist, orientation and finger pose per frame.

Least squares by Levenberg-Marquardt (Marquardt 1963). The start rotates each rest bone onto the observed one. 10,000
hands take about 15 s on one core. It uses no random numbers.

Units are metres and radians. Keypoints are in the order of the 21 joints (``hoidata.hands.JOINT_NAMES``).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands.kinematics import kinematics_of
from hoidata.hands.model import N_JOINTS, N_SHAPE, TIP_VERTICES, HandModel, HandPair, Side
from hoidata.hands.solver import FINGER_POINTS, Pose, Problem, better_pose, pose_step, predict, shape_step

KNUCKLES = [1, 4, 7, 10, 13]
THUMB = 4
# Fingertips touch objects, so they count most. Datasets disagree about the positions of knuckles and wrist.
WEIGHTS = (1.0, *(1.0, 2.0, 3.0) * 5, *(6.0,) * 5)  # (21,) of each keypoint's squared error
NOISE_M = 0.003  # standard deviation of a keypoint of weight 1

# Standard deviations of a finger joint's angles around the model's mean pose.
BEND_RAD = 1.5  # about its hinge axis
SPREAD_RAD = 0.25  # sideways
TWIST_RAD = 0.2  # about its bone
THUMB_RAD = 1.0  # of a thumb joint about both axes across its bone
SHAKE_RAD = 0.1  # from its mean over three neighbouring frames

SHAPE_FRAMES = 100  # most frames per hand that determine the shape, evenly spaced
# Weight per frame of a standard normal prior on the shape. It grows with the frames because joint definitions differ in
# the same way in all frames. Without it, ManipNet's hands lead to betas of 14.
SHAPE_PRIOR = 0.3
SHAPE_STEPS = 12
POSE_STEPS = 15


@dataclass(frozen=True)
class HandFit:
    """A fitted hand, float64, world frame."""

    wrist_m: np.ndarray  # (frame, 3)
    global_orient: np.ndarray  # (frame, 3) axis-angle
    hand_pose: np.ndarray  # (frame, 45) axis-angles, absolute
    betas: np.ndarray  # (1, 10)
    error_m: np.ndarray  # (frame, 21) distance of each keypoint from the fitted hand; NaN for an unknown keypoint


def fit_hands(
    keypoints_m: Mapping[Side, np.ndarray], hands: HandPair, betas: np.ndarray | None = None
) -> dict[Side, HandFit]:
    """Fit one or both hands of a person over consecutive frames.

    Args:
        keypoints_m: per side (frame, 21, 3) world positions; NaN for an unknown keypoint.
        betas: (10,) the shape, if known. By default one shape of both sides is fitted first (``fit_shape``).

    Raises BadInput: an array of another shape, or a frame with less than three known keypoints on the palm.
    """
    if betas is None:
        betas = fit_shape(keypoints_m, hands)
    shape = torch.as_tensor(np.asarray(betas, dtype=np.float64)).reshape(1, N_SHAPE)
    return {side: _fit_side(side, points, hands[side], shape) for side, points in keypoints_m.items()}


def fit_shape(keypoints_m: Mapping[Side, np.ndarray], hands: HandPair) -> np.ndarray:
    """Fit one shape (10,) to the keypoints of both sides, under a standard normal prior.

    Up to ``SHAPE_FRAMES`` evenly spaced frames per side are used. They need not be consecutive.
    """
    problems, poses = [], []
    betas = torch.zeros(1, N_SHAPE, dtype=torch.float64)
    for side, points in keypoints_m.items():
        chosen = np.unique(np.linspace(0, len(points) - 1, min(SHAPE_FRAMES, len(points))).astype(int))
        problems.append(_problem(side, points[chosen], hands[side], smooth=0.0))
        poses.append(_initial_pose(problems[-1]))
    n_frames = sum(len(problem.keypoints) for problem in problems)
    prior = NOISE_M**2 * max(1.0, SHAPE_PRIOR * n_frames)
    for _ in range(SHAPE_STEPS):
        betas, trials = shape_step(problems, poses, betas, prior)
        poses = [better_pose(*triple, betas) for triple in zip(problems, trials, poses, strict=True)]
    return betas[0].numpy()


def _fit_side(side: Side, points: np.ndarray, model: HandModel, betas: Tensor) -> HandFit:
    problem = _problem(side, points, model, smooth=(NOISE_M / SHAKE_RAD) ** 2)
    pose = _initial_pose(problem)
    for _ in range(POSE_STEPS):
        pose = pose_step(problem, pose, betas)
    error = (predict(problem.layer, pose, betas) - problem.keypoints).norm(dim=-1)
    error[problem.weights == 0] = torch.nan
    return HandFit(
        wrist_m=pose.wrist.numpy(),
        global_orient=rotmat_to_rotvec(pose.orient.numpy()),
        hand_pose=pose.fingers.reshape(-1, 45).numpy(),
        betas=betas.numpy().copy(),
        error_m=error.numpy(),
    )


def _problem(side: Side, points: np.ndarray, model: HandModel, smooth: float) -> Problem:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 3 or points.shape[1:] != (N_JOINTS, 3) or not len(points):
        raise BadInput(f"{side} hand keypoints", "an array (frame, 21, 3)", f"shape {points.shape}", "check the caller")
    is_known = np.asarray(np.isfinite(points).all(axis=-1))
    palm = is_known[:, [0, *KNUCKLES]].sum(axis=1)
    if palm.min() < 3:
        got = f"{palm.min()} in frame {palm.argmin()}"
        raise BadInput(f"{side} hand keypoints", "3 known keypoints on the palm", got, "omit such frames")
    rest = np.concatenate((model.rest_joints_m(np.zeros((1, N_SHAPE)))[0], model.template_m[list(TIP_VERTICES)]))
    return Problem(
        layer=kinematics_of(model, torch.float64),
        keypoints=torch.from_numpy(np.where(is_known[..., None], points, 0.0)),
        weights=torch.from_numpy(is_known * np.asarray(WEIGHTS)),
        rest=torch.from_numpy(rest),
        prior_mean=torch.from_numpy(model.mean_pose.reshape(5, 9)),
        prior=torch.from_numpy(pose_precision(rest)),
        smooth=smooth,
    )


def pose_precision(rest: np.ndarray) -> np.ndarray:
    """Precision (5, 9, 9) of the prior of each finger's axis-angles, times the squared noise, in squared metres.

    The hinge axis is across the bone in the plane of the palm. A thumb bends about any axis across its bone.
    rest: (21, 3) keypoints at rest.
    """
    palm_normal = _unit(np.cross(rest[1] - rest[0], rest[7] - rest[0]))
    precision = np.zeros((5, 9, 9))
    for finger, points in enumerate(FINGER_POINTS):
        across = (THUMB_RAD,) * 2 if finger == THUMB else (BEND_RAD, SPREAD_RAD)
        for joint in range(3):
            bone = _unit(rest[points[joint + 1]] - rest[points[joint]])
            hinge = _unit(np.cross(palm_normal, bone))
            axes = np.stack((hinge, np.cross(bone, hinge), bone))
            block = slice(3 * joint, 3 * joint + 3)
            precision[finger, block, block] = axes.T @ np.diag(np.array([*across, TWIST_RAD]) ** -2.0) @ axes
    return precision * NOISE_M**2


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def _initial_pose(problem: Problem) -> Pose:
    """Palm by a rigid fit of wrist and knuckles, fingers by rotating each rest bone onto the observed one."""
    wrist, orient = _rigid_fit(problem)
    fingers = torch.zeros(len(wrist), 5, 3, 3, dtype=wrist.dtype)
    chain = torch.tensor(FINGER_POINTS)
    parent = orient[:, None].expand(-1, 5, -1, -1)
    for joint in range(3):
        start, end = chain[:, joint], chain[:, joint + 1]
        bone = problem.keypoints[:, end] - problem.keypoints[:, start]
        is_known = (problem.weights[:, end] > 0) & (problem.weights[:, start] > 0) & (bone.norm(dim=-1) > 1e-6)
        local = (parent.transpose(-1, -2) @ bone[..., None])[..., 0]
        rotation = _shortest_rotation(problem.rest[end] - problem.rest[start], local)
        fingers[:, :, joint] = torch.where(is_known[..., None], rotation, 0.0)
        parent = parent @ rotvec_to_rotmat(fingers[:, :, joint])
    return Pose(wrist, orient, fingers)


def _rigid_fit(problem: Problem) -> tuple[Tensor, Tensor]:
    """Wrist (frame, 3) and world-from-hand (frame, 3, 3) of the best rigid fit of the palm (Kabsch 1976)."""
    palm = [0, *KNUCKLES]
    weight = (problem.weights[:, palm] > 0).to(problem.keypoints.dtype)[..., None]
    total = weight.sum(1)
    rest = problem.rest[palm].expand(len(weight), -1, -1)
    rest_centre, target_centre = (rest * weight).sum(1) / total, (problem.keypoints[:, palm] * weight).sum(1) / total
    spread = ((problem.keypoints[:, palm] - target_centre[:, None]) * weight).transpose(1, 2) @ (
        rest - rest_centre[:, None]
    )
    left, _, right = torch.linalg.svd(spread)
    sign = torch.ones_like(total).expand(-1, 3).clone()
    sign[:, 2] = torch.linalg.det(left @ right)  # a proper rotation, not a reflection
    orient = left @ (sign[..., None] * right)
    offset = problem.rest[0] - rest_centre
    return target_centre + (orient @ offset[..., None])[..., 0], orient


def _shortest_rotation(bone: Tensor, target: Tensor) -> Tensor:
    """Axis-angle (frame, 5, 3) of the smallest rotation from ``bone`` (5, 3) to ``target`` (frame, 5, 3)."""
    bone, target = torch.broadcast_tensors(bone, target)
    axis = torch.linalg.cross(bone, target, dim=-1)
    angle = torch.atan2(axis.norm(dim=-1), (bone * target).sum(-1))
    return axis / axis.norm(dim=-1, keepdim=True).clamp_min(1e-12) * angle[..., None]
