"""BimArt's metrics (Zhang et al. 2025) of one motion: ``paper`` as its code has them, ``corrected`` as they should be.

Both look at the acting hands in the frames in which they are looked at, as all metrics here; a value of a frame is of
both hands together. ``paper`` takes the triangles of the posed mesh as they are, both parts and the triangles between
them as one surface. A vertex is inside where the winding number of that surface is odd, so two parts that overlap count
as outside there. The release asks the same by casting rays. Any depth counts as contact. ``corrected`` asks the solid
each part encloses (``SurfaceIndex``; an open part has none and is left out, which ``solid_note`` says), and contact is
a vertex within 5 mm of the surface in a frame in which no vertex is deeper than 1 cm.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, reduce
from typing import NamedTuple

import igl
import numpy as np
from scipy.spatial import KDTree

from hoidata.clips.clip import FPS, SIDES, ObjectTrack, Side
from hoidata.hands import track_vertices
from hoidata.metrics.pair import Motion, Pair
from hoidata.metrics.unmeasured import NO_INSIDE, RIGID, Unmeasured, Values
from hoidata.objects.distance import MergedSurface, merged_surface
from hoidata.objects.model import ObjectModel, articulate
from hoidata.objects.surface_index import GRID_PAYS_FROM, PartSurface, SurfaceIndex, surface_index
from hoidata.surface.contact import PlacedHand, deepest_m

NEAR_M = 0.005
DEEP_M, LESS_DEEP_M = 0.01, 0.005
MOVED_AS_RELEASED_M, TURNED_AS_RELEASED_RAD = 1e-5, 1e-3
# Above the noise of recordings. At rest the farthest vertex of ARCTIC's objects jumps by 0.19 mm a frame (median; of
# ManipNet's by 0.31 mm), so the released 0.01 mm selects every frame.
MOVED_M, TURNED_RAD = 5e-4, 2e-3
CAP_M = 0.2  # distances of contact maps beyond count as this, corrected
_FAR_M = 2 * DEEP_M  # no threshold asks what lies beyond


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


def mul_cm(pairs: Sequence[Pair], every: int) -> Values:
    """(pair of motions of one clip,) mean distance of the same vertex in the same frame, cm; none of one motion."""
    del every
    first = pairs[0]
    if len(pairs) == 1:
        return Unmeasured("the clip has one motion")
    if any(not np.array_equal(pair.predicted.clip.source_frames, first.predicted.clip.source_frames) for pair in pairs):
        return Unmeasured("the motions of the clip have other frames")
    seen = [[_vertices_m(pair.predicted, side)[pair.frames(side)] for side in first.sides] for pair in pairs]
    points = [np.concatenate([own.reshape(-1, 3) for own in hands]).astype(np.float64) for hands in seen]
    apart = [np.linalg.norm(a - b, axis=-1).mean() for row, a in enumerate(points) for b in points[:row]]
    return 100 * np.array(apart)


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
    moving = steps_m(pair.predicted.clip.object) > MOVED_AS_RELEASED_M
    return _percent(_deepest_paper_m(pair)[moving][::every], lambda deepest: deepest > -NEAR_M)


def art_paper(pair: Pair, every: int) -> Values:
    """(frame in which the hinge turns,) the same of the triangles that lie in the moving part with all corners."""
    if not pair.predicted.clip.object.model.is_articulated:
        return RIGID
    turning = turns_rad(pair.predicted.clip.object) > TURNED_AS_RELEASED_RAD
    if not turning.any():
        return np.zeros(0)
    return _percent(_deepest_paper_m(pair, moving_part=True)[turning][::every], lambda deepest: deepest > -NEAR_M)


def steps_m(track: ObjectTrack) -> np.ndarray:
    """(frame,) how far the fastest vertex moves to the next frame, metres; 0 in the last frame."""
    places = track.points_in_world(track.model.vertices_m, track.model.part)
    return np.append(np.linalg.norm(np.diff(places, axis=0), axis=-1).max(axis=1), 0.0)


def turns_rad(track: ObjectTrack) -> np.ndarray:
    """(frame,) by how much the hinge turns to the next frame, either way, radians; 0 in the last frame."""
    if track.hinge_rad is None:
        return np.zeros(track.n_frames)
    return np.append(np.abs(np.diff(track.hinge_rad.astype(np.float64))), 0.0)


def moves(track: ObjectTrack) -> np.ndarray:
    """(frame,) bool: to the next frame a vertex moves by more than ``MOVED_M``, or the hinge as ``turns`` says."""
    return (steps_m(track) > MOVED_M) | turns(track)


def turns(track: ObjectTrack) -> np.ndarray:
    """(frame,) bool: the hinge turns by more than ``TURNED_RAD`` to the next frame."""
    return turns_rad(track) > TURNED_RAD


class Shell(NamedTuple):
    """Triangles as they are, in the rest frame of a part: ``surface`` for distances, ``mesh`` for winding numbers."""

    surface: PartSurface
    mesh: MergedSurface

    def winding(self, positions_m: np.ndarray) -> np.ndarray:
        """(position,) how often the triangles wind around each position; not a whole number where they are open."""
        return np.asarray(igl.fast_winding_number(*self.mesh, positions_m))

    def distance_m(self, positions_m: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """(position,) distance to the triangles, never negative; of positions not ``inside`` infinite beyond 2 cm."""
        distance = np.empty(len(positions_m))
        for rows, most_m in ((inside, np.inf), (~inside, _FAR_M)):
            distance[rows] = self.surface.distance_m(positions_m[rows], most_m)
        return distance

    def depth_m(self, positions_m: np.ndarray) -> np.ndarray:
        """(position,) depth in these triangles alone, positive inside; -inf from 2 cm outside on."""
        inside = is_odd(self.winding(positions_m))
        distance = self.distance_m(positions_m, inside)
        return np.where(inside, distance, -distance)


def is_odd(winding: np.ndarray) -> np.ndarray:
    """(position,) bool: the whole number nearest to a winding number is odd, so that a ray crosses oddly often."""
    return np.rint(winding).astype(np.int64) % 2 == 1


@lru_cache(maxsize=64)
def shells(index: SurfaceIndex) -> dict[int, Shell]:
    """By part, the triangles whose corners all lie in it."""
    model, corners = index.model, _corner_parts(index.model)
    faces = {part: model.faces[(corners == part).all(axis=1)] for part in model.parts}
    return {part: _shell(model.vertices_m, own) for part, own in faces.items() if len(own)}


def _shell(vertices_m: np.ndarray, faces: np.ndarray) -> Shell:
    mesh = merged_surface(vertices_m, faces)
    return Shell(PartSurface(*mesh, False, GRID_PAYS_FROM), mesh)


def _corner_parts(model: ObjectModel) -> np.ndarray:
    """(face, 3) the part of each corner."""
    return model.part[model.faces] if model.is_articulated else np.zeros_like(model.faces)


def whole_depth_m(hand: PlacedHand, model: ObjectModel) -> np.ndarray:
    """(valid frame, 778) depth of vertices in the whole posed mesh, positive inside; -inf from 2 cm outside on."""
    shape, own = hand.vertices_m.shape[:2], shells(surface_index(model))
    local = {part: _in_part(hand, model, part) for part in own}
    seam = list(_seam_meshes(model, hand))
    winding = np.sum([shell.winding(local[part]) for part, shell in own.items()], axis=0).reshape(shape)
    for row, mesh in enumerate(seam):
        winding[row] += igl.fast_winding_number(*mesh, hand.vertices_m[row])
    inside = is_odd(winding)
    apart = [shell.distance_m(local[part], inside.reshape(-1)) for part, shell in own.items()]
    distance = np.min(apart, axis=0).reshape(shape)
    for row, mesh in enumerate(seam):
        square = igl.point_mesh_squared_distance(hand.vertices_m[row], *mesh)[0]
        distance[row] = np.minimum(distance[row], np.sqrt(square))
    return np.where(inside, distance, -distance)


def _seam_meshes(model: ObjectModel, hand: PlacedHand) -> Iterator[MergedSurface]:
    """For each frame the triangles that have corners in both parts, posed, object frame; nothing without such."""
    corners = _corner_parts(model)
    seam = corners.min(axis=1) != corners.max(axis=1)
    if seam.any():
        used, faces = np.unique(model.faces[seam], return_inverse=True)
        faces = np.ascontiguousarray(faces.reshape(-1, 3), np.int64)
        for posed in articulate(model.vertices_m[used], model.part[used], model.hinge, hand.hinge_rad):
            yield MergedSurface(np.ascontiguousarray(posed, np.float64), faces)


def _in_part(hand: PlacedHand, model: ObjectModel, part: int) -> np.ndarray:
    """(frame x 778, 3) hand vertices in a part's rest frame."""
    local = model.object_from_part(part, hand.hinge_rad).inverse() @ hand.vertices_m
    return np.ascontiguousarray(local.reshape(-1, 3))


def part_depth_m(hand: PlacedHand, model: ObjectModel, part: int) -> np.ndarray:
    """(valid frame, 778) depth in the triangles of one part alone, positive inside; -inf from 2 cm outside on."""
    shell, shape = shells(surface_index(model)).get(part), hand.vertices_m.shape[:2]
    return np.full(shape, -np.inf) if shell is None else shell.depth_m(_in_part(hand, model, part)).reshape(shape)


@lru_cache(maxsize=2)
def _deepest_paper_m(pair: Pair, moving_part: bool = False) -> np.ndarray:
    """(frame,) of the vertices of all acting hands the deepest, negative outside; NaN in frames without a hand."""
    model, hands = pair.predicted.clip.object.model, placed_hands(pair)
    depths = [part_depth_m(hand, model, 1) if moving_part else whole_depth_m(hand, model) for hand in hands]
    return _of_hands([hand.over_clip(own.max(axis=1), np.nan) for hand, own in zip(hands, depths, strict=True)], pair)


# --- penetration and contact, corrected


def pen_1cm_corrected(pair: Pair, every: int) -> Values:
    """(frame,) 100 where a vertex is deeper than 1 cm in the solid, else 0; none for an object without an inside."""
    return _percent_of_solid(pair, _depth_m(pair)[::every], lambda deepest: deepest > DEEP_M)


def pen_5mm_corrected(pair: Pair, every: int) -> Values:
    """(frame,) the same at 5 mm."""
    return _percent_of_solid(pair, _depth_m(pair)[::every], lambda deepest: deepest > LESS_DEEP_M)


def con_everywhere_corrected(pair: Pair, every: int) -> Values:
    """(frame,) 100 where a vertex is within 5 mm of the surface, either side, and none deeper than 1 cm, else 0."""
    return _percent_of_solid(pair, _sound_contact(pair)[::every], lambda touching: touching > 0)


def con_corrected(pair: Pair, every: int) -> Values:
    """(frame in which the object moves,) the same."""
    moving = moves(pair.predicted.clip.object)
    return _percent_of_solid(pair, _sound_contact(pair)[moving][::every], lambda touching: touching > 0)


def art_corrected(pair: Pair, every: int) -> Values:
    """(frame in which the hinge turns,) the same of the surface of the moving part, triangles of the seam included."""
    if not pair.predicted.clip.object.model.is_articulated:
        return RIGID
    turning = turns(pair.predicted.clip.object)
    if not turning.any():
        return np.zeros(0)
    touching = _sound_contact(pair, moving_part=True)[turning][::every]
    return _percent_of_solid(pair, touching, lambda touching: touching > 0)


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


def _percent_of_solid(pair: Pair, values: np.ndarray, is_so: Callable[[np.ndarray], np.ndarray]) -> Values:
    """The same of values that need an object with an inside."""
    is_solid = surface_index(pair.predicted.clip.object.model).is_solid
    return _percent(values, is_so) if is_solid else NO_INSIDE


# --- contact maps


def cm_paper(pair: Pair, every: int) -> Values:
    """(hand and frame,) mean over points of |map made - map asked for|, cm; distances to the nearest of 778 vertices.

    None for a motion that was asked for no map (``hoidata.metrics.asked``).
    """
    return _map_errors_cm(pair, every, None, np.inf)


def cm_corrected(pair: Pair, every: int) -> Values:
    """(hand and frame,) the same to the vertices the map asked for is of, distances beyond 20 cm taken as that."""
    asked = pair.asked_distances
    return _map_errors_cm(pair, every, None if asked is None else asked.hand_vertices, CAP_M)


def _map_errors_cm(pair: Pair, every: int, hand_vertices: np.ndarray | None, cap_m: float) -> Values:
    asked, track, errors = pair.asked_distances, pair.predicted.clip.object, []
    if asked is None:
        return Unmeasured("the motion was made without a target map of distances")
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
