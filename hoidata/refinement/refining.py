"""Hands refined as one motion: held to what was generated, touching where it says so, out of the object, and smooth.

BimArt (CVPR 2025) Sec. 3.4 has the last three terms (Eq. 10-12) and stays near its start only by stopping early. Here a
Levenberg-Marquardt solver converges, so a data term holds the hands to the generated motion. Residuals are in units of
the standard deviations of :class:`RefinementSettings`; time grows linearly with the length of the motion, and does not
depend on the object's mesh.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import HandTrack, ObjectTrack
from hoidata.errors import BadInput
from hoidata.hands.model import HandModel, HandPair, Side
from hoidata.refinement.banded import acceleration_equations, second_differences, solve_damped
from hoidata.refinement.fitting import GeneratedHand, check_generated, pose_prior
from hoidata.refinement.kernels import N_UNKNOWNS, add_squares
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.skin import HandPose, Skin
from hoidata.workers import one_thread


@dataclass(frozen=True)
class RefinementSettings:
    """Standard deviations, metres; a smaller one counts more.

    keypoint_m: of a keypoint from the generated one, touching_m where the hand is to touch the object; one that is
    outlier_m off counts half. surface_m: of keypoint plus generated vector from the object's surface; off by more than
    stray_m, the vector is not believed. reach_m: vectors of this length count 0.6 of short ones. depth_m: of a vertex
    inside the object. acceleration_m: of a keypoint's second difference in time, per frame squared. pose: weight of the
    prior of finger poses. steps: at most; fewer where one gains less than ``enough`` of the cost.
    """

    keypoint_m: float = 0.004
    touching_m: float = 0.006
    outlier_m: float = 0.02
    surface_m: float = 0.0015
    stray_m: float = 0.01
    reach_m: float = 0.02
    depth_m: float = 0.0003
    acceleration_m: float = 0.003
    pose: float = 1.0
    steps: int = 15
    enough: float = 1e-4


@one_thread()
def refine_hands(
    pair: HandPair,
    keypoint_ids: np.ndarray,
    generated: Mapping[Side, GeneratedHand],
    tracks: Mapping[Side, HandTrack],
    thing: ObjectTrack,
    settings: RefinementSettings = RefinementSettings(),
) -> dict[Side, HandTrack]:
    """Refined hands, each side as one motion of any length; shapes stay as they are.

    generated, keypoint_ids: as in ``fit_hands``. tracks: the start, as it gives them. thing: the object's motion, as
    many frames. Raises BadInput for arrays that do not fit each other.
    """
    field = ObjectField(thing)
    refined = {}
    for side, hand in generated.items():
        check_generated(side, hand, keypoint_ids)
        if not len(hand.keypoints_m) == thing.n_frames == tracks[side].n_frames:
            got = f"{len(hand.keypoints_m)}, {tracks[side].n_frames} and {thing.n_frames} frames"
            raise BadInput(f"refinement of the {side} hand", "equally many frames", got, "check the caller")
        refined[side] = _Motion(pair[side], keypoint_ids, hand, tracks[side], field, settings).refined()
    return refined


@dataclass(frozen=True)
class _Seen:
    """A pose and all that its cost is made of. chain: of the keypoints."""

    pose: HandPose
    points_m: np.ndarray
    surface_m: np.ndarray
    surface_slope: np.ndarray
    depth_m: np.ndarray
    depth_slope: np.ndarray
    difference: np.ndarray
    cost: float


class _Motion:
    """One hand over all frames."""

    def __init__(
        self,
        model: HandModel,
        ids: np.ndarray,
        hand: GeneratedHand,
        track: HandTrack,
        field: ObjectField,
        settings: RefinementSettings,
    ) -> None:
        self.track, self.field, self.settings = track, field, settings
        betas = np.asarray(track.betas, np.float64)[0]
        self.skin, self.all = Skin(model, betas, track.template_m, ids), Skin(model, betas, track.template_m)
        self.mean, self.precision = pose_prior(model)
        self.there = hand.is_there
        self.target_m = np.where(self.there[:, None, None], hand.keypoints_m, 0.0)
        self.near = np.flatnonzero(hand.is_active & self.there)
        self.to_object_m = hand.to_object_m[self.near]
        trust = np.exp(-0.5 * (self.to_object_m**2).sum(-1) / settings.reach_m**2)
        trust = np.nan_to_num(trust)
        self.trust = trust / settings.surface_m**2
        squares = np.full(len(self.there), settings.keypoint_m**2)
        squares[self.near] += (settings.touching_m**2 - settings.keypoint_m**2) * trust.max(axis=1)
        self.held = self.there / squares
        self.to_object_m = np.nan_to_num(self.to_object_m)
        self.tied = np.zeros(len(self.there))
        self.tied[2:] = (self.there[2:] & self.there[1:-1] & self.there[:-2]) / settings.acceleration_m**2

    def refined(self) -> HandTrack:
        seen, damping = self._see(HandPose.of(self.track)), 1e-3
        for _ in range(self.settings.steps):
            blocks, vector = self._equations(seen)
            while True:
                moved = self._see(seen.pose.moved(solve_damped(blocks, vector, damping)))
                if moved.cost < seen.cost or damping > 1e4:
                    break
                damping *= 10
            if not moved.cost < seen.cost:  # also where it is no finite number
                break
            gain, seen, damping = 1 - moved.cost / seen.cost, moved, damping / 10
            if gain < self.settings.enough:
                break
        return seen.pose.track(self.track.mean_betas, self.track.valid, self.track.template_m)

    def _see(self, pose: HandPose) -> _Seen:
        near_pose = HandPose(*(array[self.near] for array in pose))
        points = self.skin.vertices_m(self.skin.chain(pose))
        surface, surface_slope = self.field.distances(points[self.near] + self.to_object_m, self.near)
        vertices = self.all.vertices_m(self.all.chain(near_pose))
        distance, slope = self.field.distances(vertices, self.near)
        difference = second_differences(points.reshape(len(points), -1))
        depth = np.minimum(distance, 0.0)
        cost = self._cost(pose, points, surface, depth, difference)
        return _Seen(pose, points, surface, surface_slope, depth, slope, difference, cost)

    def _cost(
        self, pose: HandPose, points: np.ndarray, surface: np.ndarray, depth: np.ndarray, difference: np.ndarray
    ) -> float:
        """Robust: Cauchy's for keypoints, Geman and McClure's for the surface."""
        own, off = self.settings, pose.fingers.reshape(-1, 45) - self.mean
        miss = ((points - self.target_m) ** 2).sum(-1)
        total = own.outlier_m**2 * (self.held * np.log1p(miss / own.outlier_m**2).sum(axis=1)).sum()
        total += (self.trust * surface**2 / (1 + (surface / own.stray_m) ** 2)).sum()
        total += (depth**2).sum() / own.depth_m**2 + (self.tied * (difference**2).sum(1)).sum()
        return float(total + own.pose * ((off @ self.precision) * off).sum())

    def _equations(self, seen: _Seen) -> tuple[list[np.ndarray], np.ndarray]:
        """Blocks and minus half the gradient, as ``solve_blocks`` takes them."""
        own, chain = self.settings, self.skin.chain(seen.pose, slopes=True)
        derivative = self.skin.all_derivatives(chain)
        blocks, vector = acceleration_equations(derivative, seen.difference, self.tied)
        miss = seen.points_m - self.target_m
        robust = self.held[:, None] / (1 + (miss**2).sum(-1) / own.outlier_m**2)
        weight = robust[..., None, None] * np.eye(3)
        pull = robust[..., None] * miss
        believed = self.trust / (1 + (seen.surface_m / own.stray_m) ** 2) ** 2
        slope = seen.surface_slope
        weight[self.near] += believed[..., None, None] * slope[..., :, None] * slope[..., None, :]
        pull[self.near] += (believed * seen.surface_m)[..., None] * slope
        by_point = derivative.reshape(*miss.shape, N_UNKNOWNS)
        weighted = (weight @ by_point).reshape(derivative.shape)
        blocks[0] += derivative.swapaxes(1, 2) @ weighted
        vector -= (derivative.swapaxes(1, 2) @ pull.reshape(len(pull), -1, 1))[..., 0]
        blocks[0][:, 6:, 6:] += own.pose * self.precision
        vector[:, 6:] += own.pose * (self.mean - seen.pose.fingers.reshape(-1, 45)) @ self.precision
        self._add_depth(seen, blocks[0], vector)
        return blocks, vector

    def _add_depth(self, seen: _Seen, matrix: np.ndarray, vector: np.ndarray) -> None:
        """Only vertices that are inside, in frames where the hand is near."""
        row, vertex = np.nonzero(seen.depth_m < 0)
        if not len(row):
            return
        near_pose = HandPose(*(array[self.near] for array in seen.pose))
        derivative = self.all.derivatives(self.all.chain(near_pose, slopes=True), row, vertex)
        weight = np.full(len(row), self.settings.depth_m**-2.0)
        slope, depth = seen.depth_slope[row, vertex], seen.depth_m[row, vertex]
        add_squares(self.near[row], slope, derivative, weight, depth, matrix, vector)
