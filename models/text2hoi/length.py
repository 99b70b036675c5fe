"""Predicts how many frames a motion lasts, from its sentence.

Text2HOI, Sec. 4.1, regresses the length from text and noise with a squared error, which teaches the network to ignore
the noise. ``sampled_from: gaussian`` predicts a mean and a standard deviation instead, trained by likelihood.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import MAX_FRAMES, ClipBatch, collate
from hoidata.devices import send
from models.common.corpus import Corpus, any_form
from models.common.family import Losses, Network, Objective, Setup
from models.common.features import TEXT_FEATURES
from models.text2hoi.verb_classifier import Sentences, VerbClassifier, fit_verb_classifiers

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
    # The sentence's features, or probabilities of its verb (``verb_classifier``).
    text_input: Literal["features", "verb_probabilities"] = "features"
    # Verbs in training; set by training.
    verb_count: int = 1
    # Condition on hand flags. The name is that of the diffusion network's key; the length is the output here.
    condition_on_hands_and_length: bool = False


@dataclass(frozen=True)
class LengthLossConfig:
    """The loss's augmentation."""

    jitter: float = 0.0  # relative change of lengths, at most; Text2HOI's released code has 0.05


class LengthModel(nn.Module):
    """The length, in units of 150 frames, from a sentence (B, 512), hand flags (B, 2) and noise."""

    def __init__(self, config: LengthConfig) -> None:
        super().__init__()
        self.config = config
        is_gaussian, has_verbs = config.sampled_from == "gaussian", config.text_input == "verb_probabilities"
        self.reading = VerbClassifier(TEXT_FEATURES, config.verb_count) if has_verbs else None
        text_features = config.verb_count if has_verbs else TEXT_FEATURES
        inputs = text_features + 2 * config.condition_on_hands_and_length + (0 if is_gaussian else NOISE)
        self.layers = nn.Sequential(
            nn.Linear(inputs, config.width),
            nn.ReLU() if is_gaussian else nn.LeakyReLU(0.2),
            nn.Dropout(config.dropout),
            nn.Linear(config.width, 2 if is_gaussian else 1),
        )

    def draw_noise(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, D) random numbers from N(0, I)."""
        return torch.randn(count, 1 if self.config.sampled_from == "gaussian" else NOISE, generator=generator)

    def moments(self, text: Tensor, active_hands: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation (B,) of the length; the latter is unused with input noise (B, D)."""
        text = text if self.reading is None else self.reading(text)
        inputs = [text, *([active_hands.float()] if self.config.condition_on_hands_and_length else [])]
        if self.config.sampled_from == "input_noise":
            length = self.layers(torch.cat((noise, *inputs), -1))[:, 0].sigmoid()
            return length, torch.zeros_like(length)
        mean, log_spread = self.layers(torch.cat(inputs, -1)).unbind(-1)
        # Between 1 and 55 frames, reached smoothly: a hard limit would have no gradient.
        return mean + 0.5, 2 * log_spread.tanh() - 3

    @torch.no_grad()
    def expected_frames(self, text: Tensor, active_hands: Tensor) -> Tensor:
        """(B,) expected number of frames, not rounded."""
        count = 1 if self.config.sampled_from == "gaussian" else EXPECTATION_SAMPLES
        noise = self.draw_noise(count, torch.Generator().manual_seed(0)).to(text.device)
        means = [self.moments(text, active_hands, sample.expand(len(text), -1))[0] for sample in noise]
        return (torch.stack(means).mean(0) * MAX_FRAMES).clamp(SHORTEST_FRAMES, MAX_FRAMES)

    @torch.no_grad()
    def sample(self, text: Tensor, active_hands: Tensor, generator: torch.Generator) -> Tensor:
        """Sampled numbers of frames (B,), integers from 8 to 150."""
        noise = self.draw_noise(len(text), generator).to(text.device)
        mean, log_spread = self.moments(text, active_hands, noise)
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


def jittered_frames(lengths: Tensor, jitter: float, generator: torch.Generator) -> Tensor:
    """Lengths times random factors between 1 - ``jitter`` and 1 + ``jitter``."""
    factor = 1 + jitter * (2 * torch.rand(len(lengths), generator=generator) - 1)
    return lengths * send(factor, lengths.device)


class LengthObjective:
    """Loss of the length network: Text2HOI, Sec. 4.1, or a Gaussian likelihood."""

    frames = entries = 0

    def __init__(self, network: LengthModel, loss: LengthLossConfig, corpus: Corpus, device: torch.device) -> None:
        self.network, self.loss, self.corpus, self.device = network, loss, corpus, device

    @cached_property
    def held_out(self) -> ClipBatch:
        return collate(self.corpus.held_out).to(self.device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        frames = jittered_frames(batch.lengths, self.loss.jitter, generator)
        noise = send(self.network.draw_noise(len(batch), generator), self.device)
        mean, log_spread = self.network.moments(any_form(batch, generator), batch.active_hands, noise)
        is_gaussian = self.network.config.sampled_from == "gaussian"
        return length_loss(mean, log_spread, frames) if is_gaussian else length_error(mean, frames)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, LengthModel)
        batch = self.held_out
        errors = [
            (network.expected_frames(batch.text[:, form], batch.active_hands) - batch.lengths).abs()
            for form in range(batch.text.shape[1])
        ]
        return torch.stack(errors).mean()


def _objective(setup: Setup) -> tuple[Objective, None]:
    sentences = Sentences.of(setup.corpus.train if setup.network.text_input == "verb_probabilities" else ())
    network = LengthModel(replace(setup.network, verb_count=sentences.n_verbs))
    fit_verb_classifiers(network, sentences)
    return LengthObjective(network.to(setup.device), setup.loss, setup.corpus, setup.device), None


LENGTH = Network("length", LengthConfig, build=LengthModel, objective=_objective, loss=LengthLossConfig)
