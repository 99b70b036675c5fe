"""Rigid transforms that name their frames, so that a chain reads by eye.

    points_world = world_from_object @ object_from_part @ points_part
    points_object = world_from_object.inverse() @ points_world

Works on NumPy arrays and torch tensors alike; rotations act on column vectors, ``x_world = R @ x_object``.
"""

from dataclasses import dataclass
from typing import Any, overload

import numpy as np

from hoidata.geometry.rotations import Array, rotvec_to_rotmat


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """``a_from_b``: takes points of frame b to frame a, ``rotation (p - pivot) + offset``.

    rotation: (..., 3, 3). offset: (..., 3) where the pivot goes, metres in frame a; None for zero.
    pivot: (..., 3) the point turned about, metres in frame b; None for the origin. The inverse exchanges the two, so
    that turning about a hinge, and undoing a pose, round exactly as these words say: stored bytes depend on it.
    """

    rotation: Any
    offset: Any = None
    pivot: Any = None

    @classmethod
    def from_rotvec(cls, rotvec: Array, translation_m: Array) -> "RigidTransform":
        """From axis-angles (..., 3), radians, and positions (..., 3) of the origin of b in a, metres."""
        return cls(rotvec_to_rotmat(rotvec), translation_m)

    @property
    def translation(self) -> Any:
        """(..., 3) where the origin of b lies in a, metres."""
        offset = self.rotation[..., 0] * 0 if self.offset is None else self.offset
        return offset if self.pivot is None else offset - _turned(self.rotation, self.pivot)

    def inverse(self) -> "RigidTransform":
        """``b_from_a``."""
        return self if self is IDENTITY else RigidTransform(self.rotation.swapaxes(-1, -2), self.pivot, self.offset)

    @overload
    def __matmul__(self, other: "RigidTransform") -> "RigidTransform": ...
    @overload
    def __matmul__(self, other: Array) -> Array: ...
    def __matmul__(self, other):
        """``a_from_b @ b_from_c``, or points (..., point, 3) of b in a. Leading axes broadcast: (frame, point, 3)."""
        if self is IDENTITY or other is IDENTITY:
            return other if self is IDENTITY else self
        if isinstance(other, RigidTransform):
            middle = _sum(other.offset, None if self.pivot is None else -self.pivot)
            turned = None if middle is None else _turned(self.rotation, middle)
            return RigidTransform(self.rotation @ other.rotation, _sum(turned, self.offset), other.pivot)
        points = other if self.pivot is None else other - self.pivot[..., None, :]
        points = points @ self.rotation.swapaxes(-1, -2)
        return points if self.offset is None else points + self.offset[..., None, :]

    def turn(self, vectors: Array) -> Array:
        """Directions (..., vector, 3) of b in a: turned, not moved."""
        return vectors if self is IDENTITY else vectors @ self.rotation.swapaxes(-1, -2)

    def __getitem__(self, rows: Any) -> "RigidTransform":
        """Some rows of the leading axis; a pivot or offset that all rows share stays."""
        shared = self.rotation.ndim - 2
        offset, pivot = (
            value if value is None or value.ndim <= shared else value[rows] for value in (self.offset, self.pivot)
        )
        return RigidTransform(self.rotation[rows], offset, pivot)


IDENTITY = RigidTransform(np.eye(3))


def _turned(rotation: Any, vector: Any) -> Any:
    return (rotation @ vector[..., None])[..., 0]


def _sum(first: Any, second: Any) -> Any:
    """Of two vectors of which None stands for zero."""
    return second if first is None else first if second is None else first + second
