"""Signed distances interpolated in grids, in torch: made once per surface from exact ones, for losses.

Both parts of many objects in one stack, with the offset to the nearest surface point: gradients flow to the points
asked about and never into the grid. Beyond the grid the distance goes on without a jump.

Whoever needs exact answers asks ``hoidata.objects.surface_index``. Its grid (``hoidata.objects.distance_grid``) serves
the hold (``hoidata.refinement.object_field``) and the grasp search of the embedded corpora.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from hoidata.devices import send
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index

MARGIN_M = 0.03
FAR_M = 10.0


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
                for column, found in zip((values, low, high), _part_values(model, part, resolution), strict=True):
                    column.append(found)
            axis.append(np.zeros(3) if model.hinge is None else model.hinge.axis)
            origin.append(np.zeros(3) if model.hinge is None else model.hinge.origin_m)
        self.values = torch.from_numpy(np.concatenate(values))
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
        rows = send(rows, points_m.device)
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
        node = (inside - low) / (high - low) * (self.resolution - 1)
        # A point that is no number has no corner; its weight, and so its distance, stays no number.
        corner = node.detach().nan_to_num().floor().clamp_(0, self.resolution - 2)
        weight = node - corner
        x, y, z = corner.long().unbind(-1)
        first = (
            (x * self.resolution + y) * self.resolution + z + ((rows * 2 + part) * self.resolution**3)[:, None, None]
        )
        total = _blend(self.values, first, weight, (self.resolution**2, self.resolution, 1))
        distance = total[..., 0] + (beyond.square().sum(-1) + 1e-12).sqrt() - 1e-6
        return torch.cat((distance[..., None], total[..., 1:] - beyond), -1)


def _blend(values: Tensor, first: Tensor, weight: Tensor, steps: tuple[int, int, int]) -> Tensor:
    """Trilinear interpolation of rows of ``values`` at the eight corners above index ``first``."""
    total = values.new_zeros(())
    for corner in range(8):
        bits = [(corner >> axis) & 1 for axis in range(3)]
        share = values.new_ones(())
        for axis, bit in enumerate(bits):
            share = share * (weight[..., axis] if bit else 1 - weight[..., axis])
        shift = sum(bit * step for bit, step in zip(bits, steps, strict=True))
        total = total + share[..., None] * values[first + shift]
    return total


def _part_values(model: ObjectModel, part: int, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of one part (of a rigid object all, and no second): rows (node, 4) of signed distance and offset, and the box.

    An object without the part is far away from everything.
    """
    if part not in model.parts:
        values = np.zeros((resolution**3, 4), np.float32)
        values[:, 0] = FAR_M
        return values, np.full(3, -1.0), np.full(3, 1.0)
    surface = surface_index(model).filled[part]
    box = surface.tree.box[0]
    low, high = box[:3] - MARGIN_M, box[3:] + MARGIN_M
    axes = [np.linspace(low[axis], high[axis], resolution) for axis in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    found = surface.nearest(nodes)
    values = np.column_stack((found.distance_m, found.closest_m - nodes))
    return values.astype(np.float32), low, high


def _tensor(rows: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(rows).astype(np.float32))
