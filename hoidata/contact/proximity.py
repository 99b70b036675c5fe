"""Distances from hand joints to an object's sampled points, computed in the frame of each part. Compiled with numba.

Transforming 21 joints into the frame of a part, instead of 1,024 points into the world, needs one index of bounding
boxes per part for all clips. The results do not depend on the world frame.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit

from hoidata.clips import ObjectTrack
from hoidata.errors import BadInput

CONTACT_THRESHOLD_M = 0.02
# One joint close to one point in one frame: 9 bytes.
ENTRY = np.dtype([("frame", "<i2"), ("point", "<i2"), ("joint", "i1"), ("distance_m", "<f4")])

_POINTS_PER_BOX = 32
_FIRST_ENTRIES_PER_FRAME = 256  # initial capacity of the array of entries, which doubles when full
_ENTRY_BYTES = ENTRY.itemsize


class PartPoints(Protocol):
    """Surface points (point, 3), object frame with the hinge at zero, and the part (point,) of each, 0 or 1."""

    @property
    def points_m(self) -> np.ndarray: ...
    @property
    def part(self) -> np.ndarray: ...


class ProximityIndex:
    """Search index of one object's sampled points, for all of its clips."""

    def __init__(self, points: PartPoints) -> None:
        self.count = len(points.points_m)
        self.parts = [int(part) for part in np.unique(points.part)]
        self._boxes = point_boxes(points.points_m, [np.flatnonzero(points.part == part) for part in self.parts])

    def closest_m(self, joints_m: np.ndarray, track: ObjectTrack) -> np.ndarray:
        """Return (frame,) smallest distance between the world joints ``(frame, joint, 3)`` and a point, metres."""
        if not self.parts:
            return np.full(len(joints_m), np.inf)
        return closest_of_joints(self._in_parts_m(joints_m, track), self._boxes)

    def entries(
        self, joints_m: np.ndarray, valid: np.ndarray, track: ObjectTrack, threshold_m: float = CONTACT_THRESHOLD_M
    ) -> np.ndarray:
        """Return all (frame, point, joint) closer than ``threshold_m``, in that order, as ``ENTRY`` records.

        Args:
            joints_m: (frame, joint, 3) world.
            valid: (frame,) bool; other frames give no entry.
            threshold_m: maximum distance.

        Raises BadInput: more frames, points or joints than an entry can count.
        """
        counted = {"frame": len(joints_m), "point": self.count, "joint": joints_m.shape[1]}
        for name, count in counted.items():
            most = int(np.iinfo(ENTRY[name]).max)
            if count > most:
                raise BadInput("distance map", f"at most {most} {name}s", f"{count}", "cut the sequence, or take fewer")
        if not self.parts:
            return np.zeros(0, ENTRY)
        in_parts_m = self._in_parts_m(joints_m, track)
        return near_entries(in_parts_m, np.array(valid, bool), self._boxes, self.count, threshold_m)

    def _in_parts_m(self, joints_m: np.ndarray, track: ObjectTrack) -> np.ndarray:
        """Transform world joints to the frame of each part: (frame, part, joint, 3) float64."""
        in_object = track.world_from_object.inverse() @ joints_m.astype(np.float64)
        parts = [track.model.object_from_part(part, track.hinge_rad).inverse() for part in self.parts]
        return np.stack([part_from_object @ in_object for part_from_object in parts], axis=1)


class PointBoxes(NamedTuple):
    """Points of an object's parts in bounding boxes of at most 32 points of one part."""

    part: np.ndarray  # (box,)
    low_m: np.ndarray  # (box, 3)
    high_m: np.ndarray  # (box, 3)
    first: np.ndarray  # (box + 1,) first row of each box
    point: np.ndarray  # (row,) number of each point
    points_m: np.ndarray  # (row, 3) float64 in the frame of its part


def point_boxes(points_m: np.ndarray, members: Sequence[np.ndarray]) -> PointBoxes:
    """Divide (point, 3) points, metres, into boxes. members: the point numbers of each part."""
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
    """Halve the points along the longest axis, recursively, until each group fits a box."""
    if len(rows) <= _POINTS_PER_BOX:
        return [rows]
    positions = points_m[rows]
    order = rows[np.argsort(positions[:, np.ptp(positions, axis=0).argmax()], kind="stable")]
    middle = len(order) // 2
    return _halved(points_m, order[:middle]) + _halved(points_m, order[middle:])


def near_entries(
    joints_m: np.ndarray, valid: np.ndarray, boxes: PointBoxes, point_count: int, reach_m: float
) -> np.ndarray:
    """Return all (frame, point, joint) closer than ``reach_m``, in that order, as ``ENTRY`` records.

    Args:
        joints_m: (frame, part, joint, 3) float64, the joints in the frame of each part.
        valid: (frame,) bool; other frames give no entry.
        point_count: number of points of all parts.
        reach_m: maximum distance.
    """
    return _search(joints_m, valid, boxes, point_count, reach_m**2).view(ENTRY)


@njit(cache=True)
def _search(joints_m, valid, boxes, point_count, square_reach):  # pragma: no cover (compiled)
    """Return the bytes of all entries. Bytes, because numba copies records slowly."""
    n_frames, _, n_joints, _ = joints_m.shape
    max_entries = point_count * n_joints
    keys, squares, next_row = (
        np.empty(max_entries + 1, np.int32),
        np.empty(max_entries + 1),
        np.zeros(point_count, np.int64),
    )
    buffer = np.empty(_FIRST_ENTRIES_PER_FRAME * n_frames * _ENTRY_BYTES, np.uint8)
    size = 0
    for frame in range(n_frames):
        count = _hits_of_frame(joints_m[frame], boxes, square_reach, keys, squares) if valid[frame] else 0
        if (size + count) * _ENTRY_BYTES > len(buffer):
            larger = np.empty(2 * len(buffer) + max_entries * _ENTRY_BYTES, np.uint8)
            larger[: size * _ENTRY_BYTES] = buffer[: size * _ENTRY_BYTES]
            buffer = larger
        if count:
            _write_in_order(keys[:count], squares, next_row, frame, size, buffer.view(ENTRY))
        size += count
    return buffer[: size * _ENTRY_BYTES].copy()


@njit(cache=True)
def _hits_of_frame(joints_m, boxes, square_reach, keys, squares):  # pragma: no cover (compiled)
    """Write 256 point + joint of the close pairs into ``keys``, and squared distances. Returns their number."""
    part, low_m, high_m, first, point, points_m = boxes
    count = 0
    for joint in range(joints_m.shape[1]):
        for box in range(len(part)):
            x, y, z = joints_m[part[box], joint, 0], joints_m[part[box], joint, 1], joints_m[part[box], joint, 2]
            if _square_to_box(x, y, z, low_m, high_m, box) >= square_reach:
                continue
            for index in range(first[box], first[box + 1]):
                dx, dy, dz = points_m[index, 0] - x, points_m[index, 1] - y, points_m[index, 2] - z
                square = dx * dx + dy * dy + dz * dz
                # Branch-free: each pair is written, and the next pair overwrites it unless the count has advanced.
                keys[count], squares[count] = (point[index] << 8) | joint, square
                count += square < square_reach
    return count


@njit(cache=True)
def _square_to_box(x, y, z, low_m, high_m, box):  # pragma: no cover (compiled)
    """Return the squared distance of a position to a box, a lower bound for its points, also after rounding."""
    dx = max(low_m[box, 0] - x, x - high_m[box, 0], 0.0)
    dy = max(low_m[box, 1] - y, y - high_m[box, 1], 0.0)
    dz = max(low_m[box, 2] - z, z - high_m[box, 2], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True)
def _write_in_order(keys, squares, next_row, frame, size, entries):  # pragma: no cover (compiled)
    """Write the hits of one frame into ``entries`` from row ``size``, with a counting sort by point.

    next_row: (point,) work array of zeros, which is zero again afterwards.
    """
    for key in keys:
        next_row[key >> 8] += 1
    start = size
    for point in range(len(next_row)):
        start, next_row[point] = start + next_row[point], start
    for hit in range(len(keys)):
        point = keys[hit] >> 8
        index = next_row[point]
        next_row[point] = index + 1
        entries[index].frame = frame
        entries[index].point = point
        entries[index].joint = keys[hit] & 255
        entries[index].distance_m = np.sqrt(squares[hit])
    next_row[:] = 0


@njit(cache=True)
def closest_of_joints(joints_m, boxes):  # pragma: no cover (compiled)
    """Return (frame,) smallest distance between a joint and a point, metres.

    joints_m: (frame, part, joint, 3) float64, the joints in the frame of each part. Joints move little from frame to
    frame, so the search starts with the closest joint and box of the previous frame, which excludes most boxes.
    """
    n_frames, _, n_joints, _ = joints_m.shape
    closest = np.empty(n_frames)
    joint = box = 0
    for frame in range(n_frames):
        best, box = _nearest(joints_m[frame, :, joint], boxes, np.inf, box)
        previous_joint = joint
        for other in range(n_joints):
            if other != previous_joint:
                square, nearest_box = _nearest(joints_m[frame, :, other], boxes, best, box)
                if square < best:
                    best, joint, box = square, other, nearest_box
        closest[frame] = np.sqrt(best)
    return closest


@njit(cache=True)
def _nearest(joint_m, boxes, best, likely):  # pragma: no cover (compiled)
    """Return the squared distance to the nearest point, if below ``best``, else ``best``; and its box.

    joint_m: (part, 3). likely: the box to search first.
    """
    part, low_m, high_m, first, _, points_m = boxes
    nearest_box = likely
    for step in range(-1, len(part)):
        box = likely if step < 0 else step
        if step == likely:
            continue
        x, y, z = joint_m[part[box], 0], joint_m[part[box], 1], joint_m[part[box], 2]
        if _square_to_box(x, y, z, low_m, high_m, box) >= best:
            continue
        for index in range(first[box], first[box + 1]):
            dx, dy, dz = points_m[index, 0] - x, points_m[index, 1] - y, points_m[index, 2] - z
            square = dx * dx + dy * dy + dz * dz
            if square < best:
                best, nearest_box = square, box
    return best, nearest_box
