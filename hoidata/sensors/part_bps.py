"""BimArt's input features (Zhang et al. 2024): part-wise basis point sets, distance maps and keypoints of hands.

A basis point set (Prokudin et al. 2019) encodes a shape by the vector from each of a few fixed points to the nearest
point of the shape. BimArt encodes each part of an object separately (Sec. 3.1, Eq. 1-3).

Rotating the moving part is equivalent to rotating the basis points the other way. Each basis point then moves on a
circle past fixed vertices. On a short arc only a few vertices can be the nearest one. These candidates are found once
per arc and object; the fixed base needs one query. Distances are compared in float64, so that the result equals that
of a k-d tree built from the vertices of each frame, except for ties.

All points are in the canonical frame of the object: hinge along -z through the origin, metres.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import KDTree

from hoidata.geometry.transform import IDENTITY, RigidTransform
from hoidata.hands import HandModel
from hoidata.objects.distance_grid import nearest_triangles
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import farthest_points
from hoidata.objects.surface_index import PartSurface, surface_index

Nearest = Literal["vertex", "surface"]
CanonicalFrame = Literal["axis", "base"]
MARGIN = 0.15  # d_margin of Eq. 1
ARC_RAD = np.deg2rad(3.0)
ROUNDING_M = 1e-6  # more than float32 loses in a distance of a metre
LANES, FAR_M = 16, 1e6
ON_AXIS_M = 1e-3  # a base whose centre is closer to the hinge axis than this has no direction about it


@dataclass(frozen=True)
class BasisSettings:
    """Basis points and the canonical frame they are in."""

    count: int = 512  # basis points per part, uniform in the unit ball
    seed: int = 0  # of the basis points
    # "vertex" as released; "surface" does not depend on how the surface is meshed.
    nearest: Nearest = "vertex"
    # "axis": the smallest rotation that brings the hinge to -z. "base": then also the centre of the base to +x.
    frame: CanonicalFrame = "axis"

    @property
    def places(self) -> int:
        """Number of basis points of all parts: those of the moving part first, then those of the base."""
        return 2 * self.count

    def points(self) -> np.ndarray:
        """(count, 3) float64 basis points in the unit ball."""
        rng = np.random.default_rng(self.seed)
        points = rng.normal(size=(self.count, 3))
        # A radius distributed as the cube root of a uniform number gives uniform density in the ball.
        points *= rng.uniform(size=(self.count, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
        return points


class NearestPoints(NamedTuple):
    """For each frame and basis point (``BasisSettings.places``), the nearest point of the object."""

    point_m: np.ndarray  # (frame, basis point, 3) float32 in the canonical frame
    offset: np.ndarray  # (frame, basis point, 3) float32 vector from the basis point, scaled (Eq. 2)
    vertex: np.ndarray  # (frame, basis point) vertex index; -1 for a point of the surface
    is_present: np.ndarray  # (basis point,) bool, False for a part that the object does not have


def canonical_object(model: ObjectModel, frame: CanonicalFrame = "axis") -> tuple[ObjectModel, RigidTransform]:
    """Move an object to its canonical frame.

    With a joint, z points against its axis. The origin is the point of a hinge axis nearest to the surface centre, and
    the surface centre itself for a prismatic joint. A hinge along -z through the origin is not moved (frame "axis"). A
    rigid object keeps its axes; its surface centre becomes the origin. Returns the object in the canonical frame, and
    ``object_from_canonical``.
    """
    origin, rotation = _surface_centre_m(model.vertices_m, model.faces), np.eye(3)
    if model.hinge is not None:
        axis = np.asarray(model.hinge.axis, np.float64)
        on_axis = origin if model.hinge.is_prismatic else np.asarray(model.hinge.origin_m, np.float64)
        origin = on_axis + axis * ((origin - on_axis) @ axis)
        rotation = _rotation_from_minus_z(axis)
        if frame == "axis" and np.array_equal(axis, (0, 0, -1)) and not on_axis.any():
            return model, IDENTITY
        if frame == "base":
            base_centre = _surface_centre_m(model.vertices_m, model.faces_of(0))
            rotation = rotation @ _rotation_about_z((base_centre - origin) @ rotation)
    object_from_canonical = RigidTransform(rotation, origin)
    vertices = object_from_canonical.inverse() @ np.asarray(model.vertices_m, np.float64)
    hinge = None
    if model.hinge is not None:
        hinge = replace(model.hinge, axis=np.array([0.0, 0.0, -1.0]), origin_m=np.zeros(3))
    return replace(model, vertices_m=vertices, hinge=hinge), object_from_canonical


def _surface_centre_m(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(3,) centroid of a surface, weighted by area, so that it does not depend on the mesh density."""
    corners = np.asarray(vertices_m, np.float64)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.average(corners.mean(axis=1), axis=0, weights=area if area.sum() > 0 else None)


def _rotation_from_minus_z(axis: np.ndarray) -> np.ndarray:
    """(3, 3) smallest rotation that takes -z to the unit vector ``axis`` (Rodrigues' formula)."""
    cosine = -axis[2]
    if cosine < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, 0, -axis[0]], [0, 0, -axis[1]], [axis[0], axis[1], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def _rotation_about_z(direction_m: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about z that takes +x to ``direction_m``; the identity if that is on the axis."""
    radius = np.hypot(direction_m[0], direction_m[1])
    if radius < ON_AXIS_M:
        return np.eye(3)
    cosine, sine = direction_m[0] / radius, direction_m[1] / radius
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def object_scale(model: ObjectModel) -> float:
    """s_o of Eq. 1, per metre: it scales a canonical object into the unit ball at any hinge angle."""
    return (1 - MARGIN) / float(np.linalg.norm(model.vertices_m, axis=1).max())


class PartBps:
    """Part-wise basis point sets of one canonical object; what does not depend on the hinge angle is computed once."""

    def __init__(self, model: ObjectModel, settings: BasisSettings) -> None:
        self.model, self.settings = model, settings
        self.scale = object_scale(model)
        self.points_m = settings.points() / self.scale
        self.vertices = {part: _PartVertices(model, part, self.points_m) for part in model.parts}
        surfaces = surface_index(model).filled if settings.nearest == "surface" else {}
        self.surfaces: dict[int, PartSurface] = surfaces

    def nearest_points(self, hinge_rad: np.ndarray) -> NearestPoints:
        """The point nearest to each basis point at hinge angles (frame,); zeros for a rigid object."""
        angles = np.asarray(hinge_rad, np.float64)
        part_points = {part: self._nearest_of_part(part, angles) for part in self.model.parts}
        shape = len(angles), len(self.points_m)
        absent = np.zeros((*shape, 3)), np.full(shape, -1, np.int32)
        both = [part_points.get(part, absent) for part in (1, 0)]
        point, vertex = (np.concatenate(arrays, axis=1) for arrays in zip(*both, strict=True))
        is_present = np.repeat([part in part_points for part in (1, 0)], shape[1])
        offset = np.where(is_present[:, None], (point - np.tile(self.points_m, (2, 1))) * self.scale, 0.0)
        return NearestPoints(point.astype(np.float32), offset.astype(np.float32), vertex, is_present)

    def nearest_m(self, positions_m: np.ndarray, hinge_rad: np.ndarray) -> np.ndarray:
        """(frame, position, 3) the point of the object nearest to each of ``positions_m``, of either part."""
        positions, angles = np.asarray(positions_m, np.float64), np.asarray(hinge_rad, np.float64)
        candidates = []
        for part, vertices in self.vertices.items():
            object_from_part = self.model.object_from_part(part, angles)
            queries = object_from_part.inverse() @ positions
            if self.settings.nearest == "surface":
                point = _nearest_on_surface(self.surfaces[part], queries)
            else:
                point = vertices.vertices_m[vertices.tree.query(queries)[1]]
            candidates.append(object_from_part @ point)
        nearest = np.argmin([((point - positions) ** 2).sum(-1) for point in candidates], axis=0)
        return np.take_along_axis(np.stack(candidates), nearest[None, ..., None], axis=0)[0]

    def _nearest_of_part(self, part: int, hinge_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest points (frame, basis point, 3) of one part, and their vertex indices (frame, basis point)."""
        moves = part == 1 and self.model.is_articulated
        object_from_part = self.model.object_from_part(part, hinge_rad if moves else None)
        queries = object_from_part.inverse() @ self.points_m
        queries = np.ascontiguousarray(queries if moves else queries[None])
        if self.settings.nearest == "vertex":
            vertex, point = self.vertices[part].nearest(queries, hinge_rad if moves else np.zeros(1))
        else:
            point = _nearest_on_surface(self.surfaces[part], queries)
            vertex = np.full(queries.shape[:2], -1, np.int32)
        shape = len(hinge_rad), len(self.points_m)
        return np.broadcast_to(object_from_part @ point, (*shape, 3)), np.broadcast_to(vertex, shape)


def _nearest_on_surface(surface: PartSurface, positions_m: np.ndarray) -> np.ndarray:
    """The points of a part's surface nearest to positions (frame, position, 3), rest frame."""
    queries = np.ascontiguousarray(positions_m.reshape(-1, 3))
    closest, triangle = np.empty_like(queries), np.zeros(len(queries), np.int64)
    nearest_triangles(surface.tree, queries, surface.distance_m(queries), closest, triangle)
    return closest.reshape(positions_m.shape)


class _PartVertices:
    """The vertices of one part, and per arc of the hinge the candidates for the vertex nearest to each basis point."""

    def __init__(self, model: ObjectModel, part: int, points_m: np.ndarray) -> None:
        self.ids = np.flatnonzero(model.part == part) if model.is_articulated else np.arange(len(model.vertices_m))
        self.vertices_m = np.ascontiguousarray(model.vertices_m[self.ids], np.float64)
        self.is_prismatic = model.hinge is not None and model.hinge.is_prismatic
        self.object_from_part = lambda angle: model.object_from_part(part, np.array([angle]))
        self.points_m, self.moves = points_m, part == 1 and model.is_articulated
        # Coordinates in LANES rows, so that the compiler vectorises the search; the padding is far from everything.
        lanes_m = np.full((3, LANES * -(-len(self.ids) // LANES)), FAR_M, np.float32)
        lanes_m[:, : len(self.ids)] = self.vertices_m.T
        self.lanes_m = lanes_m.reshape(3, LANES, -1)
        self.arcs: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.vertices_m)

    def nearest(self, queries_m: np.ndarray, hinge_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest vertex index (frame, point) and its position (frame, point, 3), rest frame.

        queries_m: (frame, point, 3) basis points, rotated back by the hinge angles. hinge_rad: (frame,) hinge angles.
        """
        arcs, vertex = np.floor(hinge_rad / ARC_RAD).astype(int), np.empty(queries_m.shape[:2], np.int32)
        for arc in np.unique(arcs).tolist():
            frames = np.flatnonzero(arcs == arc)
            _nearest_candidate(self.vertices_m, *self._candidates(arc), queries_m, frames, vertex)
        return self.ids[vertex], self.vertices_m[vertex]

    def _candidates(self, arc: int) -> tuple[np.ndarray, np.ndarray]:
        """Candidate vertices on an arc, one run per basis point, and the start of each run (point + 1,)."""
        if arc not in self.arcs:
            middle = self.object_from_part((arc + 0.5) * ARC_RAD).inverse() @ self.points_m
            radius = np.hypot(self.points_m[:, 0], self.points_m[:, 1]) if self.moves else np.zeros(len(middle))
            # The nearest distance changes by at most the chord from the middle of the arc to its end, in both terms.
            # On a slide, an arc is a way of as many metres.
            slack_m = np.full_like(radius, ARC_RAD) if self.is_prismatic else 4 * radius * np.sin(ARC_RAD / 4)
            points = middle.reshape(-1, 3).astype(np.float32)
            self.arcs[arc] = _vertices_within(self.lanes_m, len(self.ids), points, slack_m + ROUNDING_M)
        return self.arcs[arc]


@njit(cache=True)
def _vertices_within(lanes_m, count, points_m, slack_m):  # pragma: no cover (compiled)
    """Vertices at most ``slack_m`` (point,) farther from each point than the nearest one; and where each run starts.

    lanes_m: (3, LANES, column) coordinates of ``count`` vertices, row by row, then padding. Only columns whose smallest
    squared distance is within the limit are searched lane by lane.
    """
    columns = lanes_m.shape[2]
    square, column_least = np.empty((LANES, columns), np.float32), np.empty(columns, np.float32)
    first, vertices, size = np.zeros(len(points_m) + 1, np.int64), np.empty(64 * len(points_m), np.int32), 0
    for point in range(len(points_m)):
        x, y, z = points_m[point]
        column_least[:] = np.inf
        for lane in range(LANES):
            xs, ys, zs, lane_square = lanes_m[0, lane], lanes_m[1, lane], lanes_m[2, lane], square[lane]
            for column in range(columns):
                dx, dy, dz = xs[column] - x, ys[column] - y, zs[column] - z
                lane_square[column] = dx * dx + dy * dy + dz * dz
                column_least[column] = (
                    lane_square[column] if lane_square[column] < column_least[column] else column_least[column]
                )
        limit = np.float32((np.sqrt(column_least.min()) + slack_m[point]) ** 2)
        if size + count > len(vertices):
            grown = np.empty(2 * len(vertices) + count, np.int32)
            grown[:size] = vertices[:size]
            vertices = grown
        for column in range(columns):
            if column_least[column] <= limit:
                for lane in range(LANES):
                    if square[lane, column] <= limit:
                        vertices[size] = lane * columns + column
                        size += 1
        first[point + 1] = size
    return vertices[:size].copy(), first


@njit(cache=True)
def _nearest_candidate(vertices_m, candidates, first, queries_m, frames, nearest):  # pragma: no cover (compiled)
    """Set ``nearest (frame, point)`` to the closest candidate of each point; of equal ones the lowest index."""
    for frame in frames:
        for point in range(queries_m.shape[1]):
            x, y, z = queries_m[frame, point]
            best, best_vertex = np.inf, 0
            for index in range(first[point], first[point + 1]):
                vertex = candidates[index]
                dx, dy, dz = vertices_m[vertex, 0] - x, vertices_m[vertex, 1] - y, vertices_m[vertex, 2] - z
                square = dx * dx + dy * dy + dz * dz
                if square < best or (square == best and vertex < best_vertex):
                    best, best_vertex = square, vertex
            nearest[frame, point] = best_vertex


def distance_map(points_m: np.ndarray, hand_m: np.ndarray) -> np.ndarray:
    """BimArt's contact map of one hand (Eq. 4): distance from each object point to the nearest hand point.

    Args:
        points_m: (frame, point, 3) object points, in the same frame of reference as the hand.
        hand_m: (frame, hand point, 3).

    Returns (frame, point) float32, metres.
    """
    points = np.ascontiguousarray(np.swapaxes(points_m, 1, 2), np.float32)
    return np.sqrt(_least_squared_distances(points, np.ascontiguousarray(hand_m, np.float32)))


@njit(cache=True, fastmath={"contract"})
def _least_squared_distances(points_m, hand_m):  # pragma: no cover (compiled)
    """(frame, point) smallest squared distance, by brute force: faster than a tree over 778 vectorised hand points.

    The inner loop takes four hand points at a time, so that object points are read a quarter as often.
    """
    squares = np.full((len(points_m), points_m.shape[2]), np.float32(np.inf), np.float32)
    last = hand_m.shape[1] - 1
    for frame in range(len(points_m)):
        best, xs, ys, zs = squares[frame], points_m[frame, 0], points_m[frame, 1], points_m[frame, 2]
        hand = hand_m[frame]
        for hand_point in range(0, last + 1, 4):
            second, third, fourth = min(hand_point + 1, last), min(hand_point + 2, last), min(hand_point + 3, last)
            ax, ay, az = hand[hand_point, 0], hand[hand_point, 1], hand[hand_point, 2]
            bx, by, bz = hand[second, 0], hand[second, 1], hand[second, 2]
            cx, cy, cz = hand[third, 0], hand[third, 1], hand[third, 2]
            dx, dy, dz = hand[fourth, 0], hand[fourth, 1], hand[fourth, 2]
            for point in range(len(best)):
                x, y, z = xs[point], ys[point], zs[point]
                a = (x - ax) * (x - ax) + (y - ay) * (y - ay) + (z - az) * (z - az)
                b = (x - bx) * (x - bx) + (y - by) * (y - by) + (z - bz) * (z - bz)
                c = (x - cx) * (x - cx) + (y - cy) * (y - cy) + (z - cz) * (z - cz)
                d = (x - dx) * (x - dx) + (y - dy) * (y - dy) + (z - dz) * (z - dz)
                a, c = a if a < b else b, c if c < d else d
                a = a if a < c else c
                best[point] = a if a < best[point] else best[point]
    return squares


def hand_keypoints(model: HandModel, count: int) -> np.ndarray:
    """Choose keypoints by farthest point sampling in each segment.

    A segment is the vertices with the same joint of largest skin weight. Each segment gets at least one keypoint and
    otherwise a number in proportion to its vertices (largest remainder method). Both sides use the same vertices.
    Returns (count,) vertex indices, ascending.
    """
    segment = model.skin_weights.argmax(axis=1)
    segments = [np.flatnonzero(segment == joint) for joint in np.unique(segment)]
    sizes = np.array([len(vertices) for vertices in segments])
    quotas = np.maximum(1, np.floor(count * sizes / sizes.sum())).astype(int)
    while quotas.sum() != count:
        remainder = np.where(quotas < sizes, count * sizes / sizes.sum() - quotas, -np.inf)
        remainder = remainder if quotas.sum() < count else np.where(quotas > 1, -remainder, -np.inf)
        quotas[remainder.argmax()] += 1 if quotas.sum() < count else -1
    chosen = [
        vertices[farthest_points(model.template_m[vertices], quota)]
        for vertices, quota in zip(segments, quotas, strict=True)
    ]
    return np.sort(np.concatenate(chosen))
