"""Distances from hand joints to an object's sampled points, found in the object's own frame.

Moving 21 joints into the frame of a part (which a hinge may have turned) instead of 1,024 points into the world lets
one index per part serve every frame of every clip, and makes every result independent of the world frame.
"""

from functools import cached_property
from typing import Protocol

import numpy as np

from hoidata.clips import ObjectTrack
from hoidata.contact.near_points import ENTRY, CellGrids, cell_grids, near_entries
from hoidata.contact.nearest_point import PointBoxes, closest_of_joints, point_boxes
from hoidata.contact.part_frames import part_motion
from hoidata.errors import BadInput

CONTACT_THRESHOLD_M = 0.02


class PartPoints(Protocol):
    """points_m: (point, 3) on an object's surface, in its frame, the hinge at zero. part: (point,) 0 or 1."""

    @property
    def points_m(self) -> np.ndarray: ...
    @property
    def part(self) -> np.ndarray: ...


class ProximityIndex:
    """One object's sampled points, ready for both questions. Build once per object, use for all its clips."""

    def __init__(self, points: PartPoints) -> None:
        self.count = len(points.points_m)
        self.parts = [int(part) for part in np.unique(points.part)]
        self._points_m = points.points_m.astype(np.float32, copy=False)
        self._members = [np.flatnonzero(points.part == part) for part in self.parts]
        self._grids: dict[float, CellGrids] = {}

    def closest_m(self, joints_m: np.ndarray, track: ObjectTrack) -> np.ndarray:
        """(frame,) distance from the nearest of the world joints ``(frame, joint, 3)`` to the nearest point, metres."""
        if not self.parts:
            return np.full(len(joints_m), np.inf)
        motion, reach = part_motion(track, self.parts), CONTACT_THRESHOLD_M
        return closest_of_joints(joints_m, motion, self._boxes, self._grid(reach), reach)

    def entries(
        self, joints_m: np.ndarray, valid: np.ndarray, track: ObjectTrack, threshold_m: float = CONTACT_THRESHOLD_M
    ) -> np.ndarray:
        """All (frame, point, joint, distance) closer than ``threshold_m``, as ``ENTRY`` rows in that order.

        joints_m: (frame, joint, 3) world. valid: (frame,) bool; other frames give no entry. Raises BadInput for more
        frames, points or joints than an entry can count.
        """
        counted = {"frame": len(joints_m), "point": self.count, "joint": joints_m.shape[1]}
        for name, count in counted.items():
            most = int(np.iinfo(ENTRY[name]).max)
            if count > most:
                raise BadInput("distance map", f"at most {most} {name}s", f"{count}", "cut the sequence, or take fewer")
        if not len(self.parts):
            return np.zeros(0, ENTRY)
        motion = part_motion(track, self.parts)
        return near_entries(joints_m, valid, motion, self._grid(threshold_m), self.count, threshold_m)

    def _grid(self, reach_m: float) -> CellGrids:
        if reach_m not in self._grids:
            self._grids[reach_m] = cell_grids(self._points_m, self._members, reach_m)
        return self._grids[reach_m]

    @cached_property
    def _boxes(self) -> PointBoxes:
        return point_boxes(self._points_m.astype(np.float64), self._members)
