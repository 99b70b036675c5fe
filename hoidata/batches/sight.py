"""Which frames and distance entries of its clips a training step sees: chosen first, so that nothing else is read.

A clip of 150 frames has tens of thousands of distance entries; a step uses a few hundred of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hoidata.store.distances import DistanceEntries


@dataclass(frozen=True)
class Sight:
    """frames: (clip, K) int64, ascending. at_most: how many entries of those frames, drawn by ``random``; None: all."""

    frames: np.ndarray
    at_most: int | None = None
    random: np.random.Generator | None = None

    @classmethod
    def nothing(cls, n_clips: int) -> "Sight":
        return cls(np.zeros((n_clips, 0), np.int64), 0)

    @classmethod
    def everything(cls, lengths: Sequence[int]) -> "Sight":
        """All frames of the longest clip, and all entries."""
        return cls(np.tile(np.arange(max(lengths)), (len(lengths), 1)))

    @classmethod
    def drawn(cls, lengths: Sequence[int], count: int, at_most: int, random: np.random.Generator) -> "Sight":
        """``count`` frames of each clip, one drawn from each of as many equal stretches of it."""
        own = np.asarray(lengths)[:, None]
        frames = ((np.arange(count) + random.random((len(own), count))) / count * own).astype(np.int64)
        return cls(np.minimum(frames, own - 1), at_most, random)

    def entries(self, clips: Sequence[DistanceEntries]) -> tuple[np.ndarray, np.ndarray]:
        """(entry, 5) int64 rows (clip, side, place in ``frames``, joint, point) and their distances (entry,), metres.

        Every entry is drawn alike, each time anew. clips: their entries in the order of frames.
        """
        if not self.frames.shape[1] or self.at_most == 0:
            return np.zeros((0, 5), np.int64), np.zeros(0, np.float32)
        edges = np.stack((self.frames, self.frames + 1), 1).astype(clips[0].frame.dtype)
        bounds = [np.searchsorted(own.frame, edge) for own, edge in zip(clips, edges, strict=True)]
        first, stop = np.stack(bounds, 1).reshape(2, -1)
        before = np.concatenate(([0], np.cumsum(stop - first)))
        total = int(before[-1])
        ranks = np.arange(total)
        if self.at_most is not None and total > self.at_most:
            assert self.random is not None  # whoever limits entries says what draws them
            ranks = np.sort(self.random.integers(total, size=self.at_most))
        group = np.searchsorted(before, ranks, side="right") - 1
        clip, place = np.divmod(group, self.frames.shape[1])
        row = first[group] + ranks - before[group]
        parts = np.split(row, np.searchsorted(clip, np.arange(1, len(clips))))
        read = {
            name: np.concatenate([getattr(own, name)[part] for own, part in zip(clips, parts, strict=True)])
            for name in ("side", "joint", "point", "distance_m")
        }
        columns = (clip, read["side"], place, read["joint"], read["point"])
        return np.stack(columns, axis=1).astype(np.int64, copy=False), read["distance_m"]
