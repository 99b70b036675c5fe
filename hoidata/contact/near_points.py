"""Which sampled points are close to a joint: a grid of cells per part, each with the points within its reach.

A lookup and a few dozen distances per joint, compiled with numba, instead of a search in a tree. The candidates of a
cell are few because the reach (2 cm) is not much longer than the points are apart. Joints are brought into the frame of
a part, compared and sorted in one pass over the frames.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.contact.intrinsics import LANES, lowest_bit, squares_to_eight
from hoidata.contact.part_frames import PartMotion, places_of_frame

# One joint close to one point in one frame: 9 bytes.
ENTRY = np.dtype([("frame", "<i2"), ("point", "<i2"), ("joint", "i1"), ("distance_m", "<f4")])

_MOST_CELLS = 64  # along an axis; larger objects get larger cells
_CELLS_PER_REACH = 2
_SMALLEST_CELL_M = 1e-6
_ROUNDING_M = 1e-9  # a place may be taken for one in the next cell when it is this close to it
_FIRST_ENTRIES_PER_FRAME = 256  # room for that many to begin with
_ENTRY_BYTES = ENTRY.itemsize


class CellGrids(NamedTuple):
    """Candidates by cell, in blocks of eight; the cells of all parts one after another.

    low_m: (part, 3) corners; cells_per_m: (part,) inverse edge of a cell; shape: (part, 3) cells along the axes;
    cell: (part,) the first cell of each part. first: (cell + 1,) int32, where a cell's blocks start.
    place_m: (block, 3, 8) float32, coordinates of the candidates, infinite where a cell's last block has room left;
    point: (block, 8) int16, their numbers, rising within a cell. Small types side by side: what is slow is to fetch.
    """

    low_m: np.ndarray
    cells_per_m: np.ndarray
    shape: np.ndarray
    cell: np.ndarray
    first: np.ndarray
    place_m: np.ndarray
    point: np.ndarray


class _Hits(NamedTuple):
    """Room for one frame. key: 256 point + joint; square: its squared distance; both in the order found.

    eight: squares of one block. by_point: (point,) int32, zero between frames; touched: a bit per point, the same.
    """

    key: np.ndarray
    square: np.ndarray
    eight: np.ndarray
    by_point: np.ndarray
    touched: np.ndarray


def cell_grids(points_m: np.ndarray, members: Sequence[np.ndarray], reach_m: float) -> CellGrids:
    """Grids over (point, 3) float32 points for distances up to ``reach_m``. members: each part's rows."""
    places = points_m.astype(np.float64)
    boxes = [(places[rows].min(axis=0) - reach_m, places[rows].max(axis=0) + reach_m) for rows in members]
    edges = [_cell_edge_m(high - low, reach_m) for low, high in boxes]
    shapes = [np.ceil((high - low) / edge).astype(np.int64) + 1 for (low, high), edge in zip(boxes, edges, strict=True)]
    counts, points = [], []
    for rows, (low, _), edge, shape in zip(members, boxes, edges, shapes, strict=True):
        count, own = _candidate_blocks(places[rows], low, edge, shape, reach_m + _ROUNDING_M)
        counts.append(count)
        points.append(np.where(own < 0, len(points_m), rows[own]))
    point = np.concatenate(points)
    with_nowhere = np.concatenate((points_m.astype(np.float32), np.full((1, 3), np.inf, np.float32)))
    return CellGrids(
        low_m=np.stack([low for low, _ in boxes]),
        cells_per_m=1 / np.array(edges),
        shape=np.stack(shapes),
        cell=np.cumsum([0, *map(len, counts)])[:-1],
        first=np.concatenate(([0], np.cumsum(np.concatenate(counts)))).astype(np.int32),
        place_m=np.ascontiguousarray(with_nowhere[point].transpose(0, 2, 1)),
        point=np.where(point < len(points_m), point, 0).astype(np.int16),
    )


def _cell_edge_m(size_m: np.ndarray, reach_m: float) -> float:
    return max(reach_m / _CELLS_PER_REACH, float(size_m.max()) / _MOST_CELLS, _SMALLEST_CELL_M)


def _candidate_blocks(
    points_m: np.ndarray, low_m: np.ndarray, edge_m: float, shape: np.ndarray, reach_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """How many blocks each cell has, and (block, 8) points cell by cell; -1 where there is room left."""
    counts = np.zeros(shape.prod(), np.int64)
    _visit_cells(points_m, low_m, edge_m, shape, reach_m, counts, np.zeros(0, np.int64))
    blocks = -(-counts // LANES)
    points = np.full(blocks.sum() * LANES, -1)
    _visit_cells(points_m, low_m, edge_m, shape, reach_m, (np.cumsum(blocks) - blocks) * LANES, points)
    return blocks, points.reshape(-1, LANES)


@njit(cache=True)
def _visit_cells(points_m, low_m, edge_m, shape, reach_m, next_place, points):  # pragma: no cover (compiled)
    """For every cell whose box comes within reach of a point: count on and, where ``points`` has room, write it."""
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
    joints_m: np.ndarray, valid: np.ndarray, motion: PartMotion, grids: CellGrids, point_count: int, reach_m: float
) -> np.ndarray:
    """Every (frame, point, joint) closer than ``reach_m``, in that order, as rows of ``ENTRY``.

    joints_m: (frame, joint, 3) world joints, metres. valid: (frame,) bool; other frames give no entry. motion: of the
    object's parts. grids: built for ``reach_m`` or more, over ``point_count`` points of all parts together.
    """
    joints, given = np.array(joints_m, dtype=np.float64, order="C"), np.array(valid, dtype=bool)
    return _search(joints, given, motion, grids, point_count, reach_m**2).view(ENTRY)


@njit(cache=True)
def _search(joints_m, valid, motion, grids, point_count, square_reach):  # pragma: no cover (compiled)
    """The bytes of all entries (bytes, because NumPy copies rows slowly)."""
    n_frames, n_joints = joints_m.shape[:2]
    most = point_count * n_joints
    hits = _Hits(
        np.empty(most + LANES, np.int32),
        np.empty(most + LANES),
        np.empty(LANES),
        np.zeros(point_count, np.int32),
        np.zeros((point_count + 63) // 64, np.uint64),
    )
    turns, places = np.empty((2, 3, 3)), np.empty((len(motion.moves), n_joints, 3))
    room = np.empty(_FIRST_ENTRIES_PER_FRAME * n_frames * _ENTRY_BYTES, np.uint8)
    size = 0
    for frame in range(n_frames):
        if not valid[frame]:
            continue
        places_of_frame(joints_m[frame], motion, frame, turns, places)
        count = _hits_of_frame(places, grids, square_reach, hits)
        if not count:
            continue
        if (size + count) * _ENTRY_BYTES > len(room):
            larger = np.empty(2 * len(room) + most * _ENTRY_BYTES, np.uint8)
            larger[: size * _ENTRY_BYTES] = room[: size * _ENTRY_BYTES]
            room = larger
        _write_in_order(hits, count, frame, size, room.view(ENTRY))
        size += count
    return room[: size * _ENTRY_BYTES].copy()


@njit(cache=True)
def _hits_of_frame(places_m, grids, square_reach, hits):  # pragma: no cover (compiled)
    """Collect the near pairs of one frame, joint by joint; their number. Fields are unpacked once: access costs."""
    low_m, cells_per_m, shape, first_cell, first, place_m, point = grids
    keys, squares, eight = hits.key, hits.square, hits.eight
    count = np.uint64(0)  # unsigned: an index that cannot count from the end
    for part in range(places_m.shape[0]):
        for joint in range(places_m.shape[1]):
            x, y, z = places_m[part, joint, 0], places_m[part, joint, 1], places_m[part, joint, 2]
            i = (x - low_m[part, 0]) * cells_per_m[part]
            j = (y - low_m[part, 1]) * cells_per_m[part]
            k = (z - low_m[part, 2]) * cells_per_m[part]
            if not (0 <= i < shape[part, 0] and 0 <= j < shape[part, 1] and 0 <= k < shape[part, 2]):
                continue
            cell = first_cell[part] + (int(i) * shape[part, 1] + int(j)) * shape[part, 2] + int(k)
            for block in range(first[cell], first[cell + 1]):
                squares_to_eight(place_m, block, x, y, z, eight)
                # Without a branch: every pair is written, but only past one that counts is stepped on.
                for lane in range(LANES):
                    keys[count] = (np.int32(point[block, lane]) << 8) | joint
                    squares[count] = eight[lane]
                    count += np.uint64(eight[lane] < square_reach)
    return np.int64(count)


@njit(cache=True)
def _write_in_order(hits, count, frame, size, entries):  # pragma: no cover (compiled)
    """Sort one frame's hits by point into ``entries`` from row ``size``; the joints of a point are in order already."""
    keys, squares, by_point, touched = hits.key, hits.square, hits.by_point, hits.touched
    for hit in range(count):
        point = keys[hit] >> 8
        by_point[point] += 1
        touched[point >> 6] |= np.uint64(1) << np.uint64(point & 63)
    start = size
    for word in range(len(touched)):
        bits, touched[word] = touched[word], np.uint64(0)
        while bits:
            point = 64 * word + np.int64(lowest_bit(bits))
            bits &= bits - np.uint64(1)
            start, by_point[point] = start + by_point[point], start
    for hit in range(count):
        point = keys[hit] >> 8
        place = by_point[point]
        by_point[point] = place + 1
        entries[place].frame = frame
        entries[place].point = point
        entries[place].joint = keys[hit] & 255
        entries[place].distance_m = np.sqrt(squares[hit])
    for hit in range(count):
        by_point[keys[hit] >> 8] = 0
