"""How many frames a motion described by a sentence lasts.

Text2HOI Sec. 4.1 regresses the length from text and noise with a squared error, which teaches a network to ignore the
noise. The other way here: the network gives a mean and a spread and the noise scales the spread, trained by Gaussian
likelihood: the noise keeps its meaning and nothing can collapse.
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
from models.text2hoi.verb_reading import Sentences, VerbReading, learn_verbs

SHORTEST_FRAMES = 8
NOISE = 64  # numbers that the paper's network reads beside the sentence
EXPECTED_OF = 32  # draws
WIDEST_DRAW = 2.0  # standard deviations; lengths of one verb have limits, a Gaussian has none


@dataclass(frozen=True)
class LengthConfig:
    """Sizes; ``width`` is the paper's 512.

    drawn_by: "noise" among the inputs, or "spread". text_input: the sentence's features, or "verbs": which of ``verbs``
    verbs it means (``verb_reading``). told: hand flags.
    """

    width: int = 512
    dropout: float = 0.0
    drawn_by: Literal["noise", "spread"] = "noise"
    text_input: Literal["features", "verbs"] = "features"
    verbs: int = 1
    told: bool = False


@dataclass(frozen=True)
class LengthLossConfig:
    """jitter: lengths are changed by up to this share (the released training: 0.05)."""

    jitter: float = 0.0


class LengthModel(nn.Module):
    """The length, in units of 150 frames, from a sentence (B, text), hand flags (B, 2), and what is drawn."""

    def __init__(self, config: LengthConfig) -> None:
        super().__init__()
        self.config = config
        spread, read = config.drawn_by == "spread", config.text_input == "verbs"
        self.reading = VerbReading(TEXT_FEATURES, config.verbs) if read else None
        said = config.verbs if read else TEXT_FEATURES
        self.layers = nn.Sequential(
            nn.Linear(said + 2 * config.told + (0 if spread else NOISE), config.width),
            nn.ReLU() if spread else nn.LeakyReLU(0.2),
            nn.Dropout(config.dropout),
            nn.Linear(config.width, 2 if spread else 1),
        )

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, D) draws from N(0, I)."""
        return torch.randn(count, 1 if self.config.drawn_by == "spread" else NOISE, generator=generator)

    def moments(self, text: Tensor, active_hands: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """(B,) mean and log-spread; of a length that is drawn by noise (B, D) itself, the spread stands for nothing."""
        text = text if self.reading is None else self.reading(text)
        inputs = [text, *([active_hands.float()] if self.config.told else [])]
        if self.config.drawn_by == "noise":
            length = self.layers(torch.cat((noise, *inputs), -1))[:, 0].sigmoid()
            return length, torch.zeros_like(length)
        mean, log_spread = self.layers(torch.cat(inputs, -1)).unbind(-1)
        # Between 1 and 55 frames, reached smoothly: a hard limit would have no gradient.
        return mean + 0.5, 2 * log_spread.tanh() - 3

    @torch.no_grad()
    def expected_frames(self, text: Tensor, active_hands: Tensor) -> Tensor:
        """(B,) expected number of frames, not rounded."""
        count = 1 if self.config.drawn_by == "spread" else EXPECTED_OF
        noise = self.draw(count, torch.Generator().manual_seed(0)).to(text.device)
        drawn = [self.moments(text, active_hands, own.expand(len(text), -1))[0] for own in noise]
        return (torch.stack(drawn).mean(0) * MAX_FRAMES).clamp(SHORTEST_FRAMES, MAX_FRAMES)

    @torch.no_grad()
    def sample(self, text: Tensor, active_hands: Tensor, generator: torch.Generator) -> Tensor:
        """(B,) whole numbers of frames, 8 to 150, with noise drawn from ``generator``."""
        noise = self.draw(len(text), generator).to(text.device)
        mean, log_spread = self.moments(text, active_hands, noise)
        drawn = noise[:, 0].clamp(-WIDEST_DRAW, WIDEST_DRAW)
        spread = log_spread.exp() * drawn if self.config.drawn_by == "spread" else 0.0
        return ((mean + spread) * MAX_FRAMES).round().clamp(SHORTEST_FRAMES, MAX_FRAMES).long()


def length_error(length: Tensor, frames: Tensor) -> dict[str, Tensor]:
    """Text2HOI's squared error of lengths (B,) in units of 150 frames."""
    square = (frames.float() / MAX_FRAMES - length).square().mean()
    return {"total": square, "square": square}


def length_loss(mean: Tensor, log_spread: Tensor, frames: Tensor) -> dict[str, Tensor]:
    """Gaussian negative log-likelihood of lengths (B,) in frames, and the squared error beside it."""
    target = frames.float() / MAX_FRAMES
    square = (target - mean).square()
    # The spread learns from a detached error, so that it never excuses a wrong mean.
    likelihood = log_spread + 0.5 * square.detach() * (-2 * log_spread).exp()
    total = 20 * square.mean() + likelihood.mean()
    return {"total": total, "square": square.mean(), "likelihood": likelihood.mean()}


def jittered_frames(lengths: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Lengths times a factor drawn from 1 - ``share`` to 1 + ``share``."""
    factor = 1 + share * (2 * torch.rand(len(lengths), generator=generator) - 1)
    return lengths * send(factor, lengths.device)


class LengthObjective:
    """Text2HOI Sec. 4.1: the squared error; of a length with a spread, a likelihood."""

    frames = entries = 0

    def __init__(self, network: LengthModel, loss: LengthLossConfig, corpus: Corpus, device: torch.device) -> None:
        self.network, self.loss, self.corpus, self.device = network, loss, corpus, device

    @cached_property
    def held_out(self) -> ClipBatch:
        return collate(self.corpus.held_out).to(self.device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        frames = jittered_frames(batch.lengths, self.loss.jitter, generator)
        noise = send(self.network.draw(len(batch), generator), self.device)
        mean, log_spread = self.network.moments(any_form(batch, generator), batch.active_hands, noise)
        spread = self.network.config.drawn_by == "spread"
        return length_loss(mean, log_spread, frames) if spread else length_error(mean, frames)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, LengthModel)
        held = self.held_out
        errors = [
            (network.expected_frames(held.text[:, form], held.active_hands) - held.lengths).abs()
            for form in range(held.text.shape[1])
        ]
        return torch.stack(errors).mean()


def _objective(setup: Setup) -> tuple[Objective, None]:
    sentences = Sentences.of(setup.corpus.train if setup.network.text_input == "verbs" else ())
    network = LengthModel(replace(setup.network, verbs=sentences.n_verbs))
    learn_verbs(network, sentences)
    return LengthObjective(network.to(setup.device), setup.loss, setup.corpus, setup.device), None


LENGTH = Network("length", LengthConfig, LengthModel, _objective, LengthLossConfig)
