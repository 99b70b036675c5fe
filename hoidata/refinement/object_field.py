"""Signed distances to a moving object, from one distance grid per part at rest."""

import numpy as np

from hoidata.clips.clip import ObjectTrack
from hoidata.geometry.transform import RigidTransform
from hoidata.objects.distance_grid import DistanceGrid
from hoidata.objects.surface_index import surface_index
from hoidata.refinement.kernels import lower_signed

# The distance grid of a part, and rotation and translation of part-from-world in every frame.
_Part = tuple[DistanceGrid, tuple[np.ndarray, np.ndarray]]


class ObjectField:
    """The surface of a moving object. A part that bounds no solid has no inside: its distances are not negative."""

    def __init__(self, track: ObjectTrack) -> None:
        surfaces = surface_index(track.model).filled
        self._parts: list[_Part] = [
            (surface.grid, _contiguous(world_from_part(track, part).inverse())) for part, surface in surfaces.items()
        ]

    def part_touched(self, points_m: np.ndarray, touching: np.ndarray) -> tuple[int, np.ndarray]:
        """The part that most points touch, and which points touch it.

        points_m: (frame, point, 3) world. touching: (frame, point) bool, whether a point touches the object.
        Returns the index of the part, and (frame, point) bool, whether a point touches it.
        """
        if len(self._parts) == 1:
            return 0, touching
        nearest = np.argmin([self.distances(points_m, part=part)[0] for part in (0, 1)], axis=0)
        by_part = [touching & (nearest == number) for number in (0, 1)]
        part = int(by_part[1].sum() > by_part[0].sum())
        return part, by_part[part]

    def distances(
        self, points_m: np.ndarray, frames: np.ndarray | None = None, part: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance to one part, or to the nearest part of the object.

        Args:
            points_m: (frame, point, 3) world.
            frames: (frame,) index of each frame in the object's motion, all frames by default.
            part: index of the part; None for all.

        Returns distances (frame, point), metres, and their gradients (frame, point, 3), world.
        """
        chosen = slice(None) if frames is None else frames
        distance, slope = np.full(points_m.shape[:2], np.inf), np.zeros(points_m.shape)
        for grid, (rotation, offset) in self._parts if part is None else [self._parts[part]]:
            lower_signed(*grid, rotation[chosen], offset[chosen], np.ascontiguousarray(points_m), distance, slope)
        return distance, slope


def world_from_part(track: ObjectTrack, part: int) -> RigidTransform:
    """(frame,) pose of one part of a moving object."""
    return track.world_from_object @ track.model.object_from_part(part, track.hinge_rad)


def _contiguous(transform: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (frame, 3, 3) and translation (frame, 3), as compiled code takes them."""
    return np.ascontiguousarray(transform.rotation), np.ascontiguousarray(transform.translation)
