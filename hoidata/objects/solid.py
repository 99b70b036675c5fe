"""The solid that a mesh encloses, after small repairs that are reported.

Repairs: duplicate triangles (a surface modelled once per side), inconsistent orientation, inverted surfaces, and holes
whose patch is at most 1 % of the surface. A cup modelled as one open sheet stays open, because its thickness is
unknown.
"""

from collections import defaultdict
from typing import NamedTuple

import igl
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hoidata.geometry.rows import distinct_rows
from hoidata.objects.distance import is_closed, merged_surface, unmatched_edges, volume_m3

LARGEST_PATCH = 0.01  # fraction of the surface's area
MIN_HULL_FRACTION = 1e-3  # two opposite sheets enclose less of their convex hull


class Solid(NamedTuple):
    """A closed surface with outward normals by the right-hand rule."""

    vertices_m: np.ndarray  # (vertex, 3)
    faces: np.ndarray  # (face, 3)
    repairs: str  # a list in words; empty for an unchanged mesh
    patched: bool  # triangles were added to close holes


class NoSolid(NamedTuple):
    """The result for a mesh without an inside."""

    why: str  # the reason, in words


def solid_of(vertices_m: np.ndarray, faces: np.ndarray) -> Solid | NoSolid:
    """The solid that a mesh (vertex, 3), (face, 3) bounds. Raises BadInput for a mesh without triangles."""
    surface = merged_surface(vertices_m, faces)
    vertices, triangles = surface.vertices_m, surface.faces
    repairs = []
    if not (is_closed(triangles) and encloses(vertices, triangles)):
        # Of triangles with the same vertices, keep the first.
        single = triangles[np.sort(distinct_rows(np.sort(triangles, axis=1)).first)]
        if len(single) < len(triangles):
            repairs.append(f"{len(triangles) - len(single)} triangles that lay double left out")
        triangles = single if is_closed(single) else np.ascontiguousarray(igl.bfs_orient(single)[0], dtype=np.int64)
        if len(single) == len(surface.faces) and not np.array_equal(triangles, single):
            repairs.append("neighbouring triangles turned alike")
    holes = _holes(triangles)
    patched = bool(holes)
    if holes is None or not all(_is_small(vertices, triangles, hole) for hole in holes):
        return NoSolid("it is open" if holes else "its triangles do not meet at their edges two by two")
    if holes:
        repairs.append(f"{len(holes)} small hole{'s' if len(holes) > 1 else ''} closed")
        vertices, triangles = _patched(vertices, triangles, holes)
    if not encloses(vertices, triangles):
        return NoSolid("it encloses nothing")
    if volume_m3(vertices, triangles) < 0:
        repairs.append("triangles turned outward")
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    return Solid(vertices, triangles, ", ".join(repairs), patched)


def encloses(vertices_m: np.ndarray, faces: np.ndarray) -> bool:
    """Whether a closed surface encloses more than 0.1 % of its convex hull."""
    used = vertices_m[np.unique(faces)]
    volume = abs(volume_m3(vertices_m, faces))
    if volume > MIN_HULL_FRACTION * np.prod(np.ptp(used, axis=0)) > 0:
        return True  # the box bounds the hull, and a hull of 100,000 points takes seconds
    try:
        hull = ConvexHull(used).volume
    except (QhullError, ValueError):  # flat, or fewer than four points
        return False
    return volume > MIN_HULL_FRACTION * hull


def close_cut(vertices_m: np.ndarray, faces: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Close a part with fans where it was cut off the rest of its mesh.

    A hole is a cut if a neighbouring triangle shares one of its edges. Cuts of any size are closed; other holes stay.

    Args:
        vertices_m: (vertex, 3) of the whole mesh.
        faces: (face, 3) of the part.
        neighbours: (face, 3) of the rest of the mesh.

    Returns vertices, with the centres of the fans appended, and faces of the part.
    """
    first, number = distinct_rows(np.ascontiguousarray(vertices_m, dtype=np.float64))
    holes = _holes(number[faces]) if len(neighbours) else None
    if not holes:
        return vertices_m, faces
    edges, unmatched = unmatched_edges(number[neighbours])
    met = edges[unmatched > 0] @ (len(first), 1)
    cuts = [first[hole] for hole in holes if np.isin(hole * len(first) + np.roll(hole, -1), met).any()]
    return _patched(vertices_m, faces, cuts) if cuts else (vertices_m, faces)


def patched_holes(vertices_m: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Close all holes of a mesh, such as a hand's wrist, with fans about the centres of their edges.

    vertices_m: (..., vertex, 3), any number of poses. faces: (face, 3).
    Returns vertices, with the centres of the fans appended, and faces. Raises ValueError: an edge has more than two
    triangles.
    """
    holes = _holes(faces)
    if holes is None:
        raise ValueError("triangles that do not meet at their edges two by two")
    return _patched(vertices_m, faces, holes)


def _holes(faces: np.ndarray) -> list[np.ndarray] | None:
    """Vertices around each hole, in the order of a patch's triangles; None if an edge is open more than once.

    Holes that share a vertex are separated there, so that no hole visits a vertex twice.
    """
    edges, unmatched = unmatched_edges(faces)
    if unmatched.max(initial=0) > 1:
        return None
    after: defaultdict[int, list[int]] = defaultdict(list)
    for stop, start in edges[unmatched > 0].tolist():  # a patch has the opposite direction of its neighbours
        after[start].append(stop)
    holes: list[np.ndarray] = []
    for start in sorted(after):
        path = [start]
        while after[path[-1]]:
            vertex = after[path[-1]].pop()
            if vertex not in path:
                path.append(vertex)
                continue
            first = path.index(vertex)
            holes.append(np.array(path[first:]))
            del path[first + 1 :]
    return holes


def _patch(hole: np.ndarray, middle: int) -> np.ndarray:
    return np.stack([hole, np.roll(hole, -1), np.full(len(hole), middle)], axis=1)


def _is_small(vertices_m: np.ndarray, faces: np.ndarray, hole: np.ndarray) -> bool:
    around = np.concatenate([vertices_m[hole], [vertices_m[hole].mean(axis=0)]])
    patch = _patch(np.arange(len(hole)), len(hole))
    return bool(_area(around, patch) <= LARGEST_PATCH * _area(vertices_m, faces))


def _area(vertices_m: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices_m[faces[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _patched(vertices_m: np.ndarray, faces: np.ndarray, holes: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    middles = [vertices_m[..., hole, :].mean(axis=-2, keepdims=True) for hole in holes]
    patches = [_patch(hole, vertices_m.shape[-2] + number) for number, hole in enumerate(holes)]
    return np.concatenate([vertices_m, *middles], axis=-2), np.concatenate([faces, *patches])
