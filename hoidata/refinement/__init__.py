"""Fitting of hands to generated keypoints, refinement against the object, and contact refinement of grasps."""

from hoidata.refinement.contact import carried_fraction, refine_grasps
from hoidata.refinement.fitting import GeneratedKeypoints, fit_hands
from hoidata.refinement.refining import refine_hands
from hoidata.refinement.released import refine_as_released

__all__ = [
    "GeneratedKeypoints",
    "carried_fraction",
    "fit_hands",
    "refine_as_released",
    "refine_grasps",
    "refine_hands",
]
