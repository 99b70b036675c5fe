"""How near each hand came, kept frame by frame, so that another threshold needs no new distances.

``hand_distance.npz`` holds the frames (read by ``hoidata.store.hand_evidence.HandDistances``), 8 bytes each for both
hands; ``hand_type.parquet`` the exact minima of each clip, from which hand types at other thresholds follow.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hoidata.clips import SIDES, HandType, Side
from hoidata.errors import BadInput
from hoidata.files.arrays import write_npz
from hoidata.files.written import read_table
from hoidata.store.hand_evidence import FIRST_FRAME, HandEvidence, hand_type_of


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
