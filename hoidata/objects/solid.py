"""What a mesh encloses: as it is, or after small repairs that are said aloud.

Repaired are triangles that lie double (a surface drawn once for each side), uneven orientation, surfaces turned inside
out, and holes that a patch of 1 % of the surface closes. A cup drawn as one open sheet stays open: nothing says how
thick it is.
"""

from collections import defaultdict
from typing import NamedTuple

import igl
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hoidata.geometry.rows import distinct_rows
from hoidata.objects.distance import is_closed, merged_surface, unmatched_edges, volume_m3

LARGEST_PATCH = 0.01
LEAST_SHARE = 1e-3  # of the convex hull: less is enclosed by two opposite sheets


class Solid(NamedTuple):
    """A closed surface, outward by the right-hand rule: vertices_m (vertex, 3), faces (face, 3).

    repairs: what was changed, empty for a mesh taken as it is. patched: the surface has more than the mesh's triangles.
    """

    vertices_m: np.ndarray
    faces: np.ndarray
    repairs: str
    patched: bool


class NoSolid(NamedTuple):
    """why: what keeps a mesh from having an inside, in words."""

    why: str


def solid_of(vertices_m: np.ndarray, faces: np.ndarray) -> Solid | NoSolid:
    """The solid that a mesh (vertex, 3), (face, 3) bounds, metres. Raises BadInput for a mesh without triangles."""
    surface = merged_surface(vertices_m, faces)
    vertices, found = surface.vertices_m, surface.faces
    repairs = []
    if not (is_closed(found) and encloses(vertices, found)):
        # One triangle of each set of three vertices, the first.
        single = found[np.sort(distinct_rows(np.sort(found, axis=1)).first)]
        if len(single) < len(found):
            repairs.append(f"{len(found) - len(single)} triangles that lay double left out")
        found = single if is_closed(single) else np.ascontiguousarray(igl.bfs_orient(single)[0], dtype=np.int64)
        if len(single) == len(surface.faces) and not np.array_equal(found, single):
            repairs.append("neighbouring triangles turned alike")
    holes = _holes(found)
    patched = bool(holes)
    if holes is None or not all(_is_small(vertices, found, hole) for hole in holes):
        return NoSolid("it is open" if holes else "its triangles do not meet at their edges two by two")
    if holes:
        repairs.append(f"{len(holes)} small hole{'s' if len(holes) > 1 else ''} closed")
        vertices, found = _patched(vertices, found, holes)
    if not encloses(vertices, found):
        return NoSolid("it encloses nothing")
    if volume_m3(vertices, found) < 0:
        repairs.append("triangles turned outward")
        found = np.ascontiguousarray(found[:, ::-1])
    return Solid(vertices, found, ", ".join(repairs), patched)


def encloses(vertices_m: np.ndarray, faces: np.ndarray) -> bool:
    """A closed surface holds more than 0.1 % of its convex hull."""
    used = vertices_m[np.unique(faces)]
    volume = abs(volume_m3(vertices_m, faces))
    if volume > LEAST_SHARE * np.prod(np.ptp(used, axis=0)) > 0:
        return True  # the hull lies in its box, and a hull of 100,000 places takes seconds
    try:
        hull = ConvexHull(used).volume
    except (QhullError, ValueError):  # flat, or fewer than four points
        return False
    return volume > LEAST_SHARE * hull


def close_cut(vertices_m: np.ndarray, faces: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a part (face, 3), closed by fans where ``neighbours`` (face, 3) were cut off it.

    vertices_m: (vertex, 3) of the whole mesh; the fans' centres come after them. A hole is a cut where a neighbour
    meets one of its edges; cuts are closed whatever their size. Other holes stay.
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
    """The mesh with every hole closed by a fan about the middle of its edge, whatever its size: a hand at its wrist.

    vertices_m: (..., vertex, 3), any number of poses; faces: (face, 3). The fans' middles come after the mesh's own
    vertices. Raises ValueError where an edge has more than two triangles.
    """
    holes = _holes(faces)
    if holes is None:
        raise ValueError("triangles that do not meet at their edges two by two")
    return _patched(vertices_m, faces, holes)


def _holes(faces: np.ndarray) -> list[np.ndarray] | None:
    """Vertices around each hole, in the order a patch's triangles run; None where an edge is open more than once.

    Holes that share a vertex are told apart there, so that no hole passes a vertex twice.
    """
    edges, unmatched = unmatched_edges(faces)
    if unmatched.max(initial=0) > 1:
        return None
    after: defaultdict[int, list[int]] = defaultdict(list)
    for stop, start in edges[unmatched > 0].tolist():  # a patch runs against the triangles next to it
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
