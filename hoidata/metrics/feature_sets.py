"""Predicted features beside recorded ones, and how values of motions or of whole sets become one figure.

Distances are pure functions of (row, F) arrays, float64. Sources: FID, Heusel et al. 2017; KID, Binkowski et al. 2018;
the paired form, IMoS (Ghosh et al. 2023) as released.
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


class FeatureFigure(NamedTuple):
    """One figure. value: None where it must not be given, for the reason ``note``. clips, motions, values: in it.

    repetitions: 95 % interval over repetitions (Student), which repeat the sampler; bootstrap: over clips, whole
    sequences drawn again. None where there is none. note: what was left out, or why there is no value. without: why
    clips that are not among ``clips`` have no value; "" where all are.
    """

    value: float | None
    clips: int
    motions: int
    values: int
    repetitions: Interval | None = None
    bootstrap: Interval | None = None
    note: str = ""
    without: str = ""

    @property
    def counts(self) -> dict[str, int]:
        return {"clips": self.clips, "motions": self.motions, "values": self.values}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Predicted motions beside the recorded clips they were made for, and the clips everything was trained on.

    ``predicted.clip`` and ``reference.clip`` count the same clips; reference has one motion of each.
    """

    predicted: EncodedSet
    reference: EncodedSet
    train: EncodedSet | None

    @cached_property
    def repetitions(self) -> list[EncodedSet]:
        return self.predicted.repetitions()

    @cached_property
    def own_reference(self) -> np.ndarray:
        """(motion,) the row of each prediction's clip in the reference."""
        return rows_of(self.predicted.clip, self.reference)

    @cached_property
    def clips(self) -> np.ndarray:
        """(clip,) the clips that have a prediction."""
        return np.unique(self.predicted.clip)

    @cached_property
    def groups(self) -> np.ndarray:
        """(clip,) source sequence of each of ``clips``."""
        return self.reference.group[rows_of(self.clips, self.reference)]


def rows_of(clips: np.ndarray, encoded: EncodedSet) -> np.ndarray:
    """The row of each clip in a set that has one motion of each clip."""
    order = np.argsort(encoded.clip, kind="stable")
    return order[np.searchsorted(encoded.clip, clips, sorter=order)]


def mean_figure(
    comparison: Comparison, values: np.ndarray, note: str = "", by_repetition: bool = True, without: str = "no value"
) -> FeatureFigure | Unmeasured:
    """The mean of (motion,) values; NaN are left out, for the reason ``without``.

    by_repetition: whether a repetition alone has a figure.
    """
    known = np.isfinite(values)
    if not known.any():
        return Unmeasured(without)
    clip, sample, values = comparison.predicted.clip[known], comparison.predicted.sample[known], values[known]
    clips, row = np.unique(clip, return_inverse=True)
    means = np.bincount(row, values) / np.bincount(row)
    numbers, which = np.unique(sample, return_inverse=True)
    runs = np.bincount(which, values) / np.bincount(which)
    groups = comparison.groups[np.searchsorted(comparison.clips, clips)]
    counts = (len(clips), len(values), len(values))
    over_runs = t_interval(runs) if by_repetition and len(numbers) > 1 else None
    value = float(runs.mean() if by_repetition else means.mean())
    missing = without if len(clips) < len(comparison.clips) else ""
    return FeatureFigure(value, *counts, over_runs, bootstrap_interval(means, groups), note, missing)


def set_figure(
    comparison: Comparison,
    runs: Sequence[float],
    values: np.ndarray,
    statistic: Statistic,
    note: str = "",
    without: str = "fewer than two clips",
) -> FeatureFigure | Unmeasured:
    """A figure of whole sets: (repetition,) figures, and what ``statistic`` needs of the clips to draw them again.

    without: why it has none where no repetition has one.
    """
    runs = [run for run in runs if np.isfinite(run)]
    if not runs:
        return Unmeasured(without)
    drawn = bootstrap_interval(values, comparison.groups, statistic)
    counts = (len(comparison.clips), len(comparison.predicted), len(runs))
    return FeatureFigure(float(np.mean(runs)), *counts, t_interval(runs), drawn, note)


def mean_matrix(comparison: Comparison, of: Callable[[EncodedSet], np.ndarray]) -> np.ndarray:
    """(clip, clip) mean over the repetitions of a (motion, motion) matrix of each."""
    total = np.zeros((len(comparison.clips),) * 2)
    count = np.zeros_like(total)
    for run in comparison.repetitions:
        rows = np.searchsorted(comparison.clips, run.clip)
        total[np.ix_(rows, rows)] += of(run)
        count[np.ix_(rows, rows)] += 1
    return total / np.maximum(count, 1)


ROWS_PER_FEATURE = 4
TOO_SMALL = "N too small"


def fid_paired(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(row,) squared distance of paired features plus that of their spreads over the F units (ddof 1).

    What IMoS's released "FID" averages: it runs on one clip at a time. It needs pairs and punishes diversity.
    """
    spread = one.std(axis=1, ddof=1) - other.std(axis=1, ddof=1)
    return np.square(one - other).sum(axis=1) + np.square(spread)


def enough_rows(features: np.ndarray) -> bool:
    """At least 4 rows per feature: with fewer, two draws of one distribution seem far apart (``TOO_SMALL``)."""
    return len(features) >= ROWS_PER_FEATURE * features.shape[1]


def fid_frechet(one: np.ndarray, other: np.ndarray) -> float | None:
    """Frechet distance of the Gaussians of two sets; None where either has too few rows to know its covariance."""
    if not (enough_rows(one) and enough_rows(other)):
        return None
    return frechet_distance(*gaussian(one), *gaussian(other))


def gaussian(features: np.ndarray, weights: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (F,) and covariance (F, F) with ddof 1. weights: (row,) how often each row counts."""
    count = np.ones(len(features)) if weights is None else weights
    mean = count @ features / count.sum()
    apart = features - mean
    return mean, (apart * count[:, None]).T @ apart / (count.sum() - 1)


def frechet_distance(mean: np.ndarray, cov: np.ndarray, other_mean: np.ndarray, other_cov: np.ndarray) -> float:
    """``|m1 - m2|^2 + tr C1 + tr C2 - 2 tr (C1 C2)^(1/2)``, the root by eigenvalues, which are never complex."""
    value, vector = np.linalg.eigh(cov)
    root = vector * np.sqrt(np.maximum(value, 0)) @ vector.T
    cross = np.linalg.eigvalsh(root @ other_cov @ root)
    apart = np.square(mean - other_mean).sum()
    return float(apart + np.trace(cov) + np.trace(other_cov) - 2 * np.sqrt(np.maximum(cross, 0)).sum())


def cubic_kernel(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(row, other row) ``(x.y / F + 1)^3``."""
    return (one @ other.T / one.shape[1] + 1) ** 3


def kid(one: np.ndarray, other: np.ndarray) -> float:
    """Unbiased squared distance of the kernel means of two sets, cubic kernel; NaN with fewer than two rows."""
    if min(len(one), len(other)) < 2:
        return np.nan
    same = [mean_of_pairs(cubic_kernel(rows, rows), np.ones((1, len(rows))))[0] for rows in (one, other)]
    return float(sum(same) - 2 * cubic_kernel(one, other).mean())


def euclidean(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(row, other row) distances."""
    return cdist(one, other)


def mean_of_pairs(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(draw,) mean over all pairs of two different rows of a symmetric (row, row) matrix; NaN with fewer than two.

    weights: (draw, row) how often each row counts; a row is never a pair with itself.
    """
    off = matrix - np.diag(np.diag(matrix))
    pairs = np.square(weights.sum(axis=1)) - np.square(weights).sum(axis=1)
    return np.divide(_total(off, weights), pairs, out=np.full(len(weights), np.nan), where=pairs > 0)


def mean_with_itself(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(draw,) mean over all pairs of rows of a (row, row) matrix, a row with itself among them; weights as above."""
    return _total(matrix, weights) / np.square(weights.sum(axis=1))


def _total(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.einsum("dr,dr->d", weights @ matrix, weights)
