"""Fitting of hands to generated keypoints, refinement against the object, and contact refinement of grasps."""

from hoidata.refinement.fitting import GeneratedKeypoints, fit_hands
from hoidata.refinement.holding import GraspSettings, carried_fraction, refine_grasps, refined_tracks
from hoidata.refinement.refining import RefinementSettings, refine_hands

__all__ = [
    "GeneratedKeypoints",
    "GraspSettings",
    "RefinementSettings",
    "carried_fraction",
    "fit_hands",
    "refine_grasps",
    "refine_hands",
    "refined_tracks",
]
