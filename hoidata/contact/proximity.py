"""Distances from hand joints to an object's sampled points, computed in the frame of each part.

Transforming 21 joints into the frame of a part, instead of 1,024 points into the world, needs one index per part for
all clips. The results do not depend on the world frame.
"""

from typing import Protocol

import numpy as np

from hoidata.clips import ObjectTrack
from hoidata.contact.near_points import ENTRY, closest_of_joints, near_entries, point_boxes
from hoidata.errors import BadInput

CONTACT_THRESHOLD_M = 0.02


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
            track: motion of the object.
            threshold_m: maximum distance.

        Raises:
            BadInput: more frames, points or joints than an entry can count.
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
