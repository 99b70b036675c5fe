"""Prepares an object's mesh for display: crease normals, and subdivision fine enough to show a contact map."""

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from cachetools import LRUCache, cached
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from hoidata.geometry.rows import distinct_rows

CREASE_RAD = np.radians(40.0)
PAINT_EDGE_M = 0.006
PAINT_EDGE_PER_EXTENT = 1 / 40
PAINT_NEIGHBOURS = 12


@dataclass(frozen=True)
class ContactPaint:
    """A contact map to paint on an object."""

    points_m: np.ndarray  # (point, 3) object frame
    part: np.ndarray  # (point,) 0 base, 1 moving part
    value: np.ndarray  # (point,) in [0, 1], 1 = touched


@dataclass(frozen=True)
class Surface:
    """Triangles to draw, in the object frame."""

    vertices_m: np.ndarray  # (vertex, 3)
    normals: np.ndarray  # (vertex, 3)
    faces: np.ndarray  # (face, 3)
    value: np.ndarray | None = None  # (vertex,) of a contact map


def display_surface(vertices_m: np.ndarray, faces: np.ndarray, paint: ContactPaint | None = None) -> Surface:
    """Triangles of one rigid part with normals; with ``paint``, subdivided to edges of about 6 mm and coloured.

    ``paint`` must have the points of this part only; without points the value is zero everywhere.
    """
    surface = _triangles(vertices_m, faces, paint is not None)
    return surface if paint is None else replace(surface, value=paint_values(surface.vertices_m, paint))


# A page shows one object several times.
@cached(LRUCache(16), key=lambda vertices_m, faces, is_fine: (vertices_m.tobytes(), faces.tobytes(), is_fine))
def _triangles(vertices_m: np.ndarray, faces: np.ndarray, is_fine: bool) -> Surface:
    """The triangles without a contact map; fine ones have short edges, which show a map."""
    corners, normals = vertices_m[faces], crease_normals(vertices_m, faces)
    if is_fine:
        edge_m = max(PAINT_EDGE_M, float(np.ptp(vertices_m, axis=0).max()) * PAINT_EDGE_PER_EXTENT)
        corners, normals = _subdivide(corners, normals, edge_m)
    return _merge(corners, normals)


def crease_normals(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (face, 3, 3) per face corner: area-weighted mean over adjacent faces within 40 degrees."""
    triangles = vertices_m[faces].astype(np.float64)
    doubled = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    unit = doubled / np.maximum(np.linalg.norm(doubled, axis=1, keepdims=True), 1e-20)
    corner_vertex = distinct_rows(np.round(vertices_m, 6)).number[faces.reshape(-1)]
    ones = np.ones(len(corner_vertex))
    incidence = csr_array((ones, (np.arange(len(corner_vertex)), corner_vertex)))
    pairs = (incidence @ incidence.T).tocoo()
    first, second = pairs.coords
    smooth = np.einsum("ij,ij->i", unit[first // 3], unit[second // 3]) > np.cos(CREASE_RAD)
    to, weighted = first[smooth], doubled[second[smooth] // 3]
    normals = np.stack([np.bincount(to, column, len(corner_vertex)) for column in weighted.T], axis=1)
    normals += 1e-12 * np.repeat(unit, 3, axis=0)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    return normals.reshape(-1, 3, 3)


def paint_values(vertices_m: np.ndarray, paint: ContactPaint) -> np.ndarray:
    """(vertex,) map values: mean of the closest sample points under a Gaussian as wide as the point spacing."""
    count = min(PAINT_NEIGHBOURS, len(paint.points_m))
    if count < 2:
        return np.full(len(vertices_m), paint.value.sum())
    tree = KDTree(paint.points_m)
    distance, index = tree.query(vertices_m, k=count)
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    to_neighbour = np.asarray(tree.query(paint.points_m, k=2)[0])[:, 1]
    spacing = max(float(np.median(to_neighbour)), 1e-6)
    weight = np.exp(-0.5 * ((distance - distance[:, :1]) / spacing) ** 2)
    return (weight * paint.value[index]).sum(axis=1) / weight.sum(axis=1)


def _subdivide(corners: np.ndarray, normals: np.ndarray, edge_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Subdivide (face, 3, 3) triangles to edges of at most ``edge_m``; normals are interpolated barycentrically."""
    soup = corners.reshape(-1, 3)
    cut_vertices, cut_faces, origin = trimesh.remesh.subdivide_to_size(  # pyright: ignore[reportAssignmentType]
        soup, np.arange(len(soup)).reshape(-1, 3), edge_m, max_iter=12, return_index=True
    )
    cut = cut_vertices[cut_faces]
    repeated = np.repeat(corners[origin], 3, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # triangles without area have no weights
        weights = trimesh.triangles.points_to_barycentric(repeated, cut.reshape(-1, 3))
    barycentric = np.nan_to_num(weights, nan=1 / 3)
    mixed = np.einsum("nk,nkc->nc", barycentric, np.repeat(normals[origin], 3, axis=0))
    mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-20)
    return cut, mixed.reshape(-1, 3, 3)


def _merge(corners: np.ndarray, normals: np.ndarray) -> Surface:
    """Merge corners of equal position (to 1 um) and normal to one vertex."""
    rows = np.concatenate([np.round(corners.reshape(-1, 3), 6), np.round(normals.reshape(-1, 3), 4)], axis=1)
    first, number = distinct_rows(rows)
    return Surface(corners.reshape(-1, 3)[first], rows[first, 3:], number.reshape(-1, 3))
