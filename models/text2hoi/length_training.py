"""Training of the length network: what one step and one validation are."""

from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, collate
from hoidata.devices import send
from models.common.corpus import Corpus, any_form
from models.common.family import Losses, Network, Objective, Setup
from models.text2hoi.length import (
    LengthConfig,
    LengthLossConfig,
    LengthModel,
    jittered_frames,
    length_error,
    length_loss,
)
from models.text2hoi.verb_reading import Sentences, learn_verbs


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
