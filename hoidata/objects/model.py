"""The canonical object: a triangle mesh in metres, its parts, and the hinge between them."""

from dataclasses import dataclass

import numpy as np

from hoidata.geometry.rotations import rotvec_to_rotmat


@dataclass(frozen=True)
class Hinge:
    """One revolute joint. axis: (3,) unit vector, origin_m: (3,), both in the object frame.

    A point of the moving part at angle q lies at ``R(axis * q) (p - origin) + origin``.
    """

    axis: np.ndarray
    origin_m: np.ndarray


@dataclass(frozen=True)
class ObjectModel:
    """vertices_m: (vertex, 3); faces: (face, 3) int; part: (vertex,) uint8, 0 = base, 1 = the part the hinge moves."""

    name: str
    vertices_m: np.ndarray
    faces: np.ndarray
    part: np.ndarray
    hinge: Hinge | None = None

    @property
    def is_articulated(self) -> bool:
        return self.hinge is not None

    @property
    def face_part(self) -> np.ndarray:
        """(face,) part of each face: the moving part when at least two of its vertices move."""
        return (self.part[self.faces].sum(axis=1) >= 2).astype(np.uint8)


def articulate(points_m: np.ndarray, part: np.ndarray, hinge: Hinge | None, hinge_rad: np.ndarray | None) -> np.ndarray:
    """Points (point, 3) of the object frame at each hinge angle (frame,): (frame, point, 3), still in the object frame.

    Rigid objects (no hinge) give one frame, (1, point, 3).
    """
    if hinge is None or hinge_rad is None:
        return points_m[None]
    rotation = rotvec_to_rotmat(hinge.axis[None] * np.asarray(hinge_rad)[:, None])
    moved = (points_m - hinge.origin_m) @ rotation.transpose(0, 2, 1) + hinge.origin_m
    return np.where(part[None, :, None] == 1, moved, points_m[None])


def place(points_m: np.ndarray, rotvec: np.ndarray, translation_m: np.ndarray) -> np.ndarray:
    """Object-frame points (1 or frame, point, 3) to the world at each frame's pose: (frame, point, 3), metres."""
    return points_m @ rotvec_to_rotmat(rotvec).transpose(0, 2, 1) + translation_m[:, None]
