"""Predicted features beside recorded ones, and how values of motions or of whole sets become one figure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

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
