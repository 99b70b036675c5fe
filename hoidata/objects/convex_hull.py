"""The convex hull of an object, which fills hollow objects."""

from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hoidata.objects.model import ObjectModel


def convex_hull(model: ObjectModel) -> ObjectModel:
    """Replace each part by its convex hull; a flat part is unchanged."""
    faces = [_hull_faces(model, part) for part in model.parts]
    return replace(model, faces=np.concatenate(faces))


def _hull_faces(model: ObjectModel, part: int) -> np.ndarray:
    """(face, 3) vertex indices of a part's convex hull, oriented outward."""
    part_faces = model.faces_of(part)
    vertex_ids = np.unique(part_faces)
    try:
        hull = ConvexHull(model.vertices_m[vertex_ids])
    except QhullError:
        return part_faces
    corners = model.vertices_m[vertex_ids][hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normal * hull.equations[:, :3]).sum(axis=1) < 0
    simplices = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return vertex_ids[simplices].astype(part_faces.dtype)
