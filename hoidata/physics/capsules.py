"""Contacts of capsules (spheres swept along segments) with an object's mesh: at most one per capsule and frame.

A capsule overlaps if the signed distance at some point of its axis is below its radius. The distance is 1-Lipschitz, so
a coarse search with two refinements finds the deepest axis point, except at features thinner than an eighth of the
segment. Each part of a hinged object is tested in its rest frame.
"""

from typing import NamedTuple

import numpy as np

from hoidata.geometry.transform import RigidTransform
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import PartSurface, surface_index

COARSE_SAMPLES = 9
_REFINEMENTS = 2


class Capsules(NamedTuple):
    """Moving capsules in one frame of reference."""

    start_m: np.ndarray  # (frame, capsule, 3) start of the axis
    end_m: np.ndarray  # (frame, capsule, 3) end of the axis
    radius_m: np.ndarray  # (capsule,)

    def taken(self, frames: np.ndarray | slice, capsules: np.ndarray | slice = slice(None)) -> "Capsules":
        """A subset of frames and capsules."""
        return Capsules(self.start_m[frames][:, capsules], self.end_m[frames][:, capsules], self.radius_m[capsules])

    def relative_to(self, a_from_world: RigidTransform) -> "Capsules":
        """Transform world capsules to frame a by ``a_from_world`` (frame,)."""
        return Capsules(a_from_world @ self.start_m, a_from_world @ self.end_m, self.radius_m)

    def moved(self, shift_m: np.ndarray) -> "Capsules":
        """Translate by (3,) or (frame, 3)."""
        shift = np.broadcast_to(shift_m, (len(self.start_m), 3))[:, None]
        return Capsules(self.start_m + shift, self.end_m + shift, self.radius_m)


class ObjectPoses(NamedTuple):
    """The motion of an object, ``world_from_object``."""

    rotmats: np.ndarray  # (frame, 3, 3)
    translation_m: np.ndarray  # (frame, 3)
    hinge_rad: np.ndarray | None = None  # (frame,), None for a rigid object

    def world_from_part(self, model: ObjectModel, part: int) -> RigidTransform:
        """(frame,) poses of one part: the object's pose for the base, with the hinge rotation for part 1."""
        return RigidTransform(self.rotmats, self.translation_m) @ model.object_from_part(part, self.hinge_rad)

    def taken(self, frames: np.ndarray | slice) -> "ObjectPoses":
        """A subset of frames."""
        hinge = None if self.hinge_rad is None else self.hinge_rad[frames]
        return ObjectPoses(self.rotmats[frames], self.translation_m[frames], hinge)


class CapsuleContacts(NamedTuple):
    """Overlaps of capsules with an object in the world frame, sorted by frame, then capsule."""

    frame: np.ndarray  # (contact,) int
    capsule: np.ndarray  # (contact,) int
    part: np.ndarray  # (contact,) the touched part
    depth_m: np.ndarray  # (contact,) radius minus the signed distance of the deepest axis point
    point_m: np.ndarray  # (contact, 3) surface point closest to the deepest axis point
    normal: np.ndarray  # (contact, 3) unit, outward, gradient of the signed distance at the deepest axis point
    middle_point_m: np.ndarray  # (contact, 3) surface point closest to the middle of the axis
    middle_normal: np.ndarray  # (contact, 3) unit, outward, gradient at the middle of the axis

    def at_middle(self) -> "CapsuleContacts":
        """The overlaps with point and normal at the middle of the axis, as in ManipNet's release."""
        return self._replace(point_m=self.middle_point_m, normal=self.middle_normal)


def joined(hands: list[Capsules]) -> Capsules:
    """Concatenate the capsules of several hands in order."""
    starts, ends, radii = zip(*hands, strict=True)
    return Capsules(np.concatenate(starts, axis=1), np.concatenate(ends, axis=1), np.concatenate(radii))


def capsule_contacts(model: ObjectModel, poses: ObjectPoses, capsules: Capsules) -> CapsuleContacts:
    """Find capsules that overlap the object; of a hinged object's parts, the deepest contact counts."""
    contacts_of_parts = [
        _part_contacts(model, part, poses.world_from_part(model, part), capsules) for part in model.parts
    ]
    contacts = CapsuleContacts(*(np.concatenate(column) for column in zip(*contacts_of_parts, strict=True)))
    # Of the contacts of a capsule with both parts, keep the deepest: the first after sorting.
    order = np.lexsort((-contacts.depth_m, contacts.capsule, contacts.frame))
    frame, capsule = contacts.frame[order], contacts.capsule[order]
    first = np.r_[True, (np.diff(frame) != 0) | (np.diff(capsule) != 0)] if len(order) else np.zeros(0, dtype=bool)
    return CapsuleContacts(*(column[order][first] for column in contacts))


def _part_contacts(
    model: ObjectModel, part: int, world_from_part: RigidTransform, capsules: Capsules
) -> CapsuleContacts:
    surface = surface_index(model).filled[part]
    start, end = (world_from_part.inverse() @ ends for ends in (capsules.start_m, capsules.end_m))
    frame, capsule = _candidates(surface.tree.box[0], start, end, capsules.radius_m)
    start, end, radius = start[frame, capsule], end[frame, capsule], capsules.radius_m[capsule]
    half = np.linalg.norm(end - start, axis=1) / 2
    middle = surface.nearest((start + end) / 2)
    near = middle.distance_m < half + radius  # the distance is 1-Lipschitz along the axis
    frame, capsule, start, end, radius = (column[near] for column in (frame, capsule, start, end, radius))
    along = _deepest(surface, start, end)
    deepest = surface.nearest(start + along[:, None] * (end - start))
    hit = deepest.distance_m < radius
    frame, world = frame[hit], world_from_part[frame[hit]]
    surface_points = deepest.closest_m[hit], deepest.normal[hit], middle.closest_m[near][hit], middle.normal[near][hit]
    point, normal, middle_point, middle_normal = (
        (world.turn(rows[:, None]) if number % 2 else world @ rows[:, None])[:, 0]
        for number, rows in enumerate(surface_points)
    )
    depth = (radius - deepest.distance_m)[hit]
    parts = np.full(len(frame), part)
    return CapsuleContacts(
        frame=frame,
        capsule=capsule[hit],
        part=parts,
        depth_m=depth,
        point_m=point,
        normal=normal,
        middle_point_m=middle_point,
        middle_normal=middle_normal,
    )


def _candidates(
    box_m: np.ndarray, start: np.ndarray, end: np.ndarray, reach_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Frame and capsule index of capsules whose bounding box, grown by ``reach_m``, overlaps ``box_m`` (6,)."""
    low, high = np.minimum(start, end) - reach_m[:, None], np.maximum(start, end) + reach_m[:, None]
    frame, capsule = np.nonzero(((low < box_m[3:]) & (high > box_m[:3])).all(axis=-1))
    return frame, capsule


def _deepest(surface: PartSurface, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(segment,) position on each axis, 0 to 1, with the smallest signed distance."""
    grid = np.linspace(0, 1, COARSE_SAMPLES)
    along = np.broadcast_to(grid, (len(start), COARSE_SAMPLES))
    step = grid[1]
    for _ in range(_REFINEMENTS):
        best = _closest_sample(surface, start, end, along)
        step /= 4  # 9 samples cover the two intervals around the best sample
        along = np.clip(best[:, None] + step * np.arange(-4, 5), 0, 1)
    return _closest_sample(surface, start, end, along)


def _closest_sample(surface: PartSurface, start: np.ndarray, end: np.ndarray, along: np.ndarray) -> np.ndarray:
    points = start[:, None] + along[:, :, None] * (end - start)[:, None]
    distance = surface.signed_m(points.reshape(-1, 3)).reshape(along.shape)
    return along[np.arange(len(along)), distance.argmin(axis=1)]
