"""Exact distances from places to triangles, and crossings of rays with them: a tree of boxes with eight triangles each.

float64 throughout, compiled with numba, one thread. The least distance is the same to the last bit whatever the order
of the search and the bound it began with.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

LEAF = 8
DEEPEST = 64  # levels a search has room for: triangles are halved, so 2^60 of them would fit
BOX_ROUNDING = 1 - 1e-12  # a box is left out only when it is clearly farther than the best triangle so far


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


@njit(cache=True, inline="always")
def square_to_box(box, node, x, y, z):  # pragma: no cover (compiled)
    """Squared distance to a node's box, 0 inside."""
    dx = max(box[node, 0] - x, x - box[node, 3], 0.0)
    dy = max(box[node, 1] - y, y - box[node, 4], 0.0)
    dz = max(box[node, 2] - z, z - box[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, fastmath={"nnan", "ninf", "nsz"})
def leaf_squares(triangle, start, stop, x, y, z, squares):  # pragma: no cover (compiled)
    """Squared distances to triangles ``start`` to ``stop``, without branches, so that it runs on vectors.

    Above the inside of a triangle its plane is nearest, elsewhere one of the three edges.
    """
    for number in range(start, stop):
        px, py, pz = x - triangle[0, number], y - triangle[1, number], z - triangle[2, number]
        bx, by, bz = triangle[3, number], triangle[4, number], triangle[5, number]
        cx, cy, cz = triangle[6, number], triangle[7, number], triangle[8, number]
        nx, ny, nz = triangle[9, number], triangle[10, number], triangle[11, number]
        ex, ey, ez = cx - bx, cy - by, cz - bz
        qx, qy, qz = px - bx, py - by, pz - bz
        along = min(max((px * bx + py * by + pz * bz) * triangle[12, number], 0.0), 1.0)
        dx, dy, dz = px - along * bx, py - along * by, pz - along * bz
        square = dx * dx + dy * dy + dz * dz
        along = min(max((px * cx + py * cy + pz * cz) * triangle[13, number], 0.0), 1.0)
        dx, dy, dz = px - along * cx, py - along * cy, pz - along * cz
        square = min(square, dx * dx + dy * dy + dz * dz)
        along = min(max((qx * ex + qy * ey + qz * ez) * triangle[14, number], 0.0), 1.0)
        dx, dy, dz = qx - along * ex, qy - along * ey, qz - along * ez
        square = min(square, dx * dx + dy * dy + dz * dz)
        left_of_ab = (by * pz - bz * py) * nx + (bz * px - bx * pz) * ny + (bx * py - by * px) * nz
        left_of_ca = (py * cz - pz * cy) * nx + (pz * cx - px * cz) * ny + (px * cy - py * cx) * nz
        left_of_bc = (ey * qz - ez * qy) * nx + (ez * qx - ex * qz) * ny + (ex * qy - ey * qx) * nz
        height = px * nx + py * ny + pz * nz
        above = min(min(left_of_ab, left_of_ca), left_of_bc) > 0.0
        squares[number - start] = min(square, height * height) if above else square


@njit(cache=True)
def least_square(triangle, box, link, x, y, z, bound, enough, stack, squares):  # pragma: no cover (compiled)
    """Least squared distance to the triangles, or ``bound`` where none is nearer than that.

    Stops at the first triangle nearer than ``enough`` (0: never). stack: (64,) int64 and squares: (8,) are room.
    """
    best, size, node = bound, 0, 0
    while True:
        second = link[node, 0]
        if second:
            near, far = node + 1, second
            near_square, far_square = square_to_box(box, near, x, y, z), square_to_box(box, far, x, y, z)
            if far_square < near_square:
                near, far = far, near
                near_square, far_square = far_square, near_square
            if far_square * BOX_ROUNDING < best:
                stack[size] = far
                size += 1
            if near_square * BOX_ROUNDING < best:
                node = near
                continue
        else:
            start, stop = link[node, 1], link[node, 2]
            leaf_squares(triangle, start, stop, x, y, z, squares)
            for number in range(stop - start):
                best = min(best, squares[number])
            if best < enough:
                return best
        node, size = _next_node(box, stack, size, x, y, z, best)
        if node < 0:
            return best


@njit(cache=True, inline="always")
def _next_node(box, stack, size, x, y, z, best):  # pragma: no cover (compiled)
    """The last waiting node that is still near enough, -1 without any, and how many wait then."""
    while size:
        size -= 1
        if square_to_box(box, stack[size], x, y, z) * BOX_ROUNDING < best:
            return stack[size], size
    return -1, 0


@njit(cache=True)
def crossings(box, link, corner, vertices_m, y, z, stack, places, turns):  # pragma: no cover (compiled)
    """Where the line along x through (y, z) crosses the triangles: how many times.

    places: x of each crossing. turns: +1 where the outward normal points to +x (the line leaves the solid), -1 where
    it enters. A line through an edge or a corner counts as moved by nothing to +y, then by less to +z, so that a closed
    surface is left as often as it is entered.
    """
    count, size = 0, 1
    stack[0] = 0
    while size:
        size -= 1
        node = stack[size]
        if y < box[node, 1] or y > box[node, 4] or z < box[node, 2] or z > box[node, 5]:
            continue
        second = link[node, 0]
        if second:
            stack[size], stack[size + 1] = second, node + 1
            size += 2
            continue
        for number in range(link[node, 1], link[node, 2]):
            turn, place = crossing(vertices_m, corner[number, 0], corner[number, 1], corner[number, 2], y, z)
            if turn != 0:
                places[count], turns[count] = place, turn
                count += 1
    return count


@njit(cache=True)
def crossing(vertices_m, a, b, c, y, z):  # pragma: no cover (compiled)
    """The turn with which the line along x through (y, z) crosses a triangle, 0 where it misses, and the place.

    See ``crossings``.
    """
    turn_a, area_a = _side_of_edge(vertices_m, b, c, y, z)
    turn_b, area_b = _side_of_edge(vertices_m, c, a, y, z)
    turn_c, area_c = _side_of_edge(vertices_m, a, b, y, z)
    area = area_a + area_b + area_c
    if turn_a != turn_b or turn_b != turn_c or area == 0:
        return 0.0, 0.0
    x = area_a * vertices_m[a, 0] + area_b * vertices_m[b, 0] + area_c * vertices_m[c, 0]
    return turn_a, x / area


@njit(cache=True, inline="always")
def _side_of_edge(vertices_m, start, stop, y, z):  # pragma: no cover (compiled)
    """On which side of an edge, seen along x, the line runs (+1 left), and twice the area between.

    Both triangles of an edge compute the same number: from the corner that is numbered lower.
    """
    low, high = min(start, stop), max(start, stop)
    way_y, way_z = vertices_m[high, 1] - vertices_m[low, 1], vertices_m[high, 2] - vertices_m[low, 2]
    area = way_y * (z - vertices_m[low, 2]) - way_z * (y - vertices_m[low, 1])
    turn = np.sign(area)
    if turn == 0:
        turn = -np.sign(way_z)
    if turn == 0:
        turn = np.sign(way_y)
    return (turn, area) if start == low else (-turn, -area)
