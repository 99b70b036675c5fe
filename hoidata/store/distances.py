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

    def select(self, keep: np.ndarray) -> "DistanceEntries":
        """The entries where ``keep`` (entry,) is True."""
        return DistanceEntries(**{field.name: getattr(self, field.name)[keep] for field in fields(self)})

    def window(self, start: int, stop: int) -> "DistanceEntries":
        """The entries of frames ``start`` to ``stop`` (exclusive), frames counted from ``start``."""
        inside = self.select((self.frame >= start) & (self.frame < stop))
        return replace(inside, frame=inside.frame - start)
