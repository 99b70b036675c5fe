"""PointNet (Qi et al. 2017): features of a point cloud, with the layers of Text2HOI's supplement, Tables S4 and S5."""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True)
class PointNetConfig:
    """Sizes of the point network; the defaults are the paper's."""

    # Of the three per-point layers; the last is the length of F_obj.
    widths: tuple[int, int, int] = (64, 128, 1024)
    # Of the layers behind the maximum, in the alignment and in the VAE's encoder.
    heads: tuple[int, int] = (512, 256)
    # Predict a matrix per cloud that aligns its points.
    align: bool = True
    # Points relative to their mean, in units of the farthest one's distance. The paper divides points by the object's
    # scale and does not move them.
    centred: bool = False

    def normalised(self, points_m: Tensor, scale_m: Tensor) -> tuple[Tensor, Tensor]:
        """Points (B, N, 3) without unit, and their unit (B, 1) in metres; ``scale_m`` (B,) is the object's scale."""
        return normalised_points(points_m) if self.centred else (points_m / scale_m[:, None, None], scale_m[:, None])


def normalised_points(points_m: Tensor) -> tuple[Tensor, Tensor]:
    """Points (B, N, 3) relative to their mean, in units of the farthest point's distance; the unit (B, 1), metres."""
    centred = points_m - points_m.mean(1, keepdim=True)
    scale = centred.norm(dim=-1).amax(1)
    return centred / scale[:, None, None], scale[:, None]


def spread_out(points_m: Tensor, kinds: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Farthest-point sampling (Eldar et al. 1997) among the points of each kind.

    The first point is the one farthest from the centre of its kind.
    points_m: (B, N, 3). kinds: (B, S, N) bool.
    Returns indices (B, S, count), and the mask (B, S, count) of those that exist.
    """
    weight = kinds.to(points_m.dtype)
    centre = weight @ points_m / weight.sum(-1, keepdim=True).clamp_min(1)
    from_centre = torch.cdist(centre, points_m).masked_fill(~kinds, -1.0)
    farthest = from_centre.argmax(-1)
    nearest, chosen, mask = from_centre.clone().masked_fill(kinds, torch.inf), [], []
    for _ in range(count):
        mask.append(nearest.gather(-1, farthest[..., None])[..., 0] > 0)
        chosen.append(farthest)
        picked = points_m.gather(1, farthest[..., None].expand(-1, -1, 3))
        nearest = torch.minimum(nearest, torch.cdist(picked, points_m)).masked_fill(~kinds, -1)
        farthest = nearest.argmax(-1)
    return torch.stack(chosen, -1), torch.stack(mask, -1)


class PointNet(nn.Module):
    """Global feature (B, G) and per-point features (B, N, L) of points (B, N, C) (Qi et al. 2017; Tables S4, S5)."""

    def __init__(self, channels: int, config: PointNetConfig) -> None:
        super().__init__()
        widths = config.widths
        self.align = _Alignment(channels, config) if config.align else None
        self.first = PointLayer(channels, widths[0])
        self.second = PointLayer(widths[0], widths[1])
        self.third = PointLayer(widths[1], widths[2], activate=False)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        if self.align is not None:
            points = points @ self.align(points)
        local = self.first(points)
        return self.third(self.second(local)).amax(1), local


class PointLayer(nn.Module):
    """Linear, batch norm over clips and points, ReLU: the paper's Conv1D with kernel 1."""

    def __init__(self, inputs: int, outputs: int, activate: bool = True) -> None:
        super().__init__()
        self.linear, self.norm, self.activate = nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), activate

    def forward(self, x: Tensor) -> Tensor:
        flat = self.linear(x).flatten(0, -2)
        # Batch statistics of a single sample are undefined: a dataset of one clip uses the running statistics.
        flat = self.norm(flat) if len(flat) > 1 else self._with_running_statistics(flat)
        x = flat.reshape(*x.shape[:-1], -1)
        return x.relu() if self.activate else x

    def _with_running_statistics(self, flat: Tensor) -> Tensor:
        norm = self.norm
        return functional.batch_norm(flat, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps)


class _Alignment(nn.Module):
    """The spatial transformer: a (C, C) matrix per clip, initially the identity."""

    def __init__(self, channels: int, config: PointNetConfig) -> None:
        super().__init__()
        self.channels = channels
        sizes, heads = (channels, *config.widths), config.heads
        self.points = nn.Sequential(*[PointLayer(a, b) for a, b in pairwise(sizes)])
        self.hidden = nn.Sequential(PointLayer(sizes[-1], heads[0]), PointLayer(heads[0], heads[1]))
        self.matrix = nn.Linear(heads[1], channels * channels)
        nn.init.zeros_(self.matrix.weight)
        nn.init.zeros_(self.matrix.bias)

    def forward(self, x: Tensor) -> Tensor:
        flat = self.matrix(self.hidden(self.points(x).amax(1)))
        return flat.reshape(-1, self.channels, self.channels) + torch.eye(self.channels, device=x.device)
