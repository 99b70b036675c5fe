"""The network of IMoS: a conditional VAE that predicts the next key frame of a motion from the last four.

Ghosh et al., IMoS: Intent-Driven Full-Body Motion Synthesis, EG 2023: its network of the arms. The network of the rest
of the body and the optimisation of the object's pose have no counterpart here: the object is generated like the hands.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import torch
from torch import Tensor, nn

from models.common.features import TEXT_FEATURES
from models.common.motion_vectors import MOTION_FEATURES

KEY_FRAMES, PAST = 15, 4
BETAS = 20  # shape parameters of both hands
MOMENTUM = 0.01  # of batch norm; its statistics are frozen in evaluation
EPSILON = 1e-8
EMPTY: Mapping[int, Tensor] = MappingProxyType({})


@dataclass(frozen=True)
class ImosConfig:
    """Sizes of the network; the defaults are IMoS's."""

    condition: int = 400
    latent: int = 32
    hidden: int = 1024  # of the encoders; four times as wide in their first block, twice in the decoder
    inner: int = 256  # between the two layers of a block
    dropout: float = 0.1


class Block(nn.Module):
    """Residual block of two linear layers; its sum goes through a LeakyReLU, so falling values have a slope of 0.2."""

    def __init__(self, inputs: int, outputs: int, config: ImosConfig) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(inputs, config.inner),
            nn.BatchNorm1d(config.inner, momentum=MOMENTUM),
            nn.LeakyReLU(0.2),
            nn.Dropout(config.dropout),
            nn.Linear(config.inner, outputs),
            nn.BatchNorm1d(outputs, momentum=MOMENTUM),
        )
        is_same = inputs == outputs
        self.skip = nn.Identity() if is_same else nn.Sequential(nn.Linear(inputs, outputs), nn.LeakyReLU(0.2))

    def forward(self, x: Tensor) -> Tensor:
        return nn.functional.leaky_relu(self.layers(x) + self.skip(x), 0.2)


class Dense(nn.Module):
    """Two blocks, of which the second also reads the input."""

    def __init__(self, inputs: int, hidden: int, outputs: int, config: ImosConfig) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(inputs, momentum=MOMENTUM)
        self.first, self.second = Block(inputs, hidden, config), Block(inputs + hidden, outputs, config)

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(x)
        return self.second(torch.cat((x, self.first(x)), -1))


class LatentEncoder(nn.Module):
    """Mean and standard deviation (B, latent) of z; the deviation may have either sign."""

    def __init__(self, inputs: int, config: ImosConfig) -> None:
        super().__init__()
        self.body = Dense(inputs, 4 * config.hidden, config.hidden, config)
        self.mean, self.deviation = (nn.Linear(config.hidden, config.latent) for _ in range(2))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.body(x)
        return self.mean(hidden), self.deviation(hidden)


class ImosNetwork(nn.Module):
    """One key frame after another, each from the sentence, the hand shapes, the last four key frames and a random z.

    The arguments after ``config`` are sizes, for comparison with the released network.
    """

    def __init__(
        self, config: ImosConfig, inputs: int = MOTION_FEATURES, outputs: int = MOTION_FEATURES, betas: int = BETAS
    ) -> None:
        super().__init__()
        self.config = config
        conditions, past = TEXT_FEATURES + betas, PAST * inputs
        norm = nn.BatchNorm1d(conditions, momentum=MOMENTUM)
        self.condition = nn.Sequential(norm, Block(conditions, config.condition, config))
        self.present = LatentEncoder(inputs + config.condition, config)
        self.past = LatentEncoder(past + config.condition, config)
        self.decoder = Dense(config.condition + config.latent + past, 2 * config.hidden, outputs, config)

    def conditions(self, text: Tensor, betas: Tensor) -> Tensor:
        """(B, condition) of sentence features (B, 512) and hand shapes (B, 2, 10)."""
        return self.condition(torch.cat((text, betas.flatten(1)), -1))

    def next_frame(self, past: Tensor, z: Tensor, condition: Tensor) -> Tensor:
        """The key frame (B, 208) after ``past`` (B, 4, 208): the decoder's output is added to the last one."""
        return past[:, -1] + self.decoder(torch.cat((condition, z, past.flatten(1)), -1))

    def roll_out(
        self, start: Tensor, condition: Tensor, visible: Tensor, noise: Tensor, replaced: Mapping[int, Tensor] = EMPTY
    ) -> Tensor:
        """Key frames (B, K, 208), the first four of which are ``start``.

        Args:
            start: (B, 4, 208).
            condition: (B, condition).
            visible: (B, 208) bool: active hands and object; other features stay 0.
            noise: (B, K - 4, latent) standard normal, of z.
            replaced: (B, 208) by number of the key frame: frames that replace the network's own.
        """
        frames = list(start.unbind(1))
        for noise_of_frame in noise.unbind(1):
            past = torch.stack(frames[-PAST:], 1)
            mean, deviation = self.past(torch.cat((past.flatten(1), condition), -1))
            frame = self.next_frame(past, mean + deviation * noise_of_frame, condition) * visible
            frames.append(replaced.get(len(frames), frame))
        return torch.stack(frames, 1)


def divergence(mean: Tensor, deviation: Tensor) -> Tensor:
    """KL divergence of N(mean, deviation^2) from N(0, 1), averaged over batch and dimensions."""
    variance = deviation.square()
    return 0.5 * (variance + mean.square() - 1 - (variance + EPSILON).log()).mean()
