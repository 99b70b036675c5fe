"""Distance of each hand from the object, frame by frame, and the hand type that follows at a threshold.

``hand_distance.npz`` has the distance of each frame, ``hand_type.parquet`` the exact minimum of each clip.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.clips.clip import SIDES, HandType, Side
from hoidata.errors import BadInput, MissingResource
from hoidata.files.arrays import write_npz
from hoidata.store.mapped import map_npz

FIRST_FRAME = "first_frame"
REMEDY = "run the stage annotate again"


@dataclass(frozen=True)
class HandEvidence:
    """The distances of a clip that its hand type follows from."""

    distance_m: dict[Side, np.ndarray]  # (frame,) closest joint to the object; infinite in invalid frames
    threshold_m: float  # a hand is active below it
    smallest_m: dict[Side, float] | None = None  # exact minimum of each side, if ``distance_m`` is rounded

    def closest_m(self, side: Side) -> float:
        """Return the smallest distance of the clip, infinite if the hand is never valid."""
        if self.smallest_m is not None:
            return self.smallest_m[side]
        return float(self.distance_m[side].min(initial=np.inf))

    def near(self, side: Side) -> np.ndarray:
        """Return (frame,) bool: whether the hand is closer than the threshold."""
        return self.distance_m[side] < self.threshold_m

    @property
    def hand_type(self) -> HandType | None:
        """The hands that are closer than the threshold; None if neither is."""
        active: list[HandType] = [side for side in SIDES if self.closest_m(side) < self.threshold_m]
        if len(active) == len(SIDES):
            return "both"
        return active[0] if active else None


class HandDistances:
    """Memory-mapped ``hand_distance.npz`` of the stage annotate: hand distances of all clips of a store.

    Arrays: ``first_frame`` (clip + 1,) int64, first row of each clip in the store's order; ``left_m`` and ``right_m``
    (row,) float32 metres, infinite in invalid frames.
    """

    def __init__(self, path: Path, clips: int) -> None:
        if not path.is_file():
            raise MissingResource(f"{path} is missing: run the stage 'annotate' of this dataset again")
        arrays = map_npz(path)
        names = {FIRST_FRAME, *(f"{side}_m" for side in SIDES)}
        if set(arrays) != names:
            raise BadInput(path, f"arrays {', '.join(sorted(names))}", ", ".join(sorted(arrays)), REMEDY)
        self._first = arrays[FIRST_FRAME]
        if len(self._first) != clips + 1:
            raise BadInput(path, f"distances of {clips} clips", f"of {len(self._first) - 1}", REMEDY)
        self._distance_m: dict[Side, np.ndarray] = {side: arrays[f"{side}_m"] for side in SIDES}
        counts = {side: len(distance) for side, distance in self._distance_m.items()}
        if set(counts.values()) != {int(self._first[-1])}:
            raise BadInput(path, f"{self._first[-1]} frames as {FIRST_FRAME} says", str(counts), REMEDY)

    def of(self, index: int) -> dict[Side, np.ndarray]:
        """Return (frame,) float32 distances of each hand in clip number ``index`` of the store, metres."""
        rows = slice(int(self._first[index]), int(self._first[index + 1]))
        return {side: distance[rows] for side, distance in self._distance_m.items()}


def write_hand_distances(path: Path, evidence: Sequence[HandEvidence]) -> None:
    """Write the distances of all clips, in the store's order. Frame by frame, float32 metres."""
    counts = [len(item.distance_m[SIDES[0]]) for item in evidence]
    arrays = {FIRST_FRAME: np.cumsum([0, *counts], dtype=np.int64)}
    for side in SIDES:
        distances = [np.zeros(0, np.float32), *(item.distance_m[side].astype(np.float32) for item in evidence)]
        arrays[f"{side}_m"] = np.concatenate(distances)
    write_npz(path, arrays)
