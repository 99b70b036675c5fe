"""Training of the contact network: what one step and one validation are, and what is found on validation clips."""

import torch
from torch import nn

from hoidata.batches.dataset import ClipBatch, collate
from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus, any_form
from models.common.family import Losses, Network, Objective, Setup
from models.text2hoi.anchored_contact import AnchoredContact, by_hand_loss
from models.text2hoi.contact import ContactModel, contact_loss, turned_and_scaled
from models.text2hoi.contact_config import ContactConfig, ContactLossConfig
from models.text2hoi.thresholds import choose_contact_threshold, choose_draw_threshold


class ContactObjective:
    """Text2HOI Sec. 3.1: cross-entropy, Dice and KL divergence; or anchors in place of the latent."""

    needs_entries = False

    def __init__(self, network: nn.Module, weights: ContactLossConfig, corpus: Corpus, device: torch.device) -> None:
        self.network, self.weights, self.device = network, weights, device
        self.held_out = collate(corpus.held_out, with_entries=False).to(device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        points = turned_and_scaled(batch, generator) if self.weights.augment else batch.points_m
        some = torch.randperm(points.shape[1], generator=generator)[: self.weights.points].to(self.device)
        points, text, network = points[:, some], any_form(batch, generator), self.network
        if isinstance(network, AnchoredContact):
            contact = batch.contact[..., some].float()
            touch, logits = network.losses(points, text, batch, contact, generator)
            return by_hand_loss(touch, logits, contact, batch.active_hands, self.weights)
        assert isinstance(network, ContactModel)
        contact_map = batch.contact_map[:, some]
        noise = torch.randn(len(batch), network.config.latent, generator=generator).to(self.device)
        logits, mean, log_variance = network(points, text, batch.active_hands, contact_map, noise)
        return contact_loss(logits, contact_map, mean, log_variance, self.weights)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> float:
        assert isinstance(network, ContactModel | AnchoredContact)
        held = self.held_out
        latents = network.draw_latents(4, len(held), torch.Generator().manual_seed(0)).to(self.device)
        probability = network.sample(held.points_m, held.text[:, 0], held.active_hands, latents).amax(2).mean(1)
        return float(nn.functional.binary_cross_entropy(probability.clamp(1e-4, 1 - 1e-4), held.contact_map))


def contact_network(config: ContactConfig) -> ContactModel | AnchoredContact:
    """The network the config describes."""
    return AnchoredContact(config) if config.drawn_by == "anchor" else ContactModel(config)


def contact_threshold(checkpoint: Checkpoint) -> float:
    """The mean probability of samples from which a point counts as touched, chosen on validation clips."""
    return float(checkpoint.info["results"]["contact_threshold"])


def draw_threshold(checkpoint: Checkpoint) -> float:
    """The same for the probability in one sample: best for means is too low for anchors, whose samples differ."""
    results = checkpoint.info["results"]
    return float(results.get("draw_threshold", results["contact_threshold"]))


def _objective(setup: Setup) -> tuple[Objective, None]:
    network = contact_network(setup.network).to(setup.device)
    return ContactObjective(network, setup.loss, setup.corpus, setup.device), None


def _results(network: nn.Module, corpus: Corpus) -> dict[str, float]:
    assert isinstance(network, ContactModel | AnchoredContact)
    found = {"contact_threshold": choose_contact_threshold(network, corpus.held_out)}
    if isinstance(network, AnchoredContact):
        found["draw_threshold"] = choose_draw_threshold(network, corpus.held_out)
    return found


CONTACT = Network("contact", ContactConfig, contact_network, _objective, ContactLossConfig, results=_results)
