"""Watertight triangle meshes of simple solids: rounded boxes, solids of revolution, prisms, and their exact unions."""

import itertools
from typing import NamedTuple

import igl.copyleft.cgal as cgal
import numpy as np
from numpy.typing import ArrayLike

_WELD_DIGITS = 6


class Solid(NamedTuple):
    """A closed triangle mesh."""

    vertices_m: np.ndarray  # (vertex, 3)
    faces: np.ndarray  # (face, 3) int64, outward by the right-hand rule

    def moved(self, offset_m: tuple[float, float, float]) -> "Solid":
        return Solid(self.vertices_m + np.asarray(offset_m, dtype=np.float64), self.faces)

    def rotated(self, rotmat: np.ndarray) -> "Solid":
        return Solid(self.vertices_m @ np.asarray(rotmat, dtype=np.float64).T, self.faces)


def sharp_box(size_m: tuple[float, float, float]) -> Solid:
    """A box about the origin with 8 vertices and 12 triangles."""
    return _grid_box([np.array([-0.5, 0.5]) * extent for extent in size_m])


def rounded_box(size_m: tuple[float, float, float], radius_m: float = 0.004, spacing_m: float = 0.012) -> Solid:
    """A box about the origin with rounded edges; edges of the mesh are at most about 1.5 x ``spacing_m`` long."""
    half = np.asarray(size_m) / 2
    box = _grid_box([_rounded_axis(extent, radius_m, spacing_m) for extent in half])
    inner = np.clip(box.vertices_m, radius_m - half, half - radius_m)
    away = box.vertices_m - inner
    length = np.linalg.norm(away, axis=1, keepdims=True)
    return Solid(inner + radius_m * away / length, box.faces)


def _rounded_axis(half_m: float, radius_m: float, spacing_m: float) -> np.ndarray:
    """Grid lines of one axis, with three over each rounded edge at equal angles."""
    strip = half_m - radius_m + radius_m * np.tan(np.pi / 4 * np.linspace(0, 1, 4))
    count = max(int(np.ceil(2 * (half_m - radius_m) / spacing_m)), 1)
    middle = np.linspace(radius_m - half_m, half_m - radius_m, count + 1)
    return np.concatenate([-strip[:0:-1], middle, strip[1:]])


def _grid_box(lines: list[np.ndarray]) -> Solid:
    """The surface of a box cut along the given grid lines of its three axes."""
    sizes = [len(line) for line in lines]
    index = np.arange(np.prod(sizes)).reshape(sizes)
    quads = []
    for axis in range(3):
        for end, flip in ((0, True), (-1, False)):
            side = np.take(index, end, axis=axis)
            quad = np.stack([side[:-1, :-1], side[1:, :-1], side[1:, 1:], side[:-1, 1:]], axis=-1).reshape(-1, 4)
            # np.take drops the axis; the other two keep their order, which is left-handed for the middle axis.
            quads.append(quad[:, ::-1] if flip != (axis == 1) else quad)
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    return _compact(grid, _split_quads(np.concatenate(quads)))


def _split_quads(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int64)


def _compact(vertices: np.ndarray, faces: np.ndarray) -> Solid:
    used, renumbered = np.unique(faces, return_inverse=True)
    return Solid(vertices[used], renumbered.reshape(-1, 3).astype(np.int64))


def revolved(profile: ArrayLike, sections: int = 40, spacing_m: float = 0.012) -> Solid:
    """Solid of revolution about the z axis. Segments of the profile longer than ``spacing_m`` are subdivided.

    profile: (point, 2) radius and height, from bottom to top; the first and last points are on the axis.
    """
    points = _subdivided(np.asarray(profile, dtype=np.float64), spacing_m)
    if abs(points[0, 0]) > 1e-12 or abs(points[-1, 0]) > 1e-12:
        raise ValueError(f"a profile starts and ends on the axis, got radii {points[0, 0]} and {points[-1, 0]} m")
    rings = _rings(points[1:-1], sections)
    n_rings = len(points) - 2
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, points[0, 1]], [0, 0, points[-1, 1]]]])
    faces = [_split_quads(_ring_quads(n_rings, sections, wrap=False))]
    current, following = np.arange(sections), (np.arange(sections) + 1) % sections
    low, high, top = len(vertices) - 2, len(vertices) - 1, (n_rings - 1) * sections
    faces.append(np.stack([np.full(sections, low), following, current], axis=1))
    faces.append(np.stack([np.full(sections, high), top + current, top + following], axis=1))
    return Solid(vertices, np.concatenate(faces).astype(np.int64))


def torus(radius_m: float, tube_m: float, sections: int = 48, tube_sections: int = 20) -> Solid:
    """A torus about the z axis: ``radius_m`` to the centre of a tube of radius ``tube_m``."""
    angle = 2 * np.pi * np.arange(tube_sections) / tube_sections
    ring = np.stack([radius_m + tube_m * np.cos(angle), tube_m * np.sin(angle)], axis=1)
    rings = _rings(ring, sections)
    return Solid(rings.reshape(-1, 3), _split_quads(_ring_quads(tube_sections, sections, wrap=True)))


def _rings(profile: np.ndarray, sections: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(sections) / sections
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring = profile[:, None, :1] * circle
    return np.concatenate([ring, np.broadcast_to(profile[:, None, 1:], (len(profile), sections, 1))], axis=2)


def _ring_quads(n_rings: int, sections: int, wrap: bool) -> np.ndarray:
    ring = np.arange(n_rings if wrap else n_rings - 1)[:, None]
    current = np.arange(sections)[None]
    following = (current + 1) % sections
    above = (ring + 1) % n_rings
    pairs = ((ring, current), (ring, following), (above, following), (above, current))
    corners = [ring_number * sections + position for ring_number, position in pairs]
    return np.stack(np.broadcast_arrays(*corners), axis=-1).reshape(-1, 4)


def _subdivided(profile: np.ndarray, spacing_m: float) -> np.ndarray:
    pieces = [profile[:1]]
    for start, end in itertools.pairwise(profile):
        count = max(int(np.ceil(np.linalg.norm(end - start) / spacing_m)), 1)
        pieces.append(start + (end - start) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def sphere(radius_m: float, sections: int = 40) -> Solid:
    """A ball about the origin."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, sections // 2 + 1)
    profile = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle)], axis=1)
    profile[[0, -1], 0] = 0.0
    return revolved(profile, sections, spacing_m=1.0)


def cylinder(radius_m: float, height_m: float, edge_m: float = 0.003, sections: int = 40) -> Solid:
    """An upright cylinder about the origin with rounded rims."""
    angle = np.linspace(0, np.pi / 2, 4)
    half = height_m / 2
    rim = [(radius_m - edge_m + edge_m * np.sin(a), half - edge_m + edge_m * np.cos(a)) for a in angle]
    below = [(r, -z) for r, z in rim]
    return revolved([(0.0, -half), *below, *reversed(rim), (0.0, half)], sections)


def united(*solids: Solid) -> Solid:
    """Unite closed solids to one closed surface, with the exact arithmetic of CGAL through libigl."""
    whole = solids[0]
    for solid in solids[1:]:
        meshes = [array for one in (whole, solid) for array in (one.vertices_m, np.ascontiguousarray(one.faces))]
        vertices, faces, _ = cgal.mesh_boolean(*meshes, "union")
        whole = _welded(np.asarray(vertices), np.asarray(faces))
    return whole


def _welded(vertices: np.ndarray, faces: np.ndarray) -> Solid:
    """Round vertices to a micrometre, merge equal ones and drop collapsed triangles, so that files stay closed.

    Triangles start with their lowest vertex and are sorted, because CGAL's order differs from run to run.
    """
    unique, inverse = np.unique(np.round(vertices, _WELD_DIGITS), axis=0, return_inverse=True)
    a, b, c = inverse.reshape(-1)[faces].T
    is_valid = (a != b) & (b != c) & (c != a)
    corners = np.stack([a, b, c], axis=1)[is_valid]
    rotated = np.take_along_axis(corners, (corners.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return _compact(unique, rotated[np.lexsort(rotated.T[::-1])])
