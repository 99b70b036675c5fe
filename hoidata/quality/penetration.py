"""How deep hands lie inside the object, where its mesh is solid enough to have an inside.

The same depth as the metrics' (``hoidata.objects.surface_index``): of the deepest vertex, to the nearest surface. It is
asked of libigl here because the two differ in the last bit (1e-17 m), and quality's outputs are to keep their bytes.
"""

from collections.abc import Collection

import numpy as np

from hoidata.objects.distance import signed_distance
from hoidata.objects.model import ObjectModel


def depths_m(
    model: ObjectModel, hinge_rad: np.ndarray | None, points_m: np.ndarray, parts: Collection[int]
) -> np.ndarray:
    """(frame,) depth of the deepest point inside the object, metres; 0 outside.

    hinge_rad: (frame,) for an articulated object: the moving part is met in its rest frame.
    points_m: (frame, point, 3) object frame. parts: those that are solid.
    """
    depth = np.zeros(len(points_m))
    for part in parts:
        local = model.object_from_part(part, hinge_rad).inverse() @ points_m
        depth = np.maximum(depth, _depths_in(*model.filled_part(part), local))
    return depth


def _depths_in(vertices_m: np.ndarray, faces: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Only points inside the bounding box can be inside the mesh: the others are never looked up."""
    used = vertices_m[np.unique(faces)]
    maybe = ((points_m > used.min(axis=0)) & (points_m < used.max(axis=0))).all(axis=-1)
    depth = np.zeros(points_m.shape[:2])
    if maybe.any():
        depth[maybe] = np.maximum(-signed_distance(vertices_m, faces, points_m[maybe]).distance_m, 0.0)
    return depth.max(axis=1)
