"""Which points of an object the hands will touch, from a sentence: PointNet with a conditional VAE, or with anchors.

``ContactModel`` is Text2HOI's: Sec. 3.1 and supplement, Tables S4-S6. Layers that see per-clip features compute them
once per clip instead of once per point (the same function).

``AnchoredContact`` samples a few touched points for each hand, then both hands' maps. Text2HOI's Gaussian latent is
ignored by a network trained on few clips: two samples agree. A point that is touched is a latent with a meaning, on any
object: which points may be touched next is a distribution over the surface (soft cross-entropy, no collapse), and given
a few of them little is left open. The right hand's are drawn knowing the left's; maps come by hand, so hand flags
decide which there are.
"""

from dataclasses import dataclass, field
from itertools import product
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from hoidata.batches.requests import RequestBatch
from hoidata.devices import send
from models.common.features import TEXT_FEATURES, scaled_text
from models.common.point_net import PointLayer, PointNet, PointNetConfig, normalised_points

HAND_FLAGS = 2
TOUCH_WEIGHT = 0.1  # of the cross-entropy of touches beside that of the maps they give
N_SIDES = 2
ANCHORS = 4  # touches that a map is drawn by, of each hand
ANCHOR_FEATURES = 8
WAVES = (1.0, 2.0, 4.0)
REACHES = (0.1, 0.2, 0.4)
FAR = 10.0
ANCHOR_STRIDE = 4  # every fourth of the sampled points may become an anchor
Cloud = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class ContactConfig:
    """Sizes; the defaults are the paper's.

    drawn_by: what a sample is drawn by: the paper's Gaussian latent, which gives one map for both hands, or anchors,
    touched points of each hand drawn one after the other (``AnchoredContact``), which gives a map for each.
    """

    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    decoder_widths: tuple[int, int, int] = (512, 256, 128)
    latent: int = 64
    drawn_by: Literal["latent", "anchor"] = "latent"


@dataclass(frozen=True)
class ContactLossConfig:
    """points: how many points of every object a step sees, drawn anew each time."""

    points: int = 1024


class ContactModel(nn.Module):
    """Contact probability of every point, given points, scale and sentence."""

    def __init__(self, config: ContactConfig) -> None:
        super().__init__()
        self.config = config
        local, _, overall = config.point_net.widths
        heads = config.point_net.heads
        self.object_net = PointNet(3, config.point_net)
        self.contact_net = PointNet(4, config.point_net)
        self.to_latent = nn.Sequential(
            PointLayer(overall, heads[0]),
            PointLayer(heads[0], heads[1]),
            nn.Linear(heads[1], 2 * config.latent),
        )
        first, second, third = config.decoder_widths
        # Table S6's first layer, which sees the same numbers of a clip at each point, in two pieces.
        self.from_point = nn.Linear(local, first)
        self.from_clip = nn.Linear(overall + 1 + TEXT_FEATURES + config.latent, first, bias=False)
        self.rest = nn.Sequential(
            nn.LeakyReLU(0.2),
            nn.Linear(first, second),
            nn.LeakyReLU(0.2),
            nn.Linear(second, third),
            nn.LeakyReLU(0.2),
            nn.Linear(third, 1),
        )

    def encode(self, points: Tensor, contact_map: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance (B, latent) of z from normalised points (B, N, 3) and the true map (B, N)."""
        overall, _ = self.contact_net(torch.cat((points, contact_map[..., None]), -1))
        mean, log_variance = self.to_latent(overall).chunk(2, -1)
        return mean, log_variance.clamp(-8, 4)

    def decode(self, points_m: Tensor, text: Tensor, latent: Tensor) -> Tensor:
        """Logits (B, N) from points (B, N, 3), sentence (B, text) and z (B, latent)."""
        points, scale = normalised_points(points_m)
        overall, local = self.object_net(points)
        clip = torch.cat((overall, scale, text, latent), -1)
        return self.rest(self.from_point(local) + self.from_clip(clip)[:, None])[..., 0]

    def forward(
        self, points_m: Tensor, text: Tensor, contact_map: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Training pass: logits (B, N), mean and log-variance of z; noise (B, latent) for the reparameterisation."""
        mean, log_variance = self.encode(normalised_points(points_m)[0], contact_map)
        latent = mean + (0.5 * log_variance).exp() * noise
        return self.decode(points_m, text, latent), mean, log_variance

    @torch.no_grad()
    def sample(self, batch: RequestBatch, text: Tensor, latents: Tensor) -> Tensor:
        """Contact probabilities (B, count, 2, N), alike for hands that act; latents (count, B, latent) from N(0, I)."""
        maps = torch.stack([self.decode(batch.points_m, text, z).sigmoid() for z in latents], 1)
        return maps[:, :, None] * batch.active_hands[:, None, :, None]

    def draw_latents(self, count: int, n_clips: int, generator: torch.Generator) -> Tensor:
        """(count, clip, latent) draws from N(0, I)."""
        return torch.randn(count, n_clips, self.config.latent, generator=generator)


def contact_loss(logits: Tensor, contact_map: Tensor, mean: Tensor, log_variance: Tensor) -> dict[str, Tensor]:
    """Summed cross-entropy, Dice (per clip) and KL divergence to N(0, I) per latent, by name, and their "total"."""
    cross = functional.binary_cross_entropy_with_logits(logits, contact_map) * logits.shape[1]
    probability = logits.sigmoid()
    dice = 1 - (2 * (probability * contact_map).sum(1) + 1) / (probability.sum(1) + contact_map.sum(1) + 1)
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean()
    total = cross + dice.mean() + divergence
    return {"total": total, "cross_entropy": cross, "dice": dice.mean(), "kl": divergence}


class AnchoredContact(nn.Module):
    """Logits of the next touch and of the maps, given the touches (anchors) that are known."""

    def __init__(self, config: ContactConfig) -> None:
        super().__init__()
        self.config = config
        local, _, overall = config.point_net.widths
        self.object_net = PointNet(3, config.point_net)
        first, second, third = config.decoder_widths
        self.from_point = nn.Linear(local + 3 + 6 * len(WAVES) + N_SIDES * ANCHOR_FEATURES, first)
        self.from_clip = nn.Sequential(
            nn.Linear(overall + 1 + TEXT_FEATURES + HAND_FLAGS, first), nn.GELU(), nn.Linear(first, first)
        )
        self.rest = nn.Sequential(
            nn.GELU(),
            nn.Linear(first, second),
            nn.GELU(),
            nn.Linear(second, third),
            nn.GELU(),
            nn.Linear(third, 2 * N_SIDES),
        )

    def see(self, points_m: Tensor, text: Tensor, active_hands: Tensor) -> Cloud:
        """Normalised points (B, N, 3), their features, and those of each clip: all that anchors do not change."""
        points, scale = normalised_points(points_m)
        overall, local = self.object_net(points)
        clip = torch.cat((overall, scale, scaled_text(text), active_hands.float()), -1)
        return points, local, self.from_clip(clip)

    def logits(self, cloud: Cloud, at: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """Of touches and of maps, (B, 2, N) each; at (B, 2, A, 3): anchors, known (B, 2, A): which of them count."""
        points, local, clip = cloud
        distance = torch.cdist(points[:, None], at).masked_fill(~known[:, :, None], FAR)
        nearest, which = distance.min(-1)
        offset = points[:, None] - at.gather(2, which[..., None].expand(-1, -1, -1, 3))
        bells = [torch.exp(-0.5 * (distance / reach).square()).sum(-1) for reach in REACHES]
        share = known.to(points.dtype).mean(-1)[..., None].expand_as(nearest)
        near = torch.cat((offset, torch.stack((nearest, share, *bells), -1)), -1) * known.any(-1)[..., None, None]
        waves = [wave(points * (torch.pi * rate)) for rate in WAVES for wave in (torch.sin, torch.cos)]
        seen = (local, points, *waves, near.transpose(1, 2).flatten(2))
        mixed = self.from_point(torch.cat(seen, -1)) + clip[:, None]
        touch, contact = self.rest(mixed).transpose(1, 2).split(N_SIDES, 1)
        return touch, contact

    def losses(
        self, points_m: Tensor, text: Tensor, batch: RequestBatch, contact: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Cross-entropy of the next touch of one hand; and logits of the maps given all anchors, drawn evenly.

        The left hand's next touch is told some of its own, the right's also all of the left's. contact (B, 2, N) float:
        the true maps. A hand without any touched point has no anchor.
        """
        cloud, count, device = self.see(points_m, text, batch.active_hands), ANCHORS, contact.device
        there = contact.any(-1) & batch.active_hands
        rows = picked(contact, send(torch.rand(len(contact), N_SIDES, count, generator=generator), device))
        anchors = cloud[0][:, None].expand(-1, N_SIDES, -1, -1).gather(2, rows[..., None].expand(-1, -1, -1, 3))
        draws = send(torch.rand(len(contact), 2, generator=generator), device)
        right = there[:, 1] & (~there[:, 0] | (draws[:, 0] < 0.5))
        next_one = (draws[:, 1] * count).long()
        some = torch.arange(count, device=device) < next_one[:, None]
        known = torch.stack((some | right[:, None], some & right[:, None]), 1) & there[..., None]
        side = right.long()[:, None, None]
        told = self.logits(cloud, anchors, known)[0].log_softmax(-1).take_along_dim(side, 1)[:, 0]
        wanted = contact.take_along_dim(side, 1)[:, 0]
        wanted = wanted / wanted.sum(-1, keepdim=True).clamp_min(1)
        touch = -(wanted * told).sum() / there.any(-1).sum().clamp_min(1)
        return touch, self.logits(cloud, anchors, there[..., None].expand_as(known))[1]

    @torch.no_grad()
    def sample(self, batch: RequestBatch, text: Tensor, latents: Tensor) -> Tensor:
        """Contact probabilities (B, count, 2, N) by hand for sentences (B, text) and latents (count, B, 2, A), even
        draws from 0 to 1. A hand that acts in no clip of the batch costs nothing.
        """
        points_m, active_hands = batch.points_m, batch.active_hands
        cloud, maps = self.see(points_m, text, active_hands), []
        sides = [side for side in range(N_SIDES) if batch.sides[side]]
        some = cloud[0][:, ::ANCHOR_STRIDE], cloud[1][:, ::ANCHOR_STRIDE], cloud[2]
        clips = torch.arange(len(points_m), device=points_m.device)
        nothing = latents.new_zeros(latents.shape[1:], dtype=torch.bool)
        nowhere = points_m.new_zeros(*nothing.shape, 3)
        first = self.logits(some, nowhere, nothing)[0]  # the same for every draw
        for draw in latents:
            anchors, known = nowhere.clone(), nothing.clone()
            for turn, (side, number) in enumerate(product(sides, range(ANCHORS))):
                touches = self.logits(some, anchors, known)[0] if turn else first
                touch = touches[:, side].softmax(-1)
                anchors[:, side, number] = some[0][clips, picked(touch, draw[:, side, number, None])[:, 0]]
                known[:, side, number] = active_hands[:, side]
            maps.append(self.logits(cloud, anchors, known)[1].sigmoid() * active_hands[..., None])
        return torch.stack(maps, 1)

    def draw_latents(self, count: int, n_clips: int, generator: torch.Generator) -> Tensor:
        """(count, clip, 2, A) draws that choose the touches."""
        return torch.rand(count, n_clips, N_SIDES, ANCHORS, generator=generator)


def picked(weights: Tensor, draws: Tensor) -> Tensor:
    """(..., K) places drawn in proportion to weights (..., N) by even draws (..., K) from 0 to 1; none is beyond N."""
    places = torch.arange(weights.shape[-1], device=weights.device)
    cumulative = weights @ (places[:, None] <= places).to(weights.dtype)  # cumsum on a GPU has no order it keeps to
    found = torch.searchsorted(cumulative, draws * cumulative[..., -1:], right=True)
    return found.clamp_max(weights.shape[-1] - 1)


def by_hand_loss(touch: Tensor, logits: Tensor, contact: Tensor, active_hands: Tensor) -> dict[str, Tensor]:
    """Cross-entropy and Dice of the maps (B, 2, N) of hands that act, and that of touches, as parts and "total"."""
    there = active_hands.to(logits.dtype)
    total = there.sum().clamp_min(1)
    cross = functional.binary_cross_entropy_with_logits(logits, contact, reduction="none").mean(-1)
    probability = logits.sigmoid()
    dice = 1 - (2 * (probability * contact).sum(-1) + 1) / (probability.sum(-1) + contact.sum(-1) + 1)
    parts = {"cross_entropy": (cross * there).sum() / total, "dice": (dice * there).sum() / total, "touch": touch}
    whole = parts["cross_entropy"] + parts["dice"] + TOUCH_WEIGHT * touch
    return {"total": whole, **parts}
