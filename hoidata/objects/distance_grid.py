"""Exact distance queries on a triangle tree, accelerated by a grid of precomputed distances.

The distance function is 1-Lipschitz. So trilinear interpolation in a cell errs by at most the cell's edge times
``sqrt(sum t (1 - t))`` over the three cell coordinates t (Jensen's inequality): 0.87 edges at the cell's centre, 0 at
its corners. If this bound does not decide a query, the triangles do. All answers are exact: the distance has the same
bits with a grid, without a grid, and in any order of the search.

Compiled with numba, float64, one thread. Functions that call each other are in one file, because numba's cache is
invalidated only by a change of the file itself.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.objects.line_crossings import INSIDE, OUTSIDE, UNSURE, negate_inside
from hoidata.objects.triangle_tree import DEEPEST, LEAF, TriangleTree

CELLS = 64
MARGIN_M = 0.01
_ROUNDING_M = 1e-6  # more than float32 loses on a metre
_SHRINK = 1 - 1e-12  # of box distances: rounding must not skip a box that is as near as the best triangle
_WIDEN = 1 + 1e-9  # of search bounds: a distance equal to the bound must be found
_TINY_M = 1e-30  # its square is not yet 0


class DistanceGrid(NamedTuple):
    """Signed distances at the nodes of a regular grid."""

    low_m: np.ndarray  # (3,) position of node (0, 0, 0)
    cell_m: float  # edge of a cell
    value: np.ndarray  # (z, y, x) float32 metres, negative inside a solid


def no_grid() -> DistanceGrid:
    """A grid without nodes: all queries use the triangles."""
    return DistanceGrid(np.zeros(3), 1.0, np.zeros((0, 0, 0), np.float32))


def distance_grid(tree: TriangleTree, solid: bool) -> DistanceGrid:
    """Compute a grid over a surface and 1 cm around it, with about as many cells as a cube of 64 x 64 x 64.

    solid: the surface is closed, so distances inside are negative.
    """
    low, high = tree.box[0, :3] - MARGIN_M, tree.box[0, 3:] + MARGIN_M
    cell = float(np.cbrt(np.prod(high - low))) / CELLS
    x, y, z = np.ceil((high - low) / cell - 1e-9).astype(int) + 1
    value = np.empty((z, y, x), np.float32)
    _fill(tree, low, cell, value)
    if solid:
        negate_inside(tree, low, cell, value)
    return DistanceGrid(low, cell, value)


@njit(cache=True)
def _fill(tree, low_m, cell_m, value):  # pragma: no cover (compiled)
    """Compute the distances of all nodes. The distance of a node bounds the next one along x."""
    triangle, link, oriented = tree[0], tree[2], tree[6]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    for k in range(value.shape[0]):
        for j in range(value.shape[1]):
            y, z, distance = low_m[1] + j * cell_m, low_m[2] + k * cell_m, np.inf
            for i in range(value.shape[2]):
                x, bound = low_m[0] + i * cell_m, (distance + cell_m) * _WIDEN
                distance = np.sqrt(_least_square(triangle, link, oriented, x, y, z, bound * bound, 0.0, stack, squares))
                value[k, j, i] = distance


@njit(cache=True, inline="always")
def _interpolate(low_m, cell_m, value, x, y, z):  # pragma: no cover (compiled)
    """Interpolated distance at a point and its error bound; (0, inf) without a grid.

    A point outside the grid takes the value of the closest point of the grid; the bound grows by the gap.
    """
    if not (value.size and abs(x) + abs(y) + abs(z) < np.inf):
        return 0.0, np.inf
    u, v, w = (x - low_m[0]) / cell_m, (y - low_m[1]) / cell_m, (z - low_m[2]) / cell_m
    i = min(max(int(u), 0), value.shape[2] - 2)
    j = min(max(int(v), 0), value.shape[1] - 2)
    k = min(max(int(w), 0), value.shape[0] - 2)
    far_u, far_v, far_w = u - i, v - j, w - k
    u, v, w = min(max(far_u, 0.0), 1.0), min(max(far_v, 0.0), 1.0), min(max(far_w, 0.0), 1.0)
    outside_m = cell_m * np.sqrt((far_u - u) ** 2 + (far_v - v) ** 2 + (far_w - w) ** 2)
    near = (value[k, j, i] * (1 - u) + value[k, j, i + 1] * u) * (1 - v)
    near += (value[k, j + 1, i] * (1 - u) + value[k, j + 1, i + 1] * u) * v
    far = (value[k + 1, j, i] * (1 - u) + value[k + 1, j, i + 1] * u) * (1 - v)
    far += (value[k + 1, j + 1, i] * (1 - u) + value[k + 1, j + 1, i + 1] * u) * v
    slack = cell_m * np.sqrt(u * (1 - u) + v * (1 - v) + w * (1 - w)) + _ROUNDING_M + outside_m * _WIDEN
    return near * (1 - w) + far * w, slack


@njit(cache=True)
def interpolated(grid, points_m):  # pragma: no cover (compiled)
    """(point,) interpolated signed distances at ``points_m (point, 3)``; outside the grid, lower bounds.

    The surface is inside the grid, so its distance is at least ``hypot(gap to the grid, distance from there)``.
    """
    low_m, cell_m, value = grid[0], grid[1], grid[2]
    distance = np.empty(len(points_m))
    for point in range(len(points_m)):
        outside_square, on_grid = 0.0, np.empty(3)
        for axis in range(3):
            high_m = low_m[axis] + cell_m * (value.shape[2 - axis] - 1)
            on_grid[axis] = min(max(points_m[point, axis], low_m[axis]), high_m)
            outside_square += (points_m[point, axis] - on_grid[axis]) ** 2
        near = _interpolate(low_m, cell_m, value, on_grid[0], on_grid[1], on_grid[2])[0]
        distance[point] = np.sqrt(outside_square + near * near) if outside_square > 0.0 else near
    return distance


@njit(cache=True)
def mark_within(tree, grid, points_m, threshold_m, within):  # pragma: no cover (compiled)
    """Set ``within (point,)`` where the distance of ``points_m (point, 3)`` is less than the threshold.

    Points that are already marked are skipped.
    """
    triangle, box, link, oriented, low_m, cell_m, value = tree[0], tree[1], tree[2], tree[6], grid[0], grid[1], grid[2]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    bound, early_stop = threshold_m * threshold_m * _WIDEN, threshold_m * threshold_m / _WIDEN
    for point in range(len(points_m)):
        x, y, z = points_m[point, 0], points_m[point, 1], points_m[point, 2]
        if within[point] or _square_to_box(box, 0, x, y, z) > bound:
            continue
        distance, slack = _interpolate(low_m, cell_m, value, x, y, z)
        if abs(distance) - slack >= threshold_m:
            continue
        if abs(distance) + slack < threshold_m:
            within[point] = True
            continue
        square = _least_square(triangle, link, oriented, x, y, z, bound, early_stop, stack, squares)
        within[point] = np.sqrt(square) < threshold_m


@njit(cache=True)
def lower_distances(tree, grid, points_m, most_m, distance_m):  # pragma: no cover (compiled)
    """Lower ``distance_m (point,)`` to the distance of ``points_m (point, 3)``, unless that exceeds ``most_m``."""
    triangle, box, link, oriented, low_m, cell_m, value = tree[0], tree[1], tree[2], tree[6], grid[0], grid[1], grid[2]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    for point in range(len(points_m)):
        x, y, z = points_m[point, 0], points_m[point, 1], points_m[point, 2]
        most = min(most_m, distance_m[point])
        if _square_to_box(box, 0, x, y, z) > most * most * _WIDEN:
            continue
        near, slack = _interpolate(low_m, cell_m, value, x, y, z)
        if abs(near) - slack > most:
            continue
        bound = min(most, abs(near) + slack) * _WIDEN + _TINY_M
        distance = np.sqrt(_least_square(triangle, link, oriented, x, y, z, bound * bound, 0.0, stack, squares))
        if distance <= most:
            distance_m[point] = distance


@njit(cache=True)
def nearest_triangles(tree, points_m, distance_m, closest_m, triangle_of):  # pragma: no cover (compiled)
    """Find the closest surface point and its triangle.

    Args:
        points_m: (point, 3) query points.
        distance_m: (point,) exact distances from ``lower_distances``; points with an infinite distance are skipped.
        closest_m: (point, 3) output, on the surface.
        triangle_of: (point,) output, indices in the tree's order.
    """
    triangle, link, oriented = tree[0], tree[2], tree[6]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    for point in range(len(points_m)):
        if distance_m[point] < np.inf:
            x, y, z = points_m[point, 0], points_m[point, 1], points_m[point, 2]
            bound = distance_m[point] * _WIDEN + _TINY_M
            number = _triangle_within(triangle, link, oriented, x, y, z, bound * bound, stack, squares)
            if number < 0:  # a sliver triangle can, by rounding, be closer than its box
                number = _triangle_within(triangle, link, oriented, x, y, z, np.inf, stack, squares)
            triangle_of[point] = number
            _closest_point(triangle, number, x, y, z, closest_m[point])


@njit(cache=True)
def _triangle_within(triangle, link, oriented, x, y, z, bound, stack, squares):  # pragma: no cover (compiled)
    """The nearest triangle whose squared distance is at most ``bound``; -1 if there is none."""
    best, nearest, size = bound, -1, 1
    stack[0] = 0
    while size:
        size -= 1
        node = stack[size]
        if _square_to_oriented(oriented, node, x, y, z) * _SHRINK > best:
            continue
        if link[node, 0]:
            stack[size], stack[size + 1] = link[node, 0], node + 1
            size += 2
            continue
        start, stop = link[node, 1], link[node, 2]
        _leaf_squares(triangle, start, stop, x, y, z, squares)
        for number in range(stop - start):
            if squares[number] < best or (nearest < 0 and squares[number] <= best):
                best, nearest = squares[number], start + number
    return nearest


@njit(cache=True)
def _closest_point(triangle, number, x, y, z, closest):  # pragma: no cover (compiled)
    """The point on one triangle closest to (x, y, z), by the arithmetic of ``_leaf_squares``."""
    a, ab, ac = triangle[0:3, number], triangle[3:6, number], triangle[6:9, number]
    normal, inverse = triangle[9:12, number], triangle[12:15, number]
    p = np.array((x - a[0], y - a[1], z - a[2]))
    least = np.inf
    for edge in range(3):
        origin, direction = (ab, ac - ab) if edge == 2 else (np.zeros(3), ac if edge else ab)
        along = min(max(np.sum((p - origin) * direction) * inverse[edge], 0.0), 1.0)
        candidate = origin + along * direction
        square = np.sum((p - candidate) ** 2)
        if square < least:
            least = square
            closest[:] = a + candidate
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
def sides(tree, grid, points_m):  # pragma: no cover (compiled)
    """(point,) int8: INSIDE or OUTSIDE of a closed surface if the box or the grid decides it, else UNSURE."""
    box, low_m, cell_m, value = tree[1], grid[0], grid[1], grid[2]
    side = np.full(len(points_m), OUTSIDE, np.int8)
    for point in range(len(points_m)):
        x, y, z = points_m[point, 0], points_m[point, 1], points_m[point, 2]
        if _square_to_box(box, 0, x, y, z) == 0:
            distance, slack = _interpolate(low_m, cell_m, value, x, y, z)
            if distance - slack <= 0:
                side[point] = INSIDE if distance + slack < 0 else UNSURE
    return side


@njit(cache=True, inline="always")
def _square_to_box(box, node, x, y, z):  # pragma: no cover (compiled)
    """Squared distance to a node's box, 0 inside."""
    dx = max(box[node, 0] - x, x - box[node, 3], 0.0)
    dy = max(box[node, 1] - y, y - box[node, 4], 0.0)
    dz = max(box[node, 2] - z, z - box[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, inline="always")
def _square_to_oriented(oriented, node, x, y, z):  # pragma: no cover (compiled)
    """Squared distance to a node's oriented box, 0 inside."""
    nx, ny, nz = oriented[node, 0], oriented[node, 1], oriented[node, 2]
    ux, uy, uz = oriented[node, 3], oriented[node, 4], oriented[node, 5]
    along, across = nx * x + ny * y + nz * z, ux * x + uy * y + uz * z
    third = (ny * uz - nz * uy) * x + (nz * ux - nx * uz) * y + (nx * uy - ny * ux) * z
    along = max(oriented[node, 6] - along, along - oriented[node, 9], 0.0)
    across = max(oriented[node, 7] - across, across - oriented[node, 10], 0.0)
    third = max(oriented[node, 8] - third, third - oriented[node, 11], 0.0)
    return along * along + across * across + third * third


@njit(cache=True, fastmath={"nnan", "ninf", "nsz"})
def _leaf_squares(triangle, start, stop, x, y, z, squares):  # pragma: no cover (compiled)
    """Squared distances to triangles ``start`` to ``stop``, without branches so that the compiler vectorizes it.

    If the point projects into the triangle, its plane is closest, otherwise one of the three edges.
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
def _least_square(triangle, link, oriented, x, y, z, bound, early_stop, stack, squares):  # pragma: no cover (compiled)
    """Least squared distance to the triangles, at most ``bound``.

    The search stops at a squared distance below ``early_stop`` (0: never). ``stack`` (64,) int64 and ``squares`` (8,)
    are scratch memory.
    """
    best, size, node = bound, 0, 0
    while True:
        second = link[node, 0]
        if second:
            near, far = node + 1, second
            near_square, far_square = (
                _square_to_oriented(oriented, near, x, y, z),
                _square_to_oriented(oriented, far, x, y, z),
            )
            if far_square < near_square:
                near, far = far, near
                near_square, far_square = far_square, near_square
            # Descend to the nearer child, and keep the farther one for later.
            if far_square * _SHRINK < best:
                stack[size] = far
                size += 1
            if near_square * _SHRINK < best:
                node = near
                continue
        else:
            start, stop = link[node, 1], link[node, 2]
            _leaf_squares(triangle, start, stop, x, y, z, squares)
            for number in range(stop - start):
                best = min(best, squares[number])
            if best < early_stop:
                return best
        node, size = _next_node(oriented, stack, size, x, y, z, best)
        if node < 0:
            return best


@njit(cache=True, inline="always")
def _next_node(oriented, stack, size, x, y, z, best):  # pragma: no cover (compiled)
    """Pop nodes that are too far away. Returns the first node that is not (-1 if none) and the stack size."""
    while size:
        size -= 1
        if _square_to_oriented(oriented, stack[size], x, y, z) * _SHRINK < best:
            return stack[size], size
    return -1, 0
