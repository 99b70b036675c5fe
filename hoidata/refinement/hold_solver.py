"""One hand in the frame of the part it holds: one correction for all frames of a hold, a smooth one around them.

The unknowns are control points of a uniform cubic B-spline, 51 numbers each; those that a hold feels are one. Frames
of a hold are alike, so a few stand for all of them: time grows with the frames outside of holds. Levenberg-Marquardt.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hoidata.geometry.intervals import Interval
from hoidata.physics.capsules import Capsules
from hoidata.refinement.banded import solve_damped
from hoidata.refinement.kernels import N_UNKNOWNS, add_squares, lower_capsules
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.skin import HandPose, Skin

_MOST_DAMPING = 1e4
# How far skin moves, metres, for one unit of each unknown: the wrist, a turn of the hand, bends of fingers.
_LEVER_M = np.concatenate((np.ones(3), np.full(3, 0.1), np.full(45, 0.04)))


@dataclass(frozen=True)
class SolverSettings:
    """Standard deviations, metres; a smaller one counts more.

    press_m: how deep skin lies that touches, for it gives way. surface_m: of the nearest skin of each of 16 segments of
    a holding hand from there.
    depth_m: of a vertex deeper than press_m in the object, or in the other hand. bend_m: of a control point from the
    middle of its neighbours. knot_frames: of the spline. every: one of so many frames outside of holds is looked at.
    steps: at most; fewer where one gains less than ``enough`` of the cost.
    """

    press_m: float = 0.0015
    surface_m: float = 0.001
    depth_m: float = 0.0005
    bend_m: float = 0.004
    knot_frames: int = 5
    every: int = 2
    steps: int = 6
    enough: float = 0.01


class Draw(NamedTuple):
    """How far skin is drawn to the surface: beyond reach_m it hardly is. keypoint_m: deviation of a vertex from the
    generated one.
    """

    reach_m: float = 0.003
    keypoint_m: float = 0.006


def corrected(
    skin: Skin,
    field: ObjectField,
    pose: HandPose,
    holds: Sequence[Interval],
    valid: np.ndarray,
    other: Capsules | None,
    settings: SolverSettings,
    draw: Draw,
) -> HandPose:
    """The pose of every frame, corrected; the part's frame throughout. other: capsules of the other hand."""
    return _Motion(skin, field, pose, holds, valid, other, settings, draw).corrected()


def spline_shares(n_frames: int, holds: Sequence[Interval], knot_frames: int) -> np.ndarray:
    """(frame, control point) shares, that add up to one; the control points that a hold feels are one."""
    intervals = max(1, round((n_frames - 1) / knot_frames))
    first = np.minimum(np.linspace(0, intervals, n_frames).astype(int), intervals - 1)
    u = np.linspace(0, intervals, n_frames) - first
    weights = np.stack(((1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3), 1) / 6
    shares = np.zeros((n_frames, intervals + 3))
    shares[np.arange(n_frames)[:, None], first[:, None] + np.arange(4)] = weights
    joined = np.zeros(intervals + 2, bool)
    for start, stop in holds:
        felt = np.flatnonzero((shares[start:stop] > 1e-9).any(axis=0))
        joined[felt[0] : felt[-1]] = True
    number = np.append(0, np.cumsum(~joined))
    return shares @ np.eye(number[-1] + 1)[number]


@dataclass(frozen=True)
class _State:
    """unknowns (control point, 51) and what they make of the frames looked at: pose, signed distances (frame, vertex)
    of the skin from object and other hand, and their slopes."""

    unknowns: np.ndarray
    pose: HandPose
    distance_m: np.ndarray
    slope: np.ndarray
    other_m: np.ndarray
    other_slope: np.ndarray


class _Motion:
    """frames: those looked at. weight: how many each stands for. trust: (frame, segment) whether it is to touch."""

    def __init__(
        self,
        skin: Skin,
        field: ObjectField,
        pose: HandPose,
        holds: Sequence[Interval],
        valid: np.ndarray,
        other: Capsules | None,
        settings: SolverSettings,
        draw: Draw,
    ) -> None:
        self.skin, self.field, self.pose, self.settings, self.draw = skin, field, pose, settings, draw
        self.all_shares = spline_shares(len(valid), holds, settings.knot_frames)
        alike = 1 + 3 * (field.moves or other is not None)
        self.frames, self.weight, holding = _looked_at(holds, valid, alike, settings.every)
        self.other = None if other is None else other.taken(self.frames)
        self.shares = self.all_shares[self.frames]
        self.own = HandPose(*(array[self.frames] for array in pose))
        bend = np.diff(np.eye(self.shares.shape[1]), n=2, axis=0)
        self.bend = bend.T @ bend / settings.bend_m**2
        self.metric = self._metric()
        self.start = self._see(np.zeros((self.shares.shape[1], N_UNKNOWNS)))
        near = np.maximum(skin.nearest_of_segments(self.start.distance_m)[1], 0)
        self.trust = np.exp(-0.5 * (near / draw.reach_m) ** 2) * holding[:, None]

    def corrected(self) -> HandPose:
        state, damping = self.start, 1e-3
        cost = self._cost(state)
        for _ in range(self.settings.steps):
            blocks, vector = self._equations(state)
            while True:
                moved = self._see(state.unknowns + solve_damped(blocks, vector, damping))
                cost_moved = self._cost(moved)
                if cost_moved < cost or damping > _MOST_DAMPING:
                    break
                damping *= 10
            if cost_moved >= cost:
                break
            gain, state, cost, damping = 1 - cost_moved / cost, moved, cost_moved, damping / 10
            if gain < self.settings.enough:
                break
        return self.pose.moved(self.all_shares @ state.unknowns)

    def _metric(self) -> np.ndarray:
        """(frame, 51, 51) squares of how far every 16th vertex moves, in its standard deviations."""
        chain, vertex = self.skin.chain(self.own, slopes=True), np.arange(0, len(self.skin.shaped_m), 16)
        frame = np.repeat(np.arange(len(self.frames)), len(vertex))
        derivative = self.skin.derivatives(chain, frame, np.tile(vertex, len(self.frames)))
        derivative = derivative.reshape(len(self.frames), -1, N_UNKNOWNS)
        # Of 16 points in all, and a little of each unknown, for fingers that move few of them.
        metric = derivative.swapaxes(1, 2) @ derivative / len(vertex) + 1e-5 * np.eye(N_UNKNOWNS)
        return 16 * metric / self.draw.keypoint_m**2

    def _see(self, unknowns: np.ndarray) -> _State:
        pose = self.own.moved(self.shares @ unknowns)
        points = self.skin.vertices_m(self.skin.chain(pose))
        distance, slope = self.field.distances(points, self.frames)
        other, other_slope = np.full(distance.shape, np.inf), np.zeros(points.shape)
        if self.other is not None:
            lower_capsules(*self.other, points, other, other_slope)
        return _State(unknowns, pose, distance, slope, other, other_slope)

    def _cost(self, state: _State) -> float:
        own, step = self.settings, self.shares @ state.unknowns
        each = ((self.metric @ step[..., None])[..., 0] * step).sum(axis=1)
        each += (self.trust * (self.skin.nearest_of_segments(state.distance_m)[1] + own.press_m) ** 2).sum(
            axis=1
        ) / own.surface_m**2
        for distance in (state.distance_m, state.other_m):
            each += (np.minimum(distance + own.press_m, 0) ** 2).sum(axis=1) / own.depth_m**2
        bent = state.unknowns * _LEVER_M
        return float(self.weight @ each + (bent * (self.bend @ bent)).sum())

    def _equations(self, state: _State) -> tuple[list[np.ndarray], np.ndarray]:
        """Blocks and minus half the gradient, as ``solve_blocks`` takes them."""
        step = self.shares @ state.unknowns
        matrix, vector = np.zeros_like(self.metric), np.zeros_like(step)
        self._add_distances(state, matrix, vector)
        matrix += np.tril(matrix, -1).swapaxes(1, 2) + self.metric
        vector -= (self.metric @ step[..., None])[..., 0]
        matrix, blocks, count = matrix * self.weight[:, None, None], [], self.shares.shape[1]
        for apart in range(min(4, count)):
            shares = self.shares[:, : count - apart] * self.shares[:, apart:]
            block = (shares.T @ matrix.reshape(len(matrix), -1)).reshape(-1, N_UNKNOWNS, N_UNKNOWNS)
            blocks.append(block + np.diagonal(self.bend, apart)[:, None, None] * np.diag(_LEVER_M**2))
        pulled = self.shares.T @ (vector * self.weight[:, None])
        return blocks, pulled - self.bend @ state.unknowns * _LEVER_M**2

    def _add_distances(self, state: _State, matrix: np.ndarray, vector: np.ndarray) -> None:
        """Skin that is to touch, and skin that is too deep in the object or in the other hand."""
        own, chain = self.settings, self.skin.chain(state.pose, slopes=True)
        vertex, near = self.skin.nearest_of_segments(state.distance_m)
        row, segment = np.nonzero(self.trust > 1e-3)
        found = [(row, vertex[row, segment], near[row, segment], self.trust[row, segment] / own.surface_m**2)]
        slopes = [state.slope[row, vertex[row, segment]]]
        for distance, slope in ((state.distance_m, state.slope), (state.other_m, state.other_slope)):
            row, deep = np.nonzero(distance < -own.press_m)
            found.append((row, deep, distance[row, deep], np.full(len(row), own.depth_m**-2)))
            slopes.append(slope[row, deep])
        frame, chosen, distance, weight = (np.concatenate(column) for column in zip(*found, strict=True))
        derivative = self.skin.derivatives(chain, frame, chosen)
        add_squares(frame, np.concatenate(slopes), derivative, weight, distance + own.press_m, matrix, vector)


def _looked_at(
    holds: Sequence[Interval], valid: np.ndarray, alike: int, every: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames that stand for all, how many each stands for, and whether the hand holds in it.

    alike: how many stand for a hold. every: of the other frames one of so many does.
    """
    weight, holding = np.zeros(len(valid)), np.zeros(len(valid), bool)
    for start, stop in holds:
        holding[start:stop] = True
        weight[start + ((np.arange(alike) + 0.5) * (stop - start) / alike).astype(int)] = (stop - start) / alike
    weight[np.flatnonzero(~holding & valid)[every // 2 :: every]] = every
    frames = np.flatnonzero(weight)
    return frames, weight[frames], holding[frames]
