"""The canonical object: a triangle mesh in metres, its parts, and the hinge between them."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import IDENTITY, RigidTransform
from hoidata.objects.mesh import MassProperties, mass_properties
from hoidata.objects.solid import NoSolid, Solid, close_cut, solid_of

SEAM = 2  # in ``ObjectModel.face_part``: a triangle with corners on both parts


@dataclass(frozen=True)
class Hinge:
    """One revolute joint. axis: (3,) unit vector, origin_m: (3,), both in the object frame.

    A point of the moving part at angle q lies at ``R(axis * q) (p - origin) + origin``.
    """

    axis: np.ndarray
    origin_m: np.ndarray

    def turn(self, hinge_rad: np.ndarray) -> RigidTransform:
        """``object_from_part`` of the moving part at angles (frame,), radians."""
        rotvec = np.asarray(self.axis, dtype=np.float64) * np.asarray(hinge_rad, dtype=np.float64)[..., None]
        return RigidTransform(rotvec_to_rotmat(rotvec), self.origin_m, self.origin_m)


@dataclass(frozen=True)
class ObjectModel:
    """vertices_m: (vertex, 3); faces: (face, 3) int; part: (vertex,) uint8, 0 = base, 1 = the part the hinge moves.

    Its arrays are not to be changed: what follows from them is worked out once.
    """

    name: str
    vertices_m: np.ndarray
    faces: np.ndarray
    part: np.ndarray
    hinge: Hinge | None = None

    @property
    def is_articulated(self) -> bool:
        return self.hinge is not None

    @cached_property
    def face_part(self) -> np.ndarray:
        """(face,) uint8, the part of each face; ``SEAM`` where its corners are on both parts, so that it is on neither.

        A triangle between two parts cannot move with either: its corners would be off by the motion of the hinge.
        """
        if not self.is_articulated:
            return np.zeros(len(self.faces), np.uint8)
        corners = self.part[self.faces]
        return np.where((corners == corners[:, :1]).all(axis=1), corners[:, 0], SEAM).astype(np.uint8)

    @property
    def parts(self) -> list[int]:
        """The parts that have faces, in order; [0] for a rigid object."""
        return [int(part) for part in np.unique(self.face_part) if part != SEAM] if self.is_articulated else [0]

    @property
    def seam_triangles(self) -> int:
        """How many triangles span both parts. No part has them; distances and sampled points leave them out."""
        return int((self.face_part == SEAM).sum())

    def faces_of(self, part: int) -> np.ndarray:
        """(face, 3) faces of one part."""
        return self.faces[self.face_part == part] if self.is_articulated else self.faces

    def closed_part(self, part: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (vertex, 3) and faces (face, 3) of one part, closed where the other part was cut off it.

        A surface without such a cut is returned as it is stored. The closing triangles bound a volume; they are not
        part of the object's surface.
        """
        return self._closed_parts[part]

    @cached_property
    def _closed_parts(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        return {
            part: close_cut(self.vertices_m, self.faces_of(part), self.faces[self.face_part != part])
            for part in self.parts
        }

    @cached_property
    def solids(self) -> dict[int, Solid | NoSolid]:
        """By part, the solid that it bounds, or why it bounds none. Raises BadInput for a mesh without triangles."""
        return {part: solid_of(*self.closed_part(part)) for part in self.parts}

    def filled_part(self, part: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces that volumes and the sign of distances are computed from: the part's solid, if any.

        An open mesh, and a solid that needed no repair, are returned as ``closed_part`` has them.
        """
        solid = self.solids[part]
        return solid[:2] if isinstance(solid, Solid) and solid.repairs else self.closed_part(part)

    @cached_property
    def masses(self) -> tuple[MassProperties, ...]:
        """Mass, centre and inertia of each of ``parts``."""
        return tuple(mass_properties(*self.filled_part(part)) for part in self.parts)

    @cached_property
    def digest(self) -> str:
        """What name, mesh, parts and hinge are, as a SHA-256, worked out once."""
        hinge = () if self.hinge is None else (self.hinge.axis, self.hinge.origin_m)
        digest = hashlib.sha256(self.name.encode())
        for array in (self.vertices_m, self.faces, self.part, *hinge):
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def object_from_part(self, part: int, hinge_rad: np.ndarray | None) -> RigidTransform:
        """Where a part lies in the object frame, seen from its rest position (hinge angle 0), in which its mesh is.

        part: 0 for the base, which never moves against the object frame; 1 for the part the hinge moves.
        hinge_rad: (frame,) radians, needed for part 1 only. Raises BadInput where it is missing.
        """
        if part == 0 or self.hinge is None:
            return IDENTITY
        if hinge_rad is None:
            raise BadInput(f"motion of {self.name!r}", "a hinge angle for every frame", "none", "give the angles")
        return self.hinge.turn(hinge_rad)


def articulate(points_m: np.ndarray, part: np.ndarray, hinge: Hinge | None, hinge_rad: np.ndarray | None) -> np.ndarray:
    """Points of an object at each hinge angle: (frame, point, 3) metres, object frame; (1, point, 3) if it is rigid.

    points_m: (point, 3) at hinge angle 0, object frame. part: (point,) 0 or 1. hinge_rad: (frame,) radians.
    """
    if hinge is None or hinge_rad is None:
        return points_m[None]
    return np.where(part[None, :, None] == 1, hinge.turn(hinge_rad) @ points_m, points_m[None])
