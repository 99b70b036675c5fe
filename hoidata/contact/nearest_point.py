"""How far the nearest sampled point is, however far: boxes of points, opened only if they can still win.

Compiled with numba. Joints move little from frame to frame, so that each search starts with the point that was nearest
before; few boxes are left then.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

_POINTS_PER_BOX = 16


class PointBoxes(NamedTuple):
    """Points sorted into boxes. part: (box,); low_m, high_m: (box, 3); first: (box + 1,) where a box's points start.

    points_m: (point, 3), box by box. A box has at most 16 points, all of one part.
    """

    part: np.ndarray
    low_m: np.ndarray
    high_m: np.ndarray
    first: np.ndarray
    points_m: np.ndarray


def point_boxes(points_m: np.ndarray, members: Sequence[np.ndarray]) -> PointBoxes:
    """Boxes over (point, 3) points, metres. members: per part the rows of its points; a part is its place there."""
    found = [(part, rows) for part, own in enumerate(members) for rows in _halved(points_m, own)]
    points = [points_m[rows] for _, rows in found]
    return PointBoxes(
        part=np.array([part for part, _ in found], np.int64),
        low_m=np.array([own.min(axis=0) for own in points]).reshape(-1, 3),
        high_m=np.array([own.max(axis=0) for own in points]).reshape(-1, 3),
        first=np.cumsum([0, *map(len, points)]),
        points_m=np.concatenate(points) if points else np.zeros((0, 3)),
    )


def _halved(points_m: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """Halves across the longest axis, and their halves, until they are small enough."""
    if len(rows) <= _POINTS_PER_BOX:
        return [rows]
    own = points_m[rows]
    axis = np.ptp(own, axis=0).argmax()
    order = rows[np.argsort(own[:, axis], kind="stable")]
    middle = len(order) // 2
    return _halved(points_m, order[:middle]) + _halved(points_m, order[middle:])


@njit(cache=True)
def nearest_of_each(places_m, boxes):  # pragma: no cover (compiled)
    """(frame, joint) distance to the nearest point. places_m: (part, frame, joint, 3) joints in each part's frame."""
    n_frames, n_joints = places_m.shape[1:3]
    nearest = np.empty((n_frames, n_joints))
    box = np.zeros(n_joints, np.int64)
    for frame in range(n_frames):
        for joint in range(n_joints):
            square, box[joint] = _nearest(places_m[:, frame, joint], boxes, np.inf, box[joint])
            nearest[frame, joint] = np.sqrt(square)
    return nearest


@njit(cache=True)
def closest_of_joints(places_m, boxes):  # pragma: no cover (compiled)
    """(frame,) distance from the joint that comes closest to the points; arguments as ``nearest_of_each``."""
    n_frames, n_joints = places_m.shape[1:3]
    closest = np.empty(n_frames)
    joint, box = 0, 0
    for frame in range(n_frames):
        best, box = _nearest(places_m[:, frame, joint], boxes, np.inf, box)
        before = joint
        for other in range(n_joints):
            if other != before:
                square, found = _nearest(places_m[:, frame, other], boxes, best, box)
                if square < best:
                    best, joint, box = square, other, found
        closest[frame] = np.sqrt(best)
    return closest


@njit(cache=True)
def _nearest(place_m, boxes, best, likely):  # pragma: no cover (compiled)
    """Square of the distance to the nearest point if below ``best``, else ``best``; and its box.

    place_m: (part, 3). likely: the box to open first.
    """
    part, low_m, high_m, first, points_m = boxes
    winner = likely
    for step in range(-1, len(part)):
        box = likely if step < 0 else step
        if box >= len(part) or step == likely:
            continue
        x, y, z = place_m[part[box], 0], place_m[part[box], 1], place_m[part[box], 2]
        dx = max(low_m[box, 0] - x, x - high_m[box, 0], 0.0)
        dy = max(low_m[box, 1] - y, y - high_m[box, 1], 0.0)
        dz = max(low_m[box, 2] - z, z - high_m[box, 2], 0.0)
        if dx * dx + dy * dy + dz * dz >= best:
            continue
        for row in range(first[box], first[box + 1]):
            dx, dy, dz = points_m[row, 0] - x, points_m[row, 1] - y, points_m[row, 2] - z
            square = dx * dx + dy * dy + dz * dz
            if square < best:
                best, winner = square, box
    return best, winner
