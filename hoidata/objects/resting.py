"""Stable resting poses of a rigid body on a level surface.

A body rests stably on a face of its convex hull if its centre of mass is above that face (Goldberg et al. 1999). Faces
on which it rolls (the side of a can), and faces from which a light push tips it, are excluded.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from hoidata.objects.mesh import mass_properties

FOOT_M = 0.002  # vertices this close to the support plane carry the body, because scanned undersides are not flat
LEAST_TIP_RAD = np.deg2rad(6)  # a body that topples at a smaller angle is not stable
SAME_SIDE_RAD = np.deg2rad(25)  # hull faces within this angle are one side
WIDEST_SIDE_RAD = np.deg2rad(12)  # a side with a larger spread of normals is round, so the body rolls on it


@dataclass(frozen=True)
class Footing:
    """The stable resting poses of a body, object frame."""

    downs: np.ndarray  # (pose, 3) unit vectors, the direction of gravity in each pose
    outline_m: np.ndarray  # (point, 3) corners of the convex hull
    box_m: np.ndarray  # (2, 3) lowest and highest coordinates


def footing(vertices_m: np.ndarray, faces: np.ndarray) -> Footing:
    """The stable resting poses of a mesh (vertex, 3), (face, 3); a flat or round body has none."""
    box = np.stack((vertices_m.min(axis=0), vertices_m.max(axis=0)))
    try:
        hull = ConvexHull(vertices_m)
    except (QhullError, ValueError):
        return Footing(np.zeros((0, 3)), vertices_m, box)
    centre = mass_properties(vertices_m, faces).centre_m
    outline = vertices_m[hull.vertices]
    corners, normals = vertices_m[hull.simplices], hull.equations[:, :3]
    below = np.flatnonzero(_lies_above(centre, corners, normals))
    firm = np.array([f for f in below if _tip_angle(centre, outline, normals[f]) >= LEAST_TIP_RAD], dtype=int)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    means = [_mean_direction(normals[side], areas[side]) for side in _sides(normals[firm], firm)]
    return Footing(np.array([mean for mean in means if mean is not None]).reshape(-1, 3), outline, box)


def _lies_above(centre: np.ndarray, corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(facet,) whether the centre of mass projects onto the facet; edges count as inside."""
    inside = np.ones(len(corners), dtype=bool)
    height = np.abs(((centre - corners[:, 0]) * normals).sum(axis=1))
    for corner in range(3):
        start, end = corners[:, corner], corners[:, (corner + 1) % 3]
        third = corners[:, (corner + 2) % 3]
        inward = np.cross(normals, end - start)
        # Make the edge's in-plane normal point to the third corner, whatever the order of the facet.
        inward *= np.sign((inward * (third - start)).sum(axis=1, keepdims=True))
        length = np.linalg.norm(inward, axis=1).clip(1e-12)
        inside &= (inward * (centre - start)).sum(axis=1) / length >= -0.01 * height
    return inside


def _tip_angle(centre: np.ndarray, outline: np.ndarray, down: np.ndarray) -> float:
    """Angle by which the body must be tipped until its centre of mass is above the nearest edge of its base."""
    heights = outline @ down
    feet = outline[heights >= heights.max() - FOOT_M]
    across = np.linalg.svd(down[None])[2][1:]  # two axes of the support plane
    try:
        base = ConvexHull(feet @ across.T)
    except (QhullError, ValueError):
        return 0.0
    # Signed distances to the edges of the support polygon are negative inside.
    margin = -(base.equations[:, :2] @ (across @ centre) + base.equations[:, 2]).max()
    return float(np.arctan2(margin, heights.max() - down @ centre))


def _sides(normals: np.ndarray, facets: np.ndarray) -> list[np.ndarray]:
    """Group facets into sides: single linkage of normals within SAME_SIDE_RAD."""
    count, side = connected_components(normals @ normals.T >= np.cos(SAME_SIDE_RAD))
    return [facets[side == number] for number in range(count)]


def _mean_direction(normals: np.ndarray, areas: np.ndarray) -> np.ndarray | None:
    if (normals @ normals.T).min() < np.cos(WIDEST_SIDE_RAD):
        return None
    mean = (normals * areas[:, None]).sum(axis=0)
    return mean / np.linalg.norm(mean)
