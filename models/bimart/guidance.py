"""What pulls a clean motion to its contact map while it is being made (Sec. 3.3, eq. 5-7)."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

AT_ONCE = 1 << 22  # pairs of a place and a keypoint looked at together
GUIDED_WITHIN_M = 0.02  # places the map says are farther than this from the hand matter less and less


@dataclass(frozen=True)
class Map:
    """What a motion is held to. places_m (B, F, N, 3) of the object; contact_m (B, F, 2N): how far each hand is to be.

    known (B, F, 2N): values that count.
    """

    places_m: Tensor
    contact_m: Tensor
    known: Tensor


Guide = Literal["off", "paper", "metres"]


@dataclass(frozen=True)
class Discrepancy:
    """error_m (B, F, 2, N): made map minus wanted. nearest (B, F, 2, N): the keypoint; away (B, F, 2, N, 3): to it."""

    error_m: Tensor
    nearest: Tensor
    away: Tensor


def discrepancy(keypoints_m: Tensor, wanted: Map) -> Discrepancy:
    """Eq. 5: the map that keypoints (B, F, 2, J, 3) make, beside the wanted one."""
    batch, frames, _, count, _ = keypoints_m.shape
    places = wanted.places_m[:, :, None].expand(-1, -1, 2, -1, -1).flatten(0, 2)
    keypoints = keypoints_m.flatten(0, 2)
    step = max(1, AT_ONCE // (places.shape[1] * count))
    nearest = torch.cat(
        [torch.cdist(a, b).argmin(-1) for a, b in zip(places.split(step), keypoints.split(step), strict=True)]
    )
    way = keypoints.gather(1, nearest[..., None].expand(-1, -1, 3)) - places
    distance = way.norm(dim=-1)
    away = way / distance[..., None].clamp_min(1e-9)
    shape = batch, frames, 2, places.shape[1]
    error = distance.reshape(shape) - wanted.contact_m.unflatten(-1, (2, -1))
    return Discrepancy(error * wanted.known.unflatten(-1, (2, -1)), nearest.reshape(shape), away.reshape(*shape, 3))


def paper_step(keypoints_m: Tensor, wanted: Map, scale: Tensor, window: int) -> Tensor:
    """(B, F, 2, J, 3) the step of eq. 6 in normalised numbers: the gradient of the mean square, made of length 1.

    scale: (2, J, 3) metres of a normalised number. A path longer than a window takes the step every window would.
    """
    found = discrepancy(keypoints_m, wanted)
    count = wanted.known.unflatten(-1, (2, -1)).sum((1, 3), keepdim=True).clamp_min(1)
    gradient = (
        _on_keypoints(2 * found.error_m[..., None] * found.away / count[..., None], found.nearest, keypoints_m) * scale
    )
    length = gradient.flatten(1).norm(dim=1).clamp_min(1e-12)
    windows = max(keypoints_m.shape[1] / window, 1.0) ** 0.5
    return -gradient * (windows / length)[:, None, None, None, None]


def metre_step(keypoints_m: Tensor, wanted: Map) -> Tensor:
    """(B, F, 2, J, 3) metres: each keypoint goes the mean way that the places it is nearest to ask of it.

    A step of Gauss-Newton with the diagonal alone; places the map says are far from the hand count little.
    """
    found = discrepancy(keypoints_m, wanted)
    near = torch.exp(-wanted.contact_m / GUIDED_WITHIN_M).unflatten(-1, (2, -1)) * wanted.known.unflatten(-1, (2, -1))
    ask = _on_keypoints(near[..., None] * found.error_m[..., None] * found.away, found.nearest, keypoints_m)
    total = _on_keypoints(near[..., None].expand_as(found.away), found.nearest, keypoints_m)
    return -ask / (total + 0.5)


def _on_keypoints(values: Tensor, nearest: Tensor, like: Tensor) -> Tensor:
    """Sums over places (B, F, 2, N, 3) at the keypoints they are nearest to (B, F, 2, J, 3)."""
    return torch.zeros_like(like).scatter_add_(3, nearest[..., None].expand_as(values), values)


def combined(told: Tensor, untold: Tensor, weight: float, rule: Literal["usual", "paper"]) -> Tensor:
    """Classifier-free guidance: (1 + w) c - w u, or eq. 7 as printed, (1 + w) c - u."""
    return (1 + weight) * told - (weight if rule == "usual" else 1.0) * untold
