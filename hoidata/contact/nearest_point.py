"""How far the nearest sampled point is, however far: boxes of points, opened only if they can still win.

Compiled with numba. Joints move little from frame to frame, so that each search starts with the point that was nearest
before; few boxes are left then. As soon as a joint of a frame is within reach of a point, the cells of ``near_points``
tell of each other joint at once whether it can be closer.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.contact.intrinsics import LANES, squares_to_eight
from hoidata.contact.near_points import CellGrids
from hoidata.contact.part_frames import PartMotion, places_of_frame

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


def closest_of_joints(
    joints_m: np.ndarray, motion: PartMotion, boxes: PointBoxes, grids: CellGrids, reach_m: float
) -> np.ndarray:
    """(frame,) distance of the nearest point to the nearest of a frame's joints; most joints are passed over.

    joints_m: (frame, joint, 3) world joints, metres. grids: built for ``reach_m`` over the points of ``boxes``.
    """
    return _closest(np.array(joints_m, dtype=np.float64, order="C"), motion, boxes, grids, reach_m**2)


@njit(cache=True)
def _closest(joints_m, motion, boxes, grids, square_reach):  # pragma: no cover (compiled)
    n_frames, n_joints = joints_m.shape[:2]
    turns, places, eight = np.empty((2, 3, 3)), np.empty((len(motion.moves), n_joints, 3)), np.empty(LANES)
    closest = np.empty(n_frames)
    joint, box = 0, 0
    for frame in range(n_frames):
        places_of_frame(joints_m[frame], motion, frame, turns, places)
        # The joint that was closest before, then all: one that is looked at twice changes nothing.
        best, joint = _closest_in_cells(places, joint, joint + 1, grids, square_reach, joint, eight)
        best, joint = _closest_in_cells(places, 0, n_joints, grids, best, joint, eight)
        if best >= square_reach:
            best, joint, box = _closest_in_boxes(places, joint, boxes, box)
        closest[frame] = np.sqrt(best)
    return closest


@njit(cache=True)
def _closest_in_cells(places_m, start, stop, grids, best, joint, eight):  # pragma: no cover (compiled)
    """Of joints ``start`` to ``stop`` that are closer than ``best`` the smallest square, and the joint; else as given.

    best: at most the square of the reach the cells were made for. places_m: (part, joint, 3). eight: (8,), room.
    """
    low_m, cells_per_m, shape, first_cell, first, place_m, _ = grids
    for part in range(places_m.shape[0]):
        for other in range(start, stop):
            x, y, z = places_m[part, other, 0], places_m[part, other, 1], places_m[part, other, 2]
            i = (x - low_m[part, 0]) * cells_per_m[part]
            j = (y - low_m[part, 1]) * cells_per_m[part]
            k = (z - low_m[part, 2]) * cells_per_m[part]
            if not (0 <= i < shape[part, 0] and 0 <= j < shape[part, 1] and 0 <= k < shape[part, 2]):
                continue
            cell = first_cell[part] + (int(i) * shape[part, 1] + int(j)) * shape[part, 2] + int(k)
            for block in range(first[cell], first[cell + 1]):
                squares_to_eight(place_m, block, x, y, z, eight)
                for lane in range(LANES):
                    if eight[lane] < best:
                        best, joint = eight[lane], other
    return best, joint


@njit(cache=True)
def _closest_in_boxes(places_m, joint, boxes, box):  # pragma: no cover (compiled)
    """The smallest square of all joints, which joint's, and in which box. joint, box: to begin with."""
    best, box = _nearest(places_m[:, joint], boxes, np.inf, box)
    before = joint
    for other in range(places_m.shape[1]):
        if other != before:
            square, found = _nearest(places_m[:, other], boxes, best, box)
            if square < best:
                best, joint, box = square, other, found
    return best, joint, box


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
