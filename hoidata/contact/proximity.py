"""Distances from hand joints to an object's sampled points, found in the object's own frame.

Moving 21 joints into the frame of a part (which a hinge may have turned) instead of 1,024 points into the world lets
one search tree per part serve every frame of every clip, and makes every result independent of the world frame.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.objects.model import Hinge
from hoidata.objects.sampling import SampledPoints
from hoidata.schema import ObjectTrack

CONTACT_THRESHOLD_M = 0.02
# One joint close to one point in one frame: 9 bytes.
ENTRY = np.dtype([("frame", "<i2"), ("point", "<i2"), ("joint", "i1"), ("distance_m", "<f4")])


@dataclass(frozen=True)
class _PartIndex:
    """Search tree over the points of one part; ``points``: their indices among all sampled points."""

    part: int
    points: np.ndarray
    tree: KDTree


class ProximityIndex:
    """Search trees over one object's sampled points, one per part. Build once per object, use for all its clips."""

    def __init__(self, points: SampledPoints) -> None:
        positions = points.points_m.astype(np.float64)
        members = [(int(part), np.flatnonzero(points.part == part)) for part in np.unique(points.part)]
        self.parts = [_PartIndex(part, index, KDTree(positions[index])) for part, index in members]
        self.count = len(points)

    def nearest_m(self, joints_m: np.ndarray, track: ObjectTrack) -> np.ndarray:
        """(frame, joint) distance from world joints ``(frame, joint, 3)`` to the nearest sampled point, metres."""
        in_object = joints_in_object(joints_m, track)
        nearest = np.full(joints_m.shape[:2], np.inf)
        for part in self.parts:
            local = joints_in_part(in_object, part.part, track.model.hinge, track.hinge_rad)
            np.minimum(nearest, part.tree.query(local)[0], out=nearest)
        return nearest

    def entries(
        self, joints_m: np.ndarray, valid: np.ndarray, track: ObjectTrack, threshold_m: float = CONTACT_THRESHOLD_M
    ) -> np.ndarray:
        """All (frame, point, joint, distance) closer than ``threshold_m``, as ``ENTRY`` rows in that order.

        joints_m: (frame, joint, 3) world. valid: (frame,) bool; other frames give no entry.
        """
        in_object = joints_in_object(joints_m, track)
        found = [self._part_entries(part, in_object, valid, track, threshold_m) for part in self.parts]
        entries = np.concatenate(found) if found else np.zeros(0, ENTRY)
        # Sorting one integer per entry, and take, are eight times as fast as lexsort and indexing of packed rows.
        place = (entries["frame"].astype(np.int64) * self.count + entries["point"]) * joints_m.shape[1]
        return np.take(entries, np.argsort(place + entries["joint"]))

    def _part_entries(
        self, part: _PartIndex, in_object: np.ndarray, valid: np.ndarray, track: ObjectTrack, threshold_m: float
    ) -> np.ndarray:
        local = joints_in_part(in_object, part.part, track.model.hinge, track.hinge_rad)
        inside = (local > part.tree.mins - threshold_m) & (local < part.tree.maxes + threshold_m)
        frame, joint = np.nonzero(inside.all(axis=2) & valid[:, None])
        if not len(frame):
            return np.zeros(0, ENTRY)
        near = KDTree(local[frame, joint]).sparse_distance_matrix(part.tree, threshold_m, output_type="ndarray")
        near = near[near["v"] < threshold_m]
        entries = np.empty(len(near), ENTRY)
        entries["frame"], entries["joint"] = frame[near["i"]], joint[near["i"]]
        entries["point"], entries["distance_m"] = part.points[near["j"]], near["v"]
        return entries


def joints_in_object(joints_m: np.ndarray, track: ObjectTrack) -> np.ndarray:
    """World joints ``(frame, joint, 3)`` in the object frame of their own frame of time; float64 metres."""
    rotation = rotvec_to_rotmat(track.rotvec.astype(np.float64))
    return (joints_m.astype(np.float64) - track.translation_m[:, None].astype(np.float64)) @ rotation


def joints_in_part(in_object_m: np.ndarray, part: int, hinge: Hinge | None, hinge_rad: np.ndarray | None) -> np.ndarray:
    """Object-frame joints ``(frame, joint, 3)`` in the frame of a part: the hinge's turn undone for the moving part."""
    if part == 0 or hinge is None or hinge_rad is None:
        return in_object_m
    turn = rotvec_to_rotmat(hinge.axis[None].astype(np.float64) * hinge_rad.astype(np.float64)[:, None])
    return (in_object_m - hinge.origin_m) @ turn + hinge.origin_m
