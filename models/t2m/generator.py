"""The generator of T2M: a recurrent VAE over snippets, with attention to the words (Guo et al., CVPR 2022, Sec. 4.3).

A learned table of the training words replaces GloVe vectors and parts of speech. Attention skips padded words, so that
a motion does not depend on its batch. It has no curriculum of growing lengths, which would drop short clips.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.nn.functional import smooth_l1_loss
from torch.nn.utils.rnn import pack_padded_sequence, pad_packed_sequence, pad_sequence

from hoidata.batches.dataset import ClipBatch
from hoidata.devices import send
from models.common.family import Losses, Network, Setup
from models.common.features import Normaliser
from models.common.losses import masked_mean
from models.common.motion_vectors import MOTION_FEATURES, RecordedVectors, VectorObjective
from models.common.transformer import sinusoid
from models.t2m.movement import MOVEMENT, MovementConfig, MovementModel, snippet_counts, snippet_mask

NO_WORD, UNKNOWN = 0, 1  # rows of the word table: padding, and words that are not in the training sentences
KL_WEIGHT = 0.005
TEACHER_FORCING = 0.4  # fraction of the batches in which every step gets the recorded snippet before it


@dataclass(frozen=True)
class T2mConfig:
    """Sizes of the generator; the defaults are T2M's."""

    word: int = 300
    text: int = 512  # of each direction of the text encoder
    attention: int = 512
    latent: int = 128  # of z
    hidden: int = 1024  # of the recurrent cells
    # Autoencoder of movements, and words of the training sentences; set by training.
    movement: MovementConfig = field(default_factory=MovementConfig)
    words: tuple[str, ...] = ()


def words_of(sentence: str) -> list[str]:
    """The words of a sentence in lower case."""
    return re.findall(r"\w+", sentence.lower())


class Cell(nn.Module):
    """A recurrent cell; the embedded input gets a code of the number of snippets left."""

    def __init__(self, inputs: int, config: T2mConfig) -> None:
        super().__init__()
        self.cell, hidden = nn.GRUCell(config.hidden, config.hidden), config.hidden
        self.embed = nn.Sequential(nn.Linear(inputs, hidden), nn.LayerNorm(hidden), nn.LeakyReLU(0.2))
        self.start = nn.Linear(2 * config.text, hidden)

    def forward(self, inputs: Sequence[Tensor], time: Tensor, state: Tensor) -> Tensor:
        """The next state (B, hidden)."""
        return self.cell(self.embed(torch.cat((*inputs,), -1)) + time, state)


class T2mNetwork(nn.Module):
    """Snippets of a motion one after another, from the words, the last snippet and a random z."""

    learning_rate_factors = (("movement.", 0.1),)  # of the movement decoder; the encoder is frozen

    def __init__(self, config: T2mConfig) -> None:
        super().__init__()
        self.config, snippet, sentence, hidden = config, config.movement.latent, 2 * config.text, config.hidden
        self.index = {word: number for number, word in enumerate(config.words, UNKNOWN + 1)}
        self.movement = MovementModel(config.movement)
        for part in (self.movement.encoder, self.movement.latent):
            part.requires_grad_(False)
        self.words = nn.Embedding(len(config.words) + UNKNOWN + 1, config.word, padding_idx=NO_WORD)
        self.words_in = nn.Linear(config.word, config.text)
        self.text = nn.GRU(config.text, config.text, batch_first=True, bidirectional=True)
        self.text_start = nn.Parameter(torch.randn(2, 1, config.text))
        self.query, self.value = nn.Linear(hidden, config.attention), nn.Linear(sentence, config.attention)
        self.key = nn.Linear(sentence, config.attention, bias=False)
        self.prior = Cell(snippet + config.attention, config)
        self.posterior = Cell(2 * snippet + config.attention, config)
        self.decoder = Cell(snippet + config.attention + config.latent, config)
        # Mean and log variance of z.
        self.prior_z, self.posterior_z = (nn.Linear(hidden, 2 * config.latent) for _ in range(2))
        last = nn.Linear(hidden, snippet)
        self.snippet_out = nn.Sequential(nn.Linear(hidden, hidden), nn.LayerNorm(hidden), nn.LeakyReLU(0.2), last)

    def read(self, sentences: Sequence[str]) -> tuple[Tensor, Tensor, Tensor]:
        """Sentences (B, 2 text), words (B, W, 2 text) and whether a word is padding (B, W)."""
        numbers = [[self.index.get(word, UNKNOWN) for word in words_of(text)] or [UNKNOWN] for text in sentences]
        words = pad_sequence([torch.tensor(sentence) for sentence in numbers], batch_first=True)
        embedded, lengths = self.words_in(self.words(send(words, self.text_start.device))), [*map(len, numbers)]
        packed = pack_padded_sequence(embedded, torch.tensor(lengths), batch_first=True, enforce_sorted=False)
        outputs, ends = self.text(packed, self.text_start.repeat(1, len(numbers), 1))
        is_padding = send(words == NO_WORD, embedded.device)
        return ends.transpose(0, 1).flatten(1), pad_packed_sequence(outputs, batch_first=True)[0], is_padding

    def forward(
        self, sentences: Sequence[str], counts: Tensor, noise: Tensor, true: Tensor | None = None, forced: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Snippets (B, S, latent) and the KL divergence (B, S) of posterior and prior.

        Args:
            counts: (B,) snippets of each motion.
            noise: (B, S, z) standard normal.
            true: (B, S, latent) recorded snippets, from which the posterior is taken; None: z is from the prior.
            forced: every step gets the recorded snippet before it instead of the generated one (teacher forcing).
        """
        sentence, words, is_padding = self.read(sentences)
        keys, values = self.key(words), self.value(words)
        prior, posterior, state = (cell.start(sentence) for cell in (self.prior, self.posterior, self.decoder))
        # A motion starts after a snippet of zeros, the mean pose.
        last = self.movement.encode(noise.new_zeros(1, 1, MOTION_FEATURES))[:, 0].detach().expand(len(noise), -1)
        snippets, divergences = [], []
        for number in range(noise.shape[1]):
            time = sinusoid((counts - number).clamp_min(0), self.config.hidden)
            scores = (keys @ self.query(state)[..., None])[..., 0] / self.config.attention**0.5
            attended = (scores.masked_fill(is_padding, -torch.inf).softmax(-1)[:, None] @ values)[:, 0]
            prior = self.prior((last, attended), time, prior)
            of_prior = of_posterior = _gaussian(self.prior_z(prior))
            if true is not None:
                posterior = self.posterior((last, true[:, number], attended), time, posterior)
                of_posterior = _gaussian(self.posterior_z(posterior))
            divergences.append(kl_divergence(of_posterior, of_prior).sum(-1))
            z = of_posterior.mean + of_posterior.stddev * noise[:, number]
            state = self.decoder((last, attended, z), time, state)
            snippets.append(self.snippet_out(state))
            last = (true[:, number] if true is not None and forced else snippets[-1]).detach()
        return torch.stack(snippets, 1), torch.stack(divergences, 1)


def _gaussian(numbers: Tensor) -> Normal:
    mean, log_variance = numbers.chunk(2, -1)
    return Normal(mean, (0.5 * log_variance).exp(), validate_args=False)


class GeneratorObjective(VectorObjective):
    """Huber losses of motion and snippets, and the KL divergence of posterior and prior."""

    def terms(self, network: nn.Module, batch: ClipBatch, generator: torch.Generator) -> Losses:
        assert isinstance(network, T2mNetwork)
        target, counts = RecordedVectors.of(batch, self.normaliser), snippet_counts(batch.lengths)
        with torch.no_grad():
            true = network.movement.eval().encode(target.motion)  # without dropout
        noise = send(torch.randn(*true.shape[:2], network.config.latent, generator=generator), self.device)
        forms = torch.randint(len(batch.samples[0].sentences), (len(batch),), generator=generator).tolist()
        forced = network.training and bool(torch.rand((), generator=generator) < TEACHER_FORCING)
        sentences = [sample.sentences[form] for sample, form in zip(batch.samples, forms, strict=True)]
        snippets, divergences = network(sentences, counts, noise, true, forced)
        mask = snippet_mask(counts, true.shape[1])
        motion = network.movement.decode(snippets, mask, target.motion.shape[1])
        kl, error = masked_mean(divergences, mask), smooth_l1_loss(motion, target.motion, reduction="none")
        of_snippets = masked_mean(smooth_l1_loss(snippets, true, reduction="none"), mask[..., None])
        return {"total": masked_mean(error, target.mask) + of_snippets + KL_WEIGHT * kl, "kl": kl}


def _objective(setup: Setup) -> tuple[GeneratorObjective, Normaliser]:
    trained = setup.trained[MOVEMENT.name]
    words = {word for sample in setup.corpus.train for text in sample.sentences for word in words_of(text)}
    network = T2mNetwork(replace(setup.network, movement=trained.network.config, words=tuple(sorted(words))))
    network.movement.load_state_dict(trained.network.state_dict())
    objective = GeneratorObjective(network, setup, trained.normaliser)
    return objective, objective.normaliser


GENERATOR = Network("t2m", T2mConfig, build=T2mNetwork, objective=_objective, needs=(MOVEMENT.name,))
