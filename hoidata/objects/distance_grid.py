"""Distances to a surface on a grid, and what they say for certain about a place between the nodes.

A distance changes by at most the way gone, so what is interpolated between the eight nodes of a cell errs by at most
the cell's edge times the root of ``sum t (1 - t)`` over the three places t in the cell (Jensen's inequality): 0.87
edges in its middle, nothing at its corners. Where that does not decide a question, the triangles do.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.objects.triangle_tree import DEEPEST, LEAF, TriangleTree, crossings, least_square

CELLS = 64
MARGIN_M = 0.01
_ROUNDING_M = 1e-6  # more than float32 loses on a metre
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
    """64 cells along the longest axis of the surface and 1 cm around it. solid: the surface is closed, so that inside
    (where a line leaves the surface oftener than it enters) is negative.
    """
    low, high = tree.box[0, :3] - MARGIN_M, tree.box[0, 3:] + MARGIN_M
    cell = float((high - low).max()) / CELLS
    x, y, z = np.ceil((high - low) / cell - 1e-9).astype(int) + 1
    value = np.empty((z, y, x), np.float32)
    _fill(tree, low, cell, solid, value)
    return DistanceGrid(low, cell, value)


@njit(cache=True)
def _fill(tree, low_m, cell_m, solid, value):  # pragma: no cover (compiled)
    triangle, box, link, _, corner, vertices_m = tree
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    places, turns = np.empty(len(corner)), np.empty(len(corner))
    for k in range(value.shape[0]):
        z = low_m[2] + k * cell_m
        for j in range(value.shape[1]):
            y, distance = low_m[1] + j * cell_m, np.inf
            count = crossings(box, link, corner, vertices_m, y, z, stack, places, turns) if solid else 0
            if j:
                distance = abs(value[k, j - 1, 0]) + _ROUNDING_M
            for i in range(value.shape[2]):
                x, bound = low_m[0] + i * cell_m, (distance + cell_m) * _WIDER
                distance = np.sqrt(least_square(triangle, box, link, x, y, z, bound * bound, 0.0, stack, squares))
                winding = 0.0
                for number in range(count):
                    winding += turns[number] * (places[number] > x)
                value[k, j, i] = -distance if winding > 0 else distance


@njit(cache=True, inline="always")
def _between(low_m, cell_m, value, x, y, z):  # pragma: no cover (compiled)
    """Interpolated value at a place, and how far the truth may be off; (0, inf) off the grid."""
    u, v, w = (x - low_m[0]) / cell_m, (y - low_m[1]) / cell_m, (z - low_m[2]) / cell_m
    if not (0 <= u < value.shape[2] - 1 and 0 <= v < value.shape[1] - 1 and 0 <= w < value.shape[0] - 1):
        return 0.0, np.inf
    i, j, k = int(u), int(v), int(w)
    u, v, w = u - i, v - j, w - k
    near = (value[k, j, i] * (1 - u) + value[k, j, i + 1] * u) * (1 - v)
    near += (value[k, j + 1, i] * (1 - u) + value[k, j + 1, i + 1] * u) * v
    far = (value[k + 1, j, i] * (1 - u) + value[k + 1, j, i + 1] * u) * (1 - v)
    far += (value[k + 1, j + 1, i] * (1 - u) + value[k + 1, j + 1, i + 1] * u) * v
    slack = cell_m * np.sqrt(u * (1 - u) + v * (1 - v) + w * (1 - w)) + _ROUNDING_M
    return near * (1 - w) + far * w, slack


@njit(cache=True, inline="always")
def _outside_box(box, x, y, z):  # pragma: no cover (compiled)
    """Squared distance to the box around all triangles."""
    dx = max(box[0, 0] - x, x - box[0, 3], 0.0)
    dy = max(box[0, 1] - y, y - box[0, 4], 0.0)
    dz = max(box[0, 2] - z, z - box[0, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True)
def mark_within(tree, grid, places_m, threshold_m, within):  # pragma: no cover (compiled)
    """Set ``within (place,)`` where the distance of ``places_m (place, 3)`` is less than the threshold.

    Places already marked are not looked at. Returns how many the triangles had to decide.
    """
    triangle, box, link, low_m, cell_m, value = tree[0], tree[1], tree[2], grid[0], grid[1], grid[2]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    bound, decided = threshold_m * threshold_m * _WIDER, 0
    for place in range(len(places_m)):
        x, y, z = places_m[place, 0], places_m[place, 1], places_m[place, 2]
        if within[place] or _outside_box(box, x, y, z) > bound:
            continue
        distance, slack = _between(low_m, cell_m, value, x, y, z)
        if abs(distance) - slack >= threshold_m:
            continue
        if abs(distance) + slack < threshold_m:
            within[place] = True
            continue
        decided += 1
        square = least_square(triangle, box, link, x, y, z, bound, threshold_m * threshold_m / _WIDER, stack, squares)
        within[place] = np.sqrt(square) < threshold_m
    return decided


@njit(cache=True)
def lower_distances(tree, grid, places_m, most_m, distance_m):  # pragma: no cover (compiled)
    """Set ``distance_m (place,)`` to the distance of ``places_m (place, 3)`` where less, and not above ``most_m``."""
    triangle, box, link, low_m, cell_m, value = tree[0], tree[1], tree[2], grid[0], grid[1], grid[2]
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    for place in range(len(places_m)):
        x, y, z = places_m[place, 0], places_m[place, 1], places_m[place, 2]
        most = min(most_m, distance_m[place])
        near, slack = _between(low_m, cell_m, value, x, y, z)
        if abs(near) - slack > most or _outside_box(box, x, y, z) > most * most * _WIDER:
            continue
        bound = min(most, abs(near) + slack) * _WIDER + _TINY_M
        found = np.sqrt(least_square(triangle, box, link, x, y, z, bound * bound, 0.0, stack, squares))
        if found <= most:
            distance_m[place] = found


@njit(cache=True)
def raise_depths(tree, grid, places_m, depth_m):  # pragma: no cover (compiled)
    """Set ``depth_m (place,)`` to how far ``places_m (place, 3)`` lie inside a closed surface, where that is more."""
    triangle, box, link, _, corner, vertices_m = tree
    low_m, cell_m, value = grid
    stack, squares = np.empty(DEEPEST, np.int64), np.empty(LEAF)
    crossed, turns = np.empty(len(corner)), np.empty(len(corner))
    for place in range(len(places_m)):
        x, y, z = places_m[place, 0], places_m[place, 1], places_m[place, 2]
        if _outside_box(box, x, y, z) > 0:
            continue
        near, slack = _between(low_m, cell_m, value, x, y, z)
        if near - slack > 0 or slack - near < depth_m[place]:
            continue
        winding = 1.0
        if near + slack >= 0:
            winding = 0.0
            for number in range(crossings(box, link, corner, vertices_m, y, z, stack, crossed, turns)):
                winding += turns[number] * (crossed[number] > x)
        if winding > 0:
            bound = (slack + abs(near)) * _WIDER
            square = least_square(triangle, box, link, x, y, z, bound * bound, 0.0, stack, squares)
            depth_m[place] = max(depth_m[place], np.sqrt(square))
