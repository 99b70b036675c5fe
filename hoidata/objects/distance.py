"""Nearest points of a triangle mesh by libigl, and what a mesh is made of: merged vertices, edges, normals, volume.

Signed distances are ``hoidata.objects.surface_index``'s.
"""

from typing import NamedTuple

import igl
import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rows import distinct_rows

CHUNK_POINTS = 1 << 17


class ClosestPoints(NamedTuple):
    """distance_m: (point,) >= 0; closest_m: (point, 3) on the surface."""

    distance_m: np.ndarray
    closest_m: np.ndarray


class SignedDistance(NamedTuple):
    """distance_m: (point,) negative inside; closest_m: (point, 3); normal: (point, 3) the distance's gradient."""

    distance_m: np.ndarray
    closest_m: np.ndarray
    normal: np.ndarray


class MergedSurface(NamedTuple):
    """Vertices merged, collapsed triangles left out. vertices_m: (vertex, 3) float64; faces: (face, 3) int64."""

    vertices_m: np.ndarray
    faces: np.ndarray


def closest_points(vertices_m: np.ndarray, faces: np.ndarray, points_m: np.ndarray) -> ClosestPoints:
    """Nearest point of the mesh ``(vertex, 3)``, ``(face, 3)`` to each of ``points_m (point, 3)``; metres, one frame.

    Raises BadInput for a mesh without triangles of positive area or with numbers that are not finite.
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
    """Vertices that coincide taken as one. Raises BadInput as :func:`closest_points` does."""
    vertices = np.ascontiguousarray(vertices_m, dtype=np.float64)
    if not np.isfinite(vertices).all():
        raise BadInput("object mesh", "finite vertices", "NaN or infinity", "repair the mesh")
    first, number = distinct_rows(vertices)
    merged = number[np.asarray(faces, dtype=np.int64)].reshape(-1, 3)
    a, b, c = merged.T
    kept = merged[(a != b) & (b != c) & (c != a)]
    if not len(kept):
        raise BadInput(
            "object mesh", "at least one triangle", f"{len(merged)} faces, none with area", "repair the mesh"
        )
    return MergedSurface(vertices[first], kept)


def unmatched_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges (edge, 2) of the triangles (face, 3), and how often each is there more than its opposite."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    size = int(faces.max()) + 1
    keys = np.concatenate([edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]])
    found, number = np.unique(keys, return_inverse=True)
    unmatched = np.bincount(number, np.repeat([1, -1], len(edges)), len(found))
    return np.stack(np.divmod(found, size), axis=1), unmatched


def is_closed(faces: np.ndarray) -> bool:
    """Every directed edge is met by its opposite exactly as often: a closed, consistently oriented surface."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    size = int(faces.max()) + 1
    forward = np.sort(edges[:, 0] * size + edges[:, 1])
    backward = np.sort(edges[:, 1] * size + edges[:, 0])
    return bool(np.array_equal(forward, backward))


def volume_m3(vertices_m: np.ndarray, faces: np.ndarray) -> float:
    """Volume a closed surface encloses by the divergence theorem; negative when it is turned inside out."""
    corners = (vertices_m - vertices_m.mean(axis=0))[faces]
    return float(np.einsum("fx,fx->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)


def _chunks(points_m: np.ndarray) -> list[np.ndarray]:
    points = np.ascontiguousarray(points_m, dtype=np.float64).reshape(-1, 3)
    return [points[start : start + CHUNK_POINTS] for start in range(0, max(len(points), 1), CHUNK_POINTS)]
