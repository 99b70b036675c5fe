"""Hands from generated keypoints: fitted, then refined against the object as one motion of any length."""

from hoidata.refinement.fitting import GeneratedHand, fit_hands
from hoidata.refinement.refining import RefinementSettings, refine_hands

__all__ = ["GeneratedHand", "RefinementSettings", "fit_hands", "refine_hands"]
