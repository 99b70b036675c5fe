"""A linear classifier of the verb from a sentence's features; networks read its probabilities instead of the features.

Sentence features reflect the noun more than the verb. For a new pair of verb and noun the nearest training sentence
shares the noun, and a network trained on few clips repeats what was done with that object. The classifier is a ridge
regression to the verbs of the training sentences. Ridge and softmax sharpness are chosen by cross-validation over
nouns, so that it generalises to new nouns.

For a new pair the probabilities may be less certain than in training, and networks do not handle mixtures of two verbs.
At inference a verb with a probability above one half is therefore raised to the confidence of most training sentences.
Below one half the most probable verb is wrong too often.
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

RIDGES = (0.01, 0.03, 0.1, 0.3, 1.0)  # as fractions of the mean variance of a feature
SHARPNESSES = (2.0, 4.0, 8.0, 16.0, 32.0)  # factors of the scores before the softmax
DEFAULT_SHRINKAGE = (0.3, 8.0)  # ridge and sharpness if cross-validation is not possible
SHARPEN_ABOVE = 0.5  # probability: more than all other verbs together
CONFIDENCE_QUANTILE = 0.05  # of training sentences; a few have unusual words


@dataclass(frozen=True)
class Sentences:
    """The S distinct sentences of clips that have a verb."""

    text: np.ndarray  # (S, D) features of length sqrt(D), as by ``scaled_text``
    verb: np.ndarray  # (S,) index of the verb, in alphabetical order
    noun: np.ndarray  # (S,) index of the object's words
    weight: np.ndarray  # (S,) with equal sums for all pairs of verb and noun

    @classmethod
    def of(cls, samples: Iterable[ClipSample]) -> "Sentences":
        text_by_sentence = {
            (sample.verb, sample.object_words, sentence): text
            for sample in samples
            if sample.verb
            for sentence, text in zip(sample.sentences, sample.text, strict=True)
        }
        keys, pairs = sorted(text_by_sentence), Counter(key[:2] for key in text_by_sentence)
        verb, noun = (np.unique([key[axis] for key in keys], return_inverse=True)[1] for axis in range(2))
        text = np.array([text_by_sentence[key] for key in keys] or np.zeros((0, 1)), dtype=np.float64)
        text *= text.shape[1] ** 0.5 / np.maximum(np.linalg.norm(text, axis=1, keepdims=True), 1e-12)
        return cls(text, verb, noun, np.array([1 / pairs[key[:2]] for key in keys]))

    @property
    def n_verbs(self) -> int:
        """Number of verbs; at least one, because a layer needs an input."""
        return int(self.verb.max()) + 1 if len(self.verb) else 1

    def take(self, mask: np.ndarray) -> "Sentences":
        """The sentences that ``mask`` (S,) selects."""
        return Sentences(self.text[mask], self.verb[mask], self.noun[mask], self.weight[mask])


class VerbClassifier(nn.Module):
    """Probabilities (B, V) of the verbs of the training clips, from sentence features (B, D).

    In evaluation mode a probability above ``SHARPEN_ABOVE`` is raised to at least ``sure``, the confidence in training,
    and the others are scaled down.
    """

    def __init__(self, text: int, n_verbs: int) -> None:
        super().__init__()
        # Parameters without gradient, not buffers: training averages buffers over micro-batches.
        self.mean = nn.Parameter(torch.zeros(text), requires_grad=False)
        self.weights = nn.Parameter(torch.zeros(text, n_verbs), requires_grad=False)
        self.offset = nn.Parameter(torch.zeros(n_verbs), requires_grad=False)
        self.sharpness = nn.Parameter(torch.ones(()), requires_grad=False)
        self.sure = nn.Parameter(torch.zeros(()), requires_grad=False)

    def forward(self, text: Tensor) -> Tensor:
        probability = self.probabilities(text)
        if self.training:
            return probability
        confidence, verb = probability.max(-1, keepdim=True)
        # Interpolation towards one-hot that raises the highest probability to exactly ``sure``.
        weight = ((self.sure - confidence) / (1 - confidence).clamp(min=1e-12)).clamp(min=0)
        one_hot = torch.zeros_like(probability).scatter(-1, verb, 1.0)
        return torch.lerp(probability, one_hot, torch.where(confidence > SHARPEN_ABOVE, weight, 0.0))

    def probabilities(self, text: Tensor) -> Tensor:
        """Probabilities (B, V) before sharpening."""
        scores = (scaled_text(text) - self.mean) @ self.weights + self.offset
        return (self.sharpness * scores).softmax(-1)

    def fit(self, sentences: Sentences) -> None:
        """Fit to sentences with ``n_verbs`` verbs; without sentences all probabilities are equal."""
        if not len(sentences.text):
            return
        ridge, sharpness = choose_shrinkage(sentences)
        fitted = next(_fits(sentences, self.offset.shape[0], (ridge,)))
        for parameter, value in zip((self.mean, self.weights, self.offset), fitted, strict=True):
            parameter.data.copy_(torch.from_numpy(value))
        self.sharpness.data.fill_(sharpness)
        probability = self.probabilities(torch.from_numpy(sentences.text).to(self.mean))
        confidence = probability.gather(1, torch.from_numpy(sentences.verb)[:, None].to(probability.device))
        self.sure.data.copy_(confidence.quantile(CONFIDENCE_QUANTILE))


def fit_verb_classifiers(network: nn.Module, sentences: Sentences) -> None:
    """Fit every verb classifier inside a network."""
    for part in verb_classifiers_of(network):
        part.fit(sentences)


def verb_classifiers_of(network: nn.Module) -> list[VerbClassifier]:
    """The verb classifiers inside a network; none if it reads sentence features."""
    return [part for part in network.modules() if isinstance(part, VerbClassifier)]


def choose_shrinkage(sentences: Sentences) -> tuple[float, float]:
    """Ridge and sharpness with the lowest cross-entropy in leave-one-noun-out cross-validation.

    A sentence whose verb occurs with no other noun is skipped; ``DEFAULT_SHRINKAGE`` if all are.
    """
    n_verbs, loss = sentences.n_verbs, np.zeros((len(RIDGES), len(SHARPNESSES)))
    for noun in np.unique(sentences.noun):
        training = sentences.take(sentences.noun != noun)
        held_out = sentences.take((sentences.noun == noun) & np.isin(sentences.verb, training.verb))
        if not len(held_out.text):
            continue
        for i, (mean, weights, offset) in enumerate(_fits(training, n_verbs, RIDGES)):
            scores = (held_out.text - mean) @ weights + offset
            for j, sharpness in enumerate(SHARPNESSES):
                log_probability = log_softmax(sharpness * scores, axis=1)
                correct = np.take_along_axis(log_probability, held_out.verb[:, None], 1)[:, 0]
                loss[i, j] -= held_out.weight @ correct
    if not loss.any():
        return DEFAULT_SHRINKAGE
    return list(product(RIDGES, SHARPNESSES))[int(loss.argmin())]


def _fits(
    sentences: Sentences, n_verbs: int, ridges: Sequence[float]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Mean (D,), weights (D, V) and offset (V,) of the weighted ridge regression to one-hot verbs, for each ridge."""
    weights, target = sentences.weight / sentences.weight.sum(), np.eye(n_verbs)[sentences.verb]
    mean, offset = weights @ sentences.text, weights @ target
    centred = sentences.text - mean
    weighted = (centred * weights[:, None]).T
    values, axes = np.linalg.eigh(weighted @ centred)  # once for all ridges
    # In the eigenbasis of the covariance each ridge is a division.
    projected = axes.T @ (weighted @ (target - offset))
    for ridge in ridges:
        yield mean, axes @ (projected / (values + ridge * values.mean())[:, None]), offset
