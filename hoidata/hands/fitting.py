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
    shake_rad: standard deviation of a finger joint from the mean of its two neighbours in time.
    shape_frames: at most so many frames per hand, evenly spaced, decide the shape.
    """

    weights: tuple[float, ...] = DEFAULT_WEIGHTS
    noise_m: float = 0.003
    bend_rad: float = 1.5
    spread_rad: float = 0.3
    twist_rad: float = 0.3
    thumb_rad: float = 1.0
    shake_rad: float = 0.1
    shape_frames: int = 100
    shape_steps: int = 30
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
    for _ in range(settings.shape_steps):
        betas, poses = _shape_step(problems, poses, betas, settings.noise_m**2)
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
    known = np.isfinite(points).all(axis=-1)
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
            precision[finger, rows, rows] = axes.T @ np.diag([*across, settings.twist_rad]) ** -2.0 @ axes
    return precision * settings.noise_m**2


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
