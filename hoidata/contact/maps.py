"""Active hands, contact maps and distance maps, one per hand, on the object's sampled points."""

from collections.abc import Mapping

import numpy as np

from hoidata.clips import SIDES, Clip, Side
from hoidata.contact.proximity import CONTACT_THRESHOLD_M, ProximityIndex
from hoidata.errors import BadInput
from hoidata.store.hand_evidence import HandEvidence

LONGEST_CLIP = int(np.iinfo(np.int16).max)


def find_active_hands(
    clip: Clip, joints_m: Mapping[Side, np.ndarray], index: ProximityIndex, threshold_m: float = CONTACT_THRESHOLD_M
) -> HandEvidence:
    """Find the active hands: a joint is closer than ``threshold_m`` to a sampled point in any valid frame.

    The proximity test of Text2HOI (supplement, section 6).

    Args:
        joints_m: by side, (frame, 21, 3) world joints, metres.
        index: index of ``sample_points(clip.object.model)``.
        threshold_m: a hand is active below it.
    """
    distance: dict[Side, np.ndarray] = {}
    for side in SIDES:
        closest = index.closest_m(joints_m[side], clip.object)
        distance[side] = np.where(clip.hands[side].valid, closest, np.inf)
    return HandEvidence(distance, threshold_m)


def distance_entries(
    clip: Clip, joints_m: Mapping[Side, np.ndarray], index: ProximityIndex, threshold_m: float = CONTACT_THRESHOLD_M
) -> dict[Side, np.ndarray]:
    """Return, by hand, all (frame, point, joint) closer than ``threshold_m`` as ``ENTRY`` records.

    Arguments as in ``find_active_hands``. Raises BadInput for clips with more frames than int16 can count.
    """
    if clip.n_frames > LONGEST_CLIP:
        raise BadInput(clip.clip_id, f"at most {LONGEST_CLIP} frames", f"{clip.n_frames}", "cut the sequence")
    return {side: index.entries(joints_m[side], clip.hands[side].valid, clip.object, threshold_m) for side in SIDES}


def touched_frames(entries: np.ndarray, point_count: int) -> np.ndarray:
    """Return (point,) uint16: the number of frames in which a joint of one hand touches the point."""
    touched = np.zeros((int(entries["frame"].max(initial=-1)) + 1, point_count), dtype=bool)
    touched[entries["frame"], entries["point"]] = True
    return touched.sum(axis=0, dtype=np.uint16)


def contact_maps(entries: Mapping[Side, np.ndarray], point_count: int) -> dict[Side, np.ndarray]:
    """Return the contact map of Text2HOI by hand, (point,) uint8. Only active hands have entries."""
    return {side: (touched_frames(entries[side], point_count) > 0).astype(np.uint8) for side in SIDES}


def f1_score(predicted: np.ndarray, true: np.ndarray) -> float:
    """Return the F1 of boolean maps (point,): 2 TP / (2 TP + FP + FN); 1 if both are empty."""
    total = int(predicted.sum()) + int(true.sum())
    return 2 * int((predicted & true).sum()) / total if total else 1.0
