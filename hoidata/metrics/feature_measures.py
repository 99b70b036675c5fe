"""What can be said of encoded motions; each function gives one figure of a ``Comparison``, or why there is none.

Every figure is computed per repetition (the first motion of every clip, the second, ...) and is their mean;
"released" is how IMoS's code does it.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hoidata.metrics.encoded import UNKNOWN, EncodedSet
from hoidata.metrics.feature_sets import (
    TOO_SMALL,
    Comparison,
    FeatureFigure,
    cubic_kernel,
    enough_rows,
    euclidean,
    fid_paired,
    frechet_distance,
    gaussian,
    mean_figure,
    mean_matrix,
    mean_of_pairs,
    mean_with_itself,
    rows_of,
    set_figure,
)
from hoidata.metrics.intervals import bootstrap_interval, t_interval
from hoidata.metrics.unmeasured import Unmeasured

SEED = 0
GROUP = 32  # sentences to choose from in R-precision
HALVES = 10
FRECHET_DRAWS = 200
RELEASED_PAIRS, RELEASED_PAIRS_OF_LABEL = 200, 20
MEMORISED_BELOW = 0.5
NO_OTHERS = {False: "there is no other sentence", True: "there is no other sentence about the same object"}
Found = FeatureFigure | Unmeasured
Measure = Callable[[Comparison], Found]
NO_TRAINING = Unmeasured("there are no training clips")


def is_top(encoded: EncodedSet, k: int) -> np.ndarray:
    """(motion,) 1 where the true label is among the k highest logits, else 0; NaN for a label that was never learnt."""
    known = encoded.label != UNKNOWN
    own = encoded.logits[np.arange(len(encoded)), np.where(known, encoded.label, 0)]
    higher = (encoded.logits >= own[:, None]).sum(axis=1) - 1  # a tie is a miss: equal logits know nothing
    return np.where(known, higher < k, np.nan)


def accuracy(k: int) -> Measure:
    without = "the verb is in no training clip"
    return lambda comparison: mean_figure(comparison, is_top(comparison.predicted, k), without=without)


def confusion(encoded: EncodedSet) -> np.ndarray:
    """(label, predicted label) how many motions; labels that were never learnt are left out."""
    size = len(encoded.labels)
    known = encoded.label != UNKNOWN
    pairs = encoded.label[known] * size + encoded.logits[known].argmax(axis=1)
    return np.bincount(pairs, minlength=size * size).reshape(size, size)


def paired(comparison: Comparison) -> Found:
    own = comparison.reference.features[comparison.own_reference]
    return mean_figure(comparison, fid_paired(own, comparison.predicted.features))


def frechet(comparison: Comparison) -> Found:
    """Against the recorded clips of the same part."""
    return _frechet(comparison, comparison.reference, drawn_alike=True)


def frechet_train(comparison: Comparison) -> Found:
    """Against the training clips, of which there are more."""
    return NO_TRAINING if comparison.train is None else _frechet(comparison, comparison.train, drawn_alike=False)


def _frechet(comparison: Comparison, other: EncodedSet, drawn_alike: bool) -> Found:
    """drawn_alike: whether ``other`` holds the same clips, drawn again with the predicted ones."""
    sets = comparison.repetitions
    if not all(enough_rows(run.features) for run in sets):
        sets = [comparison.predicted]
    counts = (len(comparison.clips), len(comparison.predicted), len(sets))
    if not (enough_rows(sets[0].features) and enough_rows(other.features)):
        return FeatureFigure(None, *counts, note=TOO_SMALL)
    runs = [frechet_distance(*gaussian(run.features), *gaussian(other.features)) for run in sets]
    value, first = float(np.mean(runs)), sets[0]
    own = np.searchsorted(comparison.clips, first.clip)
    whole = gaussian(other.features)
    also = rows_of(comparison.clips, other) if drawn_alike else None

    def again(_: np.ndarray, weights: np.ndarray) -> np.ndarray:
        rivals = (gaussian(other.features[also], row) if also is not None else whole for row in weights)
        pairs = zip(weights, rivals, strict=True)
        return np.array([frechet_distance(*gaussian(first.features, row[own]), *rival) for row, rival in pairs])

    drawn = bootstrap_interval(comparison.clips, comparison.groups, again, FRECHET_DRAWS, about=value)
    drawn = drawn and drawn._replace(low=max(drawn.low, 0.0))
    note = "" if len(sets) > 1 or len(comparison.repetitions) == 1 else "all repetitions together"
    return FeatureFigure(value, *counts, t_interval(runs), drawn, note)


def floor_halves(reference: EncodedSet, distance: Callable[[np.ndarray, np.ndarray], float | None]) -> float | None:
    """Mean distance of one half of the recorded clips from the other, whole sequences together, over some divisions."""
    names, group = np.unique(reference.group, return_inverse=True)
    found = []
    for number in range(HALVES):
        first = np.random.default_rng([SEED, number]).permutation(len(names))[: len(names) // 2]
        inside = np.isin(group, first)
        found.append(distance(reference.features[inside], reference.features[~inside]))
    known = [value for value in found if value is not None and np.isfinite(value)]
    return float(np.mean(known)) if len(known) == HALVES else None


def floor(distance: Callable[[np.ndarray, np.ndarray], float | None]) -> Measure:
    """What a distance gives between halves of the truth itself."""

    def measure(comparison: Comparison) -> FeatureFigure:
        value, size = floor_halves(comparison.reference, distance), len(comparison.reference)
        return FeatureFigure(value, size, size, HALVES, note=TOO_SMALL if value is None else "")

    return measure


def kernel_distance(comparison: Comparison) -> Found:
    """Over pairs of different clips alone, as each prediction belongs to one recorded clip (Gretton et al. 2012)."""
    true = comparison.reference.features[rows_of(comparison.clips, comparison.reference)]

    def pairs(run: EncodedSet) -> np.ndarray:
        own = true[np.searchsorted(comparison.clips, run.clip)]
        across = cubic_kernel(run.features, own)
        return cubic_kernel(run.features, run.features) + cubic_kernel(own, own) - across - across.T

    runs = [mean_of_pairs(pairs(run), np.ones((1, len(run))))[0] for run in comparison.repetitions]
    return set_figure(comparison, runs, mean_matrix(comparison, pairs), mean_of_pairs)


def diversity(comparison: Comparison) -> Found:
    """Mean distance over all pairs of clips."""
    ones = lambda run: np.ones((1, len(run)))  # noqa: E731
    apart = lambda run: euclidean(run.features, run.features)  # noqa: E731
    runs = [mean_of_pairs(apart(run), ones(run))[0] for run in comparison.repetitions]
    return set_figure(comparison, runs, mean_matrix(comparison, apart), mean_of_pairs)


def diversity_released(comparison: Comparison) -> Found:
    """200 pairs drawn with replacement, in which a clip may meet itself."""
    runs = []
    for number, run in enumerate(comparison.repetitions):
        one, other = np.random.default_rng([SEED, number]).integers(0, len(run), (2, RELEASED_PAIRS))
        runs.append(np.linalg.norm(run.features[one] - run.features[other], axis=1).mean())
    matrix = mean_matrix(comparison, lambda run: euclidean(run.features, run.features))
    return set_figure(comparison, runs, matrix, mean_with_itself)


def mean_within_labels(apart: np.ndarray, label: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(draw,) mean over labels of the mean distance within each; labels of one clip are left out."""
    members = [np.flatnonzero(label == one) for one in np.unique(label[label != UNKNOWN])]
    means = [mean_of_pairs(apart[np.ix_(own, own)], weights[:, own]) for own in members if len(own) > 1]
    if not means:
        return np.full(len(weights), np.nan)
    stacked = np.stack(means)
    there = np.isfinite(stacked)
    return np.divide(
        np.where(there, stacked, 0).sum(axis=0),
        there.sum(axis=0),
        out=np.full(len(weights), np.nan),
        where=there.any(axis=0),
    )


def multimodality_by_label(comparison: Comparison) -> Found:
    """Mean distance within a true label, over labels of at least two clips."""
    label = comparison.reference.label[rows_of(comparison.clips, comparison.reference)]
    apart = lambda run: euclidean(run.features, run.features)  # noqa: E731
    runs = [mean_within_labels(apart(run), run.label, np.ones((1, len(run))))[0] for run in comparison.repetitions]
    single = int((np.unique(label[label != UNKNOWN], return_counts=True)[1] == 1).sum())
    note = f"{single} label{'s' * (single > 1)} of one clip left out" if single else ""
    again = lambda matrix, weights: mean_within_labels(matrix, label, weights)  # noqa: E731
    return set_figure(comparison, runs, mean_matrix(comparison, apart), again, note, "no label has two clips")


def multimodality_released(comparison: Comparison) -> Found:
    """20 pairs per predicted label, drawn with replacement; a clip may meet itself, absent labels count as 0."""
    runs = []
    for number, run in enumerate(comparison.repetitions):
        random, guess = np.random.default_rng([SEED, number]), run.logits.argmax(axis=1)
        total = 0.0
        for label in np.unique(guess):
            one, other = random.choice(np.flatnonzero(guess == label), (2, RELEASED_PAIRS_OF_LABEL))
            total += np.linalg.norm(run.features[one] - run.features[other], axis=1).sum()
        runs.append(total / (RELEASED_PAIRS_OF_LABEL * len(run.labels)))
    if not runs:
        return Unmeasured("there are no motions")
    counts = (len(comparison.clips), len(comparison.predicted), len(runs))
    return FeatureFigure(float(np.mean(runs)), *counts, t_interval(runs), note="no interval over clips")


def multimodality_by_prompt(comparison: Comparison) -> Found:
    """Mean distance of the motions made for one prompt; none where every clip has one motion."""
    predicted, values = comparison.predicted, np.full(len(comparison.predicted), np.nan)
    for clip in comparison.clips:
        rows = np.flatnonzero(predicted.clip == clip)
        if len(rows) > 1:
            features = predicted.features[rows]
            values[rows] = mean_of_pairs(euclidean(features, features), np.ones((1, len(rows))))[0]
    return mean_figure(comparison, values, by_repetition=False, without="the clip has one motion")


def ranks(distance: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(motion,) how many other sentences are at least as near as the nearest that is its own.

    distance, own: (motion, sentence) float and bool; every sentence that says the same is its own, so a duplicate in
    the group is a hit.
    """
    nearest = np.where(own, distance, np.inf).min(axis=1)
    return ((distance <= nearest[:, None]) & ~own).sum(axis=1)


class Groups(NamedTuple):
    """For each motion the sentences it is matched against. ranks, sizes: (motion,); NaN where there is no other."""

    ranks: np.ndarray
    sizes: np.ndarray


@lru_cache(maxsize=2)
def matched_sentences(comparison: Comparison, hard: bool) -> Groups:
    """The rank of each motion's own sentence among at most 32 that differ in verb, object or hand.

    hard: only sentences about the same object, all of them up to 31. Else 31 others drawn anew for every motion.
    """
    predicted, reference = comparison.predicted, comparison.reference
    prompts, first = np.unique(reference.prompt, return_index=True)
    assert reference.text is not None
    assert predicted.text is not None
    texts, objects = reference.text[first], reference.object[first]
    found = np.full((2, len(predicted)), np.nan)
    for row in range(len(predicted)):
        others = np.flatnonzero((prompts != predicted.prompt[row]) & ((not hard) | (objects == predicted.object[row])))
        if len(others) >= GROUP or not hard:
            random = np.random.default_rng([SEED, int(predicted.sample[row]), int(predicted.clip[row])])
            others = random.permutation(others)[: GROUP - 1]
        if len(others):
            sentences = np.concatenate((predicted.text[row][None], texts[others]))
            distance = np.linalg.norm(sentences - predicted.features[row], axis=1)
            own = np.arange(len(sentences)) == 0
            found[:, row] = ranks(distance[None], own[None])[0], len(sentences)
    return Groups(*found)


def r_precision(k: int, hard: bool) -> Measure:
    def measure(comparison: Comparison) -> Found:
        found = matched_sentences(comparison, hard)
        values = np.where(np.isfinite(found.ranks), found.ranks < k, np.nan)
        return mean_figure(comparison, values, _sizes_in_words(found.sizes), without=NO_OTHERS[hard])

    return measure


def r_precision_chance(k: int, hard: bool) -> Measure:
    """What guessing gives in the same groups."""

    def measure(comparison: Comparison) -> Found:
        found = matched_sentences(comparison, hard)
        chance, note = np.minimum(k / found.sizes, 1.0), _sizes_in_words(found.sizes)
        return mean_figure(comparison, chance, note, without=NO_OTHERS[hard])

    return measure


def _sizes_in_words(sizes: np.ndarray) -> str:
    known = sizes[np.isfinite(sizes)].astype(int)
    if not len(known):
        return ""
    low, high = known.min(), known.max()
    return f"groups of {low}" if low == high else f"groups of {low} to {high}"


def matching_distance(comparison: Comparison) -> Found:
    assert comparison.predicted.text is not None
    return mean_figure(comparison, np.linalg.norm(comparison.predicted.features - comparison.predicted.text, axis=1))


def memorised(comparison: Comparison) -> Found:
    """1 where a motion is less than half as far from its nearest training clip as its recorded clip is from its own."""
    if comparison.train is None:
        return NO_TRAINING
    sets, train = (comparison.predicted, comparison.reference), comparison.train.features
    own, usual = (euclidean(encoded.features, train).min(axis=1) for encoded in sets)
    return mean_figure(comparison, (own < MEMORISED_BELOW * usual[comparison.own_reference]).astype(float))
