"""Lines along the x axis through closed surfaces: what is inside, and where a line runs inside.

Compiled with numba, float64, one thread. All that call each other stand in this file: numba keeps compiled code by the
file it is in, and does not see a change in another. Inside is what the surface winds around: where a line through the
position leaves the surface behind it oftener than it enters.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.objects.triangle_tree import DEEPEST, TriangleTree

OUTSIDE, INSIDE, UNSURE = 0, 1, 2


class Intervals(NamedTuple):
    """Lines through a solid, one in the middle of each cell of a lattice in y and z.

    low_m: (2,) y and z of the lattice's corner; cell_m: edge of a cell; shape: (2,) cells. first: (line + 1,) where
    each line's intervals inside the solid start; start_m, stop_m: (interval,) x of their ends, rising along a line.
    """

    low_m: np.ndarray
    cell_m: float
    shape: np.ndarray
    first: np.ndarray
    start_m: np.ndarray
    stop_m: np.ndarray


def intervals_inside(tree: TriangleTree, cell_m: float) -> Intervals:
    """The intervals of the lines of a lattice that lie inside a closed surface.

    tree: its triangles, metres. cell_m: distance of the lines; they lie evenly about the middle of the surface's box.
    """
    low, high = tree.box[0, 1:3], tree.box[0, 4:]
    shape = np.ceil((high - low) / cell_m - 1e-9).astype(np.int64)  # a size that is so many cells but for rounding
    corner = (low + high) / 2 - shape * cell_m / 2
    return Intervals(corner, cell_m, shape, *_intervals(tree, corner, cell_m, shape))


@njit(cache=True)
def settle_sides(tree, positions_m, side):  # pragma: no cover (compiled)
    """Where ``side (position,)`` is UNSURE, set it to INSIDE or OUTSIDE for ``positions_m (position, 3)``."""
    _, box, link, _, corner, vertices_m, _ = tree
    stack, crossed, turns = np.empty(DEEPEST, np.int64), np.empty(len(corner)), np.empty(len(corner))
    for row in range(len(positions_m)):
        if side[row] == UNSURE:
            x, y, z = positions_m[row, 0], positions_m[row, 1], positions_m[row, 2]
            count = _crossings(box, link, corner, vertices_m, y, z, stack, crossed, turns)
            side[row] = INSIDE if _winding(crossed, turns, count, x) > 0 else OUTSIDE


@njit(cache=True)
def turn_inside_negative(tree, low_m, cell_m, value):  # pragma: no cover (compiled)
    """Of a grid's nodes ``value (z, y, x)`` those inside."""
    _, box, link, _, corner, vertices_m, _ = tree
    stack, crossed, turns = np.empty(DEEPEST, np.int64), np.empty(len(corner)), np.empty(len(corner))
    for k in range(value.shape[0]):
        for j in range(value.shape[1]):
            y, z = low_m[1] + j * cell_m, low_m[2] + k * cell_m
            count = _crossings(box, link, corner, vertices_m, y, z, stack, crossed, turns)
            for i in range(value.shape[2]):
                if _winding(crossed, turns, count, low_m[0] + i * cell_m) > 0:
                    value[k, j, i] = -value[k, j, i]


@njit(cache=True, inline="always")
def _winding(crossed, turns, count, x):  # pragma: no cover (compiled)
    winding = 0.0
    for number in range(count):
        winding += turns[number] * (crossed[number] > x)
    return winding


@njit(cache=True)
def _crossings(box, link, corner, vertices_m, y, z, stack, positions, turns):  # pragma: no cover (compiled)
    """Where the line along x through (y, z) crosses the triangles: how many times.

    positions: x of each crossing. turns: +1 where the outward normal points to +x (the line leaves the solid), -1 where
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
            turn, position = _crossing(vertices_m, corner[number, 0], corner[number, 1], corner[number, 2], y, z)
            if turn != 0:
                positions[count], turns[count] = position, turn
                count += 1
    return count


@njit(cache=True)
def _crossing(vertices_m, a, b, c, y, z):  # pragma: no cover (compiled)
    """The turn with which the line along x through (y, z) crosses a triangle, 0 where it misses, and the position.

    See ``_crossings``.
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


@njit(cache=True)
def _intervals(tree, low_m, cell_m, shape):  # pragma: no cover (compiled)
    """Where each line runs inside the solid."""
    _, box, link, _, corner, vertices_m, _ = tree
    stack, positions, turns = np.empty(DEEPEST, np.int64), np.empty(len(corner)), np.empty(len(corner))
    first = np.zeros(shape[0] * shape[1] + 1, np.int64)
    start, stop = [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for j in range(shape[0]):
        for k in range(shape[1]):
            y, z = low_m[0] + (j + 0.5) * cell_m, low_m[1] + (k + 0.5) * cell_m
            count = _crossings(box, link, corner, vertices_m, y, z, stack, positions, turns)
            _sort(positions, turns, count)
            winding = 0.0
            for number in range(count):
                if winding > 0:
                    start.append(positions[number - 1])
                    stop.append(positions[number])
                winding -= turns[number]
            first[j * shape[1] + k + 1] = len(start)
    return first, np.array(start), np.array(stop)


@njit(cache=True)
def _sort(positions, turns, count):  # pragma: no cover (compiled)
    """By position; a line has a handful of crossings."""
    for number in range(1, count):
        position, turn, at = positions[number], turns[number], number
        while at and positions[at - 1] > position:
            positions[at], turns[at] = positions[at - 1], turns[at - 1]
            at -= 1
        positions[at], turns[at] = position, turn


@njit(cache=True)
def common_length_m(vertices_m, faces, intervals):  # pragma: no cover (compiled)
    """Summed over all lines, the length inside both a closed surface (vertex, 3), (face, 3) and the intervals."""
    low_m, cell_m, shape, first, start_m, stop_m = intervals
    newest = np.full(shape[0] * shape[1], -1, np.int64)  # of each line, its newest crossing
    older, positions, turns = [0 for _ in range(0)], [0.0 for _ in range(0)], [0.0 for _ in range(0)]
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
                turn, position = _crossing(vertices_m, a, b, c, y, z)
                if turn != 0:
                    older.append(int(newest[line]))
                    newest[line] = len(positions)
                    positions.append(position)
                    turns.append(turn)
    return _summed(newest, older, positions, turns, first, start_m, stop_m)


@njit(cache=True, inline="always")
def _cells_between(vertices_m, a, b, c, axis, low_m, cell_m, count):  # pragma: no cover (compiled)
    """Cells along an axis whose middle lies within a triangle's extent, and a little beyond."""
    least = min(vertices_m[a, axis], vertices_m[b, axis], vertices_m[c, axis])
    most = max(vertices_m[a, axis], vertices_m[b, axis], vertices_m[c, axis])
    start = int(np.floor((least - low_m) / cell_m - 0.5))
    stop = int(np.ceil((most - low_m) / cell_m - 0.5)) + 1
    return max(start, 0), min(stop, count)


@njit(cache=True)
def _summed(newest, older, positions, turns, first, start_m, stop_m):  # pragma: no cover (compiled)
    length = 0.0
    own_positions, own_turns = np.empty(len(positions)), np.empty(len(positions))
    for line in range(len(newest)):
        count, number = 0, newest[line]
        while number >= 0:
            own_positions[count], own_turns[count] = positions[number], turns[number]
            count += 1
            number = older[number]
        _sort(own_positions, own_turns, count)
        winding = 0.0
        for number in range(count):
            if winding > 0:
                for interval in range(first[line], first[line + 1]):
                    begin = max(own_positions[number - 1], start_m[interval])
                    length += max(min(own_positions[number], stop_m[interval]) - begin, 0.0)
            winding -= own_turns[number]
    return length
