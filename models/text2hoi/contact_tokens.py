"""Contact as a set of points a Transformer can attend to: where each hand touches, and where nothing does.

Text2HOI hands the denoiser the contact map as 1,024 numbers in the order of the points, which means something else on
every object. Here it is told some points of the touched and of the untouched surface, spread out over it; neither
their order nor the order of the sampled points enters.
"""

import torch
from torch import Tensor

from models.common.point_net import normalised_points

TOKEN_FEATURES = 13


def contact_tokens(
    points_m: Tensor, normals: Tensor, part: Tensor, contact: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """(B, 3 count, 13) features of points touched by the left hand, by the right, and by none; (B, 3 count) which are.

    points_m, normals (B, N, 3), part (B, N), contact (B, 2, N) bool. A kind with fewer points than ``count`` has all.
    """
    about, _ = normalised_points(points_m)
    kinds = torch.cat((contact, ~contact.any(1, keepdim=True)), 1)
    chosen, there = spread_out(points_m, kinds, count)
    own = torch.cat((about, points_m * 10, normals, part[..., None].to(points_m.dtype)), -1)
    rows = torch.arange(len(own), device=own.device)[:, None, None]
    kind = torch.eye(3, device=own.device)[:, None].expand(len(own), 3, count, 3)
    return torch.cat((own[rows, chosen], kind), -1).flatten(1, 2), there.flatten(1, 2)


def spread_out(points_m: Tensor, kinds: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """(B, S, count) rows of points far from each other among those of each kind (B, S, N) bool, and which are any.

    Farthest-point sampling (Eldar et al. 1997), from the point farthest from the middle of its kind.
    """
    weight = kinds.to(points_m.dtype)
    middle = weight @ points_m / weight.sum(-1, keepdim=True).clamp_min(1)
    apart = torch.cdist(middle, points_m).masked_fill(~kinds, -1.0)
    farthest = apart.argmax(-1)
    nearest, chosen, there = apart.clone().masked_fill(kinds, torch.inf), [], []
    for _ in range(count):
        there.append(nearest.gather(-1, farthest[..., None])[..., 0] > 0)
        chosen.append(farthest)
        picked = points_m.gather(1, farthest[..., None].expand(-1, -1, 3))
        nearest = torch.minimum(nearest, torch.cdist(picked, points_m)).masked_fill(~kinds, -1)
        farthest = nearest.argmax(-1)
    return torch.stack(chosen, -1), torch.stack(there, -1)
