"""Signed distance and nearest surface point of articulated objects, looked up in grids made once per object.

Losses need both for thousands of points per step; dense point-to-point distances would cost seconds there. Each part of
an object gets a grid of exact values (libigl) in its rest frame; a query moves into that frame and reads all four
numbers by trilinear interpolation. Gradients flow to the query points and never into the grid.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.objects.distance import signed_distance
from hoidata.objects.model import ObjectModel

MARGIN_M = 0.03
FAR_M = 10.0


@dataclass(frozen=True)
class PartGrid:
    """values: (4, r, r, r) signed distance and offset to the nearest surface point, metres; box corners (3,)."""

    values: np.ndarray
    low_m: np.ndarray
    high_m: np.ndarray


def part_grid(model: ObjectModel, part: int, resolution: int) -> PartGrid | None:
    """The grid of one part, or None if the object has no such part. Part 0 of a rigid object is all of it."""
    faces = model.faces[model.face_part == part] if model.is_articulated else model.faces
    if not len(faces) or (part == 1 and not model.is_articulated):
        return None
    corners = model.vertices_m[faces].reshape(-1, 3)
    low, high = corners.min(axis=0) - MARGIN_M, corners.max(axis=0) + MARGIN_M
    axes = [np.linspace(low[axis], high[axis], resolution) for axis in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    found = signed_distance(model.vertices_m, faces, points)
    values = np.concatenate((found.distance_m[:, None], found.closest_m - points), axis=1)
    shaped = values.reshape(resolution, resolution, resolution, 4).transpose(3, 0, 1, 2)
    return PartGrid(np.ascontiguousarray(shaped, dtype=np.float32), low, high)


class DistanceFields:
    """Fields of many objects in one stack; clips name their object by key.

    Distances are negative inside. Beyond the box of a part (its bounds and 3 cm) the distance to the box is added.
    """

    def __init__(self, objects: Iterable[tuple[str, ObjectModel]], resolution: int = 40) -> None:
        """objects: (key, model) pairs; resolution: grid points along each axis."""
        self.resolution = resolution
        self.row: dict[str, int] = {}
        values, low, high, axis, origin = [], [], [], [], []
        for key, model in objects:
            if key in self.row:
                continue
            self.row[key] = len(self.row)
            for part in range(2):
                grid = part_grid(model, part, resolution) or _absent(resolution)
                values.append(grid.values)
                low.append(grid.low_m)
                high.append(grid.high_m)
            axis.append(np.zeros(3) if model.hinge is None else model.hinge.axis)
            origin.append(np.zeros(3) if model.hinge is None else model.hinge.origin_m)
        self.values = torch.from_numpy(np.stack(values)).flatten(2).transpose(1, 2).reshape(-1, 4)
        self.low, self.high = _tensor(low).reshape(-1, 2, 3), _tensor(high).reshape(-1, 2, 3)
        self.axis, self.origin = _tensor(axis), _tensor(origin)

    def rows(self, keys: Sequence[str]) -> Tensor:
        """(clip,) rows of the named objects."""
        return torch.tensor([self.row[key] for key in keys])

    def to(self, device: torch.device | str) -> "DistanceFields":
        """Moves the grids; gives itself back."""
        for name in ("values", "low", "high", "axis", "origin"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def query(self, rows: Tensor, points_m: Tensor, hinge_rad: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (B, F, P) and offset to the nearest surface point (B, F, P, 3), metres, object frame.

        rows (B,), points_m (B, F, P, 3) in the object frame, hinge_rad (B, F).
        """
        rows = rows.to(points_m.device)
        turn = rotvec_to_rotmat(self.axis[rows][:, None] * hinge_rad[..., None])
        origin = self.origin[rows][:, None, None]
        base = self._read(rows, 0, points_m)
        lid = self._read(rows, 1, (points_m - origin) @ turn + origin)
        lid = torch.cat((lid[..., :1], lid[..., 1:] @ turn.transpose(-1, -2)), -1)
        nearest = torch.where(base[..., :1] <= lid[..., :1], base, lid)
        return nearest[..., 0], nearest[..., 1:]

    def _read(self, rows: Tensor, part: int, points: Tensor) -> Tensor:
        """(B, F, P, 4) interpolated values of one part at points (B, F, P, 3) of its rest frame."""
        low, high = self.low[rows, part][:, None, None], self.high[rows, part][:, None, None]
        inside = torch.minimum(torch.maximum(points, low), high)
        beyond = points - inside
        place = (inside - low) / (high - low) * (self.resolution - 1)
        corner = place.detach().floor().clamp_(0, self.resolution - 2)
        weight = place - corner
        steps = torch.tensor([self.resolution**2, self.resolution, 1], device=points.device)
        first = (corner.long() * steps).sum(-1) + ((rows * 2 + part) * self.resolution**3)[:, None, None]
        total = _blend(self.values, first, weight, steps)
        distance = total[..., 0] + (beyond.square().sum(-1) + 1e-12).sqrt() - 1e-6
        return torch.cat((distance[..., None], total[..., 1:] - beyond), -1)


def _blend(values: Tensor, first: Tensor, weight: Tensor, steps: Tensor) -> Tensor:
    """Trilinear interpolation of rows of ``values`` at the eight corners above index ``first``."""
    total = values.new_zeros(())
    for corner in range(8):
        bits = [(corner >> axis) & 1 for axis in range(3)]
        share = values.new_ones(())
        for axis, bit in enumerate(bits):
            share = share * (weight[..., axis] if bit else 1 - weight[..., axis])
        shift = sum(int(bit) * int(step) for bit, step in zip(bits, steps, strict=True))
        total = total + share[..., None] * values[first + shift]
    return total


def _absent(resolution: int) -> PartGrid:
    values = np.zeros((4, resolution, resolution, resolution), np.float32)
    values[0] = FAR_M
    return PartGrid(values, np.full(3, -1.0), np.full(3, 1.0))


def _tensor(rows: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(rows).astype(np.float32))
