"""Which sampled points are close to a joint: a grid of cells per part, each with the points within its reach.

A lookup and about twenty distances per joint, compiled with numba, instead of a search in a tree. The candidates of a
cell are few because the reach (2 cm) is not much longer than the points are apart.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

# One joint close to one point in one frame: 9 bytes.
ENTRY = np.dtype([("frame", "<i2"), ("point", "<i2"), ("joint", "i1"), ("distance_m", "<f4")])

_MOST_CELLS = 64  # along an axis; larger objects get larger cells
_CELLS_PER_REACH = 2
_SMALLEST_CELL_M = 1e-6
_ROUNDING_M = 1e-9  # a place may be taken for one in the next cell when it is this close to it
_FIRST_ENTRIES_PER_FRAME = 256  # room for that many to begin with


class CellGrids(NamedTuple):
    """Candidates by cell, the cells of all parts one after another.

    low_m: (part, 3) corners; cells_per_m: (part,) inverse edge of a cell; shape: (part, 3) cells along the axes;
    cell: (part,) the first cell of each part. first: (cell + 1,) where a cell's candidates start. point: (candidate,)
    int16, rising within a cell; x, y, z: (candidate,) float32, its coordinates once more, so that a cell is read in one
    stretch. Small types, because what is slow is to fetch them.
    """

    low_m: np.ndarray
    cells_per_m: np.ndarray
    shape: np.ndarray
    cell: np.ndarray
    first: np.ndarray
    point: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray


class _Pairs(NamedTuple):
    """Room for the pairs of one frame (points, joints, squared distances) and for the squares of one cell."""

    point: np.ndarray
    joint: np.ndarray
    square: np.ndarray
    cell_square: np.ndarray


def cell_grids(points_m: np.ndarray, members: Sequence[np.ndarray], reach_m: float) -> CellGrids:
    """Grids over (point, 3) float32 points for distances up to ``reach_m``. members: each part's rows."""
    places = points_m.astype(np.float64)
    boxes = [(places[rows].min(axis=0) - reach_m, places[rows].max(axis=0) + reach_m) for rows in members]
    edges = [_cell_edge_m(high - low, reach_m) for low, high in boxes]
    shapes = [np.ceil((high - low) / edge).astype(np.int64) + 1 for (low, high), edge in zip(boxes, edges, strict=True)]
    counts, points = [], []
    for rows, (low, _), edge, shape in zip(members, boxes, edges, shapes, strict=True):
        count, own = _candidates(places[rows], low, edge, shape, reach_m + _ROUNDING_M)
        counts.append(count)
        points.append(rows[own].astype(np.int16))
    point = np.concatenate(points)
    return CellGrids(
        low_m=np.stack([low for low, _ in boxes]),
        cells_per_m=1 / np.array(edges),
        shape=np.stack(shapes),
        cell=np.cumsum([0, *map(len, counts)])[:-1],
        first=np.concatenate(([0], np.cumsum(np.concatenate(counts)))),
        point=point,
        **{axis: np.ascontiguousarray(points_m[point, number], np.float32) for number, axis in enumerate("xyz")},
    )


def _cell_edge_m(size_m: np.ndarray, reach_m: float) -> float:
    return max(reach_m / _CELLS_PER_REACH, float(size_m.max()) / _MOST_CELLS, _SMALLEST_CELL_M)


def _candidates(
    points_m: np.ndarray, low_m: np.ndarray, edge_m: float, shape: np.ndarray, reach_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """How many points each cell has, and the points cell by cell."""
    counts = np.zeros(shape.prod(), np.int64)
    _visit_cells(points_m, low_m, edge_m, shape, reach_m, counts, counts, np.zeros(0, np.int64))
    next_place, points = np.cumsum(counts) - counts, np.empty(counts.sum(), np.int64)
    _visit_cells(points_m, low_m, edge_m, shape, reach_m, np.zeros_like(counts), next_place, points)
    return counts, points


@njit(cache=True)
def _visit_cells(points_m, low_m, edge_m, shape, reach_m, counts, next_place, points):  # pragma: no cover (compiled)
    """For every cell whose box comes within reach of a point: count it and, where ``points`` has room, write it."""
    for row in range(len(points_m)):
        place = points_m[row] - low_m
        start = np.maximum(((place - reach_m) / edge_m).astype(np.int64) - 1, 0)
        stop = np.minimum(((place + reach_m) / edge_m).astype(np.int64) + 2, shape)
        for i in range(start[0], stop[0]):
            dx = _outside(place[0], i * edge_m, edge_m)
            for j in range(start[1], stop[1]):
                dy = _outside(place[1], j * edge_m, edge_m)
                for k in range(start[2], stop[2]):
                    dz = _outside(place[2], k * edge_m, edge_m)
                    if dx * dx + dy * dy + dz * dz < reach_m * reach_m:
                        cell = (i * shape[1] + j) * shape[2] + k
                        if len(points):
                            points[next_place[cell]] = row
                        next_place[cell] += 1


@njit(cache=True)
def _outside(value, low, length):  # pragma: no cover (compiled)
    """How far a coordinate lies outside [low, low + length]."""
    return max(low - value, value - low - length, 0.0)


def near_entries(
    places_m: np.ndarray, valid: np.ndarray, grids: CellGrids, point_count: int, reach_m: float
) -> np.ndarray:
    """Every (frame, point, joint) closer than ``reach_m``, in that order, as rows of ``ENTRY``.

    places_m: (part, frame, joint, 3) float64 joints in the frame of each part, metres. valid: (frame,) bool; other
    frames give no entry. grids: built for ``reach_m`` or more, over ``point_count`` points of all parts together.
    """
    n_frames, n_joints = places_m.shape[1:3]
    most = point_count * n_joints
    pairs = _Pairs(np.empty(most + 1, np.int16), np.empty(most + 1, np.int8), np.empty(most + 1), np.empty(point_count))
    room = np.empty(_FIRST_ENTRIES_PER_FRAME * n_frames * ENTRY.itemsize, np.uint8)  # bytes: NumPy copies rows slowly
    frame = size = 0
    while True:
        frame, size = _fill(places_m, valid, grids, point_count, reach_m**2, pairs, room.view(ENTRY), frame, size)
        used = room[: size * ENTRY.itemsize]
        if frame == n_frames:
            return used.copy().view(ENTRY)
        room = np.concatenate((used, np.empty(len(room) + most * ENTRY.itemsize, np.uint8)))


@njit(cache=True)
def _fill(places_m, valid, grids, point_count, square_reach, pairs, entries, frame, size):  # pragma: no cover
    """Go on from ``frame`` until all are done or one does not find room; where it stopped, and the entries so far."""
    starts = np.empty(point_count, np.int32)
    for number in range(frame, places_m.shape[1]):
        if not valid[number]:
            continue
        count = _pairs_of_frame(places_m[:, number], grids, square_reach, pairs)
        if size + count > len(entries):
            return number, size
        if count:
            _write_in_order(pairs, count, starts, number, entries[size : size + count])
        size += count
    return places_m.shape[1], size


@njit(cache=True)
def _pairs_of_frame(places_m, grids, square_reach, pairs):  # pragma: no cover (compiled)
    """Collect the pairs of one frame, joint by joint; their number. Fields are unpacked once: each access costs."""
    low_m, cells_per_m, shape, first_cell, first, candidate, xs, ys, zs = grids
    points, joints, found, squares = pairs
    count = 0
    for part in range(places_m.shape[0]):
        for joint in range(places_m.shape[1]):
            x, y, z = places_m[part, joint, 0], places_m[part, joint, 1], places_m[part, joint, 2]
            i = (x - low_m[part, 0]) * cells_per_m[part]
            j = (y - low_m[part, 1]) * cells_per_m[part]
            k = (z - low_m[part, 2]) * cells_per_m[part]
            if not (0 <= i < shape[part, 0] and 0 <= j < shape[part, 1] and 0 <= k < shape[part, 2]):
                continue
            cell = first_cell[part] + (int(i) * shape[part, 1] + int(j)) * shape[part, 2] + int(k)
            start, length = first[cell], first[cell + 1] - first[cell]
            # Two loops without a branch: the first runs on vectors, the second steps on only past pairs that count.
            for row in range(length):
                dx, dy, dz = xs[start + row] - x, ys[start + row] - y, zs[start + row] - z
                squares[row] = dx * dx + dy * dy + dz * dz
            for row in range(length):
                points[count], joints[count], found[count] = candidate[start + row], joint, squares[row]
                count += squares[row] < square_reach
    return count


@njit(cache=True)
def _write_in_order(pairs, count, starts, frame, entries):  # pragma: no cover (compiled)
    """Sort one frame's pairs by point into its entries; the joints of a point are in order already."""
    points, joints, squares, _ = pairs
    starts[:] = 0
    for pair in range(count):
        starts[points[pair]] += 1
    total = 0
    for point in range(len(starts)):
        total, starts[point] = total + starts[point], total
    for pair in range(count):
        place = starts[points[pair]]
        starts[points[pair]] = place + 1
        entries[place].frame = frame
        entries[place].point = points[pair]
        entries[place].joint = joints[pair]
        entries[place].distance_m = np.sqrt(squares[pair])
