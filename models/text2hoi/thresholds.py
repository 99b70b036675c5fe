"""F1 of contact maps, and the probability from which a point counts as touched: chosen on validation clips."""

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, ClipSample, collate
from hoidata.contact.maps import f1_score
from hoidata.devices import send
from models.text2hoi.anchored_contact import AnchoredContact
from models.text2hoi.contact import ContactModel

ContactNetwork = ContactModel | AnchoredContact

UNCHOSEN_THRESHOLD = 0.5  # without validation clips: touched where that is likelier than not
THRESHOLDS = tuple(round(0.05 * step, 2) for step in range(1, 20))


def mean_f1(probabilities: np.ndarray, true: np.ndarray, threshold: float) -> float:
    """Mean over clips of the F1 of maps (clip, point) of probabilities at a threshold."""
    pairs = zip(probabilities, true, strict=True)
    return float(np.mean([f1_score(probability >= threshold, truth) for probability, truth in pairs]))


def best_threshold(probabilities: np.ndarray, true: np.ndarray) -> float:
    """The threshold among 0.05, 0.10, ... 0.95 with the best mean F1; the lowest of equals."""
    scores = [mean_f1(probabilities, true, threshold) for threshold in THRESHOLDS]
    return THRESHOLDS[int(np.argmax(scores))]


def true_maps(samples: list[ClipSample]) -> np.ndarray:
    """(clip, point) bool contact maps."""
    return np.stack([sample.contact_map for sample in samples])


@torch.no_grad()
def contact_probabilities(network: ContactNetwork, samples: list[ClipSample], count: int, seed: int) -> np.ndarray:
    """(clip, point) mean of ``count`` sampled maps, for the first sentence of every clip."""
    batch, latents = _asked(network, samples, count, seed)
    return network.sample(batch, batch.text[:, 0], latents).amax(2).mean(1).cpu().numpy()


def choose_contact_threshold(network: ContactNetwork, held_out: list[ClipSample]) -> float:
    """The threshold with the best mean F1 of the mean of 32 samples on held-out clips."""
    return best_threshold(contact_probabilities(network, held_out, 32, seed=0), true_maps(held_out))


@torch.no_grad()
def choose_draw_threshold(network: ContactNetwork, held_out: list[ClipSample], count: int = 8) -> float:
    """The threshold at which single samples touch as large a share of an object as held-out clips do."""
    batch, latents = _asked(network, held_out, count, seed=0)
    found = network.sample(batch, batch.text[:, 0], latents).amax(2)
    share = float(batch.contact.any(1).float().mean())
    return min(THRESHOLDS, key=lambda threshold: abs(float((found >= threshold).float().mean()) - share))


def _asked(network: ContactNetwork, samples: list[ClipSample], count: int, seed: int) -> tuple[ClipBatch, Tensor]:
    """The clips, and so many draws for each, where the network is."""
    device = next(network.parameters()).device
    latents = network.draw_latents(count, len(samples), torch.Generator().manual_seed(seed))
    return collate(samples).to(device), send(latents, device)
