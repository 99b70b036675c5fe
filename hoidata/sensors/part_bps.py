"""What BimArt sees of an object and of hands at it: part-wise basis point sets, distance maps (Zhang et al. 2024).

A basis point set (Prokudin et al. 2019) says of each of a few fixed points where the object is nearest to it; BimArt
asks each part of its own (Sec. 3.1, eq. 1-3). Turning the moving part is the same as turning the points back, so every
point walks on a circle past vertices that never move: a few of them are all that can be nearest on a short arc, and are
found once for each arc and object. The base is asked once. Distances are compared in float64: what is found is what a
k-d tree of every frame's vertices finds, ties aside.

Everything is in the canonical frame: hinge along -z through the origin, metres, the same in any world.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import KDTree

from hoidata.geometry.transform import IDENTITY, RigidTransform
from hoidata.objects.distance_grid import nearest_triangles
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.objects.surface_index import PartSurface, surface_index

Nearest = Literal["vertex", "surface"]
CanonicalFrame = Literal["axis", "base"]
MARGIN = 0.15  # d_margin of eq. 1
ARC_RAD = np.deg2rad(3.0)
ROUNDING_M = 1e-6  # more than float32 loses in a distance of a metre
LANES, FAR_M = 16, 1e6
ON_AXIS_M = 1e-3  # a base whose middle is nearer to the axis than this has no direction about it


@dataclass(frozen=True)
class BasisSettings:
    """count: points per part; drawn uniformly in the unit ball from ``seed``.

    nearest: mesh vertices (released) or the surface itself, with which meshes of other density mean the same.
    frame: of objects whose hinge is not yet along -z through the origin: "axis" turns it there the shortest way;
    "base" turns every object further, the middle of its base to +x.
    """

    count: int = 512
    seed: int = 0
    nearest: Nearest = "vertex"
    frame: CanonicalFrame = "axis"

    @property
    def places(self) -> int:
        """How many places of an object are looked at: top part first, then the base."""
        return 2 * self.count

    def points(self) -> np.ndarray:
        """(count, 3) float64 basis points in the unit ball."""
        draws = np.random.default_rng(self.seed)
        ways = draws.normal(size=(self.count, 3))
        ways *= draws.uniform(size=(self.count, 1)) ** (1 / 3) / np.linalg.norm(ways, axis=1, keepdims=True)
        return ways


class Seen(NamedTuple):
    """What basis points see of an object, frame by frame.

    place_m: (frame, place, 3) float32 nearest places, canonical frame, metres. offset: (frame, place, 3) float32 the
    way there from the basis point, scaled (eq. 2). vertex: (frame, place) which vertex that is, -1 where it is none.
    there: (place,) bool, False for those of a part that the object does not have.
    """

    place_m: np.ndarray
    offset: np.ndarray
    vertex: np.ndarray
    there: np.ndarray


def canonical_object(model: ObjectModel, frame: CanonicalFrame = "axis") -> tuple[ObjectModel, RigidTransform]:
    """The object in its canonical frame, and ``object_from_canonical``.

    With a hinge: z against its axis, the origin on it nearest to the surface's middle; kept as it is where the axis is
    -z through the origin already (frame "axis"). Without one: its own axes, the origin in the middle of the surface.
    """
    origin, rotation = _middle_m(model.vertices_m, model.faces), np.eye(3)
    if model.hinge is not None:
        down = np.asarray(model.hinge.axis, np.float64)
        on_axis = np.asarray(model.hinge.origin_m, np.float64)
        origin = on_axis + down * ((origin - on_axis) @ down)
        rotation = _turn_to(down)
        if frame == "axis" and np.array_equal(down, (0, 0, -1)) and not on_axis.any():
            return model, IDENTITY
        if frame == "base":
            rotation = rotation @ _about_z((_middle_m(model.vertices_m, model.faces_of(0)) - origin) @ rotation)
    object_from_canonical = RigidTransform(rotation, origin)
    vertices = object_from_canonical.inverse() @ np.asarray(model.vertices_m, np.float64)
    hinge = None if model.hinge is None else Hinge(np.array([0.0, 0.0, -1.0]), np.zeros(3))
    return replace(model, vertices_m=vertices, hinge=hinge), object_from_canonical


def _middle_m(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(3,) centre of a surface; it does not depend on how finely it is meshed."""
    corners = np.asarray(vertices_m, np.float64)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.average(corners.mean(axis=1), axis=0, weights=area if area.sum() > 0 else None)


def _turn_to(down: np.ndarray) -> np.ndarray:
    """(3, 3) the smallest rotation that takes -z to ``down``, of length 1."""
    cosine = -down[2]
    if cosine < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, 0, -down[0]], [0, 0, -down[1]], [down[0], down[1], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def _about_z(way: np.ndarray) -> np.ndarray:
    """(3, 3) turn about z that takes +x to the direction of ``way`` across z; none where that is next to nothing."""
    across = np.hypot(way[0], way[1])
    if across < ON_AXIS_M:
        return np.eye(3)
    cosine, sine = way[0] / across, way[1] / across
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def object_scale(model: ObjectModel) -> float:
    """s_o of eq. 1, per metre: what brings a canonical object into the unit ball, at any angle of its hinge."""
    return (1 - MARGIN) / float(np.linalg.norm(model.vertices_m, axis=1).max())


class PartBps:
    """One canonical object as basis points see it: the static structures, made once."""

    def __init__(self, model: ObjectModel, settings: BasisSettings) -> None:
        self.model, self.settings = model, settings
        self.scale = object_scale(model)
        self.points_m = settings.points() / self.scale
        self.vertices = {part: _PartVertices(model, part, self.points_m) for part in model.parts}
        surfaces = surface_index(model).filled if settings.nearest == "surface" else {}
        self.surfaces: dict[int, PartSurface] = surfaces

    def look(self, hinge_rad: np.ndarray) -> Seen:
        """The nearest places at hinge angles (frame,), zeros for a rigid object."""
        angles = np.asarray(hinge_rad, np.float64)
        found = {part: self._of_part(part, angles) for part in self.model.parts}
        shape = len(angles), len(self.points_m)
        nothing = np.zeros((*shape, 3)), np.full(shape, -1, np.int32)
        both = [found.get(part, nothing) for part in (1, 0)]
        place, vertex = (np.concatenate(kind, axis=1) for kind in zip(*both, strict=True))
        there = np.repeat([part in found for part in (1, 0)], shape[1])
        offset = np.where(there[:, None], (place - np.tile(self.points_m, (2, 1))) * self.scale, 0.0)
        return Seen(place.astype(np.float32), offset.astype(np.float32), vertex, there)

    def nearest_m(self, positions_m: np.ndarray, hinge_rad: np.ndarray) -> np.ndarray:
        """(frame, position, 3) the place of the object nearest to each position, of whichever part."""
        positions, angles = np.asarray(positions_m, np.float64), np.asarray(hinge_rad, np.float64)
        found = []
        for part, own in self.vertices.items():
            object_from_part = self.model.object_from_part(part, angles)
            asked = object_from_part.inverse() @ positions
            if self.settings.nearest == "surface":
                place = _on_surface(self.surfaces[part], asked)
            else:
                place = own.vertices_m[own.tree.query(asked)[1]]
            found.append(object_from_part @ place)
        nearest = np.argmin([((place - positions) ** 2).sum(-1) for place in found], axis=0)
        return np.take_along_axis(np.stack(found), nearest[None, ..., None], axis=0)[0]

    def _of_part(self, part: int, hinge_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest places (frame, point, 3) of one part, and which vertices (frame, point) they are."""
        moves = part == 1 and self.model.is_articulated
        object_from_part = self.model.object_from_part(part, hinge_rad if moves else None)
        asked = object_from_part.inverse() @ self.points_m
        asked = np.ascontiguousarray(asked if moves else asked[None])
        if self.settings.nearest == "vertex":
            vertex, place = self.vertices[part].nearest(asked, hinge_rad if moves else np.zeros(1))
        else:
            place = _on_surface(self.surfaces[part], asked)
            vertex = np.full(asked.shape[:2], -1, np.int32)
        shape = len(hinge_rad), len(self.points_m)
        return np.broadcast_to(object_from_part @ place, (*shape, 3)), np.broadcast_to(vertex, shape)


def _on_surface(surface: PartSurface, positions_m: np.ndarray) -> np.ndarray:
    """The places of a part's surface nearest to positions (frame, position, 3), rest frame."""
    asked = np.ascontiguousarray(positions_m.reshape(-1, 3))
    closest, triangle = np.empty_like(asked), np.zeros(len(asked), np.int64)
    nearest_triangles(surface.tree, asked, surface.distance_m(asked), closest, triangle)
    return closest.reshape(positions_m.shape)


class _PartVertices:
    """The vertices of one part, and for every arc of the hinge which of them can be nearest to each basis point."""

    def __init__(self, model: ObjectModel, part: int, points_m: np.ndarray) -> None:
        self.row = np.flatnonzero(model.part == part) if model.is_articulated else np.arange(len(model.vertices_m))
        self.vertices_m = np.ascontiguousarray(model.vertices_m[self.row], np.float64)
        self.object_from_part = lambda angle: model.object_from_part(part, np.array([angle]))
        self.points_m, self.moves = points_m, part == 1 and model.is_articulated
        lanes_m = np.full((3, LANES * -(-len(self.row) // LANES)), FAR_M, np.float32)
        lanes_m[:, : len(self.row)] = self.vertices_m.T
        self.lanes_m = lanes_m.reshape(3, LANES, -1)
        self.arcs: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.vertices_m)

    def nearest(self, places_m: np.ndarray, hinge_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The nearest vertex (frame, point) and where it is (frame, point, 3), rest frame.

        places_m: (frame, point, 3) the basis points turned back by the angles (frame,) of the hinge.
        """
        arcs, found = np.floor(hinge_rad / ARC_RAD).astype(int), np.empty(places_m.shape[:2], np.int32)
        for arc in np.unique(arcs).tolist():
            own = np.flatnonzero(arcs == arc)
            _nearest_of(self.vertices_m, *self._arc(arc), places_m, own, found)
        return self.row[found], self.vertices_m[found]

    def _arc(self, arc: int) -> tuple[np.ndarray, np.ndarray]:
        """The vertices (found,) that can be nearest on an arc, point by point, and where each point's start."""
        if arc not in self.arcs:
            middle = self.object_from_part((arc + 0.5) * ARC_RAD).inverse() @ self.points_m
            radius = np.hypot(self.points_m[:, 0], self.points_m[:, 1]) if self.moves else np.zeros(len(middle))
            away = 4 * radius * np.sin(ARC_RAD / 4)  # twice the chord from the middle of the arc to its end
            points = middle.reshape(-1, 3).astype(np.float32)
            self.arcs[arc] = _can_be_nearest(self.lanes_m, len(self.row), points, away + ROUNDING_M)
        return self.arcs[arc]


@njit(cache=True)
def _can_be_nearest(lanes_m, count, points_m, away_m):  # pragma: no cover (compiled)
    """Vertices at most ``away_m`` (point,) farther from each point than the nearest, and where each point's start.

    lanes_m: (3, LANES, column) coordinates of ``count`` vertices, row by row, then padding that is far from everything.
    Only columns whose least square is small enough are looked at again.
    """
    columns = lanes_m.shape[2]
    square, least_of = np.empty((LANES, columns), np.float32), np.empty(columns, np.float32)
    first, kept, size = np.zeros(len(points_m) + 1, np.int64), np.empty(64 * len(points_m), np.int32), 0
    for point in range(len(points_m)):
        x, y, z = points_m[point]
        least_of[:] = np.inf
        for lane in range(LANES):
            xs, ys, zs, own = lanes_m[0, lane], lanes_m[1, lane], lanes_m[2, lane], square[lane]
            for column in range(columns):
                dx, dy, dz = xs[column] - x, ys[column] - y, zs[column] - z
                own[column] = dx * dx + dy * dy + dz * dz
                least_of[column] = own[column] if own[column] < least_of[column] else least_of[column]
        limit = np.float32((np.sqrt(least_of.min()) + away_m[point]) ** 2)
        if size + count > len(kept):
            grown = np.empty(2 * len(kept) + count, np.int32)
            grown[:size] = kept[:size]
            kept = grown
        for column in range(columns):
            if least_of[column] <= limit:
                for lane in range(LANES):
                    if square[lane, column] <= limit:
                        kept[size] = lane * columns + column
                        size += 1
        first[point + 1] = size
    return kept[:size].copy(), first


@njit(cache=True)
def _nearest_of(vertices_m, rows, first, places_m, frames, found):  # pragma: no cover (compiled)
    """Write the nearest of each point's own vertices; among equals the lowest."""
    for frame in frames:
        for point in range(places_m.shape[1]):
            x, y, z = places_m[frame, point]
            best, nearest = np.inf, 0
            for place in range(first[point], first[point + 1]):
                row = rows[place]
                dx, dy, dz = vertices_m[row, 0] - x, vertices_m[row, 1] - y, vertices_m[row, 2] - z
                square = dx * dx + dy * dy + dz * dz
                if square < best or (square == best and row < nearest):
                    best, nearest = square, row
            found[frame, point] = nearest


def distance_map(places_m: np.ndarray, hand_m: np.ndarray) -> np.ndarray:
    """(frame, place) float32 distance of places (frame, place, 3) to the nearest point of a hand (frame, point, 3).

    BimArt's contact map of one hand (eq. 4), metres; both in one frame.
    """
    places = np.ascontiguousarray(np.swapaxes(places_m, 1, 2), np.float32)
    return np.sqrt(_least_squares(places, np.ascontiguousarray(hand_m, np.float32)))


@njit(cache=True, fastmath={"contract"})
def _least_squares(places_m, hand_m):  # pragma: no cover (compiled)
    """(frame, place) square of the distance; every pair, many places at a time: no tree over 778 points is as fast.

    Four points of the hand at once, so that places are read a quarter as often.
    """
    squares = np.full((len(places_m), places_m.shape[2]), np.float32(np.inf), np.float32)
    last = hand_m.shape[1] - 1
    for frame in range(len(places_m)):
        best, xs, ys, zs = squares[frame], places_m[frame, 0], places_m[frame, 1], places_m[frame, 2]
        hand = hand_m[frame]
        for point in range(0, last + 1, 4):
            second, third, fourth = min(point + 1, last), min(point + 2, last), min(point + 3, last)
            ax, ay, az = hand[point, 0], hand[point, 1], hand[point, 2]
            bx, by, bz = hand[second, 0], hand[second, 1], hand[second, 2]
            cx, cy, cz = hand[third, 0], hand[third, 1], hand[third, 2]
            dx, dy, dz = hand[fourth, 0], hand[fourth, 1], hand[fourth, 2]
            for place in range(len(best)):
                x, y, z = xs[place], ys[place], zs[place]
                a = (x - ax) * (x - ax) + (y - ay) * (y - ay) + (z - az) * (z - az)
                b = (x - bx) * (x - bx) + (y - by) * (y - by) + (z - bz) * (z - bz)
                c = (x - cx) * (x - cx) + (y - cy) * (y - cy) + (z - cz) * (z - cz)
                d = (x - dx) * (x - dx) + (y - dy) * (y - dy) + (z - dz) * (z - dz)
                a, c = a if a < b else b, c if c < d else d
                a = a if a < c else c
                best[place] = a if a < best[place] else best[place]
    return squares
