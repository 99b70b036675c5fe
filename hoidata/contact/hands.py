"""Which hands take part in an interaction: the proximity test of Text2HOI (supplement, section 6)."""

from collections.abc import Mapping

import numpy as np

from hoidata.clips import SIDES, Clip, Side
from hoidata.contact.proximity import CONTACT_THRESHOLD_M, ProximityIndex
from hoidata.errors import BadInput
from hoidata.objects.surface_index import SurfaceIndex
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
    distance: dict[Side, np.ndarray] = {side: _per_frame_m(clip, joints_m[side], index, side) for side in SIDES}
    return HandEvidence(None, distance, threshold_m).at_threshold(threshold_m)


def _per_frame_m(clip: Clip, joints_m: np.ndarray, index: ProximityIndex, side: Side) -> np.ndarray:
    return np.where(clip.hands[side].valid, index.closest_m(joints_m, clip.object), np.inf)


def acting_hands_at_surface(
    clip: Clip,
    joints_m: Mapping[Side, np.ndarray],
    index: SurfaceIndex,
    threshold_m: float = CONTACT_THRESHOLD_M,
    most_m: float = np.inf,
) -> HandEvidence:
    """The same test against the object's surface instead of sampled points of it, exact at every hinge angle.

    joints_m: as in ``acting_hands``. index: ``surface_index(clip.object.model)``. most_m: larger distances are given as
    infinite, which is faster; at least ``threshold_m``. Distances count from the surface on either side of it.
    """
    if most_m < threshold_m:
        raise BadInput("most_m", f"at least the threshold, {threshold_m:g} m", f"{most_m:g} m")
    distance: dict[Side, np.ndarray] = {}
    for side in SIDES:
        places = clip.object.world_from_object.inverse() @ joints_m[side].astype(np.float64)
        nearest = index.distance_m(places, clip.object.hinge_rad, most_m).min(axis=1, initial=np.inf)
        distance[side] = np.where(clip.hands[side].valid, nearest, np.inf)
    return HandEvidence(None, distance, threshold_m).at_threshold(threshold_m)
