"""How many frames a motion described by a sentence lasts.

Text2HOI Sec. 4.1 regresses the length from text and noise with a squared error, which teaches a network to ignore the
noise. Here the network gives a mean and a spread and the noise scales the spread, trained by Gaussian likelihood: the
noise keeps its meaning and nothing can collapse.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import MAX_FRAMES
from models.common.features import scaled_text

SHORTEST_FRAMES = 8
WIDEST_DRAW = 2.0  # standard deviations; lengths of one verb have limits, a Gaussian has none


@dataclass(frozen=True)
class LengthConfig:
    """Sizes; ``width`` is the paper's 512."""

    text: int = 512
    width: int = 512
    dropout: float = 0.1


class LengthModel(nn.Module):
    """Mean and log-spread of the length, in units of 150 frames, from a sentence (B, text) and hand flags (B, 2)."""

    def __init__(self, config: LengthConfig) -> None:
        super().__init__()
        self.config = config
        self.layers = nn.Sequential(
            nn.Linear(config.text + 2, config.width),
            nn.ReLU(),
            nn.Dropout(config.dropout),
            nn.Linear(config.width, 2),
        )

    def forward(self, text: Tensor, active_hands: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_spread = self.layers(torch.cat((scaled_text(text), active_hands.float()), -1)).unbind(-1)
        # Between 1 and 55 frames, reached smoothly: a hard limit would have no gradient.
        return mean + 0.5, 2 * log_spread.tanh() - 3

    @torch.no_grad()
    def expected_frames(self, text: Tensor, active_hands: Tensor) -> Tensor:
        """(B,) expected number of frames, not rounded."""
        return (self(text, active_hands)[0] * MAX_FRAMES).clamp(SHORTEST_FRAMES, MAX_FRAMES)

    @torch.no_grad()
    def sample(self, text: Tensor, active_hands: Tensor, generator: torch.Generator) -> Tensor:
        """(B,) whole numbers of frames, 8 to 150, with noise drawn from ``generator``."""
        mean, log_spread = self(text, active_hands)
        noise = torch.randn(len(text), generator=generator, device=generator.device)
        noise = noise.clamp(-WIDEST_DRAW, WIDEST_DRAW)
        frames = (mean + log_spread.exp() * noise) * MAX_FRAMES
        return frames.round().clamp(SHORTEST_FRAMES, MAX_FRAMES).long()


def length_loss(mean: Tensor, log_spread: Tensor, frames: Tensor) -> dict[str, Tensor]:
    """Gaussian negative log-likelihood of lengths (B,) in frames, and the squared error beside it."""
    target = frames.float() / MAX_FRAMES
    square = (target - mean).square()
    # The spread learns from a detached error, so that it never excuses a wrong mean.
    likelihood = log_spread + 0.5 * square.detach() * (-2 * log_spread).exp()
    total = 20 * square.mean() + likelihood.mean()
    return {"total": total, "square": square.mean(), "likelihood": likelihood.mean()}


def jittered_frames(lengths: Tensor, generator: torch.Generator) -> Tensor:
    """Lengths times a factor drawn from 0.95-1.05 (Text2HOI's released training)."""
    factor = 0.95 + 0.1 * torch.rand(len(lengths), generator=generator)
    return lengths * factor.to(lengths.device)
