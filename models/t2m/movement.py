"""T2M's autoencoder of movements, one latent per snippet of four frames, and its length estimator (Sec. 4.1, 4.2)."""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import MAX_FRAMES, ClipBatch
from hoidata.devices import send
from models.common.corpus import any_form
from models.common.family import Losses
from models.common.features import TEXT_FEATURES, scaled_text
from models.common.losses import masked_mean
from models.common.motion_vectors import MOTION_FEATURES, RecordedVectors, VectorObjective, vector_network

SNIPPET_FRAMES = 4
MAX_SNIPPETS = -(-MAX_FRAMES // SNIPPET_FRAMES)
WINDOW_FRAMES = 24  # of a training clip
LATENT_WEIGHT = 1e-3  # of the latents' size, and of their change


@dataclass(frozen=True)
class MovementConfig:
    """Sizes of the autoencoder; the defaults are T2M's."""

    width: int = 512
    latent: int = 512
    dropout: float = 0.2


class MovementModel(nn.Module):
    """Motion vectors (B, F, 208) to snippets (B, S, latent) with S = ceil(F / 4), and back."""

    def __init__(self, config: MovementConfig) -> None:
        super().__init__()
        self.config = config
        widths = (MOTION_FEATURES, config.width), (config.width, config.width)
        layers = [(nn.Conv1d(*sizes, 4, 2, 1), nn.Dropout(config.dropout), nn.LeakyReLU(0.2)) for sizes in widths]
        self.encoder = nn.Sequential(*layers[0], *layers[1])
        self.latent = nn.Linear(config.width, config.latent)
        widths = (config.latent, config.width), (config.width, MOTION_FEATURES)
        layers = [(nn.ConvTranspose1d(*sizes, 4, 2, 1), nn.LeakyReLU(0.2)) for sizes in widths]
        self.decoder = nn.Sequential(*layers[0], *layers[1])
        self.motion_out = nn.Linear(MOTION_FEATURES, MOTION_FEATURES)

    def encode(self, motion: Tensor) -> Tensor:
        """Snippets of motions that are 0 beyond their length; they do not depend on the padding of the batch."""
        # The convolutions read two frames of the next snippet, so a snippet of zeros is added and removed again.
        padding = -motion.shape[1] % SNIPPET_FRAMES + SNIPPET_FRAMES
        padded = nn.functional.pad(motion, (0, 0, 0, padding))
        return self.latent(self.encoder(padded.transpose(1, 2)).transpose(1, 2))[:, :-1]

    def decode(self, snippets: Tensor, mask: Tensor, n_frames: int) -> Tensor:
        """Motions (B, n_frames, 208) of snippets (B, S, latent), of which those in ``mask`` (B, S) are valid."""
        padded = nn.functional.pad(snippets * mask[..., None], (0, 0, 0, 1))
        return self.motion_out(self.decoder(padded.transpose(1, 2)).transpose(1, 2))[:, :n_frames]


def snippet_counts(lengths: Tensor) -> Tensor:
    """(B,) snippets of motions with (B,) frames."""
    return (lengths + SNIPPET_FRAMES - 1) // SNIPPET_FRAMES


def snippet_mask(counts: Tensor, most: int) -> Tensor:
    """(B, most) bool: the snippets that motions with (B,) snippets have."""
    return torch.arange(most, device=counts.device) < counts[:, None]


class MovementObjective(VectorObjective):
    """L1 of windows of clips, with small weights of the size of latents and of their change."""

    def terms(self, network: nn.Module, batch: ClipBatch, generator: torch.Generator) -> Losses:
        assert isinstance(network, MovementModel)
        target, frame = RecordedVectors.of(batch, self.normaliser), torch.arange(WINDOW_FRAMES, device=self.device)
        starts = (batch.lengths - WINDOW_FRAMES).clamp_min(0) + 1
        start = (send(torch.rand(len(batch), generator=generator), self.device) * starts).long()
        chosen = (start[:, None] + frame).clamp_max(target.motion.shape[1] - 1)
        clip, inside = torch.arange(len(batch), device=self.device)[:, None], frame < batch.lengths[:, None]
        motion, mask = target.motion[clip, chosen] * inside[..., None], target.mask[clip, chosen] & inside[..., None]
        snippets = network.encode(motion)
        valid = snippet_mask(snippet_counts(inside.sum(1)), snippets.shape[1])
        error = masked_mean((network.decode(snippets, valid, WINDOW_FRAMES) - motion).abs(), mask)
        size = masked_mean(snippets.abs(), valid[..., None])
        change = masked_mean((snippets[:, 1:] - snippets[:, :-1]).abs(), valid[:, 1:, None])
        return {"total": error + LATENT_WEIGHT * (size + change), "motion": error}


@dataclass(frozen=True)
class LengthConfig:
    """Sizes of the length network."""

    widths: tuple[int, int] = (256, 128)  # of its hidden layers


class LengthNetwork(nn.Module):
    """Logits (B, 38) of the number of snippets, 1 to 38, from sentence features (B, 512)."""

    def __init__(self, config: LengthConfig) -> None:
        super().__init__()
        self.config, pairs = config, pairwise((TEXT_FEATURES, *config.widths))
        layers = [(nn.Linear(*pair), nn.LayerNorm(pair[1]), nn.LeakyReLU(0.2)) for pair in pairs]
        self.layers = nn.Sequential(*layers[0], *layers[1], nn.Linear(config.widths[1], MAX_SNIPPETS))

    def forward(self, text: Tensor) -> Tensor:
        return self.layers(scaled_text(text))


class LengthObjective(VectorObjective):
    """Cross-entropy of the number of snippets."""

    def terms(self, network: nn.Module, batch: ClipBatch, generator: torch.Generator) -> Losses:
        logits = network(any_form(batch, generator))
        return {"total": nn.functional.cross_entropy(logits, snippet_counts(batch.lengths) - 1)}


MOVEMENT = vector_network("t2m-movement", MovementConfig, MovementModel, MovementObjective)
LENGTH = vector_network("t2m-length", LengthConfig, LengthNetwork, LengthObjective)
