"""BimArt's figures (Zhang et al. 2025) of one motion: ``paper`` as its code has them, ``corrected`` as they should be.

Both look at the acting hands in the frames in which they are looked at, as all metrics here; a figure of a frame is of
both hands together. ``paper`` takes the triangles as they are, both parts as one surface: a vertex is inside where a
line along x crosses that an odd number of times ahead of it, so that two parts that overlap count as outside there and
an open mesh has an unreliable inside, as in the release; any depth counts as contact. ``corrected`` asks the solid each
part encloses (``SurfaceIndex``; an open part has none and is left out, which ``solid_note`` says), and contact is a
vertex within 5 mm of the surface in a frame in which no vertex is deeper than 1 cm.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, reduce
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from hoidata.clips.clip import FPS, SIDES, ObjectTrack, Side
from hoidata.hands import track_vertices
from hoidata.metrics.pair import Motion, Pair
from hoidata.objects.distance import merged_surface
from hoidata.objects.line_crossings import INSIDE, UNSURE, settle_sides
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import PartSurface, SurfaceIndex, surface_index
from hoidata.objects.triangle_tree import TriangleTree, triangle_tree
from hoidata.surface.contact import PlacedHand, deepest_m

NEAR_M = 0.005
DEEP_M, LESS_DEEP_M = 0.01, 0.005
MOVED_M = 1e-5  # an object vertex that moves farther to the next frame moves
TURNED_RAD = 1e-3  # a hinge that turns farther to the next frame turns
CAP_M = 0.2  # distances of contact maps beyond count as this, corrected
_FAR_M = 2 * DEEP_M  # no threshold asks what lies beyond
_NEVER = 1 << 62  # positions from which a grid would pay: these surfaces are asked too seldom


# --- motion


def accel_paper(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) mean over 778 vertices of the length of the second difference, cm per recorded frame^2."""
    del every  # a derivative needs every frame
    return 100 * _second_differences_m(pair)[0]


def accel_corrected(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) the same in m/s^2."""
    del every
    length_m, step = _second_differences_m(pair)
    return length_m * (FPS / step) ** 2


def mul_cm(pairs: Sequence[Pair], every: int) -> np.ndarray:
    """(pair of motions of one clip,) mean distance of the same vertex in the same frame, cm; none of one motion."""
    del every
    first = pairs[0]
    if any(not np.array_equal(pair.predicted.clip.source_frames, first.predicted.clip.source_frames) for pair in pairs):
        return np.zeros(0)
    seen = [[_vertices_m(pair.predicted, side)[pair.frames(side)] for side in first.sides] for pair in pairs]
    points = [np.concatenate([own.reshape(-1, 3) for own in hands]).astype(np.float64) for hands in seen]
    apart = [np.linalg.norm(a - b, axis=-1).mean() for row, a in enumerate(points) for b in points[:row]]
    return 100 * np.array(apart)


def border_ratios(values: np.ndarray, borders: Sequence[int], reach: int = 1) -> float:
    """95th percentile of ``values`` at the borders of windows over that elsewhere; NaN where either has none.

    values: (frame, ...) any measure per frame, such as lengths of second differences or changes of contact, row i of
    frame i. borders: first frame of every window but the first. reach: frames this near to one are of the border.
    """
    frames = np.arange(len(values))
    at = np.any([np.abs(frames - border) <= reach for border in borders], axis=0) if len(borders) else frames < 0
    if not at.any() or at.all():
        return np.nan
    there, elsewhere = (np.percentile(values[rows], 95) for rows in (at, ~at))
    return float(there / elsewhere) if elsewhere else np.nan


def _second_differences_m(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """(hand and frame,) lengths over three recorded frames, metres, and how many frames these are apart."""
    lengths, steps = [np.zeros(0)], [np.zeros(0)]
    for side in pair.sides:
        vertices = _vertices_m(pair.predicted, side).astype(np.float64)
        triples = pair.triples()
        triples = triples[pair.valid(side)[triples].all(axis=1)]
        before, now, after = (vertices[frames] for frames in triples.T)
        lengths.append(np.linalg.norm((after - now) - (now - before), axis=-1).mean(axis=-1))
        steps.append(triples[:, 1] - triples[:, 0])
    return np.concatenate(lengths), np.concatenate(steps)


@lru_cache(maxsize=32)
def _vertices_m(motion: Motion, side: Side) -> np.ndarray:
    """(frame, 778, 3) float32 world vertices of one hand. Kept for all motions of a clip."""
    return track_vertices(motion.clip.hands[side], motion.hands[side])


# --- penetration and contact, as released


def pen_1cm_paper(pair: Pair, every: int) -> np.ndarray:
    """(frame,) 100 where the deepest vertex of either hand is deeper than 1 cm in the whole mesh, else 0."""
    return _percent(_deepest_paper_m(pair)[::every], lambda deepest: deepest > DEEP_M)


def pen_5mm_paper(pair: Pair, every: int) -> np.ndarray:
    """(frame,) the same at 5 mm."""
    return _percent(_deepest_paper_m(pair)[::every], lambda deepest: deepest > LESS_DEEP_M)


def con_paper(pair: Pair, every: int) -> np.ndarray:
    """(frame in which the object moves,) 100 where a vertex is nearer than 5 mm, or inside at any depth, else 0."""
    return _percent(_deepest_paper_m(pair)[moves(pair.predicted.clip.object)][::every], lambda d: d > -NEAR_M)


def art_paper(pair: Pair, every: int) -> np.ndarray:
    """(frame in which the hinge turns,) the same of the triangles that lie in the moving part with all corners."""
    turning = turns(pair.predicted.clip.object)
    if not turning.any():
        return np.zeros(0)
    return _percent(_deepest_paper_m(pair, moving_part=True)[turning][::every], lambda deepest: deepest > -NEAR_M)


def moves(track: ObjectTrack) -> np.ndarray:
    """(frame,) bool: some vertex moves by more than ``MOVED_M`` to the next frame; the last frame does not."""
    places = track.points_in_world(track.model.vertices_m, track.model.part)
    return np.append(np.linalg.norm(np.diff(places, axis=0), axis=-1).max(axis=1) > MOVED_M, False)


def turns(track: ObjectTrack) -> np.ndarray:
    """(frame,) bool: the hinge turns by more than ``TURNED_RAD`` to the next frame; the last frame does not."""
    if track.hinge_rad is None:
        return np.zeros(track.n_frames, bool)
    return np.append(np.abs(np.diff(track.hinge_rad.astype(np.float64))) > TURNED_RAD, False)


class Shell(NamedTuple):
    """Triangles as they are, in the rest frame of a part. flipped: the same turned about, None of a closed surface."""

    surface: PartSurface
    flipped: TriangleTree | None

    def signed_m(self, positions_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (position,), infinite beyond 2 cm, and whether a line along x says inside."""
        if self.flipped is None:
            inside = self.surface.inside(positions_m)
        else:
            inside = _ahead(self.surface.tree, positions_m) | _ahead(self.flipped, positions_m)
        return self.surface.distance_m(positions_m, _FAR_M), inside


@lru_cache(maxsize=64)
def shells(index: SurfaceIndex, moving_part: bool = False) -> dict[int, Shell]:
    """By part, what the released metrics ask: all triangles, or only those wholly in the moving part."""
    model = index.model
    if not moving_part:
        return {part: _shell(index, part, model.faces_of(part)) for part in model.parts}
    faces = model.faces[model.part[model.faces].all(axis=1)]
    return {1: _shell(index, 1, faces)} if len(faces) else {}


def _shell(index: SurfaceIndex, part: int, faces: np.ndarray) -> Shell:
    filled = index.filled.get(part)
    if filled is not None and filled.closed and len(faces) == len(index.model.faces_of(part)):
        return Shell(filled, None)
    merged = merged_surface(index.model.vertices_m, faces)
    flipped = triangle_tree(merged.vertices_m, merged.faces[:, ::-1])
    return Shell(PartSurface(merged.vertices_m, merged.faces, False, _NEVER), flipped)


def _ahead(tree: TriangleTree, positions_m: np.ndarray) -> np.ndarray:
    """(position,) bool: a line along x leaves the surface oftener than it enters, ahead of the position."""
    side = np.full(len(positions_m), UNSURE, np.int8)
    settle_sides(tree, positions_m, side)
    return side == INSIDE


def signed_in(hand: PlacedHand, model: ObjectModel, by_part: dict[int, Shell]) -> np.ndarray:
    """(valid frame, 778) depth of vertices in the surfaces taken as one, positive inside; -inf from 2 cm outside on."""
    distance, inside = np.full(hand.vertices_m.shape[:2], np.inf), np.zeros(hand.vertices_m.shape[:2], bool)
    for part, shell in by_part.items():
        local = model.object_from_part(part, hand.hinge_rad).inverse() @ hand.vertices_m
        apart, within = shell.signed_m(np.ascontiguousarray(local.reshape(-1, 3)))
        distance = np.minimum(distance, apart.reshape(distance.shape))
        inside ^= within.reshape(inside.shape)
    return np.where(inside, distance, -distance)


@lru_cache(maxsize=2)
def _deepest_paper_m(pair: Pair, moving_part: bool = False) -> np.ndarray:
    """(frame,) of the vertices of all acting hands the deepest, negative outside; NaN in frames without a hand."""
    model = pair.predicted.clip.object.model
    surfaces = shells(surface_index(model), moving_part)
    found = [hand.over_clip(signed_in(hand, model, surfaces).max(axis=1), np.nan) for hand in placed_hands(pair)]
    return _of_hands(found, pair)


# --- penetration and contact, corrected


def pen_1cm_corrected(pair: Pair, every: int) -> np.ndarray:
    """(frame,) 100 where a vertex is deeper than 1 cm in the solid, else 0; none for an object without an inside."""
    return _percent(_depth_m(pair)[::every], lambda deepest: deepest > DEEP_M)


def pen_5mm_corrected(pair: Pair, every: int) -> np.ndarray:
    """(frame,) the same at 5 mm."""
    return _percent(_depth_m(pair)[::every], lambda deepest: deepest > LESS_DEEP_M)


def con_everywhere_corrected(pair: Pair, every: int) -> np.ndarray:
    """(frame,) 100 where a vertex is within 5 mm of the surface, either side, and none deeper than 1 cm, else 0."""
    return _percent(_sound_contact(pair)[::every], lambda touching: touching > 0)


def con_corrected(pair: Pair, every: int) -> np.ndarray:
    """(frame in which the object moves,) the same."""
    return _percent(_sound_contact(pair)[moves(pair.predicted.clip.object)][::every], lambda touching: touching > 0)


def art_corrected(pair: Pair, every: int) -> np.ndarray:
    """(frame in which the hinge turns,) the same of the surface of the moving part, triangles of the seam included."""
    turning = turns(pair.predicted.clip.object)
    if not turning.any():
        return np.zeros(0)
    return _percent(_sound_contact(pair, moving_part=True)[turning][::every], lambda touching: touching > 0)


@lru_cache(maxsize=1)
def _depth_m(pair: Pair) -> np.ndarray:
    """(frame,) of the vertices of all acting hands the deepest inside the solid; NaN where that is not known."""
    index = surface_index(pair.predicted.clip.object.model)
    if not index.is_solid:
        return np.full(pair.predicted.clip.n_frames, np.nan)
    return _of_hands([deepest_m(hand, index) for hand in placed_hands(pair)], pair)


def _sound_contact(pair: Pair, moving_part: bool = False) -> np.ndarray:
    """(frame,) 1 where a hand touches and none is too deep, 0 elsewhere; NaN in frames without a hand or an inside."""
    model = pair.predicted.clip.object.model
    index = surface_index(model)
    surfaces = {1: index.filled[1]} if moving_part else index.filled
    near = [_is_near(hand, model, surfaces).max(axis=1).astype(np.float64) for hand in placed_hands(pair)]
    found = [hand.over_clip(np.asarray(own), np.nan) for hand, own in zip(placed_hands(pair), near, strict=True)]
    depth = _depth_m(pair)
    return np.where(np.isnan(depth), np.nan, _of_hands(found, pair) * (depth <= DEEP_M))


def _is_near(hand: PlacedHand, model: ObjectModel, surfaces: dict[int, PartSurface]) -> np.ndarray:
    near = np.zeros(hand.vertices_m.shape[:2], bool)
    for part, surface in surfaces.items():
        local = model.object_from_part(part, hand.hinge_rad).inverse() @ hand.vertices_m
        apart = surface.distance_m(np.ascontiguousarray(local.reshape(-1, 3)), NEAR_M)
        near |= (apart <= NEAR_M).reshape(near.shape)
    return near


@lru_cache(maxsize=1)
def placed_hands(pair: Pair) -> list[PlacedHand]:
    """The acting hands of the prediction before its object, in the frames in which they are looked at."""
    clip = pair.predicted.clip
    hands = []
    for side in pair.sides:
        frames = pair.frames(side)
        local = clip.object.world_from_object.inverse() @ _vertices_m(pair.predicted, side).astype(np.float64)
        hinge = None if clip.object.hinge_rad is None else clip.object.hinge_rad[frames]
        hands.append(PlacedHand(local[frames], frames, hinge, pair.predicted.hands[side].faces, clip.n_frames))
    return hands


def _of_hands(found: list[np.ndarray], pair: Pair) -> np.ndarray:
    """(frame,) the greatest value of all acting hands, NaN where none is looked at."""
    return reduce(np.fmax, found, np.full(pair.predicted.clip.n_frames, np.nan))


def _percent(values: np.ndarray, is_so: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """100 or 0 by the question ``is_so``; unknown values are left out."""
    return 100.0 * is_so(values[~np.isnan(values)])


# --- contact maps


def cm_paper(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) mean over points of |map made - map asked for|, cm; distances to the nearest of 778 vertices.

    None for a motion that was asked for no map (``hoidata.metrics.asked``).
    """
    return _map_errors_cm(pair, every, None, np.inf)


def cm_corrected(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) the same to the vertices the map asked for is of, distances beyond 20 cm taken as that."""
    asked = pair.asked_distances
    return _map_errors_cm(pair, every, None if asked is None else asked.hand_vertices, CAP_M)


def _map_errors_cm(pair: Pair, every: int, hand_vertices: np.ndarray | None, cap_m: float) -> np.ndarray:
    asked, track, errors = pair.asked_distances, pair.predicted.clip.object, []
    if asked is None:
        return np.zeros(0)
    world_from_object = track.world_from_object
    for side in pair.sides:
        hand, wanted = _vertices_m(pair.predicted, side), asked.distance_m[:, SIDES.index(side)]
        hand = hand if hand_vertices is None else hand[:, hand_vertices]
        for frame in pair.frames(side, every):
            known = np.isfinite(wanted[frame])
            own = wanted[frame, known].astype(np.float64)
            places_m = world_from_object[int(frame)] @ asked.place_m[frame, known].astype(np.float64)
            made = KDTree(hand[frame]).query(places_m)[0]
            if known.any():
                errors.append(np.abs(np.minimum(made, cap_m) - np.minimum(own, cap_m)).mean())
    return 100 * np.array(errors)
