"""How a rigid body can stand on a level surface: on which of its sides, and which way down is then.

A body rests stably on a face of its convex hull when its centre of mass lies above that face (Goldberg et al. 1999).
Faces it would roll over (the mantle of a can) or that the lightest push tips it from are left out.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from hoidata.objects.mesh import mass_properties

FOOT_M = 0.002  # vertices so near to the support plane carry the body: scanned undersides are not flat
LEAST_TIP_RAD = np.deg2rad(6)  # a body that topples when tipped by less does not stand by itself
SAME_SIDE_RAD = np.deg2rad(25)
WIDEST_SIDE_RAD = np.deg2rad(12)  # neighbouring faces that together turn farther are round: the body rolls on them


@dataclass(frozen=True)
class Footing:
    """How a body can stand. All in the object frame, metres.

    downs: (way, 3) unit vectors, each pointing straight down when the body stands that way. outline_m: (point, 3)
    corners of the convex hull. box_m: (2, 3) lowest and highest coordinates.
    """

    downs: np.ndarray
    outline_m: np.ndarray
    box_m: np.ndarray


def footing(vertices_m: np.ndarray, faces: np.ndarray) -> Footing:
    """The stable sides of a mesh, vertices (vertex, 3) and faces (face, 3).

    No way to stand, downs (0, 3), for a body without volume or one that rolls on every side.
    """
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
    """(facet,) whether the centre, moved along the facet's normal, meets the triangle; edges count as inside."""
    inside = np.ones(len(corners), dtype=bool)
    height = np.abs(((centre - corners[:, 0]) * normals).sum(axis=1))
    for corner in range(3):
        start, end = corners[:, corner], corners[:, (corner + 1) % 3]
        third = corners[:, (corner + 2) % 3]
        inward = np.cross(normals, end - start)
        inward *= np.sign((inward * (third - start)).sum(axis=1, keepdims=True))
        length = np.linalg.norm(inward, axis=1).clip(1e-12)
        inside &= (inward * (centre - start)).sum(axis=1) / length >= -0.01 * height
    return inside


def _tip_angle(centre: np.ndarray, outline: np.ndarray, down: np.ndarray) -> float:
    """How far the body must be tipped until it falls: its centre over the nearest edge of what it stands on."""
    heights = outline @ down
    feet = outline[heights >= heights.max() - FOOT_M]
    across = np.linalg.svd(down[None])[2][1:]
    try:
        base = ConvexHull(feet @ across.T)
    except (QhullError, ValueError):
        return 0.0
    margin = -(base.equations[:, :2] @ (across @ centre) + base.equations[:, 2]).max()
    return float(np.arctan2(margin, heights.max() - down @ centre))


def _sides(normals: np.ndarray, facets: np.ndarray) -> list[np.ndarray]:
    """Facets grouped into sides: each less than SAME_SIDE_RAD from another one of its side."""
    count, side = connected_components(normals @ normals.T >= np.cos(SAME_SIDE_RAD))
    return [facets[side == number] for number in range(count)]


def _mean_direction(normals: np.ndarray, areas: np.ndarray) -> np.ndarray | None:
    if (normals @ normals.T).min() < np.cos(WIDEST_SIDE_RAD):
        return None
    mean = (normals * areas[:, None]).sum(axis=0)
    return mean / np.linalg.norm(mean)
