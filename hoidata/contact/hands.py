"""Which hands take part in an interaction: the proximity test of Text2HOI (supplement, section 6)."""

from collections.abc import Mapping

import numpy as np

from hoidata.clips import SIDES, Clip, Side
from hoidata.contact.proximity import CONTACT_THRESHOLD_M, ProximityIndex
from hoidata.store.hand_evidence import HandEvidence


def acting_hands(
    clip: Clip,
    joints_m: Mapping[Side, np.ndarray],
    index: ProximityIndex,
    threshold_m: float = CONTACT_THRESHOLD_M,
) -> HandEvidence:
    """Hands of which any joint comes closer than ``threshold_m`` to any sampled point in any valid frame.

    joints_m: per side (frame, 21, 3) in the clip's world, metres. index: over ``sample_points(clip.object.model)``.
    """
    distance: dict[Side, np.ndarray] = {}
    for side in SIDES:
        closest = index.closest_m(joints_m[side], clip.object)
        distance[side] = np.where(clip.hands[side].valid, closest, np.inf)
    return HandEvidence(None, distance, threshold_m).at_threshold(threshold_m)
