"""Contact maps and distance maps on the sampled points of a clip's object, one per hand."""

from collections.abc import Mapping

import numpy as np

from hoidata.clips import SIDES, Clip, Side
from hoidata.contact.proximity import CONTACT_THRESHOLD_M, ProximityIndex
from hoidata.errors import BadInput

LONGEST_CLIP = int(np.iinfo(np.int16).max)


def distance_entries(
    clip: Clip,
    joints_m: Mapping[Side, np.ndarray],
    index: ProximityIndex,
    threshold_m: float = CONTACT_THRESHOLD_M,
) -> dict[Side, np.ndarray]:
    """Per hand every (frame, point, joint) closer than ``threshold_m``, with its distance, as rows of ``ENTRY``.

    joints_m: per side (frame, 21, 3) in the clip's world. Raises BadInput for clips longer than int16 can count.
    """
    if clip.n_frames > LONGEST_CLIP:
        raise BadInput(clip.clip_id, f"at most {LONGEST_CLIP} frames", f"{clip.n_frames}", "cut the sequence")
    return {side: index.entries(joints_m[side], clip.hands[side].valid, clip.object, threshold_m) for side in SIDES}


def touched_frames(entries: np.ndarray, point_count: int) -> np.ndarray:
    """(point,) uint16: in how many frames a joint of this hand is as close to the point as entries are."""
    touched = np.zeros((int(entries["frame"].max(initial=-1)) + 1, point_count), dtype=bool)
    touched[entries["frame"], entries["point"]] = True
    return touched.sum(axis=0, dtype=np.uint16)


def contact_maps(entries: Mapping[Side, np.ndarray], point_count: int) -> dict[Side, np.ndarray]:
    """Per hand Text2HOI's map (point,) uint8. A hand with an entry acts, so the union needs no hand type."""
    return {side: (touched_frames(entries[side], point_count) > 0).astype(np.uint8) for side in SIDES}
