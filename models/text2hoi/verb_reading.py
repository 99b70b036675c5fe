"""Which verb a sentence means, read from its features by a linear layer: told to a network in their place.

Features of a sentence say its noun more loudly than its verb: where verb and noun were never seen together, the nearest
training sentence shares the noun, and a network trained on few clips does what was done with that object. The layer
is fitted by ridge regression to the verbs of the training sentences. How much it is shrunk, and how sure it is of what
it reads, are chosen on sentences whose noun was left out of the fit: what reads those reads the verb.

Of a sentence with a new pair of verb and noun the layer may be less sure than of nearly all that a network learnt from,
and half of one verb and half of another is a condition the network hardly met: it does either. A trained network is
told a verb that is likelier than all others together as surely as most training sentences had theirs. Below that the
likeliest one is wrong too often to be sure of.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from scipy.special import log_softmax
from torch import Tensor, nn

from hoidata.batches.dataset import ClipSample
from models.common.features import scaled_text

# Shares of the mean variance of a feature that are added to each; and factors of scores before the softmax.
RIDGES = (0.01, 0.03, 0.1, 0.3, 1.0)
SHARPNESSES = (2.0, 4.0, 8.0, 16.0, 32.0)
USUAL = (0.3, 8.0)
LIKELY = 0.5  # likelier than all other verbs together
LESS_SURE = 0.05  # of the training sentences: a few have odd words, whatever their verb


@dataclass(frozen=True)
class Sentences:
    """The distinct sentences of clips that have a verb.

    text (S, D): features at a length of sqrt(D), as by ``scaled_text``. verb, noun (S,): numbers from 0, in order of
    the words. weight (S,): all pairs of verb and noun weigh the same.
    """

    text: np.ndarray
    verb: np.ndarray
    noun: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, samples: Iterable[ClipSample]) -> "Sentences":
        found = {
            (sample.verb, sample.object_words, sentence): text
            for sample in samples
            if sample.verb
            for sentence, text in zip(sample.sentences, sample.text, strict=True)
        }
        keys, pairs = sorted(found), Counter(key[:2] for key in found)
        verb, noun = (np.unique([key[axis] for key in keys], return_inverse=True)[1] for axis in range(2))
        text = np.array([found[key] for key in keys] or np.zeros((0, 1)), dtype=np.float64)
        text *= text.shape[1] ** 0.5 / np.maximum(np.linalg.norm(text, axis=1, keepdims=True), 1e-12)
        return cls(text, verb, noun, np.array([1 / pairs[key[:2]] for key in keys]))

    @property
    def n_verbs(self) -> int:
        """How many verbs there are; one where there is none, as a layer has to have something to read."""
        return int(self.verb.max()) + 1 if len(self.verb) else 1

    def take(self, rows: np.ndarray) -> "Sentences":
        """Those where rows (S,) is True."""
        return Sentences(self.text[rows], self.verb[rows], self.noun[rows], self.weight[rows])


class VerbReading(nn.Module):
    """Probabilities (B, V) that sentences with features (B, D) mean each of the verbs of the training clips.

    In evaluation mode a verb above ``LIKELY`` has at least the probability ``sure``; the others give way in proportion.
    """

    def __init__(self, text: int, n_verbs: int) -> None:
        super().__init__()
        # Parameters, though no gradient changes them: buffers are averaged over the parts of a batch.
        self.mean = nn.Parameter(torch.zeros(text), requires_grad=False)
        self.weights = nn.Parameter(torch.zeros(text, n_verbs), requires_grad=False)
        self.offset = nn.Parameter(torch.zeros(n_verbs), requires_grad=False)
        self.sharpness = nn.Parameter(torch.ones(()), requires_grad=False)
        self.sure = nn.Parameter(torch.zeros(()), requires_grad=False)

    def forward(self, text: Tensor) -> Tensor:
        read = self.read(text)
        if self.training:
            return read
        highest, likeliest = read.max(-1, keepdim=True)
        short = ((self.sure - highest) / (1 - highest).clamp(min=1e-12)).clamp(min=0)
        certain = torch.zeros_like(read).scatter(-1, likeliest, 1.0)
        return torch.lerp(read, certain, torch.where(highest > LIKELY, short, 0.0))

    def read(self, text: Tensor) -> Tensor:
        """Probabilities (B, V) as they are read."""
        scores = (scaled_text(text) - self.mean) @ self.weights + self.offset
        return (self.sharpness * scores).softmax(-1)

    def learn(self, sentences: Sentences) -> None:
        """Fits the layer to sentences with ``n_verbs`` verbs; without any it tells nothing."""
        if not len(sentences.text):
            return
        ridge, sharpness = choose_shrinkage(sentences)
        fitted = next(_fits(sentences, self.offset.shape[0], (ridge,)))
        for own, found in zip((self.mean, self.weights, self.offset), fitted, strict=True):
            own.data.copy_(torch.from_numpy(found))
        self.sharpness.data.fill_(sharpness)
        read = self.read(torch.from_numpy(sentences.text).to(self.mean))
        own = read.gather(1, torch.from_numpy(sentences.verb)[:, None].to(read.device))
        self.sure.data.copy_(own.quantile(LESS_SURE))


def learn_verbs(network: nn.Module, sentences: Sentences) -> None:
    """Fits every reading inside a network."""
    for part in readings_of(network):
        part.learn(sentences)


def readings_of(network: nn.Module) -> list[VerbReading]:
    """The readings inside a network; one that is told the features of sentences has none."""
    return [part for part in network.modules() if isinstance(part, VerbReading)]


def choose_shrinkage(sentences: Sentences) -> tuple[float, float]:
    """The ridge and sharpness with which sentences of each noun are read best (cross-entropy) by a fit without it.

    A sentence whose verb is in no other noun's sentences cannot be asked for; the usual two where none can.
    """
    n_verbs, loss = sentences.n_verbs, np.zeros((len(RIDGES), len(SHARPNESSES)))
    for noun in np.unique(sentences.noun):
        known = sentences.take(sentences.noun != noun)
        asked = sentences.take((sentences.noun == noun) & np.isin(sentences.verb, known.verb))
        if not len(asked.text):
            continue
        for row, (mean, weights, offset) in enumerate(_fits(known, n_verbs, RIDGES)):
            scores = (asked.text - mean) @ weights + offset
            for column, sharpness in enumerate(SHARPNESSES):
                own = np.take_along_axis(log_softmax(sharpness * scores, axis=1), asked.verb[:, None], 1)[:, 0]
                loss[row, column] -= asked.weight @ own
    if not loss.any():
        return USUAL
    return list(product(RIDGES, SHARPNESSES))[int(loss.argmin())]


def _fits(
    sentences: Sentences, n_verbs: int, ridges: Sequence[float]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each ridge the mean (D,), weights (D, V) and offset (V,) of the weighted regression to verbs as 0 and 1."""
    share, wanted = sentences.weight / sentences.weight.sum(), np.eye(n_verbs)[sentences.verb]
    mean, offset = share @ sentences.text, share @ wanted
    away = sentences.text - mean
    weighed = (away * share[:, None]).T
    values, axes = np.linalg.eigh(weighed @ away)  # once for all ridges
    seen = axes.T @ (weighed @ (wanted - offset))
    for ridge in ridges:
        yield mean, axes @ (seen / (values + ridge * values.mean())[:, None]), offset
