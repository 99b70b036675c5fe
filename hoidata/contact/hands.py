"""Which hands take part in an interaction: the proximity test of Text2HOI (supplement, section 6)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hoidata.contact.proximity import CONTACT_THRESHOLD_M, ProximityIndex
from hoidata.schema import SIDES, Clip, HandType, Side


@dataclass(frozen=True)
class HandEvidence:
    """What the hand type of a clip rests on.

    hand_type: None when neither hand came close. distance_m: per side (frame,), the nearest of 21 joints to any sampled
    point; infinite in frames where the hand is not valid. threshold_m: a hand acts below it.
    """

    hand_type: HandType | None
    distance_m: dict[Side, np.ndarray]
    threshold_m: float

    def closest_m(self, side: Side) -> float:
        """The smallest distance of the clip, infinite when the hand is never valid."""
        return float(self.distance_m[side].min(initial=np.inf))

    def at_threshold(self, threshold_m: float) -> "HandEvidence":
        """The same distances judged by another threshold."""
        acting: dict[Side, bool] = {side: self.closest_m(side) < threshold_m for side in SIDES}
        return HandEvidence(_hand_type(acting), self.distance_m, threshold_m)


def acting_hands(
    clip: Clip,
    joints_m: Mapping[Side, np.ndarray],
    index: ProximityIndex,
    threshold_m: float = CONTACT_THRESHOLD_M,
) -> HandEvidence:
    """Hands of which any joint comes closer than ``threshold_m`` to any sampled point in any valid frame.

    joints_m: per side (frame, 21, 3) in the clip's world, metres. index: over ``sample_points(clip.object.model)``.
    """
    distance: dict[Side, np.ndarray] = {side: _per_frame_m(clip, joints_m[side], index, side) for side in SIDES}
    return HandEvidence(None, distance, threshold_m).at_threshold(threshold_m)


def _per_frame_m(clip: Clip, joints_m: np.ndarray, index: ProximityIndex, side: Side) -> np.ndarray:
    return np.where(clip.hands[side].valid, index.closest_m(joints_m, clip.object), np.inf)


def _hand_type(acting: Mapping[Side, bool]) -> HandType | None:
    if acting["left"] and acting["right"]:
        return "both"
    return next((side for side in SIDES if acting[side]), None)
