"""CAMS's three figures (Zheng et al. 2023) of one motion: ``paper`` as its code has them, ``corrected`` in SI units.

Can contacts at the hands, on a table and in the hinge carry both parts' motion, and can both parts be turned against
each other? A part is a set of points with masses, whose accelerations are second differences of recorded frames. Only
frames in which an acting hand is looked at count: in others no hand could carry anything. What a part's forces must add
up to is their sum of m (a - g) and of its moments. A contact pushes within four edges of its friction cone; the hinge
gives any force at 11 points of its axis, and the opposite one to the other part.

``paper``: a kilogram on every vertex, gravity 1 m per frame^2, contacts at the vertices nearest to hand vertices that
are inside or within 2 mm, and a table under the lowest vertices wherever they are. Its cones and its choice of table
points are drawn without a seed; ours have fixed directions and a fixed seed. Moments are about the object's origin, and
an arm is compared with the mean one of the part's vertices: our reading. ``corrected``: a body of 1 kg, even density,
9.81 m/s^2, contacts within 2 mm of the surface and no deeper than 1 cm, a table only where the recorded clip has one.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import igl
import numpy as np
from scipy.optimize import nnls
from scipy.spatial import KDTree

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.metrics.bimart import DEEP_M, LESS_DEEP_M, part_depth_m, placed_hands, turns, turns_rad
from hoidata.metrics.pair import Pair
from hoidata.metrics.unmeasured import NO_GRAVITY, NO_INSIDE, RIGID, Unmeasured, Values
from hoidata.objects.mesh import mass_properties
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex, surface_index
from hoidata.physics.contact_forces import FRICTION, GRAVITY_M_S2, cone_edges
from hoidata.surface.contact import PlacedHand

TOUCH_M = 0.002
TABLE_M = 0.005
TABLE_POINTS, HINGE_POINTS = 20, 11
RESIDUAL = 0.01
TURNED_PAPER_RAD = 1e-6
ARM_SHARE = 0.3


class Contacts(NamedTuple):
    """Places (contact, 3) and outward normals (contact, 3), world."""

    point_m: np.ndarray
    normal: np.ndarray


class Masses(NamedTuple):
    """A part as points: place_m (frame, point, 3) world; mass_kg (point,)."""

    place_m: np.ndarray
    mass_kg: np.ndarray


# --- penetration


def pen_paper(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) share of 778 vertices deeper than 5 mm in a part's mesh, added up over parts."""
    model, each = pair.predicted.clip.object.model, [np.zeros(0)]
    for hand in placed_hands(pair):
        deep = [part_depth_m(hand, model, part) > LESS_DEEP_M for part in model.parts]
        each.append(np.sum(deep, axis=0).mean(axis=1)[::every])
    return np.concatenate(each)


def pen_corrected(pair: Pair, every: int) -> Values:
    """(hand and frame,) share of 778 vertices deeper than 5 mm in the solid; none for an object without an inside."""
    index = surface_index(pair.predicted.clip.object.model)
    if not index.is_solid:
        return NO_INSIDE
    depths = [index.depth_m(hand.vertices_m, hand.hinge_rad) for hand in placed_hands(pair)]
    return np.concatenate([np.zeros(0), *((depth > LESS_DEEP_M).mean(axis=1)[::every] for depth in depths)])


# --- forces


def con_paper(pair: Pair, every: int) -> Values:
    """(frame with a hand, between recorded ones,) 1 where contacts carry both parts as in the release, else 0.

    None without known gravity.
    """
    return _carried(pair, every, paper=True)


def con_corrected(pair: Pair, every: int) -> Values:
    """(frame with a hand, between recorded ones,) the same in SI units; none either for an object without an inside."""
    return _carried(pair, every, paper=False)


def _carried(pair: Pair, every: int, paper: bool) -> Values:
    clip, down = pair.predicted.clip, pair.reference.clip.gravity
    triples = pair.triples()
    triples = triples[pair.looked_at()[triples[:, 1]]][::every]
    if down is None or pair.table_m is None:
        return NO_GRAVITY
    if not (paper or _all_solid(clip.object.model)):
        return Unmeasured("a part of the object has no inside")
    if not len(triples):
        return np.zeros(0)
    weight = down * (1.0 if paper else GRAVITY_M_S2)
    bodies = vertex_masses(clip.object) if paper else even_masses(clip.object)
    contacts = _contacts(pair, paper)
    carried = []
    for triple in triples:
        frame, scale = int(triple[1]), 1.0 if paper else (FPS / (triple[1] - triple[0])) ** 2
        about = clip.object.translation_m[frame].astype(np.float64)
        wanted = needed_wrenches(bodies, triple, scale, weight, about)
        own = [contacts[frame][part] for part in bodies]
        table = _table(pair, frame, down, None if paper else pair.table_m)
        hinge = _hinge_points(clip.object, frame)
        carried.append(residual(wanted, own, table, hinge, about) < RESIDUAL)
    return np.array(carried, np.float64)


def residual(
    wanted: np.ndarray, contacts: list[Contacts], table: list[Contacts], hinge_points_m: np.ndarray, about_m: np.ndarray
) -> float:
    """Norm of what no forces give of ``wanted (part, 6)``, force and moment about ``about_m (3,)``, world.

    contacts, table: by part. hinge_points_m: (point, 3), none for one part.
    """
    columns, parts = [], len(wanted)
    for part, (own, below) in enumerate(zip(contacts, table, strict=True)):
        for touching in (own, below):
            edges = cone_edges(touching.normal, FRICTION) if len(touching.normal) else np.zeros((0, 4, 3))
            moments = np.cross((touching.point_m - about_m)[:, None], edges)
            block = np.zeros((edges.shape[0] * 4, parts, 6))
            block[:, part] = np.concatenate([edges, moments], axis=2).reshape(-1, 6)
            columns.append(block.reshape(-1, 6 * parts))
    if parts == 2:
        forces = np.concatenate([np.eye(3), -np.eye(3)])
        moments = np.cross((hinge_points_m - about_m)[:, None], forces)
        wrench = np.concatenate([np.broadcast_to(forces, moments.shape), moments], axis=2).reshape(-1, 6)
        columns.append(np.concatenate([-wrench, wrench], axis=1))
    matrix = np.concatenate(columns).T
    if not matrix.shape[1]:
        return float(np.linalg.norm(wanted))
    try:
        return float(nnls(matrix, wanted.reshape(-1))[1])
    except RuntimeError:  # no convergence: counted as not carried
        return np.inf


def needed_wrenches(
    bodies: dict[int, Masses], triple: np.ndarray, scale: float, weight: np.ndarray, about_m: np.ndarray
) -> np.ndarray:
    """(part, 6) sums of m (a - g) and of their moments about a point, a = ``scale`` x second difference.

    triple: (3,) the frame and its neighbours.
    """
    wrenches = []
    for body in bodies.values():
        before, now, after = body.place_m[triple]
        force = body.mass_kg[:, None] * (scale * (after - 2 * now + before) - weight)
        wrenches.append(np.concatenate([force.sum(axis=0), np.cross(now - about_m, force).sum(axis=0)]))
    return np.array(wrenches)


def vertex_masses(track: ObjectTrack) -> dict[int, Masses]:
    """By part a kilogram on every vertex."""
    model = track.model
    vertices = track.points_in_world(model.vertices_m, model.part)
    of = {part: np.flatnonzero((model.part == part) | (not model.is_articulated)) for part in model.parts}
    return {part: Masses(vertices[:, own], np.ones(len(own))) for part, own in of.items()}


def even_masses(track: ObjectTrack) -> dict[int, Masses]:
    """By part six points that move as its solid does, of even density and 1 kg together."""
    model, solids = track.model, {}
    for part in model.parts:
        solid = surface_index(model).solid_trees[part]
        solids[part] = mass_properties(solid.vertices_m, solid.corner)
    whole = sum(solid.volume_m3 for solid in solids.values())
    bodies = {}
    for part, solid in solids.items():
        spread = np.trace(solid.inertia_kg_m2) / 2 * np.eye(3) - solid.inertia_kg_m2  # per kg: mean of r r^T
        size, axes = np.linalg.eigh(spread)
        arms = (axes * np.sqrt(3 * size.clip(0))).T
        points = solid.centre_m + np.concatenate([arms, -arms])
        places = track.points_in_world(points, np.full(6, part, np.uint8))
        bodies[part] = Masses(places, np.full(6, solid.volume_m3 / whole / 6))
    return bodies


def _all_solid(model: ObjectModel) -> bool:
    return set(surface_index(model).solid_trees) == set(model.parts)


def _table(pair: Pair, frame: int, down: np.ndarray, table_m: float | None) -> list[Contacts]:
    """By part up to 20 vertices within 5 mm of the lowest one, or of a table top at a height, which pushes up."""
    track = pair.predicted.clip.object
    model = track.model
    vertices = _object_vertices_m(pair)[frame]
    heights = -vertices @ down
    found = np.flatnonzero(np.abs(heights - (heights.min() if table_m is None else table_m)) < TABLE_M)
    if len(found) > TABLE_POINTS:
        found = np.random.default_rng(frame).choice(found, TABLE_POINTS, replace=False)
    parts = model.part[found] if model.is_articulated else np.zeros(len(found), np.uint8)
    return [
        Contacts(vertices[found[parts == part]], np.tile(down, (int((parts == part).sum()), 1))) for part in model.parts
    ]


def _hinge_points(track: ObjectTrack, frame: int) -> np.ndarray:
    """(11, 3) world: evenly over the object's extent along its axis; none of a rigid object."""
    model = track.model
    if model.hinge is None or len(model.parts) < 2:
        return np.zeros((0, 3))
    along = (model.vertices_m - model.hinge.origin_m) @ model.hinge.axis
    points = model.hinge.origin_m + np.linspace(along.min(), along.max(), HINGE_POINTS)[:, None] * model.hinge.axis
    return track.world_from_object[frame] @ points


@lru_cache(maxsize=1)
def _object_vertices_m(pair: Pair) -> np.ndarray:
    model = pair.predicted.clip.object.model
    return pair.predicted.clip.object.points_in_world(model.vertices_m, model.part).astype(np.float64)


# --- torque about the hinge


def art_paper(pair: Pair, every: int) -> Values:
    """(frame with a hand in which the hinge turns,) 1 where both parts can be turned, in opposite senses, else 0."""
    return _turned(pair, every, paper=True)


def art_corrected(pair: Pair, every: int) -> Values:
    """(frame with a hand in which it turns by more than 0.002 rad,) the same with contacts of the exact surface."""
    return _turned(pair, every, paper=False)


def _turned(pair: Pair, every: int, paper: bool) -> Values:
    track = pair.predicted.clip.object
    hinge = track.model.hinge
    if hinge is None or track.hinge_rad is None or len(track.model.parts) < 2:
        return RIGID
    turning = turns_rad(track) > TURNED_PAPER_RAD if paper else turns(track)
    frames = np.flatnonzero(turning & pair.looked_at())[::every]
    contacts = _contacts(pair, paper) if len(frames) else {}
    turned = []
    for frame in frames:
        pose = track.world_from_object[int(frame)]
        axis, origin = pose.turn(hinge.axis[None])[0], (pose @ hinge.origin_m[None])[0]
        base, lid = (arm_range(contacts[frame][part], axis, origin) for part in (0, 1))
        needed = [ARM_SHARE * _mean_arm_m(track.model, part) for part in (0, 1)]
        opposite = base[1] > needed[0] and lid[0] < -needed[1]
        turned.append(opposite or (base[0] < -needed[0] and lid[1] > needed[1]))
    return np.array(turned, np.float64)


def arm_range(contacts: Contacts, axis: np.ndarray, origin_m: np.ndarray) -> tuple[float, float]:
    """Least and greatest moment about the axis of a unit force along an edge of any contact's cone; 0, 0 for none."""
    if not len(contacts.point_m):
        return 0.0, 0.0
    edges = cone_edges(contacts.normal, FRICTION)
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    moments = np.cross((contacts.point_m - origin_m)[:, None], edges) @ axis
    return float(moments.min()), float(moments.max())


def _mean_arm_m(model: ObjectModel, part: int) -> float:
    """Mean distance of a part's vertices from the hinge's axis."""
    assert model.hinge is not None
    way = model.vertices_m[model.part == part] - model.hinge.origin_m
    return float(np.linalg.norm(np.cross(way, model.hinge.axis), axis=1).mean())


# --- contacts


@lru_cache(maxsize=2)
def _contacts(pair: Pair, paper: bool) -> dict[int, dict[int, Contacts]]:
    """By frame and part, where the acting hands touch, world."""
    clip = pair.predicted.clip
    model, none = clip.object.model, np.zeros((0, 3))
    pieces = {frame: {part: [Contacts(none, none)] for part in model.parts} for frame in range(clip.n_frames)}
    touching = _touching_paper if paper else _touching_corrected
    for hand in placed_hands(pair):
        for part in model.parts:
            object_from_part = model.object_from_part(part, hand.hinge_rad)
            local = object_from_part.inverse() @ hand.vertices_m
            for row, points, normals in touching(hand, model, part, local):
                frame = int(hand.frames[row])
                pose = clip.object.world_from_object[frame] @ (
                    object_from_part if part == 0 or model.hinge is None else object_from_part[row]
                )
                pieces[frame][part].append(Contacts(pose @ points, pose.turn(normals)))
    return {
        frame: {part: Contacts(*map(np.concatenate, zip(*own, strict=True))) for part, own in parts.items()}
        for frame, parts in pieces.items()
    }


Touching = Iterator[tuple[int, np.ndarray, np.ndarray]]


def _touching_paper(hand: PlacedHand, model: ObjectModel, part: int, local_m: np.ndarray) -> Touching:
    """Row of the hand, vertices of the part nearest to hand vertices that touch, and their normals; part frame."""
    tree, normals, vertices = _vertex_tree(surface_index(model), part)
    near = part_depth_m(hand, model, part) > -TOUCH_M
    for row in np.flatnonzero(near.any(axis=1)):
        nearest = np.unique(tree.query(local_m[row, near[row]])[1])
        yield int(row), vertices[nearest], normals[nearest]


def _touching_corrected(hand: PlacedHand, model: ObjectModel, part: int, local_m: np.ndarray) -> Touching:
    """The same: places of the exact surface nearest to hand vertices within 2 mm of it, or up to 1 cm inside."""
    surface = surface_index(model).filled[part]
    depth = -surface.signed_m(local_m.reshape(-1, 3), TOUCH_M).reshape(local_m.shape[:2])
    near = (depth > -TOUCH_M) & (depth <= DEEP_M)
    for row in np.flatnonzero(near.any(axis=1)):
        found = surface.nearest(np.ascontiguousarray(local_m[row, near[row]]))
        yield int(row), found.closest_m, found.normal


@lru_cache(maxsize=64)
def _vertex_tree(index: SurfaceIndex, part: int) -> tuple[KDTree, np.ndarray, np.ndarray]:
    """Of a part's vertices: a tree of their places, outward normals, places; the part's rest frame."""
    faces = index.model.faces_of(part)
    used, own = np.unique(faces, return_inverse=True)
    vertices = np.ascontiguousarray(index.model.vertices_m[used], np.float64)
    normals = np.asarray(igl.per_vertex_normals(vertices, np.ascontiguousarray(own.reshape(-1, 3), np.int64)))
    return KDTree(vertices), normals, vertices
