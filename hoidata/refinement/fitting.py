"""Hands of a known shape fitted to points of their skin: a rigid start in closed form, then Levenberg-Marquardt."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import HandTrack
from hoidata.errors import BadInput
from hoidata.hands.fitting import FitSettings, pose_precision
from hoidata.hands.model import TIP_VERTICES, HandModel, HandPair, Side
from hoidata.refinement.skin import HandPose, Skin

STEPS = 20
NOISE_M = 0.003  # of a keypoint, as likely as one standard deviation of the prior of poses
PALM_SHARE = 0.5  # of a vertex on the palm, that the wrist carries
LEAST_DAMPING, MOST_DAMPING = 1e-8, 1e8


@dataclass(frozen=True)
class GeneratedHand:
    """What a model says of one hand, world frame, metres.

    keypoints_m: (frame, J, 3) places of J vertices of the hand; NaN in a frame without this hand.
    to_object_m: (frame, J, 3) from each keypoint to the nearest point of the object.
    is_active: (frame,) bool, near the object: only there do contact and depth count.
    """

    keypoints_m: np.ndarray
    to_object_m: np.ndarray
    is_active: np.ndarray

    @property
    def is_there(self) -> np.ndarray:
        """(frame,) bool: the frame has this hand."""
        return np.asarray(np.isfinite(self.keypoints_m).all(axis=(1, 2)))


def fit_hands(
    pair: HandPair,
    betas: np.ndarray,
    keypoint_ids: np.ndarray,
    generated: Mapping[Side, GeneratedHand],
    template_m: np.ndarray | None = None,
) -> dict[Side, HandTrack]:
    """Hands whose vertices come nearest to generated keypoints, each frame by itself.

    betas: (2, 10) shapes of left and right. keypoint_ids: (J,) vertices, the same on both sides. template_m:
    (2, 778, 3) personal rest meshes, or None. A hand is valid in the frames it is there. Raises BadInput for arrays of
    other shapes.
    """
    tracks = {}
    for side, hand in generated.items():
        check_generated(side, hand, keypoint_ids)
        row = ("left", "right").index(side)
        template = None if template_m is None else template_m[row]
        fitted = np.flatnonzero(hand.is_there)
        pose = _fitted(pair[side], betas[row], template, keypoint_ids, hand.keypoints_m[fitted])
        # Where there is no hand the nearest frame's stands, for finite numbers.
        nearest = np.abs(np.arange(len(hand.is_there))[:, None] - fitted).argmin(axis=1)
        tracks[side] = HandPose(*(array[nearest] for array in pose)).track(betas[row], hand.is_there, template)
    return tracks


def check_generated(side: Side, hand: GeneratedHand, keypoint_ids: np.ndarray) -> None:
    """Raises BadInput where the arrays of a hand do not fit each other."""
    n_frames, wanted = len(hand.keypoints_m), (len(keypoint_ids), 3)
    shapes = (hand.keypoints_m.shape[1:], hand.to_object_m.shape[1:], len(hand.to_object_m), len(hand.is_active))
    if shapes != (wanted, wanted, n_frames, n_frames) or len(keypoint_ids) < 3:
        got = f"{hand.keypoints_m.shape}, {hand.to_object_m.shape}, {hand.is_active.shape}"
        expected = f"(frame, {wanted[0]}, 3) twice and (frame,), of three keypoints or more"
        raise BadInput(f"generated {side} hand", expected, got, "check the caller")
    if not hand.is_there.any():
        raise BadInput(f"generated {side} hand", "a frame with finite keypoints", "none", "leave this hand out")


def pose_prior(model: HandModel) -> tuple[np.ndarray, np.ndarray]:
    """Mean (45,) and precision (45, 45) of the finger axis-angles, in radians."""
    rest = np.concatenate((model.rest_joints_m(np.zeros(10)), model.template_m[list(TIP_VERTICES)]))
    settings = FitSettings()
    precision = np.zeros((45, 45))
    for finger, block in enumerate(pose_precision(rest, settings) / settings.noise_m**2):
        precision[9 * finger : 9 * finger + 9, 9 * finger : 9 * finger + 9] = block
    return model.mean_pose, precision


def _fitted(
    model: HandModel, betas: np.ndarray, template_m: np.ndarray | None, ids: np.ndarray, keypoints_m: np.ndarray
) -> HandPose:
    skin, prior = Skin(model, betas, template_m, ids), pose_prior(model)
    pose = _start(skin, model.mean_pose, keypoints_m)
    damping = np.full(len(keypoints_m), 1e-3)
    cost = _cost(skin, pose, keypoints_m, prior)
    for _ in range(STEPS):
        moved = pose.moved(_step(skin, pose, keypoints_m, prior, damping))
        cost_moved = _cost(skin, moved, keypoints_m, prior)
        better = cost_moved < cost
        pose, cost = moved.where(better, pose), np.where(better, cost_moved, cost)
        damping = np.clip(np.where(better, damping / 8, damping * 8), LEAST_DAMPING, MOST_DAMPING)
    return pose


def _start(skin: Skin, mean_pose: np.ndarray, keypoints_m: np.ndarray) -> HandPose:
    """Fingers at the mean pose, palm by the best rigid fit of its keypoints (Kabsch 1976).

    The hand turns about its wrist joint, which does not lie at the origin of the rest mesh.
    """
    n_frames = len(keypoints_m)
    fingers = np.tile(mean_pose.reshape(15, 3), (n_frames, 1, 1))
    palm = skin.weights[:, 0] > PALM_SHARE
    palm = palm if palm.sum() >= 3 else np.ones_like(palm)
    flat = HandPose(np.zeros((1, 3)), np.eye(3)[None], fingers[:1])
    rest = skin.vertices_m(skin.chain(flat))[0, palm]
    seen = keypoints_m[:, palm]
    rest_centre, seen_centre = rest.mean(axis=0), seen.mean(axis=1)
    left, _, right = np.linalg.svd((seen - seen_centre[:, None]).swapaxes(1, 2) @ (rest - rest_centre))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    orient = left @ right
    return HandPose(seen_centre - orient @ rest_centre, orient, fingers)


def _cost(skin: Skin, pose: HandPose, keypoints_m: np.ndarray, prior: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(frame,) squared misses and the prior."""
    miss = skin.vertices_m(skin.chain(pose)) - keypoints_m
    off = pose.fingers.reshape(-1, 45) - prior[0]
    return (miss**2).sum(axis=(1, 2)) / NOISE_M**2 + ((off @ prior[1]) * off).sum(axis=1)


def _step(
    skin: Skin,
    pose: HandPose,
    keypoints_m: np.ndarray,
    prior: tuple[np.ndarray, np.ndarray],
    damping: np.ndarray,
) -> np.ndarray:
    """(frame, 51) damped Gauss-Newton step of every frame by itself."""
    chain = skin.chain(pose, slopes=True)
    derivative = skin.all_derivatives(chain)
    miss = (keypoints_m - skin.vertices_m(chain)).reshape(len(keypoints_m), -1, 1)
    transposed = derivative.swapaxes(1, 2) / NOISE_M**2
    matrix, vector = transposed @ derivative, (transposed @ miss)[..., 0]
    matrix[:, 6:, 6:] += prior[1]
    vector[:, 6:] += (prior[0] - pose.fingers.reshape(-1, 45)) @ prior[1]
    diagonal = np.einsum("fii->fi", matrix)
    diagonal += damping[:, None] * diagonal
    return np.linalg.solve(matrix, vector[..., None])[..., 0]
