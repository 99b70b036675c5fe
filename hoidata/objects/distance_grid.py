"""Distances to a surface on a grid, and what they say for certain about a place between the nodes.

A distance changes by at most the way gone, so what is interpolated between the eight nodes of a cell errs by at most
the cell's edge times the root of ``sum t (1 - t)`` over the three places t in the cell (Jensen's inequality): 0.87
edges in its middle, nothing at its corners. Where that does not decide a question, the triangles do: all answers are
exact, and the least distance is the same to the last bit with a grid, without one, and in any order of the search.

Compiled with numba, float64, one thread. All that call each other stand in this file: numba keeps compiled code by the
file it is in, and does not see a change in another.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.objects.line_crossings import INSIDE, OUTSIDE, UNSURE, turn_inside_negative
from hoidata.objects.triangle_tree import DEEPEST, LEAF, TriangleTree

CELLS = 64
MARGIN_M = 0.01
_ROUNDING_M = 1e-6  # more than float32 loses on a metre
_BOX_ROUNDING = 1 - 1e-12  # a box is left out only when it is clearly farther than the best triangle so far
_WIDER = 1 + 1e-9  # bounds of a search, so that a distance equal to one is found
_TINY_M = 1e-30  # its square is not yet 0


class DistanceGrid(NamedTuple):
    """value: (z, y, x) float32 distances in metres, negative inside a solid; node (0, 0, 0) lies at low_m (3,).

    cell_m: edge of a cell.
    """

    low_m: np.ndarray
    cell_m: float
    value: np.ndarray


def no_grid() -> DistanceGrid:
    """A grid without nodes: every question goes to the triangles."""
    return DistanceGrid(np.zeros(3), 1.0, np.zeros((0, 0, 0), np.float32))


def distance_grid(tree: TriangleTree, solid: bool) -> DistanceGrid:
    """As many cells as a cube of 64 x 64 x 64, over the surface and 1 cm around it, whatever its proportions.

    solid: the surface is closed, so that inside (where a line leaves the surface oftener than it enters) is negative.
    """
    low, high = tree.box[0, :3] - MARGIN_M, tree.box[0, 3:] + MARGIN_M
    cell = float(np.cbrt(np.prod(high - low))) / CELLS
    x, y, z = np.ceil((high - low) / cell - 1e-9).astype(int) + 1
    value = np.empty((z, y, x), np.float32)
    _fill(tree, low, cell, value)
    if solid:
        turn_inside_negative(tree, low, cell, value)
    return DistanceGrid(low, cell, value)


@njit(cache=True)
def _fill(tree, low_m, cell_m, value):  # pragma: no cover (compiled)
    """Distances of all nodes; each bounds that of the next in its row."""
    triangle, link, turned = tree[0], tree[2], tree[6]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    for k in range(value.shape[0]):
        for j in range(value.shape[1]):
            y, z, distance = low_m[1] + j * cell_m, low_m[2] + k * cell_m, np.inf
            for i in range(value.shape[2]):
                x, bound = low_m[0] + i * cell_m, (distance + cell_m) * _WIDER
                distance = np.sqrt(_least_square(triangle, link, turned, x, y, z, bound * bound, 0.0, stack, squares))
                value[k, j, i] = distance


@njit(cache=True, inline="always")
def _between(low_m, cell_m, value, x, y, z):  # pragma: no cover (compiled)
    """Interpolated value at a place, and how far the truth may be off; (0, inf) without a grid.

    Off the grid the value of its nearest place stands, and the way to there is added to what it may be off.
    """
    if not (value.size and abs(x) + abs(y) + abs(z) < np.inf):
        return 0.0, np.inf
    u, v, w = (x - low_m[0]) / cell_m, (y - low_m[1]) / cell_m, (z - low_m[2]) / cell_m
    i = min(max(int(u), 0), value.shape[2] - 2)
    j = min(max(int(v), 0), value.shape[1] - 2)
    k = min(max(int(w), 0), value.shape[0] - 2)
    far_u, far_v, far_w = u - i, v - j, w - k
    u, v, w = min(max(far_u, 0.0), 1.0), min(max(far_v, 0.0), 1.0), min(max(far_w, 0.0), 1.0)
    beyond = cell_m * np.sqrt((far_u - u) ** 2 + (far_v - v) ** 2 + (far_w - w) ** 2)
    near = (value[k, j, i] * (1 - u) + value[k, j, i + 1] * u) * (1 - v)
    near += (value[k, j + 1, i] * (1 - u) + value[k, j + 1, i + 1] * u) * v
    far = (value[k + 1, j, i] * (1 - u) + value[k + 1, j, i + 1] * u) * (1 - v)
    far += (value[k + 1, j + 1, i] * (1 - u) + value[k + 1, j + 1, i + 1] * u) * v
    slack = cell_m * np.sqrt(u * (1 - u) + v * (1 - v) + w * (1 - w)) + _ROUNDING_M + beyond * _WIDER
    return near * (1 - w) + far * w, slack


@njit(cache=True)
def interpolated(grid, places_m):  # pragma: no cover (compiled)
    """(place,) signed distances at ``places_m (place, 3)`` between the nodes of a grid; off the grid lower bounds.

    The surface lies inside of the grid, so the way to it is at least the hypotenuse of the way to the grid and on.
    """
    low_m, cell_m, value = grid[0], grid[1], grid[2]
    distance = np.empty(len(places_m))
    for place in range(len(places_m)):
        beyond, on_grid = 0.0, np.empty(3)
        for axis in range(3):
            high_m = low_m[axis] + cell_m * (value.shape[2 - axis] - 1)
            on_grid[axis] = min(max(places_m[place, axis], low_m[axis]), high_m)
            beyond += (places_m[place, axis] - on_grid[axis]) ** 2
        near = _between(low_m, cell_m, value, on_grid[0], on_grid[1], on_grid[2])[0]
        distance[place] = np.sqrt(beyond + near * near) if beyond > 0.0 else near
    return distance


@njit(cache=True)
def mark_within(tree, grid, places_m, threshold_m, within):  # pragma: no cover (compiled)
    """Set ``within (place,)`` where the distance of ``places_m (place, 3)`` is less than the threshold.

    Places already marked are not looked at.
    """
    triangle, box, link, turned, low_m, cell_m, value = tree[0], tree[1], tree[2], tree[6], grid[0], grid[1], grid[2]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    bound, enough = threshold_m * threshold_m * _WIDER, threshold_m * threshold_m / _WIDER
    for place in range(len(places_m)):
        x, y, z = places_m[place, 0], places_m[place, 1], places_m[place, 2]
        if within[place] or _square_to_box(box, 0, x, y, z) > bound:
            continue
        distance, slack = _between(low_m, cell_m, value, x, y, z)
        if abs(distance) - slack >= threshold_m:
            continue
        if abs(distance) + slack < threshold_m:
            within[place] = True
            continue
        square = _least_square(triangle, link, turned, x, y, z, bound, enough, stack, squares)
        within[place] = np.sqrt(square) < threshold_m


@njit(cache=True)
def lower_distances(tree, grid, places_m, most_m, distance_m):  # pragma: no cover (compiled)
    """Set ``distance_m (place,)`` to the distance of ``places_m (place, 3)`` where less, and not above ``most_m``."""
    triangle, box, link, turned, low_m, cell_m, value = tree[0], tree[1], tree[2], tree[6], grid[0], grid[1], grid[2]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    for place in range(len(places_m)):
        x, y, z = places_m[place, 0], places_m[place, 1], places_m[place, 2]
        most = min(most_m, distance_m[place])
        if _square_to_box(box, 0, x, y, z) > most * most * _WIDER:
            continue
        near, slack = _between(low_m, cell_m, value, x, y, z)
        if abs(near) - slack > most:
            continue
        bound = min(most, abs(near) + slack) * _WIDER + _TINY_M
        found = np.sqrt(_least_square(triangle, link, turned, x, y, z, bound * bound, 0.0, stack, squares))
        if found <= most:
            distance_m[place] = found


@njit(cache=True)
def nearest_triangles(tree, places_m, distance_m, closest_m, triangle_of):  # pragma: no cover (compiled)
    """Set ``closest_m (place, 3)`` on the surface and its triangle, by the tree's order, in ``triangle_of (place,)``.

    distance_m: (place,) exact distances, as ``lower_distances`` gives them; places with an infinite one are left alone.
    """
    triangle, link, turned = tree[0], tree[2], tree[6]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    for place in range(len(places_m)):
        if distance_m[place] < np.inf:
            x, y, z = places_m[place, 0], places_m[place, 1], places_m[place, 2]
            bound = distance_m[place] * _WIDER + _TINY_M
            number = _triangle_within(triangle, link, turned, x, y, z, bound * bound, stack, squares)
            if number < 0:  # rounding put a triangle far longer than wide nearer than its box is
                number = _triangle_within(triangle, link, turned, x, y, z, np.inf, stack, squares)
            triangle_of[place] = number
            _closest_place(triangle, number, x, y, z, closest_m[place])


@njit(cache=True)
def _triangle_within(triangle, link, turned, x, y, z, bound, stack, squares):  # pragma: no cover (compiled)
    """The nearest triangle, of those whose squared distance is not above ``bound``; -1 without any."""
    best, found, size = bound, -1, 1
    stack[0] = 0
    while size:
        size -= 1
        node = stack[size]
        if _square_to_turned(turned, node, x, y, z) * _BOX_ROUNDING > best:
            continue
        if link[node, 0]:
            stack[size], stack[size + 1] = link[node, 0], node + 1
            size += 2
            continue
        start, stop = link[node, 1], link[node, 2]
        _leaf_squares(triangle, start, stop, x, y, z, squares)
        for number in range(stop - start):
            if squares[number] < best or (found < 0 and squares[number] <= best):
                best, found = squares[number], start + number
    return found


@njit(cache=True)
def _closest_place(triangle, number, x, y, z, closest):  # pragma: no cover (compiled)
    """The place on one triangle nearest to (x, y, z), as ``_leaf_squares`` finds it."""
    a, ab, ac = triangle[0:3, number], triangle[3:6, number], triangle[6:9, number]
    normal, inverse = triangle[9:12, number], triangle[12:15, number]
    p = np.array((x - a[0], y - a[1], z - a[2]))
    least = np.inf
    for edge in range(3):
        origin, way = (ab, ac - ab) if edge == 2 else (np.zeros(3), ac if edge else ab)
        along = min(max(np.sum((p - origin) * way) * inverse[edge], 0.0), 1.0)
        place = origin + along * way
        square = np.sum((p - place) ** 2)
        if square < least:
            least = square
            closest[:] = a + place
    height = np.sum(p * normal)
    flat = p - height * normal
    left_of_ab, left_of_ca = np.sum(_cross(ab, flat) * normal), np.sum(_cross(flat, ac) * normal)
    left_of_bc = np.sum(_cross(ac - ab, flat - ab) * normal)
    if min(left_of_ab, left_of_ca, left_of_bc) > 0.0 and height * height < least:
        closest[:] = a + flat


@njit(cache=True, inline="always")
def _cross(u, v):  # pragma: no cover (compiled)
    return np.array((u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]))


@njit(cache=True)
def sides(tree, grid, places_m):  # pragma: no cover (compiled)
    """(place,) int8: INSIDE or OUTSIDE of a closed surface where box or grid say so for certain, else UNSURE."""
    box, low_m, cell_m, value = tree[1], grid[0], grid[1], grid[2]
    side = np.full(len(places_m), OUTSIDE, np.int8)
    for place in range(len(places_m)):
        x, y, z = places_m[place, 0], places_m[place, 1], places_m[place, 2]
        if _square_to_box(box, 0, x, y, z) == 0:
            distance, slack = _between(low_m, cell_m, value, x, y, z)
            if distance - slack <= 0:
                side[place] = INSIDE if distance + slack < 0 else UNSURE
    return side


@njit(cache=True, inline="always")
def _square_to_box(box, node, x, y, z):  # pragma: no cover (compiled)
    """Squared distance to a node's box, 0 inside."""
    dx = max(box[node, 0] - x, x - box[node, 3], 0.0)
    dy = max(box[node, 1] - y, y - box[node, 4], 0.0)
    dz = max(box[node, 2] - z, z - box[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, inline="always")
def _square_to_turned(turned, node, x, y, z):  # pragma: no cover (compiled)
    """Squared distance to a node's turned box, 0 inside."""
    nx, ny, nz = turned[node, 0], turned[node, 1], turned[node, 2]
    ux, uy, uz = turned[node, 3], turned[node, 4], turned[node, 5]
    along, across = nx * x + ny * y + nz * z, ux * x + uy * y + uz * z
    third = (ny * uz - nz * uy) * x + (nz * ux - nx * uz) * y + (nx * uy - ny * ux) * z
    along = max(turned[node, 6] - along, along - turned[node, 9], 0.0)
    across = max(turned[node, 7] - across, across - turned[node, 10], 0.0)
    third = max(turned[node, 8] - third, third - turned[node, 11], 0.0)
    return along * along + across * across + third * third


@njit(cache=True, fastmath={"nnan", "ninf", "nsz"})
def _leaf_squares(triangle, start, stop, x, y, z, squares):  # pragma: no cover (compiled)
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
def _least_square(triangle, link, turned, x, y, z, bound, enough, stack, squares):  # pragma: no cover (compiled)
    """Least squared distance to the triangles, or ``bound`` where none is nearer than that.

    Stops at the first triangle nearer than ``enough`` (0: never). stack: (64,) int64 and squares: (8,) are room.
    """
    best, size, node = bound, 0, 0
    while True:
        second = link[node, 0]
        if second:
            near, far = node + 1, second
            near_square, far_square = _square_to_turned(turned, near, x, y, z), _square_to_turned(turned, far, x, y, z)
            if far_square < near_square:
                near, far = far, near
                near_square, far_square = far_square, near_square
            if far_square * _BOX_ROUNDING < best:
                stack[size] = far
                size += 1
            if near_square * _BOX_ROUNDING < best:
                node = near
                continue
        else:
            start, stop = link[node, 1], link[node, 2]
            _leaf_squares(triangle, start, stop, x, y, z, squares)
            for number in range(stop - start):
                best = min(best, squares[number])
            if best < enough:
                return best
        node, size = _next_node(turned, stack, size, x, y, z, best)
        if node < 0:
            return best


@njit(cache=True, inline="always")
def _next_node(turned, stack, size, x, y, z, best):  # pragma: no cover (compiled)
    """The last waiting node that is still near enough, -1 without any, and how many wait then."""
    while size:
        size -= 1
        if _square_to_turned(turned, stack[size], x, y, z) * _BOX_ROUNDING < best:
            return stack[size], size
    return -1, 0
