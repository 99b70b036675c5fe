"""Contact drawn as a touch and what goes with it: first one touched point for each hand, then both hands' maps.

Text2HOI draws a Gaussian latent, which a network trained on few clips learns to ignore: two samples agree. A point that
is touched is a latent with a meaning, on any object: which points may be touched is a distribution over the surface
(soft cross-entropy, no collapse), and given one of them little is left open. The right hand's point is drawn knowing
the left's; maps come by hand, so hand flags decide which there are.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from hoidata.batches.requests import RequestBatch
from models.common.features import scaled_text
from models.common.point_net import PointNet, normalised_points
from models.text2hoi.contact_config import HAND_FLAGS, ContactConfig, ContactLossConfig

SIDES = 2
ANCHOR_FEATURES = 8
WAVES = (1.0, 2.0, 4.0)
REACHES = (0.1, 0.2, 0.4)
Cloud = tuple[Tensor, Tensor, Tensor]


class AnchoredContact(nn.Module):
    """Logits of the next touch and of the maps, given the touches (anchors) that are known."""

    def __init__(self, config: ContactConfig) -> None:
        super().__init__()
        self.config = config
        local, _, overall = config.point_net.widths
        self.object_net = PointNet(3, config.point_net)
        first, second, third = config.decoder_widths
        self.from_point = nn.Linear(local + 3 + 6 * len(WAVES) + SIDES * ANCHOR_FEATURES, first)
        self.from_clip = nn.Sequential(
            nn.Linear(overall + 1 + config.text + HAND_FLAGS, first), nn.GELU(), nn.Linear(first, first)
        )
        self.rest = nn.Sequential(
            nn.GELU(),
            nn.Dropout(config.dropout),
            nn.Linear(first, second),
            nn.GELU(),
            nn.Linear(second, third),
            nn.GELU(),
            nn.Linear(third, 2 * SIDES),
        )

    def see(self, points_m: Tensor, text: Tensor, active_hands: Tensor) -> Cloud:
        """Normalised points (B, N, 3), their features, and those of each clip: all that anchors do not change."""
        points, scale = normalised_points(points_m)
        overall, local = self.object_net(points)
        clip = torch.cat((overall, scale, scaled_text(text), active_hands.float()), -1)
        return points, local, self.from_clip(clip)

    def logits(self, cloud: Cloud, anchors: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """Of touches and of maps, (B, 2, N) each; anchors (B, 2) rows of points, known (B, 2) which of them count."""
        points, local, clip = cloud
        at = points.gather(1, anchors[..., None].expand(-1, -1, 3))
        offset = points[:, :, None] - at[:, None]
        flags = known[:, None, :, None].expand(*offset.shape[:3], 1).to(points.dtype)
        distance = offset.norm(dim=-1, keepdim=True)
        bells = [torch.exp(-0.5 * (distance / reach).square()) for reach in REACHES]
        near = torch.cat((offset, distance, torch.ones_like(flags), *bells), -1) * flags
        waves = [wave(points * (torch.pi * rate)) for rate in WAVES for wave in (torch.sin, torch.cos)]
        mixed = self.from_point(torch.cat((local, points, *waves, near.flatten(2)), -1)) + clip[:, None]
        touch, contact = self.rest(mixed).transpose(1, 2).split(SIDES, 1)
        return touch, contact

    def losses(
        self, points_m: Tensor, text: Tensor, batch: RequestBatch, contact: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Cross-entropy of touches; and logits of the maps given one true touch of each hand, drawn evenly.

        contact (B, 2, N) float: the true maps. A hand without any touched point has no anchor.
        """
        cloud = self.see(points_m, text, batch.active_hands)
        known = contact.any(-1) & batch.active_hands
        draw = torch.rand(len(contact), SIDES, generator=generator).to(contact.device)
        anchors = picked(contact, draw)
        wanted = contact / contact.sum(-1, keepdim=True).clamp_min(1)
        first = self.touches(cloud, anchors, torch.zeros_like(known))
        told = self.knowing_left(cloud, first, anchors, known)
        touch = -((wanted * told).sum(-1) * known).sum() / known.sum().clamp_min(1)
        return touch, self.logits(cloud, anchors, known)[1]

    @torch.no_grad()
    def sample(self, points_m: Tensor, text: Tensor, active_hands: Tensor, latents: Tensor) -> Tensor:
        """Contact probabilities (B, count, 2, N) by hand for latents (count, B, 2), even draws from 0 to 1."""
        cloud, maps = self.see(points_m, text, active_hands), []
        first = self.touches(cloud, torch.zeros_like(active_hands, dtype=torch.long), torch.zeros_like(active_hands))
        for draw in latents:
            anchors = picked(first.exp(), draw)
            anchors[:, 1] = picked(self.knowing_left(cloud, first, anchors, active_hands).exp(), draw)[:, 1]
            maps.append(self.logits(cloud, anchors, active_hands)[1].sigmoid() * active_hands[..., None])
        return torch.stack(maps, 1)

    def touches(self, cloud: Cloud, anchors: Tensor, known: Tensor) -> Tensor:
        """(B, 2, N) log-probability of each hand's next touch; arguments as in ``logits``."""
        return self.logits(cloud, anchors, known)[0].log_softmax(-1)

    def knowing_left(self, cloud: Cloud, first: Tensor, anchors: Tensor, known: Tensor) -> Tensor:
        """``first``, touches without any anchor, but the right hand's told the left's anchor where both act."""
        both = known.all(-1)[:, None]
        after = self.touches(cloud, anchors, torch.cat((both, torch.zeros_like(both)), 1))
        return torch.stack((first[:, 0], torch.where(both, after[:, 1], first[:, 1])), 1)

    def draw_latents(self, count: int, n_clips: int, generator: torch.Generator) -> Tensor:
        """(count, clip, 2) draws that choose the touches."""
        return torch.rand(count, n_clips, SIDES, generator=generator)


def picked(weights: Tensor, draw: Tensor) -> Tensor:
    """(...,) places drawn in proportion to weights (..., N) by even draws (...,) from 0 to 1; 0 where all are zero."""
    places = torch.arange(weights.shape[-1], device=weights.device)
    cumulative = weights @ (places[:, None] <= places).to(weights.dtype)  # cumsum on a GPU has no order it keeps to
    return torch.searchsorted(cumulative, draw[..., None] * cumulative[..., -1:], right=True)[..., 0].clamp_max(
        weights.shape[-1] - 1
    )


def by_hand_loss(
    touch: Tensor, logits: Tensor, contact: Tensor, active_hands: Tensor, weights: ContactLossConfig
) -> dict[str, Tensor]:
    """Cross-entropy and Dice of the maps (B, 2, N) of hands that act, and that of touches, as parts and "total"."""
    there = active_hands.to(logits.dtype)
    total = there.sum().clamp_min(1)
    cross = functional.binary_cross_entropy_with_logits(logits, contact, reduction="none").mean(-1)
    probability = logits.sigmoid()
    dice = 1 - (2 * (probability * contact).sum(-1) + 1) / (probability.sum(-1) + contact.sum(-1) + 1)
    parts = {"cross_entropy": (cross * there).sum() / total, "dice": (dice * there).sum() / total, "touch": touch}
    whole = parts["cross_entropy"] + weights.dice_weight * parts["dice"] + weights.touch_weight * touch
    return {"total": whole, **parts}
