"""Distances to an object from grids of its parts at rest: made once, asked at every frame and hinge angle."""

from collections.abc import Sequence

import numpy as np

from hoidata.clips.clip import ObjectTrack
from hoidata.geometry.transform import RigidTransform
from hoidata.objects.distance_grid import DistanceGrid
from hoidata.objects.surface_index import surface_index
from hoidata.refinement.kernels import lower_signed

# A grid of distances, and the rotation and translation of every frame.
_Part = tuple[DistanceGrid, tuple[np.ndarray, np.ndarray]]


class ObjectField:
    """The surface of one moving object. A part that bounds no solid has no inside: its distances are not negative."""

    def __init__(self, thing: ObjectTrack) -> None:
        surfaces = surface_index(thing.model).filled
        self._parts: list[_Part] = [  # one grid per part, whatever the frames and angles
            (surface.grid, _contiguous(world_from_part(thing, part).inverse())) for part, surface in surfaces.items()
        ]

    @property
    def moves(self) -> bool:
        """The object has a part that a hinge moves."""
        return len(self._parts) > 1

    def most_depth_m(self, part: int) -> float:
        """How deep inside of one part a place can lie; 0 where it has no inside."""
        return max(0.0, -float(self._parts[part][0].value.min()))

    def nearest_part(self, places_m: np.ndarray) -> np.ndarray:
        """(frame, place) number of the part whose surface is nearest to places (frame, place, 3), world."""
        each = []
        for grid, (rotation, offset) in self._parts:
            each.append(np.full(places_m.shape[:2], np.inf))
            lower_signed(*grid, rotation, offset, np.ascontiguousarray(places_m), each[-1], np.zeros(places_m.shape))
        return np.argmin(each, axis=0)

    def part_touched(
        self, places_m: np.ndarray, touching: np.ndarray, part: int | None = None
    ) -> tuple[int, np.ndarray]:
        """Number of the part that most places (frame, place, 3), world, touch, or ``part``; and (frame, place) which
        touch that one.

        touching: (frame, place) bool, which touch any part.
        """
        if not self.moves:
            return 0, touching
        nearest = self.nearest_part(places_m)
        each = [touching & (nearest == number) for number in (0, 1)]
        if part is None:
            part = int(each[1].sum() > each[0].sum())
        return part, each[part]

    def distances(self, places_m: np.ndarray, frames: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Signed distances (frame, place), metres, and their slope (frame, place, 3), world frame.

        places_m: (frame, place, 3) world. frames: (frame,) which of the object's, all by default. Of two parts the one
        whose distance is less.
        """
        return self._lowest(self._parts, places_m, frames)

    def distances_to(self, part: int, places_m: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As ``distances``, to one part alone."""
        return self._lowest(self._parts[part : part + 1], places_m, frames)

    @staticmethod
    def _lowest(
        parts: Sequence[_Part], places_m: np.ndarray, frames: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        rows = slice(None) if frames is None else frames
        distance, slope = np.full(places_m.shape[:2], np.inf), np.zeros(places_m.shape)
        for grid, (rotation, offset) in parts:
            lower_signed(*grid, rotation[rows], offset[rows], np.ascontiguousarray(places_m), distance, slope)
        return distance, slope


def world_from_part(thing: ObjectTrack, part: int) -> RigidTransform:
    """(frame,) the motion of one part of an object."""
    return thing.world_from_object @ thing.model.object_from_part(part, thing.hinge_rad)


def _contiguous(transform: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (frame, 3, 3) and translation (frame, 3), as compiled code takes them."""
    return np.ascontiguousarray(transform.rotation), np.ascontiguousarray(transform.translation)
