"""Triangles in a tree of boxes, eight in each leaf; searched by ``distance_grid`` and ``line_crossings``."""

from typing import NamedTuple

import numpy as np
from numba import njit

LEAF = 8
_NARROWEST = 1e-10  # angle between ab and ac, radians: of 1e-16 the cross product is rounding
_NO_NORMAL = 1e-3  # of a node's triangles summed up: they cancel each other
_WIDER = 1e-9  # of the coordinates: more than rounding can take from a turned box; a search allows for its own
DEEPEST = 64  # levels a search has room for: triangles are halved, so 2^60 of them would fit


class TriangleTree(NamedTuple):
    """Triangles, metres, in the order of the leaves.

    triangle: (15, triangle) rows: corner a, edges ab and ac, unit normal (zero without area), inverse squared lengths
    of ab, ac and bc (zero without length). box: (node, 6) low and high corners. link: (node, 3) the second child, 0
    for a leaf (the first child follows its parent), and where the triangles below the node start and stop.
    face: (triangle,) number of each in the caller's order. corner: (triangle, 3) vertex numbers. turned_box: (node, 12)
    a box along the mean normal of the node's triangles: that unit direction, a second one across it, from where the
    triangles lie along these two and along the third (first x second), and up to where.
    """

    triangle: np.ndarray
    box: np.ndarray
    link: np.ndarray
    face: np.ndarray
    corner: np.ndarray
    vertices_m: np.ndarray
    turned_box: np.ndarray


def triangle_tree(vertices_m: np.ndarray, faces: np.ndarray) -> TriangleTree:
    """The tree of a mesh (vertex, 3), (face, 3) with at least one face.

    Triangles without area count as segments, and so do those so narrow that their normal would be rounding.
    """
    vertices = np.ascontiguousarray(vertices_m, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    corners = vertices[faces]
    order, link, box = _halved(corners)
    figures = _figures(corners[order])
    turned = _turned_boxes(corners[order], figures[9:12], link)
    return TriangleTree(figures, box, link, order, faces[order], vertices, turned)


def _figures(corners_m: np.ndarray) -> np.ndarray:
    a, ab, ac = corners_m[:, 0], corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]
    normal = np.cross(ab, ac)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    squares = np.stack([(edge**2).sum(axis=1) for edge in (ab, ac, ac - ab)], axis=1)
    narrow = length <= _NARROWEST * np.sqrt(squares[:, :1] * squares[:, 1:2])
    inverse = np.divide(1.0, squares, out=np.zeros_like(squares), where=squares > 0)
    unit = np.divide(normal, length, out=np.zeros_like(normal), where=~narrow)
    return np.ascontiguousarray(np.concatenate([a, ab, ac, unit, inverse], axis=1).T)


def _halved(corners_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order of the triangles, links and boxes of the nodes: each halved across the longest side of its centres' box."""
    low, high = corners_m.min(axis=1), corners_m.max(axis=1)
    order = np.arange(len(corners_m))
    link, box = np.zeros((2 * len(order), 3), np.int32), np.empty((2 * len(order), 6))
    count = _halve(low, high, (low + high) / 2, order, link, box)
    return order, link[:count].copy(), box[:count].copy()


@njit(cache=True)
def _halve(low_m, high_m, centre_m, order, link, box):  # pragma: no cover (compiled)
    """Sort ``order`` into leaves, fill the rows of ``link`` and ``box`` that nodes need, and say how many those are.

    low_m, high_m, centre_m: (triangle, 3) of each triangle's own box. order: (triangle,) numbers. link: (row, 3) zeros
    and box: (row, 6), of at least twice as many rows as triangles.
    """
    waiting, size, count = np.empty((DEEPEST, 3), np.int64), 1, 0  # start, stop, and the node it is the second child of
    waiting[0] = 0, len(order), -1
    while size:
        size -= 1
        start, stop, parent = waiting[size]
        own = order[start:stop].copy()
        if parent >= 0:
            link[parent, 0] = count
        link[count, 1], link[count, 2] = start, stop
        longest, axis = -1.0, 0
        for way in range(3):
            box[count, way], box[count, 3 + way] = low_m[own, way].min(), high_m[own, way].max()
            along = centre_m[own, way]
            if along.max() - along.min() > longest:
                longest, axis = along.max() - along.min(), way
        count += 1
        if stop - start > LEAF:
            order[start:stop] = own[np.argsort(centre_m[own, axis], kind="mergesort")]  # stable: equal ones keep order
            middle = start + -(-(stop - start) // (2 * LEAF)) * LEAF  # full leaves in the first half
            waiting[size], waiting[size + 1] = (middle, stop, count - 1), (start, middle, -1)
            size += 2
    return count


@njit(cache=True)
def _turned_boxes(corners_m, normal, link):  # pragma: no cover (compiled)
    """(node, 12), see ``TriangleTree``. corners_m: (triangle, 3, 3) and normal (3, triangle), in the leaves' order.

    A patch of a smooth surface is flat: the box along its normal is thin, so that few patches have to be looked at to
    find the nearest triangle, where boxes along the axes all reach too far.
    """
    turned = np.empty((len(link), 12))
    for node in range(len(link)):
        start, stop = link[node, 1], link[node, 2]
        nx, ny, nz = normal[0, start:stop].sum(), normal[1, start:stop].sum(), normal[2, start:stop].sum()
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = (nx / length, ny / length, nz / length) if length > _NO_NORMAL else (0.0, 0.0, 1.0)
        ux, uy, uz = (0.0, -nz, ny) if abs(nx) < 0.7 else (nz, 0.0, -nx)  # across the normal, and not too short
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / length, uy / length, uz / length
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        low, high, farthest = np.full(3, np.inf), np.full(3, -np.inf), 0.0
        for number in range(start, stop):
            for corner in range(3):
                x, y, z = corners_m[number, corner, 0], corners_m[number, corner, 1], corners_m[number, corner, 2]
                farthest = max(farthest, abs(x), abs(y), abs(z))
                places = nx * x + ny * y + nz * z, ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
                for way in range(3):
                    low[way], high[way] = min(low[way], places[way]), max(high[way], places[way])
        turned[node, 0:3], turned[node, 3:6] = (nx, ny, nz), (ux, uy, uz)
        turned[node, 6:9], turned[node, 9:12] = low - _WIDER * farthest, high + _WIDER * farthest
    return turned
