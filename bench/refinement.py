"""Hands fitted to keypoints and refined against the object, beside the released way, in one run on one core.

``python -m bench refinement``. Windows of 64 frames of both hands from clips in ``data/embedded/arctic/clips`` (or
HOIDATA_BENCH_CLIPS), their keypoints spoilt as a generator's are: pushed about slowly by centimetres, shaking, noisy.
HOIDATA_BENCH_FIRST: number of the first clip; our weights were set on the windows of 3, the default.
*released*: what BimArt's release does, written anew from its description (Adam to the keypoints, then 100 steps of
AdamW; vertices inside by ray parity over all triangles, distances to object vertices). Its fit is timed on
``TIMED_FITS`` steps, its refinement on one, and both scaled by the number of steps; what it reaches is found with an
exact test of what is inside in the place of ray parity, which answers the same, sooner. *Adam on grids*: the same steps
with the distances of our grids.
"""

import os
import time
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation, gaussian_filter1d
from scipy.spatial import KDTree
from torch import Tensor

from bench.harness import show
from hoidata.clips import SIDES, HandTrack, ObjectTrack, Side
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandPair, kinematics_of, load_embedded_hands, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.refinement import GeneratedHand, fit_hands, refine_hands
from hoidata.refinement.object_field import ObjectField
from hoidata.store.store import open_store

FRAMES, WINDOWS, KEYPOINTS, RUNS = 64, 2, 100, 5
TRIANGLES = (8_000, 20_000)
MOST_FITS, ENOUGH, TIMED_FITS, REFINEMENTS = 4_001, 1e-6, 40, 100
FAR_M, AROUND = 0.03, 5  # a hand that is nowhere nearer in so many frames around is not corrected by the object


@dataclass(frozen=True)
class Window:
    """betas: (2, 10). recorded: the hands as they were, before they were spoilt."""

    name: str
    betas: np.ndarray
    generated: Mapping[Side, GeneratedHand]
    recorded: Mapping[Side, HandTrack]
    thing: ObjectTrack


def main() -> None:
    torch.set_num_threads(1)
    pair, ids = load_embedded_hands(), np.unique(np.linspace(0, 777, KEYPOINTS).astype(int))
    found = windows(pair, ids, FRAMES, WINDOWS)
    few, many = ([finer(window, count) for window in found] for count in TRIANGLES)
    _show_reached(pair, ids, few)
    _show_growth(pair, ids, few, many)


def windows(pair: HandPair, ids: np.ndarray, frames: int, count: int) -> list[Window]:
    """Windows in which both hands were tracked throughout and one touches, of evenly spread clips."""
    store = open_store(os.environ.get("HOIDATA_BENCH_CLIPS", Path("data/embedded/arctic/clips")), pair)
    found = []
    first = int(os.environ.get("HOIDATA_BENCH_FIRST", "3"))
    for number, clip_id in enumerate(store.ids[first :: max(1, len(store.ids) // (6 * count))]):
        clip = store.clip(clip_id)
        if clip.n_frames < frames or not all(track.valid.all() for track in clip.hands.values()) or len(found) == count:
            continue
        clip = clip.take(slice(clip.n_frames - frames, None) if number % 2 else slice(0, frames))
        found.append(_spoilt(clip_id, clip.hands, clip.object, pair, ids, number))
    return found


def _spoilt(
    name: str, hands: Mapping[Side, HandTrack], thing: ObjectTrack, pair: HandPair, ids: np.ndarray, seed: int
) -> Window:
    random, generated, n_frames = np.random.default_rng(seed), {}, thing.n_frames
    for side in SIDES:
        skin = track_vertices(hands[side], pair[side]).astype(np.float64)
        distance, way = nearest(thing, skin[:, ids])
        push = gaussian_filter1d(random.normal(0, 0.04, (n_frames, 1, 3)), 8, axis=0, mode="nearest")
        shake = random.normal(0, 0.00065, (n_frames, 1, 3)) + random.normal(0, 0.0005, way.shape)
        generated[side] = GeneratedHand(
            skin[:, ids] + push + shake, way + random.normal(0, 0.002, way.shape), distance.min(axis=1) < 0.2
        )
    betas = np.stack([hands[side].betas.mean(axis=0) for side in SIDES])
    return Window(name, betas, generated, hands, thing)


def nearest(thing: ObjectTrack, places_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact signed distance (frame, place) and way to the surface (frame, place, 3), world frame."""
    seen = thing.world_from_object.inverse() @ places_m.astype(np.float64)
    found = surface_index(thing.model).nearest(seen, thing.hinge_rad)
    return found.distance_m, thing.world_from_object @ found.closest_m - places_m


def finer(window: Window, triangles: int) -> Window:
    """The same surface in at least so many triangles."""
    return replace(window, thing=replace(window.thing, model=_split(window.thing.model, triangles)))


def _split(model: ObjectModel, triangles: int) -> ObjectModel:
    """Edges halved together with the two triangles at them, long ones first: no hole opens, nothing moves."""
    while len(model.faces) < triangles:
        corners = model.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        edges, inverse = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
        of_face = inverse.reshape(-1, 3)
        length = np.linalg.norm(np.diff(model.vertices_m[edges], axis=1)[:, 0], axis=1)
        rank = np.argsort(np.argsort(-length, kind="stable"))
        first = rank[of_face].min(axis=1)  # of each face its longest edge
        wanted = np.bincount(np.argsort(rank)[first], minlength=len(edges)) == np.bincount(
            of_face.ravel(), minlength=len(edges)
        )
        wanted = np.flatnonzero(wanted)[: triangles - len(model.faces)]
        middle = np.full(len(edges), -1)
        middle[wanted] = len(model.vertices_m) + np.arange(len(wanted))
        model = _halved(model, edges[wanted], middle[of_face])
    return model


def _halved(model: ObjectModel, edges: np.ndarray, middle: np.ndarray) -> ObjectModel:
    """middle: (face, 3) the new vertex on each edge of a face, -1 for none; at most one of a face has one."""
    faces = [model.faces[(middle < 0).all(axis=1)]]
    for edge in range(3):
        rows = middle[:, edge] >= 0
        a, b, c = (model.faces[rows, (edge + k) % 3] for k in range(3))
        new = middle[rows, edge]
        faces += [np.stack((a, new, c), axis=1), np.stack((new, b, c), axis=1)]
    vertices = np.concatenate((model.vertices_m, model.vertices_m[edges].mean(axis=1)))
    part = np.concatenate((model.part, model.part[edges].max(axis=1)))
    return replace(model, vertices_m=vertices, faces=np.concatenate(faces), part=part)


# --- what is compared


def ours(pair: HandPair, ids: np.ndarray, window: Window) -> dict[Side, HandTrack]:
    fitted = fit_hands(pair, window.betas, ids, window.generated)
    return refine_hands(pair, ids, window.generated, fitted, window.thing)


class Descent:
    """Both hands of a window as the release optimises them: pose, turn, translation per frame, one shape per hand."""

    def __init__(self, pair: HandPair, ids: np.ndarray, window: Window) -> None:
        self.window, self.ids = window, torch.from_numpy(ids)
        self.layers = [kinematics_of(pair[side]) for side in SIDES]
        self.target = torch.from_numpy(np.stack([window.generated[side].keypoints_m for side in SIDES])).float()
        self.way = torch.from_numpy(np.stack([window.generated[side].to_object_m for side in SIDES])).float()
        n_frames = self.target.shape[1]
        self.shape, self.fingers = torch.zeros(2, 1, 10), torch.zeros(2, n_frames, 15, 3)
        starts = [self._start(row, pair[side].template_m[ids]) for row, side in enumerate(SIDES)]
        self.turn, self.shift = (torch.stack(column) for column in zip(*starts, strict=True))
        self.unknown = [self.shape, self.fingers, self.turn, self.shift]
        for values in self.unknown:
            values.requires_grad_(True)
        self.model, self.object_m = (
            window.thing.model,
            window.thing.points_in_world(window.thing.model.vertices_m, window.thing.model.part),
        )

    def _start(self, row: int, rest: np.ndarray) -> tuple[Tensor, Tensor]:
        """An affine map per frame, its turn made orthogonal, its translation taken as if about the origin."""
        known = np.concatenate((rest, np.ones((len(rest), 1))), axis=1)
        affine = np.linalg.pinv(known) @ self.target[row].double().numpy()
        left, _, right = np.linalg.svd(affine[:, :3].swapaxes(1, 2))
        left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
        return torch.from_numpy(rotmat_to_rotvec(left @ right)).float(), torch.from_numpy(affine[:, 3]).float()

    def vertices(self) -> Tensor:
        """(2, frame, 778, 3) as smplx poses them: the hand turns about its rest wrist, then moves."""
        rows = []
        for row, layer in enumerate(self.layers):
            wrist = layer.rest_joints_m[0] + (self.shape[row] @ layer.joint_directions)[:, :3]
            turns = rotvec_to_rotmat(torch.cat((self.turn[row][:, None], self.fingers[row]), 1))
            rows.append(layer(wrist + self.shift[row], turns, self.shape[row])[0])
        return torch.stack(rows)

    def fit(self, most: int) -> int:
        """Adam to the keypoints; gives the steps taken."""
        optimiser = torch.optim.Adam(self.unknown, lr=1e-3)
        for step in range(most):
            loss = (self.vertices()[:, :, self.ids] - self.target).square().mean((1, 2, 3)).sum()
            if loss < ENOUGH:
                return step
            _descend(optimiser, loss)
        return most

    def refine(self, steps: int, touch: Callable[[Tensor], Tensor]) -> None:
        """AdamW on 10 pen + 100 proj + 1000 acc. touch: the first two terms, weighted, of vertices."""
        optimiser = torch.optim.AdamW(self.unknown, lr=5e-4)
        for _ in range(steps):
            vertices = self.vertices()
            second = vertices[:, 2:] - 2 * vertices[:, 1:-1] + vertices[:, :-2]
            _descend(optimiser, 1000 * second.square().mean() + touch(vertices))

    def by_vertices(self, inside: Callable[[int, np.ndarray], np.ndarray]) -> Callable[[Tensor], Tensor]:
        """Terms of distances to object vertices. inside: (vertex,) bool of one frame's hand vertices (vertex, 3)."""
        trees = [KDTree(points) for points in self.object_m]

        def touch(vertices: Tensor) -> Tensor:
            pushed, projected = [], self._projected(vertices)
            both = vertices.transpose(0, 1).flatten(1, 2)
            for first in range(0, len(both), 2):
                squares = []
                for frame in range(first, min(first + 2, len(both))):
                    seen = both[frame].detach().numpy()
                    rows = np.flatnonzero(inside(frame, seen))
                    near = self.object_m[frame][trees[frame].query(seen[rows])[1]]
                    squares.append((both[frame][rows] - torch.from_numpy(near).float()).square().sum(-1))
                squares = torch.cat(squares)
                pushed.append(squares.mean() if len(squares) else squares.sum())
            points = projected.transpose(0, 1).flatten(1, 2)
            near = np.stack([own[trees[f].query(points[f].detach().numpy())[1]] for f, own in enumerate(self.object_m)])
            drawn = (points - torch.from_numpy(near).float()).square().sum(-1).mean()
            return 10 * torch.stack(pushed).sum() + 100 * drawn

        return touch

    def by_grids(self, vertices: Tensor) -> Tensor:
        """The same terms of grid distances; the slope of a distance is the grid's."""
        field = ObjectField(self.window.thing)

        def distance(points: Tensor) -> Tensor:
            value, slope = (torch.from_numpy(a).float() for a in field.distances(points.detach().double().numpy()))
            return value + (slope * (points - points.detach())).sum(-1)

        depth = distance(vertices.transpose(0, 1).flatten(1, 2)).clamp_max(0)
        chunks = (depth.square().split(2), depth.lt(0).split(2))
        pushed = sum(s.sum() / i.sum().clamp_min(1) for s, i in zip(*chunks, strict=True))
        return 10 * pushed + 100 * distance(self._projected(vertices).transpose(0, 1).flatten(1, 2)).square().mean()

    def _projected(self, vertices: Tensor) -> Tensor:
        return vertices[:, :, self.ids] + self.way

    def by_parity(self, frame: int, seen: np.ndarray) -> np.ndarray:
        """ObMan's test: a line along one direction meets how many triangles, all pairs (Moeller and Trumbore)."""
        corner = torch.from_numpy(self.object_m[frame][self.model.faces]).float()
        first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        along = torch.tensor([0.4395064455, 0.617598629942, 0.652231566745])
        across = torch.linalg.cross(along.expand_as(second), second)
        scale = 1 / (first * across).sum(-1)
        away = torch.from_numpy(seen)[:, None] - corner[:, 0]
        u = (away * across).sum(-1) * scale
        turned = torch.linalg.cross(away, first.expand_as(away))
        v, t = (turned * along).sum(-1) * scale, (turned * second).sum(-1) * scale
        return (((u > 0) & (v > 0) & (u + v < 1) & (t > 0)).sum(1) % 2 == 1).numpy()

    def by_winding(self, frame: int, seen: np.ndarray) -> np.ndarray:
        return nearest(self.window.thing.take(slice(frame, frame + 1)), seen[None])[0][0] < 0

    def tracks(self) -> dict[Side, HandTrack]:
        made = {}
        for row, side in enumerate(SIDES):
            layer = self.layers[row]
            wrist = layer.rest_joints_m[0] + (self.shape[row] @ layer.joint_directions)[:, :3] + self.shift[row]
            arrays = (wrist, self.turn[row], self.fingers[row].flatten(1), self.shape[row])
            made[side] = HandTrack(*(a.detach().numpy().copy() for a in arrays), np.ones(len(wrist), bool))
        return made


def _descend(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()


# --- the tables


def reached(pair: HandPair, ids: np.ndarray, window: Window, tracks: Mapping[Side, HandTrack]) -> np.ndarray:
    """Share of frames deeper than 10 and 5 mm, with a vertex within 5 mm of the surface or inside; mean acceleration,
    cm per frame^2; RMS of the keypoints of far hands to the generated ones, mm.
    """
    skins = {side: track_vertices(track, pair[side]).astype(np.float64) for side, track in tracks.items()}
    deepest = np.min([nearest(window.thing, skin)[0].min(axis=1) for skin in skins.values()], axis=0)
    second = np.mean([np.linalg.norm(np.diff(skin, 2, axis=0), axis=-1) for skin in skins.values()])
    squares = []
    for side, hand in window.generated.items():
        near = nearest(window.thing, hand.keypoints_m)[0].min(axis=1) < FAR_M
        far = ~binary_dilation(near, iterations=AROUND)
        squares.append(((skins[side][:, ids] - hand.keypoints_m) ** 2).sum(-1)[far])
    rms = 1000 * np.sqrt(np.concatenate(squares).mean())
    shares = [100 * (deepest < -limit).mean() for limit in (0.01, 0.005, -0.005)]
    return np.array([*shares, 100 * second, rms])


def _show_reached(pair: HandPair, ids: np.ndarray, found: list[Window]) -> None:
    names = ("recorded", "spoilt, fitted", "ours", "released", "Adam on grids")
    figures, seconds = {name: [] for name in names}, {name: [] for name in names[2:]}
    for window in found:
        ours(pair, ids, window)  # compiles, and makes the grids, which serve every later motion of the object
        fitted = fit_hands(pair, window.betas, ids, window.generated)
        made = {"recorded": window.recorded, "spoilt, fitted": fitted, "ours": ours(pair, ids, window)}
        seconds["ours"].append(np.median([_timed(lambda w=window: ours(pair, ids, w)) for _ in range(RUNS)]))
        for name, own, second in _descended(pair, ids, window):
            seconds[name].append(second)
            made[name] = own.tracks()
        for name, tracks in made.items():
            figures[name].append(reached(pair, ids, window, tracks))
    rows = []
    for name in names:
        own = np.mean(seconds[name], axis=0) if name in seconds else None
        slower = "" if own is None else f"{own / np.mean(seconds['ours']):.1f}x"
        rows.append(
            [name, *(f"{value:.2f}" for value in np.mean(figures[name], axis=0)), f"{own:.2f}" if own else "", slower]
        )
    columns = ["", "Pen 10 mm %", "Pen 5 mm %", "Con %", "Accel cm", "far RMS mm", "seconds", "of ours"]
    title = f"{len(found)} windows of {FRAMES} frames, both hands, {TRIANGLES[0]} triangles, processor time"
    show(title, columns, rows)


def _descended(pair: HandPair, ids: np.ndarray, window: Window) -> list[tuple[str, Descent, float]]:
    """Both ways of descent, run to their end, and the seconds all their steps take; they share the fit."""
    first = Descent(pair, ids, window)
    step = _timed(lambda: first.fit(TIMED_FITS)) / TIMED_FITS
    steps = TIMED_FITS + first.fit(MOST_FITS - TIMED_FITS)
    other, done = deepcopy(first), []
    for name, own, timed, exact in (
        ("released", first, first.by_vertices(first.by_parity), first.by_vertices(first.by_winding)),
        ("Adam on grids", other, other.by_grids, other.by_grids),
    ):
        once = _timed(lambda own=own, timed=timed: own.refine(1, timed))
        own.refine(REFINEMENTS - 1, exact)
        done.append((name, own, steps * step + REFINEMENTS * once))
        print(f"{window.name}, {name}: {steps} steps of {1000 * step:.1f} ms, {REFINEMENTS} of {once:.2f} s")
    return done


def _show_growth(pair: HandPair, ids: np.ndarray, few: list[Window], many: list[Window]) -> None:
    for own in many:
        ours(pair, ids, own)
    base, more = ([_timed(lambda w=w: ours(pair, ids, w)) for w in own for _ in range(RUNS)] for own in (few, many))
    rows = [[f"{TRIANGLES[1]} triangles, against {TRIANGLES[0]}", f"{np.median(more) / np.median(base):.2f}x"]]
    short, long = (_longer(pair, ids, few[0], frames) for frames in (300, 600))
    times = [[_timed(lambda w=w: ours(pair, ids, w)) for w in (short, long)] for _ in range(RUNS)]
    first, second = np.median(times, axis=0)
    rows.append([f"600 frames ({second:.1f} s), against 300 ({first:.1f} s)", f"{second / first:.2f}x"])
    show("What time depends on", ["", "time"], rows)


def _longer(pair: HandPair, ids: np.ndarray, window: Window, frames: int) -> Window:
    """The recording forward and backward in turn, spoilt anew."""
    there = np.arange(window.thing.n_frames)
    rows = np.resize(np.concatenate((there, there[-2:0:-1])), frames)
    hands: dict[Side, HandTrack] = {side: track.take(rows) for side, track in window.recorded.items()}
    return _spoilt(window.name, hands, window.thing.take(rows), pair, ids, 0)


def _timed(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start
