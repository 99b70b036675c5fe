"""Hands from generated keypoints, fitted and refined against the object; generated hands that hold what they touch."""

from hoidata.refinement.fitting import GeneratedHand, fit_hands
from hoidata.refinement.holding import HoldSettings, carried_share, hold_clip, hold_hands
from hoidata.refinement.refining import RefinementSettings, refine_hands

__all__ = [
    "GeneratedHand",
    "HoldSettings",
    "RefinementSettings",
    "carried_share",
    "fit_hands",
    "hold_clip",
    "hold_hands",
    "refine_hands",
]
