"""Intersections of lines along x with closed surfaces: inside tests, and the intervals of a line inside a solid.

Compiled with numba, float64, one thread. Functions that call each other are in one file, because numba's cache is
invalidated only by a change of the file itself. A point is inside if its winding number is positive: the line beyond
the point leaves the surface more often than it enters.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.objects.triangle_tree import DEEPEST, TriangleTree

OUTSIDE, INSIDE, UNSURE = 0, 1, 2
ROUNDING_M = 1e-9  # more than the rounding of a crossing's x


class Intervals(NamedTuple):
    """Intervals inside a solid, of lines along x through the cell centres of a lattice in y and z."""

    low_m: np.ndarray  # (2,) y and z of the lattice's corner
    cell_m: float  # edge of a cell
    shape: np.ndarray  # (2,) cells along y and z
    first: np.ndarray  # (line + 1,) index of each line's first interval
    start_m: np.ndarray  # (interval,) x of the start, rising along a line
    stop_m: np.ndarray  # (interval,) x of the end


def intervals_inside(tree: TriangleTree, cell_m: float) -> Intervals:
    """Intersect a lattice of lines, centred on the bounding box, with the solid that a closed surface bounds.

    cell_m: distance between lines.
    """
    low, high = tree.box[0, 1:3], tree.box[0, 4:]
    shape = np.ceil((high - low) / cell_m - 1e-9).astype(np.int64)  # rounding must not add a cell
    corner = (low + high) / 2 - shape * cell_m / 2
    return Intervals(corner, cell_m, shape, *_intervals(tree, corner, cell_m, shape))


@njit(cache=True)
def settle_sides(tree, points_m, side):  # pragma: no cover (compiled)
    """Replace UNSURE in ``side (point,)`` by INSIDE or OUTSIDE for ``points_m (point, 3)``."""
    _, box, link, _, corner, vertices_m, _ = tree
    stack, crossings_m, signs = np.empty(DEEPEST, np.int64), np.empty(len(corner)), np.empty(len(corner))
    for point in range(len(points_m)):
        if side[point] == UNSURE:
            x, y, z = points_m[point, 0], points_m[point, 1], points_m[point, 2]
            count = _crossings(box, link, corner, vertices_m, x, y, z, stack, crossings_m, signs)
            side[point] = INSIDE if _winding(crossings_m, signs, count, x) > 0 else OUTSIDE


@njit(cache=True)
def negate_inside(tree, low_m, cell_m, value):  # pragma: no cover (compiled)
    """Change the sign of a grid's values (z, y, x) at nodes inside the surface."""
    _, box, link, _, corner, vertices_m, _ = tree
    stack, crossings_m, signs = np.empty(DEEPEST, np.int64), np.empty(len(corner)), np.empty(len(corner))
    for k in range(value.shape[0]):
        for j in range(value.shape[1]):
            y, z = low_m[1] + j * cell_m, low_m[2] + k * cell_m
            count = _crossings(box, link, corner, vertices_m, low_m[0], y, z, stack, crossings_m, signs)
            for i in range(value.shape[2]):
                if _winding(crossings_m, signs, count, low_m[0] + i * cell_m) > 0:
                    value[k, j, i] = -value[k, j, i]


@njit(cache=True, inline="always")
def _winding(crossings_m, signs, count, x):  # pragma: no cover (compiled)
    winding = 0.0
    for number in range(count):
        winding += signs[number] * (crossings_m[number] > x)
    return winding


@njit(cache=True)
def _crossings(box, link, corner, vertices_m, from_x, y, z, stack, crossings_m, signs):  # pragma: no cover (compiled)
    """Intersect the line along x through (y, z) with the triangles. Returns the number of crossings.

    Boxes of triangles below ``from_x`` are skipped, so crossings there may be missing; -inf gives all crossings.
    ``crossings_m`` receives the x of each crossing, ``signs`` +1 if the line leaves the solid there (outward normal
    along +x) and -1 if it enters. A line through an edge or a corner counts as shifted by an infinitesimal step to +y
    and a smaller one to +z, so that every line leaves a closed surface as often as it enters.
    """
    count, size = 0, 1
    stack[0] = 0
    while size:
        size -= 1
        node = stack[size]
        if (
            box[node, 3] < from_x - ROUNDING_M
            or y < box[node, 1]
            or y > box[node, 4]
            or z < box[node, 2]
            or z > box[node, 5]
        ):
            continue
        second = link[node, 0]
        if second:
            stack[size], stack[size + 1] = second, node + 1
            size += 2
            continue
        for number in range(link[node, 1], link[node, 2]):
            sign, x_m = _crossing(vertices_m, corner[number, 0], corner[number, 1], corner[number, 2], y, z)
            if sign != 0:
                crossings_m[count], signs[count] = x_m, sign
                count += 1
    return count


@njit(cache=True)
def _crossing(vertices_m, a, b, c, y, z):  # pragma: no cover (compiled)
    """Sign (0 for a miss) and x of the crossing of one triangle by the line along x through (y, z)."""
    sign_a, area_a = _side_of_edge(vertices_m, b, c, y, z)
    sign_b, area_b = _side_of_edge(vertices_m, c, a, y, z)
    sign_c, area_c = _side_of_edge(vertices_m, a, b, y, z)
    # The line hits the triangle if it is on the same side of all edges; the areas are its barycentric coordinates.
    area = area_a + area_b + area_c
    if sign_a != sign_b or sign_b != sign_c or area == 0:
        return 0.0, 0.0
    x = area_a * vertices_m[a, 0] + area_b * vertices_m[b, 0] + area_c * vertices_m[c, 0]
    return sign_a, x / area


@njit(cache=True, inline="always")
def _side_of_edge(vertices_m, start, end, y, z):  # pragma: no cover (compiled)
    """Side of an edge, seen along x, on which the line is (+1 left), and twice the signed area between them.

    Both triangles of an edge compute the same bits, because both start from the corner with the lower index.
    """
    low, high = min(start, end), max(start, end)
    edge_y, edge_z = vertices_m[high, 1] - vertices_m[low, 1], vertices_m[high, 2] - vertices_m[low, 2]
    area = edge_y * (z - vertices_m[low, 2]) - edge_z * (y - vertices_m[low, 1])
    sign = np.sign(area)
    # A line through the edge: the sign after the infinitesimal shift to +y, then to +z.
    if sign == 0:
        sign = -np.sign(edge_z)
    if sign == 0:
        sign = np.sign(edge_y)
    return (sign, area) if start == low else (-sign, -area)


@njit(cache=True)
def _intervals(tree, low_m, cell_m, shape):  # pragma: no cover (compiled)
    """Index of each line's first interval, and start and end of the intervals inside the solid."""
    _, box, link, _, corner, vertices_m, _ = tree
    stack, crossings_m, signs = np.empty(DEEPEST, np.int64), np.empty(len(corner)), np.empty(len(corner))
    first = np.zeros(shape[0] * shape[1] + 1, np.int64)
    start, stop = [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for j in range(shape[0]):
        for k in range(shape[1]):
            y, z = low_m[0] + (j + 0.5) * cell_m, low_m[1] + (k + 0.5) * cell_m
            count = _crossings(box, link, corner, vertices_m, -np.inf, y, z, stack, crossings_m, signs)
            _sort(crossings_m, signs, count)
            winding = 0.0
            for number in range(count):
                if winding > 0:
                    start.append(crossings_m[number - 1])
                    stop.append(crossings_m[number])
                winding -= signs[number]
            first[j * shape[1] + k + 1] = len(start)
    return first, np.array(start), np.array(stop)


@njit(cache=True)
def _sort(crossings_m, signs, count):  # pragma: no cover (compiled)
    """Sort by insertion, because a line has few crossings."""
    for number in range(1, count):
        crossing_m, sign, slot = crossings_m[number], signs[number], number
        while slot and crossings_m[slot - 1] > crossing_m:
            crossings_m[slot], signs[slot] = crossings_m[slot - 1], signs[slot - 1]
            slot -= 1
        crossings_m[slot], signs[slot] = crossing_m, sign


@njit(cache=True)
def common_length_m(vertices_m, faces, intervals):  # pragma: no cover (compiled)
    """Total length of lines inside both a closed surface (vertex, 3), (face, 3) and the intervals."""
    low_m, cell_m, shape, first, start_m, stop_m = intervals
    newest = np.full(shape[0] * shape[1], -1, np.int64)  # (line,) index of its last crossing: a linked list
    previous, crossings_m, signs = [0 for _ in range(0)], [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for face in range(len(faces)):
        a, b, c = faces[face]
        j_start, j_stop = _cells_between(vertices_m, a, b, c, 1, low_m[0], cell_m, shape[0])
        k_start, k_stop = _cells_between(vertices_m, a, b, c, 2, low_m[1], cell_m, shape[1])
        for j in range(j_start, j_stop):
            for k in range(k_start, k_stop):
                line = j * shape[1] + k
                if first[line] == first[line + 1]:
                    continue
                y, z = low_m[0] + (j + 0.5) * cell_m, low_m[1] + (k + 0.5) * cell_m
                sign, crossing_m = _crossing(vertices_m, a, b, c, y, z)
                if sign != 0:
                    previous.append(int(newest[line]))
                    newest[line] = len(crossings_m)
                    crossings_m.append(crossing_m)
                    signs.append(sign)
    return _sum_common_lengths(newest, previous, crossings_m, signs, first, start_m, stop_m)


@njit(cache=True, inline="always")
def _cells_between(vertices_m, a, b, c, axis, low_m, cell_m, count):  # pragma: no cover (compiled)
    """Range of cells along an axis whose centres are within a triangle's extent, widened against rounding."""
    low = min(vertices_m[a, axis], vertices_m[b, axis], vertices_m[c, axis])
    high = max(vertices_m[a, axis], vertices_m[b, axis], vertices_m[c, axis])
    start = int(np.floor((low - low_m) / cell_m - 0.5))
    stop = int(np.ceil((high - low_m) / cell_m - 0.5)) + 1
    return max(start, 0), min(stop, count)


@njit(cache=True)
def _sum_common_lengths(newest, previous, crossings_m, signs, first, start_m, stop_m):  # pragma: no cover (compiled)
    length = 0.0
    line_crossings_m, line_signs = np.empty(len(crossings_m)), np.empty(len(crossings_m))
    for line in range(len(newest)):
        count, number = 0, newest[line]
        while number >= 0:
            line_crossings_m[count], line_signs[count] = crossings_m[number], signs[number]
            count += 1
            number = previous[number]
        _sort(line_crossings_m, line_signs, count)
        winding = 0.0
        for number in range(count):
            if winding > 0:
                for interval in range(first[line], first[line + 1]):
                    begin = max(line_crossings_m[number - 1], start_m[interval])
                    length += max(min(line_crossings_m[number], stop_m[interval]) - begin, 0.0)
            winding -= line_signs[number]
    return length
