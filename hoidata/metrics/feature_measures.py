"""Feature metrics: accuracy, FID, KID, diversity, R-precision. Each function maps a ``Comparison`` to one result.

Metrics are computed per repetition (the first motion of every clip, the second, ...) and averaged. "Released" follows
the code of IMoS.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from hoidata.metrics.encoded import UNKNOWN, EncodedSet
from hoidata.metrics.feature_sets import (
    TOO_SMALL,
    Comparison,
    FeatureMetricResult,
    cubic_kernel,
    feature_distances,
    fid_paired,
    frechet_distance,
    gaussian,
    has_enough_rows,
    mean_matrix,
    mean_of_pairs,
    mean_result,
    mean_with_itself,
    pairs_result,
    rows_of_clips,
    set_result,
)
from hoidata.metrics.intervals import bootstrap_interval, t_interval
from hoidata.metrics.unmeasured import Unmeasured

SEED = 0
GROUP = 32  # sentences to choose from in R-precision
HALVES = 10
FRECHET_RESAMPLES = 200
RELEASED_PAIRS, RELEASED_PAIRS_OF_LABEL = 200, 20
MEMORISED_BELOW = 0.5
NO_OTHERS = {False: "there is no other sentence", True: "there is no other sentence about the same object"}
Outcome = FeatureMetricResult | Unmeasured
Measure = Callable[[Comparison], Outcome]
NO_TRAINING = Unmeasured("there are no training clips")


def is_top(encoded: EncodedSet, k: int) -> np.ndarray:
    """(motion,) 1 if the true label is among the k highest logits, else 0; NaN for a label that was not trained."""
    has_label = encoded.label != UNKNOWN
    true_logit = encoded.logits[np.arange(len(encoded)), np.where(has_label, encoded.label, 0)]
    higher = (encoded.logits >= true_logit[:, None]).sum(axis=1) - 1  # a tie is a miss: equal logits carry no evidence
    return np.where(has_label, higher < k, np.nan)


def accuracy(k: int) -> Measure:
    """Top-k classification accuracy."""
    without = "the verb is in no training clip"
    return lambda comparison: mean_result(comparison, is_top(comparison.predicted, k), without=without)


def confusion(encoded: EncodedSet) -> np.ndarray:
    """(label, predicted label) number of motions; labels that were not trained are skipped."""
    size = len(encoded.labels)
    has_label = encoded.label != UNKNOWN
    pairs = encoded.label[has_label] * size + encoded.logits[has_label].argmax(axis=1)
    return np.bincount(pairs, minlength=size * size).reshape(size, size)


def paired(comparison: Comparison) -> Outcome:
    """``fid_paired`` of every prediction and its recorded clip."""
    reference_features = comparison.reference.features[comparison.reference_rows]
    return mean_result(comparison, fid_paired(reference_features, comparison.predicted.features))


def frechet(comparison: Comparison) -> Outcome:
    """Frechet distance from the recorded reference clips."""
    return _frechet(comparison, comparison.reference, same_clips=True)


def frechet_train(comparison: Comparison) -> Outcome:
    """Frechet distance from the training clips, which are more numerous."""
    return NO_TRAINING if comparison.train is None else _frechet(comparison, comparison.train, same_clips=False)


def _frechet(comparison: Comparison, other: EncodedSet, same_clips: bool) -> Outcome:
    """Frechet distance of the predictions from ``other``.

    Args:
        same_clips: ``other`` has the same clips as the predictions, so the bootstrap resamples both together.
    """
    sets = comparison.repetitions
    if not all(has_enough_rows(run.features) for run in sets):
        sets = [comparison.predicted]
    counts = (len(comparison.clips), len(comparison.predicted), len(sets))
    if not (has_enough_rows(sets[0].features) and has_enough_rows(other.features)):
        return FeatureMetricResult(None, *counts, note=TOO_SMALL)
    runs = [frechet_distance(*gaussian(run.features), *gaussian(other.features)) for run in sets]
    value, first = float(np.mean(runs)), sets[0]
    clip_rows = np.searchsorted(comparison.clips, first.clip)
    whole_gaussian = gaussian(other.features)
    other_rows = rows_of_clips(comparison.clips, other) if same_clips else None

    def one_resample(weights: np.ndarray) -> float:
        target = whole_gaussian if other_rows is None else gaussian(other.features[other_rows], weights)
        return frechet_distance(*gaussian(first.features, weights[clip_rows]), *target)

    def statistic(_: np.ndarray, weights: np.ndarray) -> np.ndarray:
        return np.array([one_resample(clip_weights) for clip_weights in weights])

    interval = bootstrap_interval(comparison.clips, comparison.groups, statistic, FRECHET_RESAMPLES, centre=value)
    interval = interval and interval._replace(low=max(interval.low, 0.0))
    note = "" if len(sets) > 1 or len(comparison.repetitions) == 1 else "all repetitions together"
    return FeatureMetricResult(value, *counts, repetitions=t_interval(runs), bootstrap=interval, note=note)


def distance_of_halves(
    reference: EncodedSet, distance: Callable[[np.ndarray, np.ndarray], float | None]
) -> float | None:
    """Mean distance between two random halves of the recorded clips, over ``HALVES`` divisions.

    A source sequence is never split. None if any division is too small.
    """
    names, group = np.unique(reference.group, return_inverse=True)
    distances = []
    for number in range(HALVES):
        first_groups = np.random.default_rng([SEED, number]).permutation(len(names))[: len(names) // 2]
        is_first = np.isin(group, first_groups)
        distances.append(distance(reference.features[is_first], reference.features[~is_first]))
    finite = [value for value in distances if value is not None and np.isfinite(value)]
    return float(np.mean(finite)) if len(finite) == HALVES else None


def lower_bound(distance: Callable[[np.ndarray, np.ndarray], float | None]) -> Measure:
    """The distance between halves of the recorded clips: no generator can be expected to score lower."""

    def measure(comparison: Comparison) -> FeatureMetricResult:
        value, size = distance_of_halves(comparison.reference, distance), len(comparison.reference)
        note = TOO_SMALL if value is None else ""
        return FeatureMetricResult(value, clips=size, motions=size, values=HALVES, note=note)

    return measure


def kernel_distance(comparison: Comparison) -> Outcome:
    """Kernel distance over pairs of different clips: predictions and references are paired (Gretton et al. 2012)."""
    recorded_features = comparison.reference.features[rows_of_clips(comparison.clips, comparison.reference)]

    def kernel_differences(run: EncodedSet) -> np.ndarray:
        recorded = recorded_features[np.searchsorted(comparison.clips, run.clip)]
        across = cubic_kernel(run.features, recorded)
        return cubic_kernel(run.features, run.features) + cubic_kernel(recorded, recorded) - across - across.T

    return pairs_result(comparison, kernel_differences)


def diversity(comparison: Comparison) -> Outcome:
    """Mean distance over all pairs of clips."""
    return pairs_result(comparison, feature_distances)


def diversity_released(comparison: Comparison) -> Outcome:
    """Mean distance of 200 pairs sampled with replacement; a clip may be paired with itself."""
    runs = []
    for number, run in enumerate(comparison.repetitions):
        one, other = np.random.default_rng([SEED, number]).integers(0, len(run), (2, RELEASED_PAIRS))
        runs.append(np.linalg.norm(run.features[one] - run.features[other], axis=1).mean())
    return set_result(comparison, runs, mean_matrix(comparison, feature_distances), mean_with_itself)


def mean_within_labels(distances: np.ndarray, label: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(resample,) mean over labels of the mean distance within each label; labels of one clip are skipped."""
    members = [np.flatnonzero(label == one) for one in np.unique(label[label != UNKNOWN])]
    means = [mean_of_pairs(distances[np.ix_(rows, rows)], weights[:, rows]) for rows in members if len(rows) > 1]
    if not means:
        return np.full(len(weights), np.nan)
    stacked = np.stack(means)
    is_defined = np.isfinite(stacked)
    return np.divide(
        np.where(is_defined, stacked, 0).sum(axis=0),
        is_defined.sum(axis=0),
        out=np.full(len(weights), np.nan),
        where=is_defined.any(axis=0),
    )


def multimodality_by_label(comparison: Comparison) -> Outcome:
    """Mean distance within a true label, over labels of at least two clips."""
    label = comparison.reference.label[rows_of_clips(comparison.clips, comparison.reference)]
    runs = [
        mean_within_labels(feature_distances(run), run.label, np.ones((1, len(run))))[0]
        for run in comparison.repetitions
    ]
    single = int((np.unique(label[label != UNKNOWN], return_counts=True)[1] == 1).sum())
    note = f"{single} label{'s' * (single > 1)} of one clip left out" if single else ""
    statistic = lambda matrix, weights: mean_within_labels(matrix, label, weights)  # noqa: E731
    return set_result(
        comparison, runs, mean_matrix(comparison, feature_distances), statistic, note, "no label has two clips"
    )


def multimodality_released(comparison: Comparison) -> Outcome:
    """Mean distance of 20 pairs per predicted label, sampled with replacement.

    A clip may be paired with itself, and labels that are never predicted count as 0.
    """
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
    return FeatureMetricResult(float(np.mean(runs)), *counts, t_interval(runs), note="no interval over clips")


def multimodality_by_prompt(comparison: Comparison) -> Outcome:
    """Mean distance of the motions generated for one prompt; unmeasured if every clip has one motion."""
    predicted, values = comparison.predicted, np.full(len(comparison.predicted), np.nan)
    for clip in comparison.clips:
        rows = np.flatnonzero(predicted.clip == clip)
        if len(rows) > 1:
            values[rows] = mean_of_pairs(feature_distances(predicted.take(rows)), np.ones((1, len(rows))))[0]
    return mean_result(comparison, values, by_repetition=False, without="the clip has one motion")


class Groups(NamedTuple):
    """The retrieval result of every motion, NaN for a motion without other sentences."""

    ranks: np.ndarray  # (motion,) rank of the matching sentence, 0 is best
    sizes: np.ndarray  # (motion,) number of sentences in the group


@lru_cache(maxsize=2)
def sentence_ranks(comparison: Comparison, hard: bool) -> Groups:
    """The rank of each motion's sentence among at most 32 that differ in verb, object or hand.

    Args:
        hard: compare with sentences about the same object, at most 31. Otherwise 31 others are sampled per motion.
    """
    predicted, reference = comparison.predicted, comparison.reference
    prompts, first = np.unique(reference.prompt, return_index=True)
    assert reference.text is not None
    assert predicted.text is not None
    texts, objects = reference.text[first], reference.object[first]
    ranks_and_sizes = np.full((2, len(predicted)), np.nan)
    for motion in range(len(predicted)):
        is_allowed = (not hard) | (objects == predicted.object[motion])
        others = np.flatnonzero((prompts != predicted.prompt[motion]) & is_allowed)
        if len(others) >= GROUP or not hard:
            random = np.random.default_rng([SEED, int(predicted.sample[motion]), int(predicted.clip[motion])])
            others = random.permutation(others)[: GROUP - 1]
        if len(others):
            sentences = np.concatenate((predicted.text[motion][None], texts[others]))
            distance = np.linalg.norm(sentences - predicted.features[motion], axis=1)
            closer = distance[1:] <= distance[0]  # a tie is a miss
            ranks_and_sizes[:, motion] = closer.sum(), len(sentences)
    return Groups(*ranks_and_sizes)


def r_precision(k: int, hard: bool) -> Measure:
    """Fraction of motions whose sentence is among the k closest (T2M, Sec. 5); groups as in ``sentence_ranks``."""

    def measure(comparison: Comparison) -> Outcome:
        groups = sentence_ranks(comparison, hard)
        values = np.where(np.isfinite(groups.ranks), groups.ranks < k, np.nan)
        return mean_result(comparison, values, _sizes_in_words(groups.sizes), without=NO_OTHERS[hard])

    return measure


def r_precision_chance(k: int, hard: bool) -> Measure:
    """The R-precision of random guessing in the same groups."""

    def measure(comparison: Comparison) -> Outcome:
        groups = sentence_ranks(comparison, hard)
        chance, note = np.minimum(k / groups.sizes, 1.0), _sizes_in_words(groups.sizes)
        return mean_result(comparison, chance, note, without=NO_OTHERS[hard])

    return measure


def _sizes_in_words(sizes: np.ndarray) -> str:
    counts = sizes[np.isfinite(sizes)].astype(int)
    if not len(counts):
        return ""
    low, high = counts.min(), counts.max()
    return f"groups of {low}" if low == high else f"groups of {low} to {high}"


def matching_distance(comparison: Comparison) -> Outcome:
    """Mean distance of a motion from its sentence in the shared feature space."""
    assert comparison.predicted.text is not None
    return mean_result(comparison, np.linalg.norm(comparison.predicted.features - comparison.predicted.text, axis=1))


def memorised(comparison: Comparison) -> Outcome:
    """Fraction of motions that are suspiciously close to a training clip.

    A motion counts if its distance to the nearest training clip is below half that of its recorded clip.
    """
    if comparison.train is None:
        return NO_TRAINING
    sets, train = (comparison.predicted, comparison.reference), comparison.train.features
    distance, recorded_distance = (cdist(encoded.features, train).min(axis=1) for encoded in sets)
    is_close = distance < MEMORISED_BELOW * recorded_distance[comparison.reference_rows]
    return mean_result(comparison, is_close.astype(float))
