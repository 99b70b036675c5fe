"""Windows of a path: cut from it, told what a network needs to know of them, and put together again."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from models.bimart.network import DenoiserConfig, Windows
from models.bimart.scene import Scene


@dataclass(frozen=True)
class Layout:
    """Where windows of ``length`` frames lie on a path of ``frames``; each half on the next one, or apart."""

    frames: int
    length: int
    overlapping: bool = True

    @cached_property
    def starts(self) -> list[int]:
        """First frames; only the last of windows that lie apart may reach beyond the path."""
        if not self.overlapping:
            return list(range(0, self.frames, self.length))
        last = max(self.frames - self.length, 0)
        return [*range(0, last, max(self.length // 2, 1)), last]

    def cut(self, path: Tensor) -> Tensor:
        """(B, frame, ...) to windows (B n, length, ...), zeros beyond the end."""
        spare = max(self.starts[-1] + self.length - self.frames, 0)
        padded = functional.pad(path.flatten(2), (0, 0, 0, spare)).unflatten(2, path.shape[2:])
        return torch.stack([padded[:, start : start + self.length] for start in self.starts], 1).flatten(0, 1)

    def joined(self, windows: Tensor) -> Tensor:
        """The path (B, frame, D) of windows (B n, length, D): the mean where they overlap, less towards their ends."""
        own = windows.unflatten(0, (-1, len(self.starts)))
        total = own.new_zeros(len(own), self.starts[-1] + self.length, own.shape[-1])
        weight = total.new_zeros(total.shape[1], 1)
        place = torch.arange(self.length, device=own.device, dtype=own.dtype)
        ramp = torch.minimum(place + 1, self.length - place)[:, None]
        for number, start in enumerate(self.starts):
            total[:, start : start + self.length] += ramp * own[:, number]
            weight[start : start + self.length] += ramp
        return (total / weight.clamp_min(1e-9))[:, : self.frames]


def layout_of(frames: int, window: int, overlapping: bool) -> Layout:
    """Windows on a path; a path shorter than a window is one, as long as it is."""
    return Layout(frames, min(window, frames), overlapping)


@dataclass(frozen=True)
class Asked:
    """Frames start to stop of a scene, with the hands (2,) that take part."""

    scene: Scene
    start: int
    stop: int
    hands: np.ndarray


def windows_of(asked: Sequence[Asked], length: int, config: DenoiserConfig) -> Windows:
    """What a network is told of windows, padded to ``length``."""

    def padded(rows: np.ndarray) -> np.ndarray:
        return np.concatenate((rows, np.zeros((length - len(rows), *rows.shape[1:]), rows.dtype)))

    stops = [min(one.stop, len(one.scene)) for one in asked]
    states = [one.scene.state(config.features.state, one.start, stop) for one, stop in zip(asked, stops, strict=True)]
    offsets = [
        one.scene.offset[one.start : stop].reshape(stop - one.start, -1) for one, stop in zip(asked, stops, strict=True)
    ]
    arrays = (
        np.stack([padded(rows.astype(np.float32)) for rows in offsets]),
        np.stack([padded(rows.astype(np.float32)) for rows in states]),
        np.array([one.scene.scale for one in asked], np.float32),
        np.stack([one.scene.there for one in asked]),
        np.stack([one.hands if config.told else np.ones(2, bool) for one in asked]),
        np.arange(length) < (np.array(stops) - [one.start for one in asked])[:, None],
    )
    return Windows(*(torch.from_numpy(array) for array in arrays))
