"""Which points of an object the hands will touch, from a sentence: PointNet with a conditional VAE or with anchors.

``ContactModel`` is Text2HOI's: Sec. 3.1 and supplement, Tables S4-S6. Layers that read per-clip features run once per
clip instead of once per point; the function is the same.

``AnchoredContact`` first samples a few touched points of each hand, the anchors, then predicts both hands' maps given
them. A network trained on few clips ignores Text2HOI's Gaussian latent: two samples agree. Anchors cannot be ignored.
Each is sampled from a distribution over the surface, trained by cross-entropy, and a few anchors nearly determine the
map. The left hand's anchors are sampled first and condition the right hand's.
"""

from dataclasses import dataclass, field
from itertools import product
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from hoidata.batches.requests import RequestBatch
from hoidata.devices import send
from models.common.features import TEXT_FEATURES, scaled_text
from models.common.point_net import PointLayer, PointNet, PointNetConfig

TYPICAL_SCALE_M, LOG_SCALE_DEVIATION = 0.08, 0.5  # of hand-held objects
TOUCH_WEIGHT = 0.1  # of the anchors' cross-entropy relative to that of the maps
N_SIDES = 2
ANCHORS = 4  # per hand
ANCHOR_FEATURES = 8
WAVES = (1.0, 2.0, 4.0)  # frequencies of sine and cosine position features
# Widths of Gaussians about the anchors: a hand's reach does not scale with the object.
REACHES_M = (0.008, 0.016, 0.032)
FAR = 10.0  # distance of a point from an anchor that is not given
ANCHOR_STRIDE = 4  # every fourth of the sampled points may become an anchor


class EncodedPoints(NamedTuple):
    """What ``AnchoredContact`` computes before any anchor is known."""

    points: Tensor  # (B, N, 3) normalised
    local: Tensor  # (B, N, L) per-point features
    clip: Tensor  # (B, width) features of object, sentence and hand flags
    unit_m: Tensor  # (B, 1) metres per unit of ``points``


@dataclass(frozen=True)
class ContactConfig:
    """Sizes of the contact network; the defaults are the paper's."""

    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    decoder_widths: tuple[int, int, int] = (512, 256, 128)
    latent: int = 64
    # What a sample is generated from: the paper's Gaussian latent, with one map for both hands, or anchor points, with
    # one map per hand (``AnchoredContact``).
    sampled_from: Literal["latent", "anchor_points"] = "latent"


@dataclass(frozen=True)
class ContactLossConfig:
    """The loss's sizes."""

    points: int = 1024  # sampled from every object in each training step
    # Half of the clips of a step have an object scaled by a random factor, at most this one or its inverse, and its
    # contact map (``scaled_contact``); 1: none.
    max_scaling: float = 1.0


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
            PointLayer(overall, heads[0]), PointLayer(heads[0], heads[1]), nn.Linear(heads[1], 2 * config.latent)
        )
        first, second, third = config.decoder_widths
        # Table S6's first layer, split in two: the inputs per clip are equal at every point.
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

    def decode(self, points_m: Tensor, scale_m: Tensor, text: Tensor, latent: Tensor) -> Tensor:
        """Logits (B, N) from points (B, N, 3), the object's scale (B,), sentence (B, text) and z (B, latent)."""
        points, scale = self.config.point_net.normalised(points_m, scale_m)
        overall, local = self.object_net(points)
        clip = torch.cat((overall, scale, text, latent), -1)
        return self.rest(self.from_point(local) + self.from_clip(clip)[:, None])[..., 0]

    def forward(
        self, points_m: Tensor, scale_m: Tensor, text: Tensor, contact_map: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Training pass: logits (B, N), mean and log-variance of z; noise (B, latent) for the reparameterisation."""
        mean, log_variance = self.encode(self.config.point_net.normalised(points_m, scale_m)[0], contact_map)
        # Reparameterisation (Kingma and Welling 2014): the gradient passes through mean and variance.
        latent = mean + (0.5 * log_variance).exp() * noise
        return self.decode(points_m, scale_m, text, latent), mean, log_variance

    @torch.no_grad()
    def sample(self, batch: RequestBatch, text: Tensor, latents: Tensor) -> Tensor:
        """Contact probabilities (B, count, 2, N), equal for active hands; latents (count, B, latent) from N(0, I)."""
        maps = torch.stack([self.decode(batch.points_m, batch.scale_m, text, z).sigmoid() for z in latents], 1)
        return maps[:, :, None] * batch.active_hands[:, None, :, None]

    def draw_latents(self, count: int, n_clips: int, generator: torch.Generator) -> Tensor:
        """Latents (count, clip, latent) from N(0, I)."""
        return torch.randn(count, n_clips, self.config.latent, generator=generator)


def contact_loss(logits: Tensor, contact_map: Tensor, mean: Tensor, log_variance: Tensor) -> dict[str, Tensor]:
    """Cross-entropy summed over points, Dice and KL divergence to N(0, I), per clip, and their sum "total"."""
    cross = functional.binary_cross_entropy_with_logits(logits, contact_map) * logits.shape[1]
    probability = logits.sigmoid()
    dice = 1 - (2 * (probability * contact_map).sum(1) + 1) / (probability.sum(1) + contact_map.sum(1) + 1)
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean()
    total = cross + dice.mean() + divergence
    return {"total": total, "cross_entropy": cross, "dice": dice.mean(), "kl": divergence}


class AnchoredContact(nn.Module):
    """Predicts the next anchor and both contact maps from the anchors given so far."""

    def __init__(self, config: ContactConfig) -> None:
        super().__init__()
        self.config = config
        local, _, overall = config.point_net.widths
        self.object_net = PointNet(3, config.point_net)
        first, second, third = config.decoder_widths
        self.from_point = nn.Linear(local + 3 + 6 * len(WAVES) + N_SIDES * ANCHOR_FEATURES, first)
        self.from_clip = nn.Sequential(
            nn.Linear(overall + 1 + TEXT_FEATURES + N_SIDES, first), nn.GELU(), nn.Linear(first, first)
        )
        self.rest = nn.Sequential(
            nn.GELU(),
            nn.Linear(first, second),
            nn.GELU(),
            nn.Linear(second, third),
            nn.GELU(),
            nn.Linear(third, 2 * N_SIDES),
        )

    def encode_points(self, points_m: Tensor, scale_m: Tensor, text: Tensor, active_hands: Tensor) -> EncodedPoints:
        """Encode an object with points (B, N, 3) and scale (B,), a sentence (B, 512) and hand flags (B, 2)."""
        points, scale = self.config.point_net.normalised(points_m, scale_m)
        overall, local = self.object_net(points)
        # Metres are too small to learn from; the logarithm is standardised.
        log_scale = (scale / TYPICAL_SCALE_M).log() / LOG_SCALE_DEVIATION
        clip = torch.cat((overall, log_scale, scaled_text(text), active_hands.float()), -1)
        return EncodedPoints(points, local, self.from_clip(clip), scale)

    def logits(self, cloud: EncodedPoints, anchors: Tensor, anchor_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of the next anchor and of the contact maps, (B, 2, N) each, by hand.

        anchors: (B, 2, A, 3) normalised points. anchor_mask: (B, 2, A) bool, the anchors given so far.
        """
        points, local, clip, unit_m = cloud
        distance = torch.cdist(points[:, None], anchors).masked_fill(~anchor_mask[:, :, None], FAR)
        nearest_distance, nearest_anchor = distance.min(-1)
        offset = points[:, None] - anchors.gather(2, nearest_anchor[..., None].expand(-1, -1, -1, 3))
        # Gaussians of the distance to each anchor, at three widths.
        distance_m = distance * unit_m[:, None, None]
        bells = [torch.exp(-0.5 * (distance_m / reach_m).square()).sum(-1) for reach_m in REACHES_M]
        anchor_fraction = anchor_mask.to(points.dtype).mean(-1)[..., None].expand_as(nearest_distance)
        anchor_features = torch.cat((offset, torch.stack((nearest_distance, anchor_fraction, *bells), -1)), -1)
        anchor_features = anchor_features * anchor_mask.any(-1)[..., None, None]
        # Sine and cosine features let a linear layer resolve fine positions.
        waves = [wave(points * (torch.pi * rate)) for rate in WAVES for wave in (torch.sin, torch.cos)]
        features = (local, points, *waves, anchor_features.transpose(1, 2).flatten(2))
        mixed = self.from_point(torch.cat(features, -1)) + clip[:, None]
        touch, contact = self.rest(mixed).transpose(1, 2).split(N_SIDES, 1)
        return touch, contact

    def losses(
        self, batch: RequestBatch, text: Tensor, contact: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Cross-entropy of one hand's next anchor, and logits (B, 2, N) of the maps given all anchors.

        Anchors are sampled uniformly from touched points. The left hand's next anchor is predicted from a random number
        of its first ones, the right hand's also from all of the left hand's. A hand without contact has no anchors.
        contact: (B, 2, N) float, recorded maps.
        """
        cloud = self.encode_points(batch.points_m, batch.scale_m, text, batch.active_hands)
        count, device = ANCHORS, contact.device
        has_contact = contact.any(-1) & batch.active_hands
        uniform = send(torch.rand(len(contact), N_SIDES, count, generator=generator), device)
        index = sample_indices(contact, uniform)[..., None].expand(-1, -1, -1, 3)
        anchors = cloud.points[:, None].expand(-1, N_SIDES, -1, -1).gather(2, index)
        random = send(torch.rand(len(contact), 2, generator=generator), device)
        is_right = has_contact[:, 1] & (~has_contact[:, 0] | (random[:, 0] < 0.5))
        given_count = (random[:, 1] * count).long()
        is_given = torch.arange(count, device=device) < given_count[:, None]
        # Of the left hand all anchors are given if the right hand's next one is predicted.
        anchor_mask = torch.stack((is_given | is_right[:, None], is_given & is_right[:, None]), 1)
        anchor_mask = anchor_mask & has_contact[..., None]
        side = is_right.long()[:, None, None]
        log_probability = self.logits(cloud, anchors, anchor_mask)[0].log_softmax(-1).take_along_dim(side, 1)[:, 0]
        target = contact.take_along_dim(side, 1)[:, 0]
        target = target / target.sum(-1, keepdim=True).clamp_min(1)
        # Soft cross-entropy: every touched point is an equally good next anchor.
        touch = -(target * log_probability).sum() / has_contact.any(-1).sum().clamp_min(1)
        return touch, self.logits(cloud, anchors, has_contact[..., None].expand_as(anchor_mask))[1]

    @torch.no_grad()
    def sample(self, batch: RequestBatch, text: Tensor, latents: Tensor) -> Tensor:
        """Contact probabilities (B, count, 2, N) by hand; a hand inactive in the whole batch costs nothing.

        text: (B, 512) sentence features. latents: (count, B, 2, A) uniform random numbers from 0 to 1.
        """
        points_m, active_hands = batch.points_m, batch.active_hands
        cloud, maps = self.encode_points(points_m, batch.scale_m, text, active_hands), []
        sides = [side for side in range(N_SIDES) if batch.sides[side]]
        candidates = EncodedPoints(cloud.points[:, ::ANCHOR_STRIDE], cloud.local[:, ::ANCHOR_STRIDE], *cloud[2:])
        clips = torch.arange(len(points_m), device=points_m.device)
        no_mask = latents.new_zeros(latents.shape[1:], dtype=torch.bool)
        no_anchors = points_m.new_zeros(*no_mask.shape, 3)
        first_touch = self.logits(candidates, no_anchors, no_mask)[0]  # the same for every sample
        for uniform in latents:
            anchors, anchor_mask = no_anchors.clone(), no_mask.clone()
            for step, (side, anchor) in enumerate(product(sides, range(ANCHORS))):
                touch_logits = self.logits(candidates, anchors, anchor_mask)[0] if step else first_touch
                probability = touch_logits[:, side].softmax(-1)
                index = sample_indices(probability, uniform[:, side, anchor, None])[:, 0]
                anchors[:, side, anchor] = candidates.points[clips, index]
                anchor_mask[:, side, anchor] = active_hands[:, side]
            maps.append(self.logits(cloud, anchors, anchor_mask)[1].sigmoid() * active_hands[..., None])
        return torch.stack(maps, 1)

    def draw_latents(self, count: int, n_clips: int, generator: torch.Generator) -> Tensor:
        """Uniform random numbers (count, clip, 2, A) from which anchors are sampled."""
        return torch.rand(count, n_clips, N_SIDES, ANCHORS, generator=generator)


def sample_indices(weights: Tensor, uniform: Tensor) -> Tensor:
    """Indices (..., K) sampled in proportion to weights (..., N), from uniform random numbers (..., K)."""
    index = torch.arange(weights.shape[-1], device=weights.device)
    cumulative = weights @ (index[:, None] <= index).to(weights.dtype)  # torch.cumsum is not deterministic on a GPU
    sampled = torch.searchsorted(cumulative, uniform * cumulative[..., -1:], right=True)
    return sampled.clamp_max(weights.shape[-1] - 1)


def by_hand_loss(touch: Tensor, logits: Tensor, contact: Tensor, active_hands: Tensor) -> dict[str, Tensor]:
    """Cross-entropy and Dice of active hands' maps (B, 2, N), the anchors' loss ``touch``, and their "total"."""
    mask = active_hands.to(logits.dtype)
    count = mask.sum().clamp_min(1)
    cross = functional.binary_cross_entropy_with_logits(logits, contact, reduction="none").mean(-1)
    probability = logits.sigmoid()
    dice = 1 - (2 * (probability * contact).sum(-1) + 1) / (probability.sum(-1) + contact.sum(-1) + 1)
    parts = {"cross_entropy": (cross * mask).sum() / count, "dice": (dice * mask).sum() / count, "touch": touch}
    total = parts["cross_entropy"] + parts["dice"] + TOUCH_WEIGHT * touch
    return {"total": total, **parts}
