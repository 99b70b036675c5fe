"""Which points of an object the hands will touch, from a sentence: PointNet and a conditional VAE.

Text2HOI Sec. 3.1 and supplement, Tables S4-S6. Layers that see per-clip features compute them once per clip instead of
once per point (the same function).
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from hoidata.batches.requests import RequestBatch
from models.common.features import TEXT_FEATURES
from models.common.point_net import PointLayer, PointNet, normalised_points
from models.text2hoi.contact_config import ContactConfig, ContactLossConfig


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


def contact_loss(
    logits: Tensor, contact_map: Tensor, mean: Tensor, log_variance: Tensor, weights: ContactLossConfig
) -> dict[str, Tensor]:
    """Summed cross-entropy, Dice (per clip) and KL divergence to N(0, I) per latent, by name, and their "total"."""
    cross = functional.binary_cross_entropy_with_logits(logits, contact_map) * logits.shape[1]
    probability = logits.sigmoid()
    dice = 1 - (2 * (probability * contact_map).sum(1) + 1) / (probability.sum(1) + contact_map.sum(1) + 1)
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean()
    total = cross + weights.dice_weight * dice.mean() + weights.kl_weight * divergence
    return {"total": total, "cross_entropy": cross, "dice": dice.mean(), "kl": divergence}
