"""Distances from hand joints to an object's sampled points, found in the object's own frame.

Moving 21 joints into the frame of a part (which a hinge may have turned) instead of 1,024 points into the world lets
one index per part serve every frame of every clip, and makes every result independent of the world frame.
"""

from typing import Protocol

import numpy as np

from hoidata.clips import ObjectTrack
from hoidata.contact.near_points import ENTRY, closest_of_joints, near_entries, point_boxes
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
        self._boxes = point_boxes(points.points_m, [np.flatnonzero(points.part == part) for part in self.parts])

    def closest_m(self, joints_m: np.ndarray, track: ObjectTrack) -> np.ndarray:
        """(frame,) distance from the nearest of the world joints ``(frame, joint, 3)`` to the nearest point, metres."""
        if not self.parts:
            return np.full(len(joints_m), np.inf)
        return closest_of_joints(self._places_m(joints_m, track), self._boxes)

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
        if not self.parts:
            return np.zeros(0, ENTRY)
        places_m = self._places_m(joints_m, track)
        return near_entries(places_m, np.array(valid, bool), self._boxes, self.count, threshold_m)

    def _places_m(self, joints_m: np.ndarray, track: ObjectTrack) -> np.ndarray:
        """(frame, part, joint, 3) float64, world joints in the frame of each part."""
        in_object = track.world_from_object.inverse() @ joints_m.astype(np.float64)
        parts = [track.model.object_from_part(part, track.hinge_rad).inverse() for part in self.parts]
        return np.stack([part_from_object @ in_object for part_from_object in parts], axis=1)
