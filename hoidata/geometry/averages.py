"""Means of rigid transforms, and outliers in a recording at rest."""

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.geometry.transform import RigidTransform

MEDIAN_ITERATIONS, MIN_ANGLE_RAD = 20, 1e-6


def mean_transform(transforms: RigidTransform) -> RigidTransform:
    """The mean rotation and the mean translation of transforms (frame,)."""
    rotation = Rotation.from_matrix(transforms.rotation).mean().as_matrix()
    return RigidTransform(rotation, transforms.translation.mean(axis=0))


def is_near_median(transforms: RigidTransform, max_distance_m: float, max_angle_rad: float) -> np.ndarray:
    """(frame,) whether a transform differs from the median of all by at most a distance and an angle.

    The median of positions is that of each coordinate. The median of rotations has the least sum of angles; Weiszfeld's
    algorithm finds it (Hartley et al. 2011, L1 rotation averaging).
    """
    rotations, position_m = Rotation.from_matrix(transforms.rotation), transforms.translation
    angle_rad = np.ones(len(position_m))
    for _ in range(MEDIAN_ITERATIONS):
        median = rotations.mean(1 / np.maximum(angle_rad, MIN_ANGLE_RAD))
        angle_rad = (median.inv() * rotations).magnitude()
    distance_m = np.linalg.norm(position_m - np.median(position_m, axis=0), axis=1)
    return (distance_m <= max_distance_m) & (angle_rad <= max_angle_rad)
