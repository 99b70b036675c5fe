"""Fast signed distances to a mesh, by interpolation in a grid: what the grasp search asks thousands of times."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hoidata.objects.distance import signed_distance

MARGIN_M = 0.035
_GRADIENT_STEP_M = 1e-3


class Field(Protocol):
    """Signed distance in metres, negative inside, of points (..., 3)."""

    def __call__(self, points_m: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class GridField:
    """Trilinear interpolation of exact signed distances on a grid; beyond it, a lower bound: the object keeps
    MARGIN_M from the grid's faces.

    origin_m: (3,) first node. spacing_m: step of the grid. values_m: (x, y, z) distances at the nodes.
    """

    origin_m: np.ndarray
    spacing_m: float
    values_m: np.ndarray

    def __call__(self, points_m: np.ndarray) -> np.ndarray:
        shape = np.array(self.values_m.shape)
        cell = (points_m - self.origin_m) / self.spacing_m
        clipped = np.clip(cell, 0, shape - 1.000001)
        beyond = np.sqrt(((cell - clipped) ** 2).sum(-1)) * self.spacing_m
        low = clipped.astype(np.int64)
        x, y, z = np.moveaxis(clipped - low, -1, 0)
        step_x, step_y = shape[1] * shape[2], shape[2]
        flat = low[..., 0] * step_x + low[..., 1] * step_y + low[..., 2]
        values = self.values_m.reshape(-1)
        rows = []
        for offset in (0, step_y, step_x, step_x + step_y):
            start = values[flat + offset]
            rows.append(start + z * (values[flat + offset + 1] - start))
        near = rows[0] + y * (rows[1] - rows[0])
        far = rows[2] + y * (rows[3] - rows[2])
        return np.where(beyond > 0, beyond + MARGIN_M, near + x * (far - near))


@dataclass(frozen=True)
class MovedField:
    """A field turned by ``rotmat (3, 3)`` about ``origin_m (3,)``."""

    field: Field
    rotmat: np.ndarray
    origin_m: np.ndarray

    def __call__(self, points_m: np.ndarray) -> np.ndarray:
        return self.field((points_m - self.origin_m) @ self.rotmat + self.origin_m)


@dataclass(frozen=True)
class MirroredField:
    """A field seen in a mirror with normal x: left hands are searched with the right hand's code."""

    field: Field

    def __call__(self, points_m: np.ndarray) -> np.ndarray:
        return self.field(points_m * np.array([-1.0, 1.0, 1.0]))


@dataclass(frozen=True)
class NearestField:
    """The union of several fields."""

    fields: tuple[Field, ...]

    def __call__(self, points_m: np.ndarray) -> np.ndarray:
        return np.minimum.reduce([field(points_m) for field in self.fields])


def gradient(field: Field, points_m: np.ndarray) -> np.ndarray:
    """Unit outward normals (..., 3) at points near the surface, by central differences."""
    steps = _GRADIENT_STEP_M * np.eye(3)
    slope = np.stack([field(points_m + step) - field(points_m - step) for step in steps], axis=-1)
    return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)


def grid_field(vertices_m: np.ndarray, faces: np.ndarray) -> GridField:
    """Sample the exact signed distance of a closed mesh on a grid of 3 to 6 mm, finer for smaller objects."""
    used = vertices_m[np.unique(faces)]
    low, high = used.min(0) - MARGIN_M, used.max(0) + MARGIN_M
    spacing = float(np.clip((np.prod(high - low) / 1e5) ** (1 / 3), 0.003, 0.006))
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [low[axis] + spacing * np.arange(counts[axis]) for axis in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = signed_distance(vertices_m, faces, nodes).distance_m
    return GridField(low, spacing, distance.reshape(counts))
