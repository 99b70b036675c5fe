"""Intervals of frames with a property, and outlier steps of a motion."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np


class Interval(NamedTuple):
    """Frames ``start`` to ``stop``, half-open."""

    start: int
    stop: int


def runs(flags: np.ndarray) -> list[Interval]:
    """Maximal intervals of True in (frame,) booleans."""
    change = np.diff(np.concatenate(([0], flags.astype(np.int8), [0])))
    pairs = zip(np.flatnonzero(change == 1), np.flatnonzero(change == -1), strict=True)
    return [Interval(int(start), int(stop)) for start, stop in pairs]


def bridged(flags: np.ndarray, longest: int) -> np.ndarray:
    """Flags (frame,) with gaps of at most ``longest`` frames between True values filled."""
    filled = flags.copy()
    for start, stop in runs(~flags):
        if start > 0 and stop < len(flags) and stop - start <= longest:
            filled[start:stop] = True
    return filled


def widened(interval: Interval, margin: int, usable: np.ndarray) -> Interval:
    """The interval extended by up to ``margin`` frames on each side, while frames are usable (frame,)."""
    start, stop = interval
    while start > max(0, interval.start - margin) and usable[start - 1]:
        start -= 1
    while stop < min(len(usable), interval.stop + margin) and usable[stop]:
        stop += 1
    return Interval(start, stop)


def sudden_steps(step: np.ndarray, notable: float, large: float, ratio: float, neighbours: int = 5) -> np.ndarray:
    """Find steps above ``large``, or above both ``notable`` and ``ratio`` times the motion around the step.

    The motion around a step is the median of ``2 * neighbours + 1`` steps, mirrored at the ends. So a glitch of one or
    two frames does not affect it.

    step: (step,) sizes >= 0 in the unit of ``notable`` and ``large``. Returns (step,) bool.
    """
    if not len(step):
        return np.zeros(0, dtype=bool)
    padded = np.pad(step, neighbours, mode="reflect" if len(step) > neighbours else "edge")
    around = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * neighbours + 1), axis=1)
    return (step > large) | ((step > notable) & (step > ratio * around))


def split_evenly(interval: Interval, longest: int) -> list[Interval]:
    """Split an interval into the fewest intervals of at most ``longest`` frames, about equally long."""
    n_parts = -(-(interval.stop - interval.start) // longest)
    edges = np.linspace(interval.start, interval.stop, n_parts + 1).round().astype(int).tolist()
    return [Interval(start, stop) for start, stop in pairwise(edges)]
