"""Refine hands over a whole motion: near the generated keypoints, in contact, outside of the object, and smooth.

BimArt (CVPR 2025) Sec. 3.4 has the last three terms (Eq. 10-12) and stays near its start by early stopping. This
Levenberg-Marquardt solver converges, so it has a data term for the generated keypoints. Residuals are in the standard
deviations below. Time is linear in the frames and does not depend on the object's mesh.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import HandTrack, ObjectTrack
from hoidata.hands.model import HandModel, HandPair, Side
from hoidata.refinement.banded import acceleration_equations, minimize_banded, second_differences
from hoidata.refinement.fitting import GeneratedKeypoints, check_generated, pose_prior
from hoidata.refinement.kernels import N_UNKNOWNS, add_squares
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.skin import HandPose, SkinnedHand
from hoidata.workers import one_thread

# Standard deviations of the residuals; a smaller one counts more.
KEYPOINT_M = 0.004  # of a keypoint from the generated one
TOUCHING_M = 0.006  # the same in frames in which the hand should touch the object
OUTLIER_M = 0.02  # a keypoint error of this size counts half (Cauchy loss)
SURFACE_M = 0.0015  # distance of keypoint plus generated vector from the object's surface
STRAY_M = 0.01  # a generated vector that ends farther from the surface hardly counts (Geman-McClure loss)
REACH_M = 0.02  # a generated vector of this length counts 0.6 of a short one (Gaussian weight)
DEPTH_M = 0.0003  # of a vertex inside the object
ACCELERATION_M = 0.003  # second difference of a keypoint in time, metres per frame squared

STEPS = 15  # largest number of steps
MIN_GAIN = 1e-4  # stop when a step reduces the cost by less than this fraction


@one_thread()
def refine_hands(
    pair: HandPair,
    keypoint_ids: np.ndarray,
    generated: Mapping[Side, GeneratedKeypoints],
    tracks: Mapping[Side, HandTrack],
    object_track: ObjectTrack,
) -> dict[Side, HandTrack]:
    """Refine fitted hands against the object; shapes are unchanged.

    ``tracks`` are the start, as returned by ``fit_hands`` for the same keypoints; the object has equally many frames.

    Raises BadInput: arrays of inconsistent shapes or lengths.
    """
    field = ObjectField(object_track)
    refined = {}
    for side, hand in generated.items():
        check_generated(side, hand, keypoint_ids, (tracks[side].n_frames, object_track.n_frames))
        refined[side] = _HandRefiner(pair[side], keypoint_ids, hand, tracks[side], field=field).refined()
    return refined


@dataclass(frozen=True)
class _EvaluatedMotion:
    """A hand's motion with the residuals of its cost. near frame: a frame in which the hand is active."""

    pose: HandPose
    points_m: np.ndarray  # (frame, keypoint, 3)
    surface_m: np.ndarray  # (near frame, keypoint) signed distance of keypoint plus generated vector
    surface_slope: np.ndarray  # (near frame, keypoint, 3) its gradient
    depth_m: np.ndarray  # (near frame, vertex) signed distance of vertices inside the object, else 0
    depth_slope: np.ndarray  # (near frame, vertex, 3) its gradient
    difference: np.ndarray  # (frame, keypoint x 3) second difference in time
    cost: float


class _HandRefiner:
    """Cost and normal equations of one hand over all frames."""

    def __init__(
        self, model: HandModel, ids: np.ndarray, hand: GeneratedKeypoints, track: HandTrack, field: ObjectField
    ) -> None:
        self.track, self.field = track, field
        betas = np.asarray(track.betas, np.float64)[0]
        self.keypoints = SkinnedHand(model, betas, track.template_m, ids)
        self.vertices = SkinnedHand(model, betas, track.template_m)
        self.mean, self.precision = pose_prior(model)
        is_present = hand.is_present
        self.target_m = np.where(is_present[:, None, None], hand.keypoints_m, 0.0)
        self.near = np.flatnonzero(hand.is_active & is_present)
        self.to_object_m = hand.to_object_m[self.near]
        touch = np.nan_to_num(np.exp(-0.5 * (self.to_object_m**2).sum(-1) / REACH_M**2))
        self.to_object_m = np.nan_to_num(self.to_object_m)
        self.surface_weight = touch / SURFACE_M**2
        # A hand that should touch may leave its generated keypoints more.
        variance = np.full(len(is_present), KEYPOINT_M**2)
        variance[self.near] += (TOUCHING_M**2 - KEYPOINT_M**2) * touch.max(axis=1)
        self.keypoint_weight = is_present / variance
        self.acceleration_weight = np.zeros(len(is_present))
        three_frames = is_present[2:] & is_present[1:-1] & is_present[:-2]
        self.acceleration_weight[2:] = three_frames / ACCELERATION_M**2

    def refined(self) -> HandTrack:
        """The track at the minimum of the cost."""
        motion = minimize_banded(
            self._evaluate(HandPose.of(self.track)),
            lambda motion: motion.cost,
            self._equations,
            lambda motion, step: self._evaluate(motion.pose.moved(step)),
            max_steps=STEPS,
            min_gain=MIN_GAIN,
        )
        return motion.pose.track(self.track.mean_betas, self.track.valid, self.track.template_m)

    def _evaluate(self, pose: HandPose) -> _EvaluatedMotion:
        points = self.keypoints.vertices_m(self.keypoints.chain(pose))
        surface, surface_slope = self.field.distances(points[self.near] + self.to_object_m, self.near)
        vertices = self.vertices.vertices_m(self.vertices.chain(pose.taken(self.near)))
        distance, depth_slope = self.field.distances(vertices, self.near)
        difference = second_differences(points.reshape(len(points), -1))
        depth = np.minimum(distance, 0.0)
        return _EvaluatedMotion(
            pose,
            points_m=points,
            surface_m=surface,
            surface_slope=surface_slope,
            depth_m=depth,
            depth_slope=depth_slope,
            difference=difference,
            cost=self._cost(pose, points, surface, depth, difference),
        )

    def _cost(
        self, pose: HandPose, points: np.ndarray, surface: np.ndarray, depth: np.ndarray, difference: np.ndarray
    ) -> float:
        """Cauchy loss for keypoints, Geman-McClure loss for the surface, squares for the rest."""
        deviation = pose.fingers.reshape(-1, 45) - self.mean
        squared_error = ((points - self.target_m) ** 2).sum(-1)
        log_error = np.log1p(squared_error / OUTLIER_M**2).sum(axis=1)
        total = OUTLIER_M**2 * (self.keypoint_weight * log_error).sum()
        total += (self.surface_weight * surface**2 / (1 + (surface / STRAY_M) ** 2)).sum()
        total += (depth**2).sum() / DEPTH_M**2 + (self.acceleration_weight * (difference**2).sum(1)).sum()
        return float(total + ((deviation @ self.precision) * deviation).sum())

    def _equations(self, motion: _EvaluatedMotion) -> tuple[list[np.ndarray], np.ndarray]:
        """Blocks and minus half the gradient, as ``solve_blocks`` takes them."""
        chain = self.keypoints.chain(motion.pose, slopes=True)
        derivative = self.keypoints.all_derivatives(chain)
        blocks, vector = acceleration_equations(derivative, motion.difference, self.acceleration_weight)
        # Iteratively reweighted least squares: the weights are the losses' derivatives by the squared residual.
        error = motion.points_m - self.target_m
        cauchy = self.keypoint_weight[:, None] / (1 + (error**2).sum(-1) / OUTLIER_M**2)
        weight = cauchy[..., None, None] * np.eye(3)
        gradient = cauchy[..., None] * error
        geman = self.surface_weight / (1 + (motion.surface_m / STRAY_M) ** 2) ** 2
        slope = motion.surface_slope
        weight[self.near] += geman[..., None, None] * slope[..., :, None] * slope[..., None, :]
        gradient[self.near] += (geman * motion.surface_m)[..., None] * slope
        by_point = derivative.reshape(*error.shape, N_UNKNOWNS)
        weighted = (weight @ by_point).reshape(derivative.shape)
        blocks[0] += derivative.swapaxes(1, 2) @ weighted
        vector -= (derivative.swapaxes(1, 2) @ gradient.reshape(len(gradient), -1, 1))[..., 0]
        blocks[0][:, 6:, 6:] += self.precision
        vector[:, 6:] += (self.mean - motion.pose.fingers.reshape(-1, 45)) @ self.precision
        self._add_depth(motion, blocks[0], vector)
        return blocks, vector

    def _add_depth(self, motion: _EvaluatedMotion, matrix: np.ndarray, vector: np.ndarray) -> None:
        """Add the residuals of vertices inside the object."""
        frame, vertex = np.nonzero(motion.depth_m < 0)
        if not len(frame):
            return
        chain = self.vertices.chain(motion.pose.taken(self.near), slopes=True)
        derivative = self.vertices.derivatives(chain, frame, vertex)
        weight = np.full(len(frame), DEPTH_M**-2.0)
        slope, depth = motion.depth_slope[frame, vertex], motion.depth_m[frame, vertex]
        add_squares(self.near[frame], slope, derivative, weight, depth, matrix, vector)
