"""Capsules (spheres swept along segments) against an object's mesh: at most one contact per capsule and frame.

A capsule overlaps where the signed distance somewhere on its axis is below its radius. The distance along a segment
changes by at most the way gone, so a coarse search with two refinements finds the deepest axis point of all but
features thinner than an eighth of the segment. Each part of a hinged object is met in its own frame.
"""

from typing import NamedTuple

import numpy as np

from hoidata.geometry.transform import RigidTransform
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import PartSurface, surface_index

COARSE_SAMPLES = 9
_REFINEMENTS = 2


class Capsules(NamedTuple):
    """start_m, end_m: (frame, capsule, 3) ends of the axes, metres. radius_m: (capsule,)."""

    start_m: np.ndarray
    end_m: np.ndarray
    radius_m: np.ndarray

    def taken(self, frames: np.ndarray | slice, capsules: np.ndarray | slice = slice(None)) -> "Capsules":
        """Some frames and some capsules only."""
        return Capsules(self.start_m[frames][:, capsules], self.end_m[frames][:, capsules], self.radius_m[capsules])

    def seen_from(self, a_from_world: RigidTransform) -> "Capsules":
        """In frame a, ``a_from_world`` (frame,) transforms."""
        return Capsules(a_from_world @ self.start_m, a_from_world @ self.end_m, self.radius_m)

    def moved(self, shift_m: np.ndarray) -> "Capsules":
        """Shifted by (3,) or, frame by frame, (frame, 3)."""
        shift = np.broadcast_to(shift_m, (len(self.start_m), 3))[:, None]
        return Capsules(self.start_m + shift, self.end_m + shift, self.radius_m)


class ObjectPoses(NamedTuple):
    """rotmats: (frame, 3, 3) and translation_m: (frame, 3) of ``world_from_object``; hinge_rad: (frame,) or None."""

    rotmats: np.ndarray
    translation_m: np.ndarray
    hinge_rad: np.ndarray | None = None

    def world_from_part(self, model: ObjectModel, part: int) -> RigidTransform:
        """(frame,) poses of one part: the object's own for the base, turned by the hinge for part 1."""
        return RigidTransform(self.rotmats, self.translation_m) @ model.object_from_part(part, self.hinge_rad)

    def taken(self, frames: np.ndarray | slice) -> "ObjectPoses":
        hinge = None if self.hinge_rad is None else self.hinge_rad[frames]
        return ObjectPoses(self.rotmats[frames], self.translation_m[frames], hinge)


class CapsuleContacts(NamedTuple):
    """One row per overlap, sorted by frame, then capsule; world frame.

    frame, capsule: (contact,) int. part: (contact,) touched part. depth_m: (contact,) radius less signed distance of
    the deepest axis point. point_m: (contact, 3) nearest surface point to it. normal: (contact, 3) unit, out of the
    object, the gradient of the signed distance there. middle_point_m, middle_normal: the same of the axis's middle.
    """

    frame: np.ndarray
    capsule: np.ndarray
    part: np.ndarray
    depth_m: np.ndarray
    point_m: np.ndarray
    normal: np.ndarray
    middle_point_m: np.ndarray
    middle_normal: np.ndarray

    def at_middle(self) -> "CapsuleContacts":
        """The same overlaps with point and normal nearest to the middle of the axis, as ManipNet's release has them."""
        return self._replace(point_m=self.middle_point_m, normal=self.middle_normal)


def joined(hands: list[Capsules]) -> Capsules:
    """The capsules of several hands as one set, in the order given."""
    starts, ends, radii = zip(*hands, strict=True)
    return Capsules(np.concatenate(starts, axis=1), np.concatenate(ends, axis=1), np.concatenate(radii))


def capsule_contacts(
    model: ObjectModel, poses: ObjectPoses, capsules: Capsules, tolerance_m: float = 0.0
) -> CapsuleContacts:
    """Every capsule within ``tolerance_m`` of the object, world frame; a hinged object counts by its nearer part."""
    found = [
        _part_contacts(model, part, poses.world_from_part(model, part), capsules, tolerance_m) for part in model.parts
    ]
    every = CapsuleContacts(*(np.concatenate(column) for column in zip(*found, strict=True)))
    order = np.lexsort((-every.depth_m, every.capsule, every.frame))
    frame, capsule = every.frame[order], every.capsule[order]
    first = np.r_[True, (np.diff(frame) != 0) | (np.diff(capsule) != 0)] if len(order) else np.zeros(0, dtype=bool)
    return CapsuleContacts(*(column[order][first] for column in every))


def _part_contacts(
    model: ObjectModel, part: int, world_from_part: RigidTransform, capsules: Capsules, tolerance_m: float
) -> CapsuleContacts:
    surface = surface_index(model).filled[part]
    start, end = (world_from_part.inverse() @ ends for ends in (capsules.start_m, capsules.end_m))
    frame, capsule = _candidates(surface.tree.box[0], start, end, capsules.radius_m + tolerance_m)
    start, end, radius = start[frame, capsule], end[frame, capsule], capsules.radius_m[capsule]
    half = np.linalg.norm(end - start, axis=1) / 2
    middle = surface.nearest((start + end) / 2)
    near = middle.distance_m < half + radius + tolerance_m
    frame, capsule, start, end, radius = (column[near] for column in (frame, capsule, start, end, radius))
    along = _deepest(surface, start, end)
    deepest = surface.nearest(start + along[:, None] * (end - start))
    hit = deepest.distance_m < radius + tolerance_m
    frame, world = frame[hit], world_from_part[frame[hit]]
    places = deepest.closest_m[hit], deepest.normal[hit], middle.closest_m[near][hit], middle.normal[near][hit]
    point, normal, middle_point, middle_normal = (
        (world.turn(rows[:, None]) if number % 2 else world @ rows[:, None])[:, 0] for number, rows in enumerate(places)
    )
    depth = (radius - deepest.distance_m)[hit]
    part_of = np.full(len(frame), part)
    return CapsuleContacts(frame, capsule[hit], part_of, depth, point, normal, middle_point, middle_normal)


def _candidates(
    box_m: np.ndarray, start: np.ndarray, end: np.ndarray, reach_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frame and capsule of those whose bounding box, widened by its reach, meets the part's, box_m (6,)."""
    low, high = np.minimum(start, end) - reach_m[:, None], np.maximum(start, end) + reach_m[:, None]
    frame, capsule = np.nonzero(((low < box_m[3:]) & (high > box_m[:3])).all(axis=-1))
    return frame, capsule


def _deepest(surface: PartSurface, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(segment,) position on each axis, 0 to 1, where the signed distance is least."""
    grid = np.linspace(0, 1, COARSE_SAMPLES)
    along = np.broadcast_to(grid, (len(start), COARSE_SAMPLES))
    step = grid[1]
    for _ in range(_REFINEMENTS):
        best = _least(surface, start, end, along)
        step /= 4
        along = np.clip(best[:, None] + step * np.arange(-4, 5), 0, 1)
    return _least(surface, start, end, along)


def _least(surface: PartSurface, start: np.ndarray, end: np.ndarray, along: np.ndarray) -> np.ndarray:
    points = start[:, None] + along[:, :, None] * (end - start)[:, None]
    distance = surface.signed_m(points.reshape(-1, 3)).reshape(along.shape)
    return along[np.arange(len(along)), distance.argmin(axis=1)]
