"""Sparse distances between hand joints and sampled object points, as the contact stage stores them."""

from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class DistanceEntries:
    """Joint-to-point distances below the contact threshold, arrays (entry,)."""

    side: np.ndarray  # int64: 0 left, 1 right
    frame: np.ndarray  # int64
    joint: np.ndarray  # int64: 0-20
    point: np.ndarray  # int64: 0-1023
    distance_m: np.ndarray  # float32

    def select(self, keep: np.ndarray | slice) -> "DistanceEntries":
        """Return the entries where ``keep`` (entry,) is True, at these indices, or in this slice."""
        return DistanceEntries(**{field.name: getattr(self, field.name)[keep] for field in fields(self)})

    def window(self, start: int, stop: int) -> "DistanceEntries":
        """Return the entries of frames ``start`` to ``stop`` (exclusive), with frames relative to ``start``."""
        inside = self.select((self.frame >= start) & (self.frame < stop))
        return replace(inside, frame=inside.frame - start)

    def interval(self, start: int, stop: int) -> "DistanceEntries":
        """Like ``window``, but faster: entries must be sorted by frame."""
        first, last = np.searchsorted(self.frame, np.array([start, stop], self.frame.dtype))
        inside = self.select(slice(int(first), int(last)))
        return replace(inside, frame=inside.frame - self.frame.dtype.type(start))
