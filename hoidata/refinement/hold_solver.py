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
    a holding hand from there. depth_m: of a vertex deeper than press_m in the object, or in the other hand. bend_m: of
    a control point from the middle of its neighbours. finger_rad: radians, of each angle of the fingers from what it
    was: without it skin that is drawn far is brought by fingers that nobody can bend so. clear_m, clear_deviation_m:
    how far a holding hand stays from a part that passes it, and of a vertex nearer than that. knot_frames: of the
    spline. every: one of so many frames outside of holds is looked at. steps: at most; fewer where one gains less than
    ``enough`` of the cost.
    """

    press_m: float = 0.0015
    surface_m: float = 0.001
    depth_m: float = 0.0005
    bend_m: float = 0.004
    finger_rad: float = 0.1
    clear_m: float = 0.012
    clear_deviation_m: float = 0.004
    knot_frames: int = 5
    every: int = 2
    steps: int = 12
    enough: float = 0.01


@dataclass(frozen=True)
class Draw:
    """How far skin is drawn to the surface: beyond reach_m it hardly is. keypoint_m: deviation of a vertex from where
    it was.
    """

    reach_m: float = 0.003
    keypoint_m: float = 0.006


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


class State(NamedTuple):
    """step (frame, 51) from where a hand was, and what it makes of it: pose, signed distances (frame, vertex) of the
    skin from the object, from what of it is held, what passes the hand and the other hand, and their slopes.
    """

    step: np.ndarray
    pose: HandPose
    distance_m: np.ndarray
    slope: np.ndarray
    held_m: np.ndarray
    held_slope: np.ndarray
    passing_m: np.ndarray
    passing_slope: np.ndarray
    other_m: np.ndarray
    other_slope: np.ndarray


class Wishes:
    """What is wished for the skin of one hand, frame by frame; the part's frame throughout.

    own: the hand as it was. frames: (frame,) which of the object's each row is. holding: (frame,) bool. other: capsules
    of the other hand there. part: number of the one that is held. passed: (frame,) bool, the other part moves past the
    hand; None: nowhere. start: what is seen of ``own``. trust: (frame, segment) how much skin of each is to touch.
    """

    def __init__(
        self,
        skin: Skin,
        field: ObjectField,
        own: HandPose,
        frames: np.ndarray,
        holding: np.ndarray,
        other: Capsules | None,
        settings: SolverSettings,
        draw: Draw,
        part: int = 0,
        passed: np.ndarray | None = None,
    ) -> None:
        self.skin, self.field, self.own, self.frames = skin, field, own, frames
        self.other, self.settings, self.draw, self.part, self.passed = other, settings, draw, part, passed
        self.metric = self._metric()
        self.start = self.see(np.zeros((len(frames), N_UNKNOWNS)))
        near = np.maximum(skin.nearest_of_segments(self.start.held_m)[1], 0)
        self.trust = np.exp(-0.5 * (near / draw.reach_m) ** 2) * holding[:, None]

    def _metric(self) -> np.ndarray:
        """(frame, 51, 51) squares of how far every 16th vertex moves, in its standard deviations."""
        chain, vertex = self.skin.chain(self.own, slopes=True), np.arange(0, len(self.skin.shaped_m), 16)
        frame = np.repeat(np.arange(len(self.frames)), len(vertex))
        derivative = self.skin.derivatives(chain, frame, np.tile(vertex, len(self.frames)))
        derivative = derivative.reshape(len(self.frames), -1, N_UNKNOWNS)
        # Of 16 points in all, and a little of each unknown, for fingers that move few of them.
        metric = derivative.swapaxes(1, 2) @ derivative / len(vertex) + 1e-5 * np.eye(N_UNKNOWNS)
        metric *= 16 / self.draw.keypoint_m**2
        fingers = np.arange(6, N_UNKNOWNS)
        metric[:, fingers, fingers] += self.settings.finger_rad**-2
        return metric

    def see(self, step: np.ndarray) -> State:
        """The hand after a step (frame, 51)."""
        pose = self.own.moved(step)
        points = self.skin.vertices_m(self.skin.chain(pose))
        other, passing = ((np.full(points.shape[:2], np.inf), np.zeros(points.shape)) for _ in range(2))
        if self.other is not None:
            lower_capsules(*self.other, points, *other)
        if self.passed is None:
            nearest = held = self.field.distances(points, self.frames)
        else:
            own, beside = (self.field.distances_to(part, points, self.frames) for part in (self.part, 1 - self.part))
            first, passed = own[0] <= beside[0], self.passed[:, None]
            nearest = np.where(first, own[0], beside[0]), np.where(first[..., None], own[1], beside[1])
            held = np.where(passed, own[0], nearest[0]), np.where(passed[..., None], own[1], nearest[1])
            passing = np.where(passed, beside[0], np.inf), beside[1]
        return State(step, pose, *nearest, *held, *passing, *other)

    def costs(self, state: State) -> np.ndarray:
        """(frame,) what is left to wish for."""
        own, step = self.settings, state.step
        each = ((self.metric @ step[..., None])[..., 0] * step).sum(axis=1)
        each += (self.trust * (self.skin.nearest_of_segments(state.held_m)[1] + own.press_m) ** 2).sum(
            axis=1
        ) / own.surface_m**2
        for distance, _, least_m, deviation_m in self._outside(state):
            each += (np.minimum(distance - least_m, 0) ** 2).sum(axis=1) / deviation_m**2
        return each

    def _outside(self, state: State) -> list[tuple[np.ndarray, np.ndarray, float, float]]:
        """Distances and slopes of what skin is to stay outside of, by how much, and the deviation from that, metres."""
        own = self.settings
        return [
            (state.distance_m, state.slope, -own.press_m, own.depth_m),
            (state.other_m, state.other_slope, -own.press_m, own.depth_m),
            (state.passing_m, state.passing_slope, own.clear_m, own.clear_deviation_m),
        ]

    def equations(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations (frame, 51, 51) of the next step, and minus half the gradient (frame, 51)."""
        matrix, vector = np.zeros_like(self.metric), np.zeros_like(state.step)
        self._add_distances(state, matrix, vector)
        matrix += np.tril(matrix, -1).swapaxes(1, 2) + self.metric
        vector -= (self.metric @ state.step[..., None])[..., 0]
        return matrix, vector

    def _add_distances(self, state: State, matrix: np.ndarray, vector: np.ndarray) -> None:
        """Skin that is to touch, and skin that is too deep in object or other hand, or too near to what passes."""
        own, chain = self.settings, self.skin.chain(state.pose, slopes=True)
        vertex, near = self.skin.nearest_of_segments(state.held_m)
        row, segment = np.nonzero(self.trust > 1e-3)
        too_far = near[row, segment] + own.press_m
        found = [(row, vertex[row, segment], too_far, self.trust[row, segment] / own.surface_m**2)]
        slopes = [state.held_slope[row, vertex[row, segment]]]
        for distance, slope, least_m, deviation_m in self._outside(state):
            row, deep = np.nonzero(distance < least_m)
            found.append((row, deep, distance[row, deep] - least_m, np.full(len(row), deviation_m**-2)))
            slopes.append(slope[row, deep])
        frame, chosen, off_m, weight = (np.concatenate(column) for column in zip(*found, strict=True))
        derivative = self.skin.derivatives(chain, frame, chosen)
        add_squares(frame, np.concatenate(slopes), derivative, weight, off_m, matrix, vector)


def settled(wishes: Wishes, steps: int) -> HandPose:
    """Every frame's hand by itself, after so many steps of Levenberg-Marquardt with a damping of its own."""
    state, damping = wishes.start, np.full(len(wishes.frames), 1e-3)
    cost, diagonal = wishes.costs(state), np.arange(N_UNKNOWNS)
    for _ in range(steps):
        matrix, vector = wishes.equations(state)
        matrix[:, diagonal, diagonal] *= 1 + damping[:, None]
        moved = wishes.see(state.step + np.linalg.solve(matrix, vector[..., None])[..., 0])
        cost_moved = wishes.costs(moved)
        better = cost_moved < cost
        state = _chosen(better, moved, state)
        cost, damping = np.where(better, cost_moved, cost), damping * np.where(better, 0.1, 10)
    return state.pose


def _chosen(moved: np.ndarray, one: State, other: State) -> State:
    """Frame by frame ``one`` where ``moved (frame,)``, else the other."""

    def either(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.where(moved.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return State(
        either(one.step, other.step),
        one.pose.where(moved, other.pose),
        either(one.distance_m, other.distance_m),
        either(one.slope, other.slope),
        either(one.held_m, other.held_m),
        either(one.held_slope, other.held_slope),
        either(one.passing_m, other.passing_m),
        either(one.passing_slope, other.passing_slope),
        either(one.other_m, other.other_m),
        either(one.other_slope, other.other_slope),
    )


class HandInTime:
    """One hand through time, the part's frame throughout. valid: (frame,) bool. other: capsules of the other hand.

    part, passed: as in ``Wishes``, of every frame. all_shares: of every frame; shares and weight, how many it stands
    for, of those looked at. bend: of the control points' second differences.
    """

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
        part: int = 0,
        passed: np.ndarray | None = None,
    ) -> None:
        self.pose, self.settings = pose, settings
        self.all_shares = spline_shares(len(valid), holds, settings.knot_frames)
        alike = 1 + 3 * (field.moves or other is not None)
        frames, self.weight, holding = _looked_at(holds, valid, alike, settings.every)
        self.shares = self.all_shares[frames]
        bend = np.diff(np.eye(self.shares.shape[1]), n=2, axis=0)
        self.bend = bend.T @ bend / settings.bend_m**2
        there = None if other is None else other.taken(frames)
        passed = None if passed is None else passed[frames]
        self.wishes = Wishes(skin, field, pose.taken(frames), frames, holding, there, settings, draw, part, passed)

    def corrected(self) -> HandPose:
        """The pose of every frame."""
        state, unknowns, damping = self.wishes.start, np.zeros((self.shares.shape[1], N_UNKNOWNS)), 1e-3
        cost = self._cost(state, unknowns)
        for _ in range(self.settings.steps):
            blocks, vector = self._equations(state, unknowns)
            while True:
                further = unknowns + solve_damped(blocks, vector, damping)
                moved = self.wishes.see(self.shares @ further)
                cost_moved = self._cost(moved, further)
                if cost_moved < cost or damping > _MOST_DAMPING:
                    break
                damping *= 10
            if not cost_moved < cost:  # also where it is no finite number
                break
            gain, state, unknowns = 1 - cost_moved / cost, moved, further
            cost, damping = cost_moved, damping / 10
            if gain < self.settings.enough:
                break
        return self.pose.moved(self.all_shares @ unknowns)

    def _cost(self, state: State, unknowns: np.ndarray) -> float:
        bent = unknowns * _LEVER_M
        return float(self.weight @ self.wishes.costs(state) + (bent * (self.bend @ bent)).sum())

    def _equations(self, state: State, unknowns: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """Blocks and minus half the gradient, as ``solve_blocks`` takes them."""
        matrix, vector = self.wishes.equations(state)
        matrix, blocks, count = matrix * self.weight[:, None, None], [], self.shares.shape[1]
        for apart in range(min(4, count)):
            shares = self.shares[:, : count - apart] * self.shares[:, apart:]
            block = (shares.T @ matrix.reshape(len(matrix), -1)).reshape(-1, N_UNKNOWNS, N_UNKNOWNS)
            blocks.append(block + np.diagonal(self.bend, apart)[:, None, None] * np.diag(_LEVER_M**2))
        pulled = self.shares.T @ (vector * self.weight[:, None])
        return blocks, pulled - self.bend @ unknowns * _LEVER_M**2


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
