"""Comparison of predicted with recorded features: distances of sets, and results with intervals.

Distances are pure functions of (row, F) float64 arrays, one row per motion. Sources: FID, Heusel et al. 2017; KID,
Binkowski et al. 2018; the paired distance, IMoS (Ghosh et al. 2023) as released.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from hoidata.metrics.encoded import EncodedSet
from hoidata.metrics.intervals import Interval, Statistic, bootstrap_interval, t_interval
from hoidata.metrics.unmeasured import Unmeasured


class FeatureMetricResult(NamedTuple):
    """The value of a feature metric with its counts and 95 % intervals."""

    value: float | None  # None: it would mislead, for the reason ``note``
    clips: int
    motions: int
    values: int
    repetitions: Interval | None = None  # over repetitions of sampling (Student's t)
    bootstrap: Interval | None = None  # over clips, resampling whole source sequences
    note: str = ""  # a remark, or why the value is missing
    without: str = ""  # why some clips have no value; "" if all have one

    @property
    def counts(self) -> dict[str, int]:
        return {"clips": self.clips, "motions": self.motions, "values": self.values}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Encoded predictions, their recorded reference clips and the training clips."""

    predicted: EncodedSet
    reference: EncodedSet  # one motion per clip; ``clip`` has the same numbers as in ``predicted``
    train: EncodedSet | None

    @cached_property
    def repetitions(self) -> list[EncodedSet]:
        return self.predicted.repetitions()

    @cached_property
    def reference_rows(self) -> np.ndarray:
        """(motion,) row of each prediction's clip in the reference."""
        return rows_of_clips(self.predicted.clip, self.reference)

    @cached_property
    def clips(self) -> np.ndarray:
        """(clip,) sorted indices of the clips that have a prediction."""
        return np.unique(self.predicted.clip)

    @cached_property
    def groups(self) -> np.ndarray:
        """(clip,) source sequence of each of ``clips``."""
        return self.reference.group[rows_of_clips(self.clips, self.reference)]


def rows_of_clips(clips: np.ndarray, encoded: EncodedSet) -> np.ndarray:
    """(clip,) row of each clip in a set with one motion per clip."""
    order = np.argsort(encoded.clip, kind="stable")
    return order[np.searchsorted(encoded.clip, clips, sorter=order)]


def mean_result(
    comparison: Comparison, values: np.ndarray, note: str = "", by_repetition: bool = True, without: str = "no value"
) -> FeatureMetricResult | Unmeasured:
    """The mean of (motion,) values with intervals.

    Args:
        values: NaN for motions without a value, which are skipped for the reason ``without``.
        by_repetition: average within each repetition first. False: average within each clip first.
    """
    has_value = np.isfinite(values)
    if not has_value.any():
        return Unmeasured(without)
    clip, sample = comparison.predicted.clip[has_value], comparison.predicted.sample[has_value]
    values = values[has_value]
    clips, clip_of_value = np.unique(clip, return_inverse=True)
    means = np.bincount(clip_of_value, values) / np.bincount(clip_of_value)
    numbers, repetition = np.unique(sample, return_inverse=True)
    runs = np.bincount(repetition, values) / np.bincount(repetition)
    groups = comparison.groups[np.searchsorted(comparison.clips, clips)]
    counts = (len(clips), len(values), len(values))
    over_runs = t_interval(runs) if by_repetition and len(numbers) > 1 else None
    value = float(runs.mean() if by_repetition else means.mean())
    missing = without if len(clips) < len(comparison.clips) else ""
    over_clips = bootstrap_interval(means, groups)
    return FeatureMetricResult(value, *counts, repetitions=over_runs, bootstrap=over_clips, note=note, without=missing)


def set_result(
    comparison: Comparison,
    runs: Sequence[float],
    values: np.ndarray,
    statistic: Statistic,
    note: str = "",
    without: str = "fewer than two clips",
) -> FeatureMetricResult | Unmeasured:
    """The mean of a metric of whole sets over repetitions, with intervals.

    Args:
        runs: the value of each repetition; repetitions that are not finite are skipped.
        values: the input of ``statistic`` per clip, for the bootstrap.
        without: the reason if no repetition has a value.
    """
    runs = [run for run in runs if np.isfinite(run)]
    if not runs:
        return Unmeasured(without)
    over_clips = bootstrap_interval(values, comparison.groups, statistic)
    counts = (len(comparison.clips), len(comparison.predicted), len(runs))
    value = float(np.mean(runs))
    return FeatureMetricResult(value, *counts, repetitions=t_interval(runs), bootstrap=over_clips, note=note)


def pairs_result(
    comparison: Comparison, matrix_of: Callable[[EncodedSet], np.ndarray]
) -> FeatureMetricResult | Unmeasured:
    """The mean over all pairs of different clips of each repetition's (motion, motion) matrix, with intervals."""
    runs = [mean_of_pairs(matrix_of(run), np.ones((1, len(run))))[0] for run in comparison.repetitions]
    return set_result(comparison, runs, mean_matrix(comparison, matrix_of), mean_of_pairs)


def feature_distances(encoded: EncodedSet) -> np.ndarray:
    """(motion, motion) Euclidean distances of the features."""
    return cdist(encoded.features, encoded.features)


def mean_matrix(comparison: Comparison, matrix_of: Callable[[EncodedSet], np.ndarray]) -> np.ndarray:
    """(clip, clip) mean over the repetitions of each one's (motion, motion) matrix; NaN for clips that share none."""
    total = np.zeros((len(comparison.clips),) * 2)
    count = np.zeros_like(total)
    for run in comparison.repetitions:
        rows = np.searchsorted(comparison.clips, run.clip)
        total[np.ix_(rows, rows)] += matrix_of(run)
        count[np.ix_(rows, rows)] += 1
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


ROWS_PER_FEATURE = 4
TOO_SMALL = "N too small"


def fid_paired(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(row,) squared distance of paired features plus squared difference of their standard deviations over F (ddof 1).

    The "FID" of IMoS's released code averages this, one clip at a time. It needs pairs and penalises diversity.
    """
    spread = one.std(axis=1, ddof=1) - other.std(axis=1, ddof=1)
    return np.square(one - other).sum(axis=1) + np.square(spread)


def has_enough_rows(features: np.ndarray) -> bool:
    """Whether there are at least 4 different rows per feature: below, two samples of one distribution seem far apart.

    Copies, such as repetitions of a method without randomness, add nothing to a covariance.
    """
    enough = ROWS_PER_FEATURE * features.shape[1]
    return len(features) >= enough and len(np.unique(features, axis=0)) >= enough


def fid_frechet(one: np.ndarray, other: np.ndarray) -> float | None:
    """Frechet distance of the Gaussians of two sets; None if a set is too small to estimate its covariance."""
    if not (has_enough_rows(one) and has_enough_rows(other)):
        return None
    return frechet_distance(*gaussian(one), *gaussian(other))


def gaussian(features: np.ndarray, weights: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (F,) and covariance (F, F) with ddof 1, rows counted (row,) ``weights`` times."""
    count = np.ones(len(features)) if weights is None else weights
    mean = count @ features / count.sum()
    centred = features - mean
    return mean, (centred * count[:, None]).T @ centred / (count.sum() - 1)


def frechet_distance(mean: np.ndarray, cov: np.ndarray, other_mean: np.ndarray, other_cov: np.ndarray) -> float:
    """``|m1 - m2|^2 + tr C1 + tr C2 - 2 tr (C1 C2)^(1/2)`` (Heusel et al. 2017).

    The root is taken of the symmetric C1^(1/2) C2 C1^(1/2), whose eigenvalues are never complex.
    """
    value, vector = np.linalg.eigh(cov)
    root = vector * np.sqrt(np.maximum(value, 0)) @ vector.T
    cross = np.linalg.eigvalsh(root @ other_cov @ root)
    mean_distance = np.square(mean - other_mean).sum()
    return float(mean_distance + np.trace(cov) + np.trace(other_cov) - 2 * np.sqrt(np.maximum(cross, 0)).sum())


def cubic_kernel(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(row, other row) kernel values ``(x.y / F + 1)^3``."""
    return (one @ other.T / one.shape[1] + 1) ** 3


def kid(one: np.ndarray, other: np.ndarray) -> float:
    """Unbiased squared kernel distance (MMD) of two sets, cubic kernel; NaN with fewer than two rows."""
    if min(len(one), len(other)) < 2:
        return np.nan
    same = [mean_of_pairs(cubic_kernel(rows, rows), np.ones((1, len(rows))))[0] for rows in (one, other)]
    return float(sum(same) - 2 * cubic_kernel(one, other).mean())


def mean_of_pairs(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(resample,) mean over all pairs of different rows of a symmetric (row, row) matrix; NaN with fewer than two.

    Args:
        matrix: NaN in pairs that do not count.
        weights: (resample, row) how often each row counts; a row never pairs with itself.
    """
    off = matrix.copy()
    np.fill_diagonal(off, np.nan)
    return mean_with_itself(off, weights)


def mean_with_itself(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(resample,) mean over all pairs of rows of a (row, row) matrix, including a row with itself; without NaN."""
    is_known = np.isfinite(matrix)
    pairs = _total(is_known.astype(np.float64), weights)
    total = _total(np.where(is_known, matrix, 0), weights)
    return np.divide(total, pairs, out=np.full(len(weights), np.nan), where=pairs > 0)


def _total(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.einsum("dr,dr->d", weights @ matrix, weights)
