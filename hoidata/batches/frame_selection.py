"""Selects the frames and distance entries that geometric losses use in a training step.

A clip of 150 frames has tens of thousands of distance entries and a step uses a few hundred, so only the selected ones
are read.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hoidata.store.distances import DistanceEntries


@dataclass(frozen=True)
class FrameSelection:
    """Selected frames of each clip, and the number of distance entries to sample from them."""

    frames: np.ndarray  # (clip, K) int64, ascending
    at_most: int | None = None  # maximum number of entries, sampled with ``random``; None: all entries
    random: np.random.Generator | None = None

    @classmethod
    def nothing(cls, n_clips: int) -> "FrameSelection":
        return cls(np.zeros((n_clips, 0), np.int64), 0)

    @classmethod
    def drawn(cls, lengths: Sequence[int], count: int, at_most: int, random: np.random.Generator) -> "FrameSelection":
        """Stratified sampling: one frame from each of ``count`` equal intervals of each clip."""
        column = np.asarray(lengths)[:, None]
        frames = ((np.arange(count) + random.random((len(column), count))) / count * column).astype(np.int64)
        return cls(np.minimum(frames, column - 1), at_most, random)

    def entries(self, clips: Sequence[DistanceEntries]) -> tuple[np.ndarray, np.ndarray]:
        """Read the selected frames of entries sorted by frame; with ``at_most``, a uniform sample with replacement.

        Returns (entry, 5) int64 columns clip, side, index in ``frames``, joint, point; and (entry,) distances, metres.
        """
        if not self.frames.shape[1] or self.at_most == 0:
            return np.zeros((0, 5), np.int64), np.zeros(0, np.float32)
        edges = np.stack((self.frames, self.frames + 1), 1).astype(clips[0].frame.dtype)
        bounds = [np.searchsorted(entries.frame, edge) for entries, edge in zip(clips, edges, strict=True)]
        first, stop = np.stack(bounds, 1).reshape(2, -1)
        before = np.concatenate(([0], np.cumsum(stop - first)))
        total = int(before[-1])
        ranks = np.arange(total)
        if self.at_most is not None and total > self.at_most:
            assert self.random is not None  # a limit needs a generator
            ranks = np.sort(self.random.integers(total, size=self.at_most))
        group = np.searchsorted(before, ranks, side="right") - 1
        clip, frame_index = np.divmod(group, self.frames.shape[1])
        entry_index = first[group] + ranks - before[group]
        parts = np.split(entry_index, np.searchsorted(clip, np.arange(1, len(clips))))
        read = {
            name: np.concatenate([getattr(entries, name)[part] for entries, part in zip(clips, parts, strict=True)])
            for name in ("side", "joint", "point", "distance_m")
        }
        columns = (clip, read["side"], frame_index, read["joint"], read["point"])
        return np.stack(columns, axis=1).astype(np.int64, copy=False), read["distance_m"]
