"""Triangles in a tree of boxes, eight in each leaf; searched by ``distance_grid`` and ``line_crossings``."""

from typing import NamedTuple

import numpy as np

LEAF = 8
DEEPEST = 64  # levels a search has room for: triangles are halved, so 2^60 of them would fit


class TriangleTree(NamedTuple):
    """Triangles, metres, in the order of the leaves.

    triangle: (15, triangle) rows: corner a, edges ab and ac, unit normal (zero without area), inverse squared lengths
    of ab, ac and bc (zero without length). box: (node, 6) low and high corners. link: (node, 3) the second child, 0
    for a leaf (the first child follows its parent), and where the triangles below the node start and stop.
    face: (triangle,) number of each in the caller's order. corner: (triangle, 3) vertex numbers.
    """

    triangle: np.ndarray
    box: np.ndarray
    link: np.ndarray
    face: np.ndarray
    corner: np.ndarray
    vertices_m: np.ndarray


def triangle_tree(vertices_m: np.ndarray, faces: np.ndarray) -> TriangleTree:
    """The tree of a mesh (vertex, 3), (face, 3) with at least one face; triangles without area count as segments."""
    vertices = np.ascontiguousarray(vertices_m, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    corners = vertices[faces]
    order, link, box = _halved(corners)
    return TriangleTree(_figures(corners[order]), box, link, order, faces[order], vertices)


def _figures(corners_m: np.ndarray) -> np.ndarray:
    a, ab, ac = corners_m[:, 0], corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]
    normal = np.cross(ab, ac)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    squares = np.stack([(edge**2).sum(axis=1) for edge in (ab, ac, ac - ab)], axis=1)
    inverse = np.divide(1.0, squares, out=np.zeros_like(squares), where=squares > 0)
    unit = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    return np.ascontiguousarray(np.concatenate([a, ab, ac, unit, inverse], axis=1).T)


def _halved(corners_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order of the triangles, links and boxes of the nodes: each halved across the longest side of its centres' box."""
    low, high = corners_m.min(axis=1), corners_m.max(axis=1)
    centre, order = (low + high) / 2, np.arange(len(corners_m))
    links, boxes = [], []
    waiting = [(0, len(order), -1)]  # start, stop, and the node it is the second child of
    while waiting:
        start, stop, parent = waiting.pop()
        own = order[start:stop]
        if parent >= 0:
            links[parent][0] = len(links)
        links.append([0, start, stop])
        boxes.append(np.concatenate((low[own].min(axis=0), high[own].max(axis=0))))
        if stop - start > LEAF:
            axis = np.ptp(centre[own], axis=0).argmax()
            order[start:stop] = own[np.argsort(centre[own, axis], kind="stable")]
            middle = start + -(-(stop - start) // (2 * LEAF)) * LEAF  # full leaves in the first half
            waiting += [(middle, stop, len(links) - 1), (start, middle, -1)]
    return order, np.array(links, dtype=np.int32), np.array(boxes)
