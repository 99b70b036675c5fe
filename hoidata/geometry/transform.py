"""Rigid transforms whose names state their frames.

    points_world = world_from_object @ object_from_part @ points_part
    points_object = world_from_object.inverse() @ points_world

The arrays are NumPy arrays or torch tensors. Rotations act on column vectors, ``x_world = R @ x_object``.
"""

from dataclasses import dataclass
from typing import Any, overload

import numpy as np

from hoidata.geometry.rotations import Array, rotvec_to_rotmat


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """``a_from_b``: maps points of frame b to frame a by ``rotation (p - pivot) + offset``.

    The inverse exchanges pivot and offset. Stored bytes depend on the rounding of exactly this formula.
    """

    rotation: Any  # (..., 3, 3)
    offset: Any = None  # (..., 3) position of the pivot in frame a, metres; None for zero
    pivot: Any = None  # (..., 3) centre of the rotation in frame b, metres; None for the origin

    @classmethod
    def from_rotvec(cls, rotvec: Array, translation_m: Array) -> "RigidTransform":
        """Build from axis-angles (..., 3) in radians and positions (..., 3) of the origin of b in a, metres."""
        return cls(rotvec_to_rotmat(rotvec), translation_m)

    @property
    def translation(self) -> Any:
        """(..., 3) position of the origin of b in a, metres."""
        offset = self.rotation[..., 0] * 0 if self.offset is None else self.offset
        return offset if self.pivot is None else offset - _turned(self.rotation, self.pivot)

    def inverse(self) -> "RigidTransform":
        """The transform ``b_from_a``."""
        return self if self is IDENTITY else RigidTransform(self.rotation.swapaxes(-1, -2), self.pivot, self.offset)

    @overload
    def __matmul__(self, other: "RigidTransform") -> "RigidTransform": ...
    @overload
    def __matmul__(self, other: Array) -> Array: ...
    def __matmul__(self, other):
        """Compose ``a_from_b @ b_from_c``, or map points (..., point, 3) of b to a. Leading axes broadcast."""
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
        """Rotate directions (..., vector, 3) of b to a."""
        return vectors if self is IDENTITY else vectors @ self.rotation.swapaxes(-1, -2)

    def __getitem__(self, index: Any) -> "RigidTransform":
        """Index the leading axis; a pivot or offset without that axis is shared."""
        ndim_of_shared = self.rotation.ndim - 2
        offset, pivot = (
            value if value is None or value.ndim <= ndim_of_shared else value[index]
            for value in (self.offset, self.pivot)
        )
        return RigidTransform(self.rotation[index], offset, pivot)


IDENTITY = RigidTransform(np.eye(3))


def _turned(rotation: Any, vector: Any) -> Any:
    return (rotation @ vector[..., None])[..., 0]


def _sum(first: Any, second: Any) -> Any:
    """The sum of two vectors, either of which may be None for zero."""
    return second if first is None else first if second is None else first + second
