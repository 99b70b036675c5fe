"""Differentiable signed distances in torch for losses, interpolated in grids of exact distances.

One tensor has the grids of both parts of many objects, with the offset to the closest surface point. Gradients flow to
the query points, not into the grid. The distance is continuous beyond the grid.

``hoidata.objects.surface_index`` has exact distances. Its grid (``hoidata.objects.distance_grid``) is used in contact
refinement (``hoidata.refinement.object_field``) and in the grasp search of the embedded corpora.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from hoidata.devices import send
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.objects.model import ObjectModel, joint_vectors
from hoidata.objects.surface_index import surface_index

MARGIN_M = 0.03
FAR_M = 10.0


class DistanceFields:
    """Signed distance fields of many objects, which clips reference by key.

    Distances are negative inside. Outside the box of a part (its bounds and 3 cm), the distance to the box is added.
    """

    def __init__(self, objects: Iterable[tuple[str, ObjectModel]], resolution: int = 40) -> None:
        """Compute the grids of (key, model) pairs with ``resolution`` nodes along each axis."""
        self.resolution = resolution
        self.row: dict[str, int] = {}
        self.any_lid = False
        values, low, high, axis, origin, slide = [], [], [], [], [], []
        for key, model in objects:
            if key in self.row:
                continue
            self.row[key] = len(self.row)
            for part in range(2):
                for stack, value in zip((values, low, high), _part_values(model, part, resolution), strict=True):
                    stack.append(value)
            for stack, vector in zip((axis, slide), joint_vectors(model), strict=True):
                stack.append(vector)
            origin.append(np.zeros(3) if model.hinge is None else model.hinge.origin_m)
            self.any_lid |= 1 in model.parts
        self.values = torch.from_numpy(np.concatenate(values))
        self.distances = self.values[:, :1].contiguous()
        self.low, self.high = _tensor(low).reshape(-1, 2, 3), _tensor(high).reshape(-1, 2, 3)
        self.axis, self.origin, self.slide_m = _tensor(axis), _tensor(origin), _tensor(slide)

    def rows(self, keys: Sequence[str]) -> Tensor:
        """(clip,) indices of objects by key."""
        return torch.tensor([self.row[key] for key in keys])

    def to(self, device: torch.device | str) -> "DistanceFields":
        """Move the grids to a device. Returns self."""
        for name in ("values", "distances", "low", "high", "axis", "origin", "slide_m"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def query(self, rows: Tensor, points_m: Tensor, hinge_rad: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance and offset to the closest surface point, object frame.

        rows: (B,) indices of objects. points_m: (B, F, P, 3). hinge_rad: (B, F) ``ObjectTrack.joint_angle_rad``.
        Returns distances (B, F, P) and offsets (B, F, P, 3), metres.
        """
        nearest = self._nearest(self.values, rows, points_m, hinge_rad)
        return nearest[..., 0], nearest[..., 1:]

    def distance(self, rows: Tensor, points_m: Tensor, hinge_rad: Tensor) -> Tensor:
        """The distances of ``query``, computed without the offsets."""
        return self._nearest(self.distances, rows, points_m, hinge_rad)[..., 0]

    def _nearest(self, values: Tensor, rows: Tensor, points_m: Tensor, hinge_rad: Tensor) -> Tensor:
        """(B, F, P, C) interpolated ``values`` (node, C) of the closer part, vectors in the object frame."""
        rows = send(rows, points_m.device)
        base = self._read(values, rows, 0, points_m)
        if not self.any_lid:
            return base
        rotation = rotvec_to_rotmat(self.axis[rows][:, None] * hinge_rad[..., None])
        origin = self.origin[rows][:, None, None]
        slid_m = (self.slide_m[rows][:, None] * hinge_rad[..., None])[..., None, :]
        lid = self._read(values, rows, 1, (points_m - origin - slid_m) @ rotation + origin)
        if lid.shape[-1] > 1:
            lid = torch.cat((lid[..., :1], lid[..., 1:] @ rotation.transpose(-1, -2)), -1)
        return torch.where(base[..., :1] <= lid[..., :1], base, lid)

    def _read(self, values: Tensor, rows: Tensor, part: int, points: Tensor) -> Tensor:
        """(B, F, P, C) interpolated ``values`` of one part at points (B, F, P, 3) of its rest frame."""
        low, high = self.low[rows, part][:, None, None], self.high[rows, part][:, None, None]
        inside = torch.minimum(torch.maximum(points, low), high)
        outside_m = points - inside
        node = (inside - low) / (high - low) * (self.resolution - 1)
        # A NaN point has no cell; its weight, and so its distance, stays NaN.
        corner = node.detach().nan_to_num().floor().clamp_(0, self.resolution - 2)
        weight = node - corner
        x, y, z = corner.long().unbind(-1)
        first = (
            (x * self.resolution + y) * self.resolution + z + ((rows * 2 + part) * self.resolution**3)[:, None, None]
        )
        total = _blend(values, first, weight, (self.resolution**2, self.resolution, 1))
        distance = total[..., 0] + (outside_m.square().sum(-1) + 1e-12).sqrt() - 1e-6
        if total.shape[-1] == 1:
            return distance[..., None]
        return torch.cat((distance[..., None], total[..., 1:] - outside_m), -1)


def _blend(values: Tensor, first: Tensor, weight: Tensor, steps: tuple[int, int, int]) -> Tensor:
    """Trilinear interpolation of rows of ``values`` at the eight corners of the cell with index ``first``."""
    total = values.new_zeros(())
    for corner in range(8):
        bits = [(corner >> axis) & 1 for axis in range(3)]
        corner_weight = values.new_ones(())
        for axis, bit in enumerate(bits):
            corner_weight = corner_weight * (weight[..., axis] if bit else 1 - weight[..., axis])
        shift = sum(bit * step for bit, step in zip(bits, steps, strict=True))
        total = total + corner_weight[..., None] * values[first + shift]
    return total


def _part_values(model: ObjectModel, part: int, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distances and offsets (node, 4) of one part, and the low and high corners of its grid.

    A part that the object does not have is far away from all points.
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
    nearest = surface.nearest(nodes)
    values = np.column_stack((nearest.distance_m, nearest.closest_m - nodes))
    return values.astype(np.float32), low, high


def _tensor(rows: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(rows).astype(np.float32))
