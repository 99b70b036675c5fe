"""95 % intervals: over repetitions, which repeat the sampler, and over clips, which are what the figure is about."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

LEVEL = 0.95
DRAWS = 2_000
SEED = 0
WEIGHTS_AT_ONCE = 2**20
Statistic = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of values (clip, ...) and weights (draw, clip): (draw,)


class Interval(NamedTuple):
    """From ``low`` to ``high``, in the unit of the figure."""

    low: float
    high: float


def t_interval(values_by_repetition: ArrayLike) -> Interval | None:
    """Student's interval of the mean over repetitions; None for fewer than two.

    values_by_repetition: (repetition,) the figure of each. For 20 repetitions mean +- 2.093 s / sqrt(20), ddof 1.
    """
    values = np.asarray(values_by_repetition, dtype=np.float64)
    if len(values) < 2:
        return None
    half = stdtrit(len(values) - 1, (1 + LEVEL) / 2) * values.std(ddof=1) / np.sqrt(len(values))
    return Interval(float(values.mean() - half), float(values.mean() + half))


def weighted_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(draw,) the mean of (clip,) values under each row of (draw, clip) weights."""
    return weights @ values / weights.sum(axis=1)


def bootstrap_interval(
    values_by_clip: ArrayLike,
    groups: ArrayLike,
    statistic: Statistic = weighted_mean,
    draws: int = DRAWS,
    seed: int = SEED,
) -> Interval | None:
    """Percentile interval of a figure when whole groups of clips are drawn again with replacement; None for one group.

    values_by_clip: (clip, ...) of any shape the statistic knows; no NaN: a clip without a value is left out before.
    groups: (clip,) labels, the source sequence of each; all samples of a clip belong to its group. statistic: of these
    values and of (draw, clip) weights, how often each clip was drawn; gives (draw,) figures, NaN where it has none.
    """
    values, (names, group) = np.asarray(values_by_clip), np.unique(np.asarray(groups), return_inverse=True)
    if len(names) < 2:
        return None
    drawn = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1 / len(names)), size=draws)
    rows = max(1, WEIGHTS_AT_ONCE // len(group))
    chunks = [drawn[start : start + rows, group].astype(np.float64) for start in range(0, draws, rows)]
    figures = np.concatenate([statistic(values, weights) for weights in chunks])
    figures = figures[np.isfinite(figures)]
    if not len(figures):
        return None
    low, high = np.quantile(figures, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(float(low), float(high))
