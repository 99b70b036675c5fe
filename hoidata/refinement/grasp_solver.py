"""Correct one hand relative to the object part it grasps: one constant correction per grasp, a smooth one around it.

The unknowns are control points of a uniform cubic B-spline, 51 numbers each. All control points that influence a grasp
are one. A few frames of a grasp represent all; the cost grows with the frames outside of grasps. Solved by
Levenberg-Marquardt.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hoidata.geometry.intervals import Interval
from hoidata.physics.capsules import Capsules
from hoidata.refinement.banded import minimize_banded
from hoidata.refinement.kernels import N_UNKNOWNS, add_squares, lower_capsules
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.skin import HandPose, SkinnedHand

# How far skin moves, metres, per unit of each unknown: wrist position, hand rotation, finger joints.
_LEVER_M = np.concatenate((np.ones(3), np.full(3, 0.1), np.full(45, 0.04)))
GRASP_FRAMES = 6  # that represent a grasp
_METRIC_VERTICES = 16  # the deviation of a pose from the original counts as that of 16 vertices
PRESS_M = 0.0015  # depth of touching skin, since skin is soft
CLEAR_M = 0.012  # distance that a grasping hand keeps from a part that moves past it
REACH_M = 0.003  # skin farther from the surface is hardly attracted (Gaussian weight)

# Standard deviations of the residuals; a smaller one counts more.
SURFACE_M = 0.001  # of the nearest skin of each of 16 segments of a grasping hand, from PRESS_M
DEPTH_M = 0.0005  # of a vertex deeper than PRESS_M in the object or in the other hand
CLEAR_DEVIATION_M = 0.004  # of a vertex closer than CLEAR_M
KEYPOINT_M = 0.006  # of a vertex from its original position
BEND_M = 0.004  # of a control point from the mean of its neighbours
FINGER_RAD = 0.1  # of a finger angle from the original; without it, impossible poses bring distant skin to the surface

KNOT_FRAMES = 5  # frames between knots of the spline
EVERY = 2  # outside of grasps one of so many frames is evaluated
STEPS = 12  # largest number of steps
MIN_GAIN = 0.01  # stop when a step reduces the cost by less than this fraction


def spline_weights(n_frames: int, grasps: Sequence[Interval]) -> np.ndarray:
    """(frame, control point) weights that sum to 1; the control points that influence a grasp are one."""
    intervals = max(1, round((n_frames - 1) / KNOT_FRAMES))
    first = np.minimum(np.linspace(0, intervals, n_frames).astype(int), intervals - 1)
    u = np.linspace(0, intervals, n_frames) - first
    basis = np.stack(((1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3), 1) / 6
    weights = np.zeros((n_frames, intervals + 3))
    weights[np.arange(n_frames)[:, None], first[:, None] + np.arange(4)] = basis
    is_joined = np.zeros(intervals + 2, bool)  # with the next control point
    for start, stop in grasps:
        influencing = np.flatnonzero((weights[start:stop] > 1e-9).any(axis=0))
        is_joined[influencing[0] : influencing[-1]] = True
    number = np.append(0, np.cumsum(~is_joined))
    return weights @ np.eye(number[-1] + 1)[number]


class EvaluatedPose(NamedTuple):
    """A pose and the signed distances (frame, vertex) of its skin, metres, with their gradients (frame, vertex, 3)."""

    step: np.ndarray  # (frame, 51) from the original pose
    pose: HandPose
    distance_m: np.ndarray  # to the object
    slope: np.ndarray
    grasped_m: np.ndarray  # to what the hand grasps: the object, or one part while the other moves past
    grasped_slope: np.ndarray
    passing_m: np.ndarray  # to the part that moves past the hand, infinite otherwise
    passing_slope: np.ndarray
    other_m: np.ndarray  # to the other hand
    other_slope: np.ndarray


@dataclass
class GraspObjective:
    """Cost of a hand's pose in each frame, and its normal equations; everything in the frame of the part."""

    skin: SkinnedHand
    field: ObjectField
    original: HandPose  # (frame,) before the correction
    frames: np.ndarray  # (frame,) index of each frame in the object's motion
    in_grasp: np.ndarray  # (frame,) bool
    other: Capsules | None  # (frame,) of the other hand
    part: int
    passed: np.ndarray | None  # (frame,) bool, the other part moves past the hand; None for never

    def __post_init__(self) -> None:
        self.metric = self._metric()
        self.start = self.evaluate(np.zeros((len(self.frames), N_UNKNOWNS)))
        near = np.maximum(self.skin.nearest_of_segments(self.start.grasped_m)[1], 0)
        # (frame, segment) how certain it is that the segment touches.
        self.touch_weight = np.exp(-0.5 * (near / REACH_M) ** 2) * self.in_grasp[:, None]

    def _metric(self) -> np.ndarray:
        """(frame, 51, 51) quadratic form of a step: squared vertex displacements in standard deviations."""
        chain = self.skin.chain(self.original, slopes=True)
        vertex = np.arange(0, len(self.skin.shaped_m), _METRIC_VERTICES)
        frame = np.repeat(np.arange(len(self.frames)), len(vertex))
        derivative = self.skin.derivatives(chain, frame, np.tile(vertex, len(self.frames)))
        derivative = derivative.reshape(len(self.frames), -1, N_UNKNOWNS)
        # A little of each unknown is added, since some fingers move few of the vertices.
        metric = derivative.swapaxes(1, 2) @ derivative / len(vertex) + 1e-5 * np.eye(N_UNKNOWNS)
        metric *= _METRIC_VERTICES / KEYPOINT_M**2
        fingers = np.arange(6, N_UNKNOWNS)
        metric[:, fingers, fingers] += FINGER_RAD**-2
        return metric

    def evaluate(self, step: np.ndarray) -> EvaluatedPose:
        """The hand after a step (frame, 51) from the original pose."""
        pose = self.original.moved(step)
        points = self.skin.vertices_m(self.skin.chain(pose))
        other, passing = ((np.full(points.shape[:2], np.inf), np.zeros(points.shape)) for _ in range(2))
        if self.other is not None:
            lower_capsules(*self.other, points, *other)
        if self.passed is None:
            nearest = grasped = self.field.distances(points, self.frames)
        else:
            to_part, to_passer = (
                self.field.distances(points, self.frames, part) for part in (self.part, 1 - self.part)
            )
            part_is_closer, passed = to_part[0] <= to_passer[0], self.passed[:, None]
            nearest = (
                np.where(part_is_closer, to_part[0], to_passer[0]),
                np.where(part_is_closer[..., None], to_part[1], to_passer[1]),
            )
            grasped = np.where(passed, to_part[0], nearest[0]), np.where(passed[..., None], to_part[1], nearest[1])
            passing = np.where(passed, to_passer[0], np.inf), to_passer[1]
        return EvaluatedPose(step, pose, *nearest, *grasped, *passing, *other)

    def costs(self, state: EvaluatedPose) -> np.ndarray:
        """(frame,) cost of a pose."""
        costs = ((self.metric @ state.step[..., None])[..., 0] * state.step).sum(axis=1)
        to_touch = self.skin.nearest_of_segments(state.grasped_m)[1] + PRESS_M
        costs += (self.touch_weight * to_touch**2).sum(axis=1) / SURFACE_M**2
        for distance, _, least_m, deviation_m in self._obstacles(state):
            costs += (np.minimum(distance - least_m, 0) ** 2).sum(axis=1) / deviation_m**2
        return costs

    def _obstacles(self, state: EvaluatedPose) -> list[tuple[np.ndarray, np.ndarray, float, float]]:
        """Per obstacle: distances, gradients, least allowed distance and standard deviation, metres."""
        return [
            (state.distance_m, state.slope, -PRESS_M, DEPTH_M),
            (state.other_m, state.other_slope, -PRESS_M, DEPTH_M),
            (state.passing_m, state.passing_slope, CLEAR_M, CLEAR_DEVIATION_M),
        ]

    def equations(self, state: EvaluatedPose) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations (frame, 51, 51) of the next step, and minus half the gradient (frame, 51)."""
        matrix, vector = np.zeros_like(self.metric), np.zeros_like(state.step)
        self._add_distances(state, matrix, vector)
        matrix += np.tril(matrix, -1).swapaxes(1, 2) + self.metric
        vector -= (self.metric @ state.step[..., None])[..., 0]
        return matrix, vector

    def _add_distances(self, state: EvaluatedPose, matrix: np.ndarray, vector: np.ndarray) -> None:
        """Add the residuals of skin that should touch, and of skin beyond the least distance of an obstacle."""
        chain = self.skin.chain(state.pose, slopes=True)
        nearest_vertex, near = self.skin.nearest_of_segments(state.grasped_m)
        frame, segment = np.nonzero(self.touch_weight > 1e-3)
        vertex = nearest_vertex[frame, segment]
        weight = self.touch_weight[frame, segment] / SURFACE_M**2
        residuals = [(frame, vertex, near[frame, segment] + PRESS_M, weight)]
        slopes = [state.grasped_slope[frame, vertex]]
        for distance, slope, least_m, deviation_m in self._obstacles(state):
            frame, vertex = np.nonzero(distance < least_m)
            weight = np.full(len(frame), deviation_m**-2)
            residuals.append((frame, vertex, distance[frame, vertex] - least_m, weight))
            slopes.append(slope[frame, vertex])
        frame, vertex, residual_m, weight = (np.concatenate(column) for column in zip(*residuals, strict=True))
        derivative = self.skin.derivatives(chain, frame, vertex)
        add_squares(frame, np.concatenate(slopes), derivative, weight, residual_m, matrix, vector)


def corrected_pose(
    skin: SkinnedHand,
    field: ObjectField,
    pose: HandPose,
    grasps: Sequence[Interval],
    valid: np.ndarray,
    other: Capsules | None,
    part: int,
    passed: np.ndarray | None,
) -> HandPose:
    """The pose (frame,) of a hand after its spline correction, everything in the frame of the part.

    The correction is constant in ``grasps``. valid: (frame,) bool, the hand is tracked. The other arguments are as in
    ``GraspObjective``, for all frames.
    """
    all_weights = spline_weights(len(valid), grasps)
    frames, frame_weight, in_grasp = _representative_frames(grasps, valid)
    weights, count = all_weights[frames], all_weights.shape[1]
    bend = np.diff(np.eye(count), n=2, axis=0)
    bend = bend.T @ bend / BEND_M**2  # of the control points' second differences
    others, passing = None if other is None else other.taken(frames), None if passed is None else passed[frames]
    objective = GraspObjective(skin, field, pose.taken(frames), frames, in_grasp, others, part, passing)

    def stepped(state: tuple[EvaluatedPose, np.ndarray], step: np.ndarray) -> tuple[EvaluatedPose, np.ndarray]:
        points = state[1] + step
        return objective.evaluate(weights @ points), points

    def cost(state: tuple[EvaluatedPose, np.ndarray]) -> float:
        points_m = state[1] * _LEVER_M
        return float(frame_weight @ objective.costs(state[0]) + (points_m * (bend @ points_m)).sum())

    def equations(state: tuple[EvaluatedPose, np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
        matrix, vector = objective.equations(state[0])
        matrix, blocks = (matrix * frame_weight[:, None, None]).reshape(len(matrix), -1), []
        for offset in range(min(4, count)):
            products = weights[:, : count - offset] * weights[:, offset:]
            block = (products.T @ matrix).reshape(-1, N_UNKNOWNS, N_UNKNOWNS)
            blocks.append(block + np.diagonal(bend, offset)[:, None, None] * np.diag(_LEVER_M**2))
        gradient = weights.T @ (vector * frame_weight[:, None])
        return blocks, gradient - bend @ state[1] * _LEVER_M**2

    start = objective.start, np.zeros((count, N_UNKNOWNS))
    _, control_points = minimize_banded(start, cost, equations, stepped, max_steps=STEPS, min_gain=MIN_GAIN)
    return pose.moved(all_weights @ control_points)


def _representative_frames(grasps: Sequence[Interval], valid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames to evaluate, how many frames each represents, and whether it is in a grasp."""
    weight, in_grasp = np.zeros(len(valid)), np.zeros(len(valid), bool)
    for start, stop in grasps:
        in_grasp[start:stop] = True
        middles = ((np.arange(GRASP_FRAMES) + 0.5) * (stop - start) / GRASP_FRAMES).astype(int)
        weight[start + middles] = (stop - start) / GRASP_FRAMES
    weight[np.flatnonzero(~in_grasp & valid)[EVERY // 2 :: EVERY]] = EVERY
    frames = np.flatnonzero(weight)
    return frames, weight[frames], in_grasp[frames]
