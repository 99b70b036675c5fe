"""Bounding-volume tree of triangles, for ``distance_grid``, ``line_crossings`` and ``rays``.

libigl's AABB tree has no threshold queries, no rays that meet one side only and no line intervals; its first ray hits
are wrong for some rays.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

LEAF = 8  # triangles per leaf
_NARROWEST = 1e-10  # angle between ab and ac, radians; at 1e-16 the cross product is rounding
_NO_NORMAL = 1e-3  # length of a node's summed normals below which they cancel out
_WIDEN = 1e-9  # relative to the coordinates: more than the rounding of an oriented box
DEEPEST = 64  # size of a search's stack: triangles are halved, so that 2^60 triangles would fit


class TriangleTree(NamedTuple):
    """Triangles in the order of the leaves, and the nodes of the tree in depth-first order."""

    # (15, triangle) corner a, edges ab and ac, unit normal (zero without area), and the inverse squared lengths of
    # ab, ac and bc (zero without length)
    triangle: np.ndarray
    box: np.ndarray  # (node, 6) low and high corners of the axis-aligned box
    # (node, 3) index of the second child (0 for a leaf; the first child follows its parent), and the range of triangles
    link: np.ndarray
    face: np.ndarray  # (triangle,) index in the caller's faces
    corner: np.ndarray  # (triangle, 3) vertex indices
    vertices_m: np.ndarray  # (vertex, 3)
    # (node, 12) box along the mean normal n of the node's triangles: n, a unit vector u across n, and the low and high
    # corners in the axes n, u, n x u
    oriented_box: np.ndarray


def triangle_tree(vertices_m: np.ndarray, faces: np.ndarray) -> TriangleTree:
    """Build the tree of a mesh (vertex, 3), (face, 3) with at least one face.

    Triangles without area, or so narrow that their normal would be rounding, count as segments.
    """
    vertices = np.ascontiguousarray(vertices_m, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    corners = vertices[faces]
    order, link, box = _build_nodes(corners)
    triangles = _triangle_rows(corners[order])
    oriented_boxes = _oriented_boxes(corners[order], triangles[9:12], link)
    return TriangleTree(
        triangle=triangles,
        box=box,
        link=link,
        face=order,
        corner=faces[order],
        vertices_m=vertices,
        oriented_box=oriented_boxes,
    )


def _triangle_rows(corners_m: np.ndarray) -> np.ndarray:
    a, ab, ac = corners_m[:, 0], corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]
    normal = np.cross(ab, ac)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    squares = np.stack([(edge**2).sum(axis=1) for edge in (ab, ac, ac - ab)], axis=1)
    narrow = length <= _NARROWEST * np.sqrt(squares[:, :1] * squares[:, 1:2])
    inverse = np.divide(1.0, squares, out=np.zeros_like(squares), where=squares > 0)
    unit = np.divide(normal, length, out=np.zeros_like(normal), where=~narrow)
    return np.ascontiguousarray(np.concatenate([a, ab, ac, unit, inverse], axis=1).T)


def _build_nodes(corners_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order of triangles, links and boxes of nodes; nodes split along the longest side of their centres' box."""
    low, high = corners_m.min(axis=1), corners_m.max(axis=1)
    order = np.arange(len(corners_m))
    link, box = np.zeros((2 * len(order), 3), np.int32), np.empty((2 * len(order), 6))
    count = _split(low, high, (low + high) / 2, order, link, box)
    return order, link[:count].copy(), box[:count].copy()


@njit(cache=True)
def _split(low_m, high_m, centre_m, order, link, box):  # pragma: no cover (compiled)
    """Sort ``order`` into leaves and fill ``link`` and ``box``. Returns the number of nodes.

    Args:
        low_m, high_m, centre_m: (triangle, 3) of each triangle's bounding box.
        order: (triangle,) indices, sorted in place.
        link: (2 * triangle, 3) zeros, output.
        box: (2 * triangle, 6) output.
    """
    pending, size, count = np.empty((DEEPEST, 3), np.int64), 1, 0
    # Of each pending node: start, stop, and the node whose second child it is (-1: a first child).
    pending[0] = 0, len(order), -1
    while size:
        size -= 1
        start, stop, parent = pending[size]
        members = order[start:stop].copy()
        if parent >= 0:
            link[parent, 0] = count
        link[count, 1], link[count, 2] = start, stop
        longest, split_axis = -1.0, 0
        for axis in range(3):
            box[count, axis], box[count, 3 + axis] = low_m[members, axis].min(), high_m[members, axis].max()
            along = centre_m[members, axis]
            if along.max() - along.min() > longest:
                longest, split_axis = along.max() - along.min(), axis
        count += 1
        if stop - start > LEAF:
            # A stable sort keeps the order of ties.
            order[start:stop] = members[np.argsort(centre_m[members, split_axis], kind="mergesort")]
            middle = start + -(-(stop - start) // (2 * LEAF)) * LEAF  # full leaves in the first half
            pending[size], pending[size + 1] = (middle, stop, count - 1), (start, middle, -1)
            size += 2
    return count


@njit(cache=True)
def _oriented_boxes(corners_m, normal, link):  # pragma: no cover (compiled)
    """(node, 12) as in ``TriangleTree``; corners_m (triangle, 3, 3) and normal (3, triangle) in leaf order.

    A box along the normal of a smooth patch is thin. So a nearest-triangle search visits far fewer nodes than with
    axis-aligned boxes.
    """
    oriented = np.empty((len(link), 12))
    for node in range(len(link)):
        start, stop = link[node, 1], link[node, 2]
        nx, ny, nz = normal[0, start:stop].sum(), normal[1, start:stop].sum(), normal[2, start:stop].sum()
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = (nx / length, ny / length, nz / length) if length > _NO_NORMAL else (0.0, 0.0, 1.0)
        # Perpendicular to the normal, and not too short.
        ux, uy, uz = (0.0, -nz, ny) if abs(nx) < 0.7 else (nz, 0.0, -nx)
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / length, uy / length, uz / length
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        low, high, farthest = np.full(3, np.inf), np.full(3, -np.inf), 0.0
        for number in range(start, stop):
            for corner in range(3):
                x, y, z = corners_m[number, corner, 0], corners_m[number, corner, 1], corners_m[number, corner, 2]
                farthest = max(farthest, abs(x), abs(y), abs(z))
                coordinates = nx * x + ny * y + nz * z, ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
                for axis in range(3):
                    low[axis], high[axis] = min(low[axis], coordinates[axis]), max(high[axis], coordinates[axis])
        oriented[node, 0:3], oriented[node, 3:6] = (nx, ny, nz), (ux, uy, uz)
        oriented[node, 6:9], oriented[node, 9:12] = low - _WIDEN * farthest, high + _WIDEN * farthest
    return oriented
