"""Samples the points that represent an object in contact maps and networks: evenly, and equal on all machines.

Farthest-point sampling (Eldar et al. 1997; PointNet++) as Text2HOI does it, over the mesh vertices where they are dense
enough, else over a dense area-uniform sample of the surface. Points are in buckets; only buckets that the newest choice
can affect are visited (Han et al. 2023, "QuickFPS"). Compiled with numba. Squared distances are in float32 in one fixed
order, so that every point keeps the bits a plain loop gives it.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit

from hoidata.errors import BadInput
from hoidata.geometry.rows import distinct_rows
from hoidata.objects.distance import face_normals
from hoidata.objects.model import SEAM, ObjectModel

POINT_COUNT = 1024
LONGEST_EDGE_M = 0.02
DENSE_FACTOR = 32
# Roberts' R2 sequence: powers of 1/p, p the plastic number (the real root of p^3 = p + 1).
PLASTIC = 1.3247179572447460
_POINTS_PER_BUCKET = 128
_ROUNDING = np.float32(1 - 1e-5)  # a bound from box corners rounds differently from a distance
SamplingMethod = Literal["vertices-fps", "surface-fps"]


@dataclass(frozen=True)
class SampledPoints:
    """Points on an object's surface, in the object frame at hinge angle 0."""

    points_m: np.ndarray  # (point, 3) float32
    normals: np.ndarray  # (point, 3) float32, unit
    face: np.ndarray  # (point,) int32, the triangle with the point
    barycentric: np.ndarray  # (point, 3) float32, coordinates in that triangle
    part: np.ndarray  # (point,) uint8, 1 if the hinge moves the point
    method: SamplingMethod

    def __len__(self) -> int:
        return len(self.points_m)


def sample_points(model: ObjectModel, count: int = POINT_COUNT) -> SampledPoints:
    """Sample ``count`` points of the object in farthest-point order.

    If at least ``count`` distinct vertices are on faces and no edge is longer than 2 cm, the candidates are the
    vertices, starting at the first ("vertices-fps"). Otherwise they are ``32 count`` points spread over the faces in
    proportion to area ("surface-fps"). The latter excludes triangles that span both parts of a hinged object.

    Raises:
        BadInput: the mesh has no area.
    """
    corners = np.asarray(model.vertices_m, dtype=np.float64)[model.faces]
    if not len(corners) or not np.linalg.norm(_face_cross(corners), axis=1).any():
        raise BadInput(f"mesh of {model.name!r}", "faces with area", f"{len(corners)} faces without", "repair the mesh")
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    distinct = distinct_rows(model.vertices_m[np.unique(model.faces)]).first
    if len(distinct) >= count and edges.max() <= LONGEST_EDGE_M:
        return _from_vertices(model, count)
    return _from_surface(model, corners, count)


def _from_vertices(model: ObjectModel, count: int) -> SampledPoints:
    on_faces = np.unique(model.faces)
    chosen = on_faces[farthest_points(model.vertices_m[on_faces], count)]
    face, corner = _incident_face(model, chosen)
    return SampledPoints(
        points_m=model.vertices_m[chosen].astype(np.float32),
        normals=_vertex_normals(model)[chosen].astype(np.float32),
        face=face.astype(np.int32),
        barycentric=np.eye(3, dtype=np.float32)[corner],
        part=model.part[chosen].astype(np.uint8),
        method="vertices-fps",
    )


def _incident_face(model: ObjectModel, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first face at each vertex (of the vertex's part, if any), and the index of its corner."""
    vertex = model.faces.reshape(-1)
    face, corner = np.divmod(np.arange(len(vertex)), 3)
    other_part = model.face_part[face] != model.part[vertex]
    order = np.lexsort((face, other_part, vertex))
    first = order[np.searchsorted(vertex[order], vertices)]
    return face[first], corner[first]


def _vertex_normals(model: ObjectModel) -> np.ndarray:
    """(vertex, 3) unit normals: angle-weighted face normals; coinciding vertices share a normal."""
    corners = np.asarray(model.vertices_m, dtype=np.float64)[model.faces]
    ahead = _unit(np.roll(corners, -1, axis=1) - corners)
    behind = _unit(np.roll(corners, 1, axis=1) - corners)
    angle = np.arccos(np.clip((ahead * behind).sum(axis=2), -1, 1))
    weighted = angle[:, :, None] * face_normals(model.vertices_m, model.faces)[:, None]
    keys = np.column_stack([model.vertices_m, model.part])
    group = distinct_rows(keys).number
    total = np.zeros((len(keys), 3))
    np.add.at(total, group[model.faces.reshape(-1)], weighted.reshape(-1, 3))
    return _unit(total)[group]


def _from_surface(model: ObjectModel, corners: np.ndarray, count: int) -> SampledPoints:
    # Collapse seam triangles, so that they have no area and get no point.
    corners = np.where((model.face_part == SEAM)[:, None, None], corners[:, :1], corners)
    face, barycentric = _spread_over_faces(corners, DENSE_FACTOR * count)
    dense = np.einsum("pc,pcx->px", barycentric, corners[face])
    chosen = farthest_points(dense, count)
    face = face[chosen]
    return SampledPoints(
        points_m=dense[chosen].astype(np.float32),
        normals=face_normals(model.vertices_m, model.faces)[face].astype(np.float32),
        face=face.astype(np.int32),
        barycentric=barycentric[chosen].astype(np.float32),
        part=model.face_part[face],
        method="surface-fps",
    )


def _spread_over_faces(corners: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Systematic sampling by area, with barycentric coordinates from the R2 sequence."""
    area = np.cumsum(np.linalg.norm(_face_cross(corners), axis=1))
    step = np.arange(count)
    face = np.searchsorted(area, (step + 0.5) / count * area[-1], side="right")
    u, v = (0.5 + (step[None] + 1) * np.array([[1 / PLASTIC], [1 / PLASTIC**2]])) % 1
    is_outside = u + v > 1
    # Fold the unit square onto the triangle u + v <= 1.
    u, v = np.where(is_outside, 1 - u, u), np.where(is_outside, 1 - v, v)
    return face, np.column_stack([1 - u - v, u, v])


def _face_cross(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def farthest_points(points_m: np.ndarray, count: int) -> np.ndarray:
    """(count,) indices of points (point, 3): the first point, then each time the one farthest from all chosen ones.

    Squared distances are float32, and the lowest index wins a tie. Indices repeat only when points coincide.
    """
    points = np.ascontiguousarray(points_m, dtype=np.float32)
    order, first = _buckets(points)
    x, y, z = np.ascontiguousarray(points[order].T, np.float32)
    low = np.minimum.reduceat(points[order], first[:-1], axis=0)
    high = np.maximum.reduceat(points[order], first[:-1], axis=0)
    return _choose_points(x, y, z, order, first, low, high, points, count)


def _buckets(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Point indices in buckets (intervals of a Morton curve), rising in each bucket, and the start of each bucket."""
    above = points.astype(np.float64) - points.min(axis=0)
    cell = (above / (above.max() or 1) * 1023).astype(np.uint32)
    x, y, z = _spread_bits(cell).T
    order = np.argsort(x | y << 1 | z << 2, kind="stable")
    first = np.append(np.arange(0, len(points), _POINTS_PER_BUCKET), len(points))
    whole = order[: len(order) // _POINTS_PER_BUCKET * _POINTS_PER_BUCKET]
    rest = np.sort(order[len(whole) :])
    return np.concatenate((np.sort(whole.reshape(-1, _POINTS_PER_BUCKET), axis=1).ravel(), rest)), first


def _spread_bits(value: np.ndarray) -> np.ndarray:
    """Ten bits with two empty ones between each pair, for interleaving three coordinates."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        value = (value | value << np.uint32(shift)) & np.uint32(mask)
    return value


@njit(cache=True)
def _choose_points(x, y, z, order, first, low, high, points, count):  # pragma: no cover (compiled)
    nearest = np.full(len(x), np.float32(np.inf), np.float32)
    farthest = np.full(len(low), np.float32(np.inf), np.float32)  # (bucket,) its largest distance
    winner = np.zeros(len(low), np.int64)  # (bucket,) the lowest index of a point at that distance
    chosen = np.zeros(count, np.int64)
    for step in range(1, count):
        last = points[chosen[step - 1]]
        best, best_point = np.float32(-1), 0
        # A bucket changes only if the last choice is closer to its box than its farthest point is to the chosen ones.
        for bucket in range(len(low)):
            if _square_to_box(last, low[bucket], high[bucket]) * _ROUNDING < farthest[bucket]:
                start, stop = first[bucket], first[bucket + 1]
                point = start + _lower_distances(x[start:stop], y[start:stop], z[start:stop], last, nearest[start:stop])
                farthest[bucket], winner[bucket] = nearest[point], order[point]
            if farthest[bucket] > best or (farthest[bucket] == best and winner[bucket] < best_point):
                best, best_point = farthest[bucket], winner[bucket]
        chosen[step] = best_point
    return chosen


@njit(cache=True)
def _square_to_box(point, low, high):  # pragma: no cover (compiled)
    """Square of the distance from a point to a box, 0 inside."""
    square = np.float32(0)
    for axis in range(3):
        outside = max(low[axis] - point[axis], point[axis] - high[axis], np.float32(0))
        square += outside * outside
    return square


@njit(cache=True)
def _lower_distances(x, y, z, reference, nearest):  # pragma: no cover (compiled)
    """Lower each distance to that from ``reference`` if smaller. Returns the first index of the largest distance."""
    for point in range(len(x)):
        dx, dy, dz = x[point] - reference[0], y[point] - reference[1], z[point] - reference[2]
        square = (dx * dx + dy * dy) + dz * dz
        nearest[point] = min(nearest[point], square)
    # Non-negative floats sort like their bits, and the compiler vectorizes the maximum of integers.
    bits, largest = nearest.view(np.int32), np.int32(-1)
    for point in range(len(bits)):
        largest = max(largest, bits[point])
    for point in range(len(bits)):
        if bits[point] == largest:
            return point
    return 0
