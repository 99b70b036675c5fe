"""Which sampled points are close to a joint, and how far the nearest one is: boxes of points, opened only where needed.

Compiled with numba. Joints come in the frames of an object's parts, so that the boxes of a part serve every frame.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

# One joint close to one point in one frame: 9 bytes.
ENTRY = np.dtype([("frame", "<i2"), ("point", "<i2"), ("joint", "i1"), ("distance_m", "<f4")])

_POINTS_PER_BOX = 32
_FIRST_ENTRIES_PER_FRAME = 256  # the array of entries starts with room for this many and doubles when it is full
_ENTRY_BYTES = ENTRY.itemsize


class PointBoxes(NamedTuple):
    """Points of an object's parts in boxes of at most 32, each box of one part.

    part: (box,). low_m, high_m: (box, 3) corners. first: (box + 1,) where the points of a box start.
    point: (row,) number of each point. points_m: (row, 3) float64 in the frame of its part.
    """

    part: np.ndarray
    low_m: np.ndarray
    high_m: np.ndarray
    first: np.ndarray
    point: np.ndarray
    points_m: np.ndarray


def point_boxes(points_m: np.ndarray, members: Sequence[np.ndarray]) -> PointBoxes:
    """Boxes over (point, 3) points, metres. members: the point numbers of each part; a part is its index there."""
    boxes = [(part, rows) for part, numbers in enumerate(members) for rows in _halved(points_m, numbers)]
    points = [points_m[rows].astype(np.float64) for _, rows in boxes]
    return PointBoxes(
        part=np.array([part for part, _ in boxes], np.int64),
        low_m=np.array([rows.min(axis=0) for rows in points]).reshape(-1, 3),
        high_m=np.array([rows.max(axis=0) for rows in points]).reshape(-1, 3),
        first=np.cumsum([0, *map(len, points)]),
        point=np.concatenate([np.zeros(0, np.int64), *(rows for _, rows in boxes)]),
        points_m=np.concatenate([np.zeros((0, 3)), *points]),
    )


def _halved(points_m: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """Halves across the longest axis, and their halves, until they are small enough."""
    if len(rows) <= _POINTS_PER_BOX:
        return [rows]
    places = points_m[rows]
    order = rows[np.argsort(places[:, np.ptp(places, axis=0).argmax()], kind="stable")]
    middle = len(order) // 2
    return _halved(points_m, order[:middle]) + _halved(points_m, order[middle:])


def near_entries(
    places_m: np.ndarray, valid: np.ndarray, boxes: PointBoxes, point_count: int, reach_m: float
) -> np.ndarray:
    """Every (frame, point, joint) closer than ``reach_m``, in that order, as rows of ``ENTRY``.

    places_m: (frame, part, joint, 3) float64, the joints in the frame of each part. valid: (frame,) bool; other frames
    give no entry. point_count: points of all parts together.
    """
    return _search(places_m, valid, boxes, point_count, reach_m**2).view(ENTRY)


@njit(cache=True)
def _search(places_m, valid, boxes, point_count, square_reach):  # pragma: no cover (compiled)
    """The bytes of all entries. Bytes, because numba copies records slowly."""
    n_frames, _, n_joints, _ = places_m.shape
    most = point_count * n_joints
    keys, squares, next_row = np.empty(most + 1, np.int32), np.empty(most + 1), np.zeros(point_count, np.int64)
    room = np.empty(_FIRST_ENTRIES_PER_FRAME * n_frames * _ENTRY_BYTES, np.uint8)
    size = 0
    for frame in range(n_frames):
        count = _hits_of_frame(places_m[frame], boxes, square_reach, keys, squares) if valid[frame] else 0
        if (size + count) * _ENTRY_BYTES > len(room):
            larger = np.empty(2 * len(room) + most * _ENTRY_BYTES, np.uint8)
            larger[: size * _ENTRY_BYTES] = room[: size * _ENTRY_BYTES]
            room = larger
        if count:
            _write_in_order(keys[:count], squares, next_row, frame, size, room.view(ENTRY))
        size += count
    return room[: size * _ENTRY_BYTES].copy()


@njit(cache=True)
def _hits_of_frame(places_m, boxes, square_reach, keys, squares):  # pragma: no cover (compiled)
    """Near pairs of one frame, joint by joint: 256 point + joint into ``keys``, squared distances; their number."""
    part, low_m, high_m, first, point, points_m = boxes
    count = 0
    for joint in range(places_m.shape[1]):
        for box in range(len(part)):
            x, y, z = places_m[part[box], joint, 0], places_m[part[box], joint, 1], places_m[part[box], joint, 2]
            if _square_to_box(x, y, z, low_m, high_m, box) >= square_reach:
                continue
            for row in range(first[box], first[box + 1]):
                dx, dy, dz = points_m[row, 0] - x, points_m[row, 1] - y, points_m[row, 2] - z
                square = dx * dx + dy * dy + dz * dz
                # Without a branch: every pair is written, and the next one overwrites it unless it counts.
                keys[count], squares[count] = (point[row] << 8) | joint, square
                count += square < square_reach
    return count


@njit(cache=True)
def _square_to_box(x, y, z, low_m, high_m, box):  # pragma: no cover (compiled)
    """Square of the distance from a place to a box; never more than that to a point in it, also when rounded."""
    dx = max(low_m[box, 0] - x, x - high_m[box, 0], 0.0)
    dy = max(low_m[box, 1] - y, y - high_m[box, 1], 0.0)
    dz = max(low_m[box, 2] - z, z - high_m[box, 2], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True)
def _write_in_order(keys, squares, next_row, frame, size, entries):  # pragma: no cover (compiled)
    """Hits of one frame into ``entries`` from row ``size``, sorted by point; a point's joints are in order already.

    next_row: (point,) zeros, and zeros again afterwards.
    """
    for key in keys:
        next_row[key >> 8] += 1
    start = size
    for point in range(len(next_row)):
        start, next_row[point] = start + next_row[point], start
    for hit in range(len(keys)):
        point = keys[hit] >> 8
        row = next_row[point]
        next_row[point] = row + 1
        entries[row].frame = frame
        entries[row].point = point
        entries[row].joint = keys[hit] & 255
        entries[row].distance_m = np.sqrt(squares[hit])
    next_row[:] = 0


@njit(cache=True)
def closest_of_joints(places_m, boxes):  # pragma: no cover (compiled)
    """(frame,) distance of the nearest point to the nearest of a frame's joints, metres.

    places_m: (frame, part, joint, 3) float64, the joints in the frame of each part. Joints move little from frame to
    frame: the search starts with the joint and the box that were nearest before, which leaves few boxes to open.
    """
    n_frames, _, n_joints, _ = places_m.shape
    closest = np.empty(n_frames)
    joint = box = 0
    for frame in range(n_frames):
        best, box = _nearest(places_m[frame, :, joint], boxes, np.inf, box)
        before = joint
        for other in range(n_joints):
            if other != before:
                square, found = _nearest(places_m[frame, :, other], boxes, best, box)
                if square < best:
                    best, joint, box = square, other, found
        closest[frame] = np.sqrt(best)
    return closest


@njit(cache=True)
def _nearest(place_m, boxes, best, likely):  # pragma: no cover (compiled)
    """Square of the distance to the nearest point if below ``best``, else ``best``; and its box.

    place_m: (part, 3). likely: the box to open first.
    """
    part, low_m, high_m, first, _, points_m = boxes
    winner = likely
    for step in range(-1, len(part)):
        box = likely if step < 0 else step
        if step == likely:
            continue
        x, y, z = place_m[part[box], 0], place_m[part[box], 1], place_m[part[box], 2]
        if _square_to_box(x, y, z, low_m, high_m, box) >= best:
            continue
        for row in range(first[box], first[box + 1]):
            dx, dy, dz = points_m[row, 0] - x, points_m[row, 1] - y, points_m[row, 2] - z
            square = dx * dx + dy * dy + dz * dz
            if square < best:
                best, winner = square, box
    return best, winner
