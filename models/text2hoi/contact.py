"""Which points of an object the hands will touch, from a sentence: PointNet and a conditional VAE.

Text2HOI Sec. 3.1 and supplement, Tables S4-S6. Deviations, each for a reason: the hand type is an explicit input (a
sentence embedding hardly encodes left and right); layers that see per-clip features compute them once per clip
instead of once per point (the same function); sizes come from the config.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from hoidata.batches.dataset import ClipBatch
from hoidata.geometry.rotations import rotvec_to_rotmat
from models.common.features import scaled_text

HAND_FLAGS = 2


@dataclass(frozen=True)
class PointNetConfig:
    """Sizes; the defaults are the paper's. widths: the three per-point layers, the last is the length of F_obj.

    heads: layers behind the maximum (of the alignment, and of the encoder of z). align: learn a matrix per cloud.
    """

    widths: tuple[int, int, int] = (64, 128, 1024)
    heads: tuple[int, int] = (512, 256)
    align: bool = True


@dataclass(frozen=True)
class ContactConfig:
    """Sizes; the defaults are the paper's."""

    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    decoder_widths: tuple[int, int, int] = (512, 256, 128)
    latent: int = 64
    text: int = 512
    dropout: float = 0.0


@dataclass(frozen=True)
class ContactLossConfig:
    """Weights of KL divergence and Dice term beside the mean cross-entropy.

    augment: turn and scale objects. points: how many points of every object a step sees, drawn anew each time.
    """

    kl_weight: float = 0.01
    dice_weight: float = 1.0
    augment: bool = True
    points: int = 1024


def normalised_points(points_m: Tensor) -> tuple[Tensor, Tensor]:
    """Points (B, N, 3) about their mean, divided by the largest distance from it, and that scale (B, 1), metres."""
    centred = points_m - points_m.mean(1, keepdim=True)
    scale = centred.norm(dim=-1).amax(1)
    return centred / scale[:, None, None], scale[:, None]


class PointNet(nn.Module):
    """Global feature (B, G) and per-point features (B, N, L) of points (B, N, C) (Qi et al. 2017; Tables S4, S5)."""

    def __init__(self, channels: int, config: PointNetConfig) -> None:
        super().__init__()
        widths = config.widths
        self.align = _Alignment(channels, config) if config.align else None
        self.first = _PointLayer(channels, widths[0])
        self.second = _PointLayer(widths[0], widths[1])
        self.third = _PointLayer(widths[1], widths[2], activate=False)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        if self.align is not None:
            points = points @ self.align(points)
        local = self.first(points)
        return self.third(self.second(local)).amax(1), local


class _PointLayer(nn.Module):
    """Linear, batch norm over clips and points, ReLU: the paper's Conv1D with kernel 1."""

    def __init__(self, inputs: int, outputs: int, activate: bool = True) -> None:
        super().__init__()
        self.linear, self.norm, self.activate = nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), activate

    def forward(self, x: Tensor) -> Tensor:
        rows = self.linear(x).flatten(0, -2)
        # One row has no spread of its own: a dataset of one clip is normalised with the running statistics.
        rows = self.norm(rows) if len(rows) > 1 else self._with_running_statistics(rows)
        x = rows.reshape(*x.shape[:-1], -1)
        return x.relu() if self.activate else x

    def _with_running_statistics(self, rows: Tensor) -> Tensor:
        norm = self.norm
        return functional.batch_norm(rows, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps)


class _Alignment(nn.Module):
    """The spatial transformer: a (C, C) matrix per clip that starts as the identity."""

    def __init__(self, channels: int, config: PointNetConfig) -> None:
        super().__init__()
        self.channels = channels
        sizes, heads = (channels, *config.widths), config.heads
        self.points = nn.Sequential(*[_PointLayer(a, b) for a, b in pairwise(sizes)])
        self.hidden = nn.Sequential(_PointLayer(sizes[-1], heads[0]), _PointLayer(heads[0], heads[1]))
        self.matrix = nn.Linear(heads[1], channels * channels)
        nn.init.zeros_(self.matrix.weight)
        nn.init.zeros_(self.matrix.bias)

    def forward(self, x: Tensor) -> Tensor:
        flat = self.matrix(self.hidden(self.points(x).amax(1)))
        return flat.reshape(-1, self.channels, self.channels) + torch.eye(self.channels, device=x.device)


class ContactModel(nn.Module):
    """Contact probability of every point, given points, scale, sentence and hand flags."""

    def __init__(self, config: ContactConfig) -> None:
        super().__init__()
        self.config = config
        local, _, overall = config.point_net.widths
        heads = config.point_net.heads
        self.object_net = PointNet(3, config.point_net)
        self.contact_net = PointNet(4, config.point_net)
        self.to_latent = nn.Sequential(
            _PointLayer(overall, heads[0]), _PointLayer(heads[0], heads[1]), nn.Linear(heads[1], 2 * config.latent)
        )
        first, second, third = config.decoder_widths
        self.from_point = nn.Linear(local + 3, first)
        self.from_clip = nn.Linear(overall + 1 + config.text + HAND_FLAGS + config.latent, first, bias=False)
        self.rest = nn.Sequential(
            nn.LeakyReLU(0.2),
            nn.Dropout(config.dropout),
            nn.Linear(first, second),
            nn.LeakyReLU(0.2),
            nn.Linear(second, third),
            nn.LeakyReLU(0.2),
            nn.Linear(third, 1),
        )

    def encode(self, points: Tensor, touched: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance (B, latent) of z from normalised points (B, N, 3) and the true map (B, N)."""
        overall, _ = self.contact_net(torch.cat((points, touched[..., None]), -1))
        mean, log_variance = self.to_latent(overall).chunk(2, -1)
        return mean, log_variance.clamp(-8, 4)

    def decode(self, points_m: Tensor, text: Tensor, acts: Tensor, latent: Tensor) -> Tensor:
        """Logits (B, N) from points (B, N, 3), sentence (B, text), hand flags (B, 2) and z (B, latent)."""
        points, scale = normalised_points(points_m)
        overall, local = self.object_net(points)
        clip = torch.cat((overall, scale, scaled_text(text), acts.float(), latent), -1)
        mixed = self.from_point(torch.cat((local, points), -1)) + self.from_clip(clip)[:, None]
        return self.rest(mixed)[..., 0]

    def forward(
        self, points_m: Tensor, text: Tensor, acts: Tensor, touched: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Training pass: logits (B, N), mean and log-variance of z; noise (B, latent) for the reparameterisation."""
        mean, log_variance = self.encode(normalised_points(points_m)[0], touched)
        latent = mean + (0.5 * log_variance).exp() * noise
        return self.decode(points_m, text, acts, latent), mean, log_variance

    @torch.no_grad()
    def sample(self, points_m: Tensor, text: Tensor, acts: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Contact probabilities (B, count, N) for z drawn from ``generator``. Use in evaluation mode."""
        drawn = torch.randn(count, len(text), self.config.latent, generator=generator, device=generator.device)
        return torch.stack([self.decode(points_m, text, acts, z).sigmoid() for z in drawn], 1)


def contact_loss(
    logits: Tensor, touched: Tensor, mean: Tensor, log_variance: Tensor, weights: ContactLossConfig
) -> dict[str, Tensor]:
    """Cross-entropy, Dice (per clip) and KL divergence to N(0, I) per latent, as named parts and their "total"."""
    cross = functional.binary_cross_entropy_with_logits(logits, touched)
    chance = logits.sigmoid()
    dice = 1 - (2 * (chance * touched).sum(1) + 1) / (chance.sum(1) + touched.sum(1) + 1)
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean()
    total = cross + weights.dice_weight * dice.mean() + weights.kl_weight * divergence
    return {"total": total, "cross_entropy": cross, "dice": dice.mean(), "kl": divergence}


def turned_and_scaled(batch: ClipBatch, generator: torch.Generator) -> Tensor:
    """The batch's object points (B, N, 3), each clip's scaled by 0.8-1.2 and turned by up to 15 degrees per axis.

    Augmentation of Text2HOI's released training.
    """
    device = batch.points_m.device
    drawn = torch.rand(len(batch), 4, generator=generator).to(device)
    turn = rotvec_to_rotmat((drawn[:, :3] * 2 - 1) * torch.pi / 12)
    return batch.points_m @ turn.transpose(1, 2) * (0.8 + 0.4 * drawn[:, 3])[:, None, None]
