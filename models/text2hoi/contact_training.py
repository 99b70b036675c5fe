"""Training of the contact network, and its results on validation clips: probability thresholds of contact."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, ClipSample, collate
from hoidata.batches.requests import RequestBatch
from hoidata.devices import send
from models.common.augmentation import scaled_contact
from models.common.checkpoints import Checkpoint
from models.common.contact_maps import THRESHOLDS, best_threshold, true_maps
from models.common.corpus import Corpus, any_form
from models.common.family import ClipObjective, Losses, Network, Objective, Setup
from models.common.predicting import spread
from models.text2hoi.contact import (
    AnchoredContact,
    ContactConfig,
    ContactLossConfig,
    ContactModel,
    by_hand_loss,
    contact_loss,
)

ContactNetwork = ContactModel | AnchoredContact

DEFAULT_THRESHOLD = 0.5  # without validation clips
THRESHOLD_CLIPS = 100  # held-out clips that choose a threshold, at most


@torch.no_grad()
def contact_probabilities(network: ContactNetwork, samples: list[ClipSample], count: int, seed: int) -> np.ndarray:
    """(clip, point) mean of ``count`` sampled maps, for the first sentence of every clip."""
    batch, latents = _batch_and_latents(network, samples, count, seed)
    return network.sample(batch, batch.text[:, 0], latents).amax(2).mean(1).cpu().numpy()


def choose_contact_threshold(network: ContactNetwork, held_out: list[ClipSample]) -> float:
    """The threshold with the best mean F1 of the mean of 32 samples on held-out clips."""
    return best_threshold(contact_probabilities(network, held_out, 32, seed=0), true_maps(held_out))


@torch.no_grad()
def choose_sample_threshold(network: ContactNetwork, held_out: list[ClipSample], count: int = 8) -> float:
    """The threshold at which single samples touch the same fraction of points as held-out clips do."""
    batch, latents = _batch_and_latents(network, held_out, count, seed=0)
    probabilities = network.sample(batch, batch.text[:, 0], latents).amax(2)
    touched_fraction = float(batch.contact.any(1).float().mean())
    return min(
        THRESHOLDS, key=lambda threshold: abs(float((probabilities >= threshold).float().mean()) - touched_fraction)
    )


def _batch_and_latents(
    network: ContactNetwork, samples: list[ClipSample], count: int, seed: int
) -> tuple[ClipBatch, Tensor]:
    """The clips as a batch and ``count`` latents for each, on the network's device."""
    device = next(network.parameters()).device
    latents = network.draw_latents(count, len(samples), torch.Generator().manual_seed(seed))
    return collate(samples).to(device), send(latents, device)


# From a batch, sentence features (B, 512) and random numbers, of the batch or of each motion, to contact maps (B, 2, N)
# by hand, from 0 to 1.
SampleContact = Callable[[RequestBatch, Tensor, torch.Generator | Sequence[torch.Generator]], Tensor]


class ContactObjective(ClipObjective):
    """Losses of the contact network: Text2HOI, Sec. 3.1, or those of ``AnchoredContact``."""

    def __init__(self, network: nn.Module, loss: ContactLossConfig, corpus: Corpus, device: torch.device) -> None:
        super().__init__(network, corpus, device)
        self.loss = loss

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        order = torch.randperm(batch.points_m.shape[1], generator=generator)[: self.loss.points]
        chosen, text, network = send(order, self.device), any_form(batch, generator), self.network
        contact = batch.contact[..., chosen].float()
        batch = replace(batch, points_m=batch.points_m[:, chosen])
        if self.loss.max_scaling > 1:
            batch, contact = self._scaled(batch, contact, order.numpy(), generator)
        if isinstance(network, AnchoredContact):
            touch, logits = network.losses(batch, text, contact, generator)
            return by_hand_loss(touch, logits, contact, batch.active_hands)
        assert isinstance(network, ContactModel)
        contact_map = contact.amax(1)
        noise = send(torch.randn(len(batch), network.config.latent, generator=generator), self.device)
        logits, mean, log_variance = network(batch.points_m, batch.scale_m, text, contact_map, noise)
        return contact_loss(logits, contact_map, mean, log_variance)

    def _scaled(
        self, batch: ClipBatch, contact: Tensor, chosen: np.ndarray, generator: torch.Generator
    ) -> tuple[ClipBatch, Tensor]:
        """Scale the objects of about half of the clips by log-uniform factors, and recompute their maps (B, 2, K)."""
        is_scaled, exponent = torch.rand(2, len(batch), generator=generator)
        factor = self.loss.max_scaling ** ((2 * exponent - 1) * (is_scaled < 0.5))
        maps = [
            contact_map if size == 1 else torch.from_numpy(scaled_contact(sample, size, chosen)).to(contact)
            for sample, size, contact_map in zip(batch.samples, factor.tolist(), contact, strict=True)
        ]
        factor = send(factor, self.device)
        scaled = replace(batch, points_m=batch.points_m * factor[:, None, None], scale_m=batch.scale_m * factor)
        return scaled, torch.stack(maps)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, ContactModel | AnchoredContact)
        batch = self.held_out
        latents = send(network.draw_latents(4, len(batch), torch.Generator().manual_seed(0)), self.device)
        probability = network.sample(batch, batch.text[:, 0], latents).amax(2).mean(1)
        return nn.functional.binary_cross_entropy(probability.clamp(1e-4, 1 - 1e-4), batch.contact_map)


def contact_network(config: ContactConfig) -> ContactModel | AnchoredContact:
    """The network the config describes."""
    return AnchoredContact(config) if config.sampled_from == "anchor_points" else ContactModel(config)


def contact_threshold(checkpoint: Checkpoint) -> float:
    """From this mean probability over samples a point counts as touched.

    Chosen on validation clips; ``DEFAULT_THRESHOLD`` without any.
    """
    return float(checkpoint.info["results"]["contact_threshold"])


def sample_threshold(checkpoint: Checkpoint) -> float:
    """From this probability in one sample a point counts as touched; higher than that of means if samples differ."""
    results = checkpoint.info["results"]
    return float(results.get("draw_threshold", results["contact_threshold"]))


def touched(checkpoint: Checkpoint, probability: Tensor) -> Tensor:
    """(..., N) bool: points that count as touched; the most probable ones if none reaches the threshold."""
    return probability >= probability.amax(-1, keepdim=True).clamp_max(sample_threshold(checkpoint))


def most_typical(maps: Tensor) -> Tensor:
    """The medoid (B, 2, N) of each motion's maps (B, K, 2, N): the one with the best mean F1 with the others.

    Maps are from 0 to 1. F1 counts points touched by either hand. The first of equals.
    This is minimum Bayes risk decoding.
    """
    either = maps.amax(2)
    # F1 of all pairs of maps: 2 |A and B| / (|A| + |B|).
    shared, sizes = either @ either.transpose(1, 2), either.sum(-1)
    agreement = 2 * shared / (sizes[:, :, None] + sizes[:, None]).clamp_min(1)
    best = agreement.sum(-1).argmax(-1)
    return maps[torch.arange(len(maps), device=maps.device), best]


def contact_sampler(checkpoint: Checkpoint, is_binary: bool, count: int = 1) -> SampleContact:
    """Samples maps from a trained contact network: probabilities, as in the paper, or 0 or 1.

    count: maps sampled per motion, of which the medoid counts. Maps of the VAE hardly differ, so one is sampled.
    """
    network = checkpoint.network
    assert isinstance(network, ContactNetwork)
    count = count if isinstance(network, AnchoredContact) else 1

    def sample(batch: RequestBatch, text: Tensor, random: torch.Generator | Sequence[torch.Generator]) -> Tensor:
        if isinstance(random, torch.Generator):
            latents = network.draw_latents(count, len(batch), random)
        else:
            latents = torch.cat([network.draw_latents(count, 1, generator) for generator in random], 1)
        maps = network.sample(batch, text, send(latents, text.device))
        if is_binary:
            maps = (touched(checkpoint, maps) & batch.active_hands[:, None, :, None]).float()
        return most_typical(maps)

    return sample


def _objective(setup: Setup) -> tuple[Objective, None]:
    network = contact_network(setup.network).to(setup.device)
    return ContactObjective(network, setup.loss, setup.corpus, setup.device), None


def _results(network: nn.Module, corpus: Corpus) -> dict[str, float]:
    assert isinstance(network, ContactModel | AnchoredContact)
    held_out = spread(corpus.held_out, THRESHOLD_CLIPS)
    if not held_out:
        return {"contact_threshold": DEFAULT_THRESHOLD}
    results = {"contact_threshold": choose_contact_threshold(network, held_out)}
    if isinstance(network, AnchoredContact):
        results["draw_threshold"] = choose_sample_threshold(network, held_out)
    return results


CONTACT = Network(
    "contact", ContactConfig, build=contact_network, objective=_objective, loss=ContactLossConfig, results=_results
)
