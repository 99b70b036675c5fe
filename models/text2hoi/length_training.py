"""Training of the length network: what one step and one validation are."""

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, collate
from models.common.corpus import Corpus, any_form
from models.common.family import Losses, Network
from models.text2hoi.length import LengthConfig, LengthModel, jittered_frames, length_loss


class LengthObjective:
    """Text2HOI Sec. 4.1, with a likelihood in place of the plain squared error."""

    frames = entries = 0

    def __init__(self, network: LengthModel, corpus: Corpus, device: torch.device) -> None:
        self.network = network
        self.held_out = collate(corpus.held_out).to(device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        frames = jittered_frames(batch.lengths, generator)
        mean, log_spread = self.network(any_form(batch, generator), batch.active_hands)
        return length_loss(mean, log_spread, frames)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, LengthModel)
        held = self.held_out
        errors = [
            (network.expected_frames(held.text[:, form], held.active_hands) - held.lengths).abs()
            for form in range(held.text.shape[1])
        ]
        return torch.stack(errors).mean()


LENGTH = Network(
    "length",
    LengthConfig,
    LengthModel,
    lambda setup: (LengthObjective(LengthModel(setup.network).to(setup.device), setup.corpus, setup.device), None),
)
