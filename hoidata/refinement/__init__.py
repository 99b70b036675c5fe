"""Fitting of hands to generated keypoints, refinement against the object, and contact refinement of grasps."""

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
