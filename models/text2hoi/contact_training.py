"""Training of the contact network: what one step and one validation are, and what is found on validation clips."""

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, collate
from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus, any_form
from models.common.family import Losses, Network
from models.text2hoi.contact import ContactConfig, ContactLossConfig, ContactModel, contact_loss, turned_and_scaled
from models.text2hoi.thresholds import choose_contact_threshold


class ContactObjective:
    """Text2HOI Sec. 3.1: cross-entropy, Dice and KL divergence."""

    frames = entries = 0

    def __init__(self, network: ContactModel, weights: ContactLossConfig, corpus: Corpus, device: torch.device) -> None:
        self.network, self.weights, self.device = network, weights, device
        self.held_out = collate(corpus.held_out).to(device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        points = turned_and_scaled(batch, generator) if self.weights.augment else batch.points_m
        some = torch.randperm(points.shape[1], generator=generator)[: self.weights.points].to(self.device)
        contact_map = batch.contact_map[:, some]
        noise = torch.randn(len(batch), self.network.config.latent, generator=generator).to(self.device)
        logits, mean, log_variance = self.network(
            points[:, some], any_form(batch, generator), batch.active_hands, contact_map, noise
        )
        return contact_loss(logits, contact_map, mean, log_variance, self.weights)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, ContactModel)
        held = self.held_out
        latents = network.draw_latents(8, len(held), torch.Generator().manual_seed(0)).to(self.device)
        probability = network.sample(held.points_m, held.text[:, 0], held.active_hands, latents).mean(1)
        return nn.functional.binary_cross_entropy(probability.clamp(1e-4, 1 - 1e-4), held.contact_map)


def contact_threshold(checkpoint: Checkpoint) -> float:
    """The probability from which a point counts as touched, chosen on validation clips with the contact network."""
    return float(checkpoint.info["results"]["contact_threshold"])


def _results(network: nn.Module, corpus: Corpus) -> dict[str, float]:
    assert isinstance(network, ContactModel)
    return {"contact_threshold": choose_contact_threshold(network, corpus.held_out)}


CONTACT = Network(
    "contact",
    ContactConfig,
    ContactModel,
    lambda s: (ContactObjective(ContactModel(s.network).to(s.device), s.loss, s.corpus, s.device), None),
    ContactLossConfig,
    results=_results,
)
