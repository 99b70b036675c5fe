"""What the hand type of a clip rests on: how near each hand came, frame by frame, judged at any threshold.

``hand_distance.npz`` holds the frames, 8 bytes each for both hands; ``hand_type.parquet`` the exact minima of each
clip, from which hand types at other thresholds follow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.clips.clip import SIDES, HandType, Side
from hoidata.errors import BadInput, MissingResource
from hoidata.files.arrays import write_npz
from hoidata.files.written import read_table
from hoidata.store.mapped import map_npz

FIRST_FRAME = "first_frame"
REMEDY = "run the stage annotate again"


@dataclass(frozen=True)
class HandEvidence:
    """hand_type: None when neither hand came close. distance_m: per side (frame,), the nearest of 21 joints to any
    sampled point of the object, or to its surface; infinite in frames where the hand is not valid. threshold_m: a hand
    acts below it. smallest_m: the smallest distance of each side where ``distance_m`` is rounded.
    """

    hand_type: HandType | None
    distance_m: dict[Side, np.ndarray]
    threshold_m: float
    smallest_m: dict[Side, float] | None = None

    def closest_m(self, side: Side) -> float:
        """The smallest distance of the clip, infinite when the hand is never valid."""
        if self.smallest_m is not None:
            return self.smallest_m[side]
        return float(self.distance_m[side].min(initial=np.inf))

    def near(self, side: Side) -> np.ndarray:
        """(frame,) bool: the hand is nearer than the threshold, the same test as the clip's for one frame."""
        return self.distance_m[side] < self.threshold_m

    def at_threshold(self, threshold_m: float) -> "HandEvidence":
        """The same distances judged by another threshold."""
        found = hand_type_of({side: self.closest_m(side) for side in SIDES}, threshold_m)
        return HandEvidence(found, self.distance_m, threshold_m, self.smallest_m)


def hand_type_of(closest_m: Mapping[Side, float], threshold_m: float) -> HandType | None:
    """The hands nearer than a threshold; None when neither is."""
    acting: list[HandType] = [side for side in SIDES if closest_m[side] < threshold_m]
    if len(acting) == len(SIDES):
        return "both"
    return acting[0] if acting else None


class HandDistances:
    """The distances of every clip of a store, as the stage annotate keeps them (``hand_distance.npz``), mapped.

    first_frame: (clip + 1,) int64, the rows of each clip in the store's order; left_m, right_m: (row,) float32 metres,
    infinite where the hand is not valid. Rounded to float32: 1 nm at 2 cm.
    """

    def __init__(self, path: Path, clips: int) -> None:
        if not path.is_file():
            raise MissingResource(f"{path} is not there: run the stage 'annotate' of this dataset again")
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

    def of(self, row: int) -> dict[Side, np.ndarray]:
        """Per side (frame,) float32 distances of the ``row``-th clip of the store, metres."""
        rows = slice(int(self._first[row]), int(self._first[row + 1]))
        return {side: distance[rows] for side, distance in self._distance_m.items()}


def write_hand_distances(path: Path, evidence: Sequence[HandEvidence]) -> None:
    """Per-frame distances of every clip, in the store's order, float32 metres."""
    counts = [len(item.distance_m[SIDES[0]]) for item in evidence]
    arrays: dict[str, np.ndarray] = {
        FIRST_FRAME: np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64)
    }
    for side in SIDES:
        arrays[f"{side}_m"] = np.concatenate(
            [np.zeros(0, np.float32), *(item.distance_m[side].astype(np.float32) for item in evidence)]
        )
    write_npz(path, arrays)


def hand_types_at(annotation: str | Path, threshold_m: float) -> dict[str, HandType | None]:
    """Hand type of every clip of an annotation folder at another threshold, by clip id; None: neither hand is near.

    The same as the stage gives when it runs with that threshold: it rests on the exact minima the stage kept. Raises
    BadInput for a threshold that is no length.
    """
    if not threshold_m > 0:
        raise BadInput("threshold_m", "metres above 0", repr(threshold_m), "give a length such as 0.02")
    minima = {side: f"min_{side}_m" for side in SIDES}
    table = read_table(Path(annotation) / "hand_type.parquet", ["clip_id", *minima.values()])
    found: dict[str, HandType | None] = {}
    for clip_id, *values in table.itertuples(index=False):
        closest: dict[Side, float] = dict(zip(SIDES, (float(value) for value in values), strict=True))
        found[clip_id] = hand_type_of(closest, threshold_m)
    return found
