"""BimArt's metrics (Zhang et al. 2025) of one motion: ``paper`` as in its released code, and ``corrected``.

A value of a frame covers both acting hands.

``paper`` treats the posed mesh as one surface: both parts and the triangles between them. A vertex is inside if the
winding number is odd, so the overlap of two parts counts as outside; the released code finds the same by casting rays.
Any depth counts as contact.

``corrected`` tests the solid that each part encloses (``SurfaceIndex``). Open parts enclose none and are skipped;
``repair_note`` reports them. Contact is a vertex within 5 mm of the surface in a frame with no vertex deeper than 1 cm.
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
from hoidata.surface.contact import HandInObjectFrame, deepest_m

NEAR_M = 0.005
DEEP_M, LESS_DEEP_M = 0.01, 0.005
MOVED_AS_RELEASED_M, TURNED_AS_RELEASED_RAD = 1e-5, 1e-3
# Above the noise of recordings: at rest the fastest vertex moves by 0.19 mm per frame in ARCTIC (median) and by 0.31 mm
# in ManipNet. The released 0.01 mm therefore selects every frame.
MOVED_M, TURNED_RAD = 5e-4, 2e-3
CAP_M = 0.2  # ``corrected`` clips larger distances of contact maps to this
_FAR_M = 2 * DEEP_M  # farther than any threshold: larger distances need not be exact


# --- motion


def accel_paper(pair: Pair, _frame_step: int) -> np.ndarray:
    """(hand and frame,) mean length of the second difference over 778 vertices, cm per recorded frame^2."""
    return 100 * _second_differences_m(pair)[0]


def accel_corrected(pair: Pair, _frame_step: int) -> np.ndarray:
    """(hand and frame,) mean acceleration over 778 vertices, m/s^2."""
    length_m, step = _second_differences_m(pair)
    return length_m * (FPS / step) ** 2


def mul_cm(pairs: Sequence[Pair], _frame_step: int) -> Values:
    """(pair of motions of one clip,) mean distance of the same vertex in the same frame, cm; unmeasured for one."""
    first = pairs[0]
    if len(pairs) == 1:
        return Unmeasured("the clip has one motion")
    if any(not np.array_equal(pair.predicted.clip.source_frames, first.predicted.clip.source_frames) for pair in pairs):
        return Unmeasured("the motions of the clip have other frames")
    vertices = [[_vertices_m(pair.predicted, side)[pair.frames(side)] for side in first.sides] for pair in pairs]
    points = [np.concatenate([hand.reshape(-1, 3) for hand in hands]).astype(np.float64) for hands in vertices]
    apart = [np.linalg.norm(a - b, axis=-1).mean() for index, a in enumerate(points) for b in points[:index]]
    return 100 * np.array(apart)


def _second_differences_m(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """(hand and frame,) lengths over three recorded frames, metres, and the spacing of these frames."""
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
    """(frame, 778, 3) float32 world vertices of one hand. Cached for all motions of a clip."""
    return track_vertices(motion.clip.hands[side], motion.hands[side])


# --- penetration and contact, as released


def pen_1cm_paper(pair: Pair, frame_step: int) -> np.ndarray:
    """(frame,) 100 if the deepest vertex of either hand is deeper than 1 cm in the whole mesh, else 0."""
    return _percent(_deepest_paper_m(pair)[::frame_step], lambda deepest: deepest > DEEP_M)


def pen_5mm_paper(pair: Pair, frame_step: int) -> np.ndarray:
    """(frame,) as ``pen_1cm_paper``, at 5 mm."""
    return _percent(_deepest_paper_m(pair)[::frame_step], lambda deepest: deepest > LESS_DEEP_M)


def con_paper(pair: Pair, frame_step: int) -> np.ndarray:
    """(frame in which the object moves,) 100 if a vertex is closer than 5 mm, or inside at any depth, else 0."""
    moving = steps_m(pair.predicted.clip.object) > MOVED_AS_RELEASED_M
    return _percent(_deepest_paper_m(pair)[moving][::frame_step], lambda deepest: deepest > -NEAR_M)


def art_paper(pair: Pair, frame_step: int) -> Values:
    """(frame in which the hinge turns,) as ``con_paper``, of the triangles entirely in the moving part."""
    if not pair.predicted.clip.object.model.is_articulated:
        return RIGID
    turning = turns_rad(pair.predicted.clip.object) > TURNED_AS_RELEASED_RAD
    if not turning.any():
        return np.zeros(0)
    return _percent(_deepest_paper_m(pair, moving_part=True)[turning][::frame_step], lambda deepest: deepest > -NEAR_M)


def steps_m(track: ObjectTrack) -> np.ndarray:
    """(frame,) displacement of the fastest vertex to the next frame, metres; 0 in the last frame."""
    positions_m = track.points_in_world(track.model.vertices_m, track.model.part)
    return np.append(np.linalg.norm(np.diff(positions_m, axis=0), axis=-1).max(axis=1), 0.0)


def turns_rad(track: ObjectTrack) -> np.ndarray:
    """(frame,) absolute change of the hinge angle to the next frame, radians; 0 in the last frame."""
    if (angle_rad := track.joint_angle_rad) is None:
        return np.zeros(track.n_frames)
    return np.append(np.abs(np.diff(angle_rad.astype(np.float64))), 0.0)


def moves(track: ObjectTrack) -> np.ndarray:
    """(frame,) bool: a vertex moved by more than ``MOVED_M`` since the frame before, or the hinge by ``TURNED_RAD``."""
    return (steps_m(track) > MOVED_M) | turns(track)


def turns(track: ObjectTrack) -> np.ndarray:
    """(frame,) bool: the hinge turns by more than ``TURNED_RAD`` to the next frame."""
    return turns_rad(track) > TURNED_RAD


class Shell(NamedTuple):
    """Unrepaired triangles in the rest frame of a part."""

    surface: PartSurface  # for distances
    mesh: MergedSurface  # for winding numbers

    def winding(self, positions_m: np.ndarray) -> np.ndarray:
        """(position,) winding number of the triangles; not an integer if they are open."""
        return np.asarray(igl.fast_winding_number(*self.mesh, positions_m))

    def distance_m(self, positions_m: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """(position,) unsigned distance to the triangles; infinite beyond 2 cm for positions that are not inside."""
        distance = np.empty(len(positions_m))
        for mask, most_m in ((inside, np.inf), (~inside, _FAR_M)):
            distance[mask] = self.surface.distance_m(positions_m[mask], most_m)
        return distance

    def depth_m(self, positions_m: np.ndarray) -> np.ndarray:
        """(position,) depth in these triangles alone, positive inside; -inf beyond 2 cm outside."""
        inside = is_odd(self.winding(positions_m))
        distance = self.distance_m(positions_m, inside)
        return np.where(inside, distance, -distance)


def is_odd(winding: np.ndarray) -> np.ndarray:
    """(position,) bool: the rounded winding number is odd, so a ray crosses the surface an odd number of times."""
    return np.rint(winding).astype(np.int64) % 2 == 1


@lru_cache(maxsize=64)
def shells(index: SurfaceIndex) -> dict[int, Shell]:
    """Per part, the triangles whose corners are all in it."""
    model, corners = index.model, _corner_parts(index.model)
    faces = {part: model.faces[(corners == part).all(axis=1)] for part in model.parts}
    return {part: _shell(model.vertices_m, part_faces) for part, part_faces in faces.items() if len(part_faces)}


def _shell(vertices_m: np.ndarray, faces: np.ndarray) -> Shell:
    mesh = merged_surface(vertices_m, faces)
    return Shell(PartSurface(*mesh, False, GRID_PAYS_FROM), mesh)


def _corner_parts(model: ObjectModel) -> np.ndarray:
    """(face, 3) the part of each corner."""
    return model.part[model.faces] if model.is_articulated else np.zeros_like(model.faces)


def whole_depth_m(hand: HandInObjectFrame, model: ObjectModel) -> np.ndarray:
    """(valid frame, 778) depth of vertices in the whole posed mesh, positive inside; -inf beyond 2 cm outside."""
    shape, part_shells = hand.vertices_m.shape[:2], shells(surface_index(model))
    local = {part: _in_part(hand, model, part) for part in part_shells}
    seam = list(_seam_meshes(model, hand))
    winding = np.sum([shell.winding(local[part]) for part, shell in part_shells.items()], axis=0).reshape(shape)
    for frame, mesh in enumerate(seam):
        winding[frame] += igl.fast_winding_number(*mesh, hand.vertices_m[frame])
    inside = is_odd(winding)
    distances = [shell.distance_m(local[part], inside.reshape(-1)) for part, shell in part_shells.items()]
    distance = np.min(distances, axis=0).reshape(shape)
    for frame, mesh in enumerate(seam):
        square_m2 = igl.point_mesh_squared_distance(hand.vertices_m[frame], *mesh)[0]
        distance[frame] = np.minimum(distance[frame], np.sqrt(square_m2))
    return np.where(inside, distance, -distance)


def _seam_meshes(model: ObjectModel, hand: HandInObjectFrame) -> Iterator[MergedSurface]:
    """Per frame, the posed triangles with corners in both parts, object frame; empty if there are none."""
    corners = _corner_parts(model)
    seam = corners.min(axis=1) != corners.max(axis=1)
    if seam.any():
        used, faces = np.unique(model.faces[seam], return_inverse=True)
        faces = np.ascontiguousarray(faces.reshape(-1, 3), np.int64)
        for posed in articulate(model.vertices_m[used], model.part[used], model.hinge, hand.hinge_rad):
            yield MergedSurface(np.ascontiguousarray(posed, np.float64), faces)


def _in_part(hand: HandInObjectFrame, model: ObjectModel, part: int) -> np.ndarray:
    """(frame x 778, 3) hand vertices in a part's rest frame."""
    local = model.object_from_part(part, hand.hinge_rad).inverse() @ hand.vertices_m
    return np.ascontiguousarray(local.reshape(-1, 3))


def part_depth_m(hand: HandInObjectFrame, model: ObjectModel, part: int) -> np.ndarray:
    """(valid frame, 778) depth in the triangles of one part alone, positive inside; -inf beyond 2 cm outside."""
    shell, shape = shells(surface_index(model)).get(part), hand.vertices_m.shape[:2]
    return np.full(shape, -np.inf) if shell is None else shell.depth_m(_in_part(hand, model, part)).reshape(shape)


@lru_cache(maxsize=2)
def _deepest_paper_m(pair: Pair, moving_part: bool = False) -> np.ndarray:
    """(frame,) depth of the deepest vertex of the acting hands, negative outside; NaN in frames without a hand."""
    model, hands = pair.predicted.clip.object.model, placed_hands(pair)
    depths = [part_depth_m(hand, model, 1) if moving_part else whole_depth_m(hand, model) for hand in hands]
    per_frame = [hand.expand_to_clip(depth.max(axis=1), np.nan) for hand, depth in zip(hands, depths, strict=True)]
    return _of_hands(per_frame, pair)


# --- penetration and contact, corrected


def pen_1cm_corrected(pair: Pair, frame_step: int) -> Values:
    """(frame,) 100 if a vertex is deeper than 1 cm in the solid, else 0; unmeasured if the object is not solid."""
    return _percent_of_solid(pair, _depth_m(pair)[::frame_step], lambda deepest: deepest > DEEP_M)


def pen_5mm_corrected(pair: Pair, frame_step: int) -> Values:
    """(frame,) as ``pen_1cm_corrected``, at 5 mm."""
    return _percent_of_solid(pair, _depth_m(pair)[::frame_step], lambda deepest: deepest > LESS_DEEP_M)


def con_everywhere_corrected(pair: Pair, frame_step: int) -> Values:
    """(frame,) 100 if a vertex is within 5 mm of the surface, inside or outside, and none deeper than 1 cm, else 0."""
    return _percent_of_solid(pair, _sound_contact(pair)[::frame_step], lambda touching: touching > 0)


def con_corrected(pair: Pair, frame_step: int) -> Values:
    """(frame in which the object moves,) as ``con_everywhere_corrected``."""
    moving = moves(pair.predicted.clip.object)
    return _percent_of_solid(pair, _sound_contact(pair)[moving][::frame_step], lambda touching: touching > 0)


def art_corrected(pair: Pair, frame_step: int) -> Values:
    """(frame in which the hinge turns,) as ``con_corrected``, of the moving part, triangles of the seam included."""
    if not pair.predicted.clip.object.model.is_articulated:
        return RIGID
    turning = turns(pair.predicted.clip.object)
    if not turning.any():
        return np.zeros(0)
    touching = _sound_contact(pair, moving_part=True)[turning][::frame_step]
    return _percent_of_solid(pair, touching, lambda touching: touching > 0)


@lru_cache(maxsize=1)
def _depth_m(pair: Pair) -> np.ndarray:
    """(frame,) depth of the deepest vertex of the acting hands inside the solid; NaN if unknown."""
    index = surface_index(pair.predicted.clip.object.model)
    if not index.is_solid:
        return np.full(pair.predicted.clip.n_frames, np.nan)
    return _of_hands([deepest_m(hand, index) for hand in placed_hands(pair)], pair)


def _sound_contact(pair: Pair, moving_part: bool = False) -> np.ndarray:
    """(frame,) 1 if a hand touches and none is too deep, else 0; NaN without a hand or a solid."""
    model = pair.predicted.clip.object.model
    index = surface_index(model)
    surfaces = {1: index.filled[1]} if moving_part else index.filled
    per_frame = []
    for hand in placed_hands(pair):
        touching = _is_near(hand, model, surfaces).max(axis=1).astype(np.float64)
        per_frame.append(hand.expand_to_clip(np.asarray(touching), np.nan))
    depth = _depth_m(pair)
    return np.where(np.isnan(depth), np.nan, _of_hands(per_frame, pair) * (depth <= DEEP_M))


def _is_near(hand: HandInObjectFrame, model: ObjectModel, surfaces: dict[int, PartSurface]) -> np.ndarray:
    near = np.zeros(hand.vertices_m.shape[:2], bool)
    for part, surface in surfaces.items():
        apart = surface.distance_m(_in_part(hand, model, part), NEAR_M)
        near |= (apart <= NEAR_M).reshape(near.shape)
    return near


@lru_cache(maxsize=1)
def placed_hands(pair: Pair) -> list[HandInObjectFrame]:
    """The acting hands of the prediction in the object frame, in the frames in which they are measured."""
    clip = pair.predicted.clip
    hands = []
    for side in pair.sides:
        frames = pair.frames(side)
        local = clip.object.world_from_object.inverse() @ _vertices_m(pair.predicted, side).astype(np.float64)
        hinge, faces = pair.predicted.hinge_rad(frames), pair.predicted.hands[side].faces
        hands.append(HandInObjectFrame(local[frames], frames, hinge, faces=faces, n_frames=clip.n_frames))
    return hands


def _of_hands(values_per_hand: list[np.ndarray], pair: Pair) -> np.ndarray:
    """(frame,) the largest value of the acting hands, NaN if none is measured."""
    return reduce(np.fmax, values_per_hand, np.full(pair.predicted.clip.n_frames, np.nan))


def _percent(values: np.ndarray, condition: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """100 where ``condition`` is true, else 0; NaN values are skipped."""
    return 100.0 * condition(values[~np.isnan(values)])


def _percent_of_solid(pair: Pair, values: np.ndarray, condition: Callable[[np.ndarray], np.ndarray]) -> Values:
    """As ``_percent``, for values that need a solid object."""
    is_solid = surface_index(pair.predicted.clip.object.model).is_solid
    return _percent(values, condition) if is_solid else NO_INSIDE


# --- contact maps


def contact_map_error_paper(pair: Pair, frame_step: int) -> Values:
    """(hand and frame,) mean absolute difference of the generated and the target distance map over points, cm.

    Distances are to the nearest of 778 vertices. Unmeasured for a motion without a target map
    (``hoidata.metrics.target_contact``).
    """
    return _map_errors_cm(pair, frame_step, None, np.inf)


def contact_map_error_corrected(pair: Pair, frame_step: int) -> Values:
    """(hand and frame,) as ``contact_map_error_paper``, to the target map's vertices, distances capped at 20 cm."""
    target = pair.target_distances
    return _map_errors_cm(pair, frame_step, None if target is None else target.hand_vertices, CAP_M)


def _map_errors_cm(pair: Pair, frame_step: int, hand_vertices: np.ndarray | None, cap_m: float) -> Values:
    target, track, errors = pair.target_distances, pair.predicted.clip.object, []
    if target is None:
        return Unmeasured("the motion was made without a target map of distances")
    world_from_object = track.world_from_object
    for side in pair.sides:
        hand, target_m = _vertices_m(pair.predicted, side), target.distance_m[:, SIDES.index(side)]
        hand = hand if hand_vertices is None else hand[:, hand_vertices]
        for frame in pair.frames(side, frame_step):
            has_target = np.isfinite(target_m[frame])
            target_here_m = target_m[frame, has_target].astype(np.float64)
            positions_m = world_from_object[int(frame)] @ target.place_m[frame, has_target].astype(np.float64)
            generated_m = KDTree(hand[frame]).query(positions_m)[0]
            if has_target.any():
                errors.append(np.abs(np.minimum(generated_m, cap_m) - np.minimum(target_here_m, cap_m)).mean())
    return 100 * np.array(errors)
