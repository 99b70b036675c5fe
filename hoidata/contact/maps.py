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


def touched_frames(entries: np.ndarray, point_count: int, threshold_m: float | None = None) -> np.ndarray:
    """(point,) uint16: in how many frames a joint of this hand is closer than ``threshold_m`` to the point.

    None takes every entry, that is the threshold they were found with.
    """
    near = entries if threshold_m is None else entries[entries["distance_m"].astype(np.float64) < threshold_m]
    frame_count = int(near["frame"].max(initial=-1)) + 1
    return frame_contact(near, frame_count, point_count).sum(axis=0, dtype=np.uint16)


def contact_map(entries: np.ndarray, point_count: int, threshold_m: float | None = None) -> np.ndarray:
    """(point,) uint8: 1 where a joint of this hand is closer than ``threshold_m`` in any frame, Text2HOI's map."""
    return (touched_frames(entries, point_count, threshold_m) > 0).astype(np.uint8)


def contact_maps(
    entries: Mapping[Side, np.ndarray], point_count: int, threshold_m: float | None = None
) -> dict[Side, np.ndarray]:
    """Per hand its clip-level binary map (point,) uint8. A hand with an entry acts, so the union needs no hand type."""
    return {side: contact_map(entries[side], point_count, threshold_m) for side in SIDES}


def frame_contact(entries: np.ndarray, frame_count: int, point_count: int) -> np.ndarray:
    """(frame, point) bool: the per-frame contact map of one hand at the threshold the entries were found with."""
    touched = np.zeros((frame_count, point_count), dtype=bool)
    touched[entries["frame"], entries["point"]] = True
    return touched


def dense_distances(entries: np.ndarray, frame_count: int, point_count: int, joint_count: int = 21) -> np.ndarray:
    """(frame, point, joint) float32 distance map of one hand, metres; infinite where there is no entry."""
    dense = np.full((frame_count, point_count, joint_count), np.inf, dtype=np.float32)
    dense[entries["frame"], entries["point"], entries["joint"]] = entries["distance_m"]
    return dense
