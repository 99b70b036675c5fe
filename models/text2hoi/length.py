"""Predicts how many frames a motion lasts, from its sentence.

Text2HOI, Sec. 4.1, regresses the length from text and noise with a squared error, which teaches the network to ignore
the noise. ``sampled_from: gaussian`` predicts a mean and a standard deviation instead, trained by likelihood.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from hoidata.annotation.vocabulary import Vocabulary
from hoidata.batches.dataset import MAX_FRAMES, ClipBatch
from hoidata.devices import send
from models.common.corpus import any_form
from models.common.family import ClipObjective, Losses, Network, Objective, Setup
from models.common.features import TEXT_FEATURES, verb_one_hot

SHORTEST_FRAMES = 8
NOISE = 64  # random inputs of the paper's network
EXPECTATION_SAMPLES = 32
MAX_DEVIATIONS = 2.0  # at which samples are clipped: lengths of one verb have limits, a Gaussian has none


@dataclass(frozen=True)
class LengthConfig:
    """Sizes and inputs of the length network; the defaults are the paper's."""

    width: int = 512
    dropout: float = 0.0
    # Sample the length from random inputs of the network (the paper), or from the Gaussian that the network predicts.
    sampled_from: Literal["input_noise", "gaussian"] = "input_noise"
    # Read the verb that the grammar finds in the sentence, in addition to the sentence's features.
    verb_input: bool = False
    # Verbs of the training clips; set by training with ``verb_input``.
    verbs: tuple[str, ...] = ()


class LengthModel(nn.Module):
    """The length, in units of 150 frames, from a sentence (B, 512), its verb and noise."""

    def __init__(self, config: LengthConfig) -> None:
        super().__init__()
        self.config = config
        is_gaussian = config.sampled_from == "gaussian"
        self.layers = nn.Sequential(
            nn.Linear(TEXT_FEATURES + len(config.verbs) + (0 if is_gaussian else NOISE), config.width),
            nn.ReLU() if is_gaussian else nn.LeakyReLU(0.2),
            nn.Dropout(config.dropout),
            nn.Linear(config.width, 2 if is_gaussian else 1),
        )

    def draw_noise(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, D) random numbers from N(0, I)."""
        return torch.randn(count, 1 if self.config.sampled_from == "gaussian" else NOISE, generator=generator)

    def moments(self, text: Tensor, verbs: Sequence[str | None], noise: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation (B,) of the length; the latter is unused with input noise (B, D)."""
        inputs = [text, verb_one_hot(verbs, self.config.verbs, text.device)] if self.config.verbs else [text]
        if self.config.sampled_from == "input_noise":
            length = self.layers(torch.cat((noise, *inputs), -1))[:, 0].sigmoid()
            return length, torch.zeros_like(length)
        mean, log_spread = self.layers(torch.cat(inputs, -1)).unbind(-1)
        # Between 1 and 55 frames, reached smoothly: a hard limit would have no gradient.
        return mean + 0.5, 2 * log_spread.tanh() - 3

    @torch.no_grad()
    def expected_frames(self, text: Tensor, verbs: Sequence[str | None]) -> Tensor:
        """(B,) expected number of frames, not rounded."""
        count = 1 if self.config.sampled_from == "gaussian" else EXPECTATION_SAMPLES
        noise = self.draw_noise(count, torch.Generator().manual_seed(0)).to(text.device)
        means = [self.moments(text, verbs, sample.expand(len(text), -1))[0] for sample in noise]
        return (torch.stack(means).mean(0) * MAX_FRAMES).clamp(SHORTEST_FRAMES, MAX_FRAMES)

    @torch.no_grad()
    def sample(self, text: Tensor, verbs: Sequence[str | None], generator: torch.Generator) -> Tensor:
        """Sampled numbers of frames (B,), integers from 8 to 150."""
        noise = self.draw_noise(len(text), generator).to(text.device)
        mean, log_spread = self.moments(text, verbs, noise)
        deviations = noise[:, 0].clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
        spread = log_spread.exp() * deviations if self.config.sampled_from == "gaussian" else 0.0
        return ((mean + spread) * MAX_FRAMES).round().clamp(SHORTEST_FRAMES, MAX_FRAMES).long()


def length_error(length: Tensor, frames: Tensor) -> dict[str, Tensor]:
    """Text2HOI's squared error of lengths (B,) in units of 150 frames."""
    square = (frames.float() / MAX_FRAMES - length).square().mean()
    return {"total": square, "square": square}


def length_loss(mean: Tensor, log_spread: Tensor, frames: Tensor) -> dict[str, Tensor]:
    """Gaussian negative log-likelihood of lengths (B,) in frames, plus the squared error."""
    target = frames.float() / MAX_FRAMES
    square = (target - mean).square()
    # The error is detached, so that a large deviation never makes up for a wrong mean.
    likelihood = log_spread + 0.5 * square.detach() * (-2 * log_spread).exp()
    total = 20 * square.mean() + likelihood.mean()
    return {"total": total, "square": square.mean(), "likelihood": likelihood.mean()}


class LengthObjective(ClipObjective):
    """Loss of the length network: Text2HOI, Sec. 4.1, or a Gaussian likelihood."""

    network: LengthModel

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        noise = send(self.network.draw_noise(len(batch), generator), self.device)
        verbs = [sample.verb for sample in batch.samples]
        mean, log_spread = self.network.moments(any_form(batch, generator), verbs, noise)
        is_gaussian = self.network.config.sampled_from == "gaussian"
        return length_loss(mean, log_spread, batch.lengths) if is_gaussian else length_error(mean, batch.lengths)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, LengthModel)
        batch = self.held_out
        verbs, forms = [sample.verb for sample in batch.samples], range(batch.text.shape[1])
        errors = [(network.expected_frames(batch.text[:, form], verbs) - batch.lengths).abs() for form in forms]
        return torch.stack(errors).mean()


def _objective(setup: Setup) -> tuple[Objective, None]:
    config = setup.network
    if config.verb_input:
        config = replace(config, verbs=tuple(Vocabulary.of(setup.corpus.train).verb_names))
    return LengthObjective(LengthModel(config).to(setup.device), setup.corpus, setup.device), None


LENGTH = Network("length", LengthConfig, build=LengthModel, objective=_objective)
