"""Closest points on a triangle mesh (libigl), and mesh properties: merged vertices, edges, normals, volume.

``hoidata.objects.surface_index`` computes signed distances.
"""

from typing import NamedTuple

import igl
import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rows import distinct_rows

CHUNK_POINTS = 1 << 17


class ClosestPoints(NamedTuple):
    """The closest surface point of each query point."""

    distance_m: np.ndarray  # (point,) >= 0
    closest_m: np.ndarray  # (point, 3) on the surface


class SignedDistance(NamedTuple):
    """Signed distance and closest surface point of each query point."""

    distance_m: np.ndarray  # (point,) negative inside
    closest_m: np.ndarray  # (point, 3) on the surface
    normal: np.ndarray  # (point, 3) unit gradient of the signed distance, outward


class MergedSurface(NamedTuple):
    """A mesh whose coinciding vertices are merged, without triangles that collapse."""

    vertices_m: np.ndarray  # (vertex, 3) float64
    faces: np.ndarray  # (face, 3) int64


def closest_points(vertices_m: np.ndarray, faces: np.ndarray, points_m: np.ndarray) -> ClosestPoints:
    """Closest point of a mesh to each query point.

    vertices_m: (vertex, 3), any frame. faces: (face, 3). points_m: (point, 3), same frame.
    Raises BadInput: the mesh has no triangle of positive area, or a vertex is not finite.
    """
    surface = merged_surface(vertices_m, faces)
    parts = [igl.point_mesh_squared_distance(chunk, *surface)[::2] for chunk in _chunks(points_m)]
    square, closest = (np.concatenate(column) for column in zip(*parts, strict=True))
    return ClosestPoints(np.sqrt(square), closest.reshape(-1, 3))


def face_normals(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(face, 3) unit normals by the right-hand rule; zero for a triangle without area."""
    a, b, c = (vertices_m[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross / np.where(length > 0, length, 1.0)


def merged_surface(vertices_m: np.ndarray, faces: np.ndarray) -> MergedSurface:
    """Merge coinciding vertices. Raises BadInput as :func:`closest_points` does."""
    vertices = np.ascontiguousarray(vertices_m, dtype=np.float64)
    if not np.isfinite(vertices).all():
        raise BadInput("object mesh", "finite vertices", "NaN or infinity", "repair the mesh")
    first, number = distinct_rows(vertices)
    merged = number[np.asarray(faces, dtype=np.int64)].reshape(-1, 3)
    a, b, c = merged.T
    valid_faces = merged[(a != b) & (b != c) & (c != a)]
    if not len(valid_faces):
        raise BadInput(
            "object mesh", "at least one triangle", f"{len(merged)} faces, none with area", "repair the mesh"
        )
    return MergedSurface(vertices[first], valid_faces)


def unmatched_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges (edge, 2) of triangles (face, 3), and each edge's count minus the count of its opposite."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    size = int(faces.max()) + 1
    keys = np.concatenate([edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]])
    pairs, pair_of_edge = np.unique(keys, return_inverse=True)
    unmatched = np.bincount(pair_of_edge, np.repeat([1, -1], len(edges)), len(pairs))
    return np.stack(np.divmod(pairs, size), axis=1), unmatched


def is_closed(faces: np.ndarray) -> bool:
    """Whether each directed edge occurs as often as its opposite: a closed, consistently oriented surface."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    size = int(faces.max()) + 1
    forward = np.sort(edges[:, 0] * size + edges[:, 1])
    backward = np.sort(edges[:, 1] * size + edges[:, 0])
    return bool(np.array_equal(forward, backward))


def volume_m3(vertices_m: np.ndarray, faces: np.ndarray) -> float:
    """Volume of a closed surface by the divergence theorem; negative if its triangles face inward."""
    corners = (vertices_m - vertices_m.mean(axis=0))[faces]
    return float(np.einsum("fx,fx->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)


def _chunks(points_m: np.ndarray) -> list[np.ndarray]:
    points = np.ascontiguousarray(points_m, dtype=np.float64).reshape(-1, 3)
    return [points[start : start + CHUNK_POINTS] for start in range(0, max(len(points), 1), CHUNK_POINTS)]
