"""Sparse distances between hand joints and sampled object points, as the contact stage keeps them."""

from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class DistanceEntries:
    """Joint-to-point distances below 2 cm, one row per entry.

    side: 0 left, 1 right; frame, joint (0-20), point (0-1023): int64 (entry,); distance_m: float32 (entry,).
    """

    side: np.ndarray
    frame: np.ndarray
    joint: np.ndarray
    point: np.ndarray
    distance_m: np.ndarray

    def select(self, keep: np.ndarray | slice) -> "DistanceEntries":
        """The entries where ``keep`` (entry,) is True, at these rows, or in this slice."""
        return DistanceEntries(**{field.name: getattr(self, field.name)[keep] for field in fields(self)})

    def window(self, start: int, stop: int) -> "DistanceEntries":
        """The entries of frames ``start`` to ``stop`` (exclusive), frames counted from ``start``."""
        inside = self.select((self.frame >= start) & (self.frame < stop))
        return replace(inside, frame=inside.frame - start)

    def interval(self, start: int, stop: int) -> "DistanceEntries":
        """As ``window``, of entries in the order of their frames, most of which are not looked at."""
        first, last = np.searchsorted(self.frame, np.array([start, stop], self.frame.dtype))
        inside = self.select(slice(int(first), int(last)))
        return replace(inside, frame=inside.frame - self.frame.dtype.type(start))
