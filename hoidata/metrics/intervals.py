"""95 % confidence intervals of a metric: over repetitions of sampling, and over clips."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

LEVEL = 0.95
RESAMPLES = 2_000
SEED = 0
MOST_WEIGHTS = 2**20  # weights in memory at a time
Statistic = Callable[[np.ndarray, np.ndarray], np.ndarray]  # values (clip, ...), weights (resample, clip): (resample,)


class Interval(NamedTuple):
    """From ``low`` to ``high``, in the unit of the metric."""

    low: float
    high: float


def t_interval(values_by_repetition: ArrayLike) -> Interval | None:
    """Student's t interval of the mean over (repetition,) values; None for fewer than two.

    For 20 repetitions this is mean +- 2.093 s / sqrt(20), ddof 1.
    """
    values = np.asarray(values_by_repetition, dtype=np.float64)
    if len(values) < 2:
        return None
    half = stdtrit(len(values) - 1, (1 + LEVEL) / 2) * values.std(ddof=1) / np.sqrt(len(values))
    return Interval(float(values.mean() - half), float(values.mean() + half))


def weighted_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(resample,) weighted means of (clip,) values under (resample, clip) weights."""
    return weights @ values / weights.sum(axis=1)


def bootstrap_interval(
    values_by_clip: ArrayLike,
    groups: ArrayLike,
    statistic: Statistic = weighted_mean,
    resamples: int = RESAMPLES,
    centre: float | None = None,
) -> Interval | None:
    """Bootstrap percentile interval, resampling whole groups of clips with replacement; None for one group.

    Args:
        values_by_clip: (clip, ...) in the shape that the statistic takes, without NaN.
        groups: (clip,) labels: the source sequence of each clip. All samples of a clip are in one group.
        statistic: maps the values and (resample, clip) counts to (resample,) results, NaN if undefined.
        centre: shifts the interval so that its median is here. Resampling inflates some statistics: duplicates
            shrink the covariance.
    """
    values, (names, group) = np.asarray(values_by_clip), np.unique(np.asarray(groups), return_inverse=True)
    if len(names) < 2:
        return None
    counts = np.random.default_rng(SEED).multinomial(len(names), np.full(len(names), 1 / len(names)), size=resamples)
    chunk = max(1, MOST_WEIGHTS // len(group))
    chunks = [counts[start : start + chunk, group].astype(np.float64) for start in range(0, resamples, chunk)]
    results = np.concatenate([statistic(values, weights) for weights in chunks])
    results = results[np.isfinite(results)]
    if not len(results):
        return None
    low, middle, high = np.quantile(results, ((1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2))
    shift = 0.0 if centre is None else centre - middle
    return Interval(float(low + shift), float(high + shift))
