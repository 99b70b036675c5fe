"""Builders of test objects: boxes, trimesh meshes, hinged parts, point clouds."""

from typing import Any

import igl
import numpy as np
import trimesh

from hoidata.objects.distance import merged_surface
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.objects.sampling import SampledPoints

Three = tuple[float, float, float]


def model_of(mesh: Any, name: str = "object") -> ObjectModel:
    """A rigid object of a mesh with ``vertices`` and ``faces``."""
    return ObjectModel(name, np.array(mesh.vertices), np.array(mesh.faces), np.zeros(len(mesh.vertices), np.uint8))


def box_model(size_m: Three = (0.10, 0.08, 0.06), name: str = "box", middle_m: Three = (0.0, 0.0, 0.0)) -> ObjectModel:
    return model_of(trimesh.creation.box(size_m).apply_translation(middle_m), name)


def igl_signed_m(vertices_m: np.ndarray, faces: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """(point,) libigl's signed distances to a closed mesh (vertex, 3), (face, 3)."""
    return igl.signed_distance(points_m, *merged_surface(vertices_m, faces))[0]


def two_parts(
    base: ObjectModel, lid: ObjectModel, axis: Three, origin_m: Three = (0.0, 0.0, 0.0), name: str = "two parts"
) -> ObjectModel:
    """Base and moving part of one object, both in its frame at hinge angle 0."""
    n_base = len(base.vertices_m)
    return ObjectModel(
        name,
        np.concatenate([base.vertices_m, lid.vertices_m]),
        np.concatenate([base.faces, lid.faces + n_base]),
        part=np.repeat(np.array([0, 1], np.uint8), [n_base, len(lid.vertices_m)]),
        hinge=Hinge(np.array(axis, np.float64), np.array(origin_m, np.float64)),
    )


def hinged_box() -> ObjectModel:
    """The box of ``box_model`` with a lid of 1 cm on its -y side that rotates about an edge along x."""
    lid = box_model((0.10, 0.01, 0.06), middle_m=(0, -0.045, 0))
    return two_parts(box_model(), lid, (1, 0, 0), (0, -0.04, -0.03), "hinged_box")


def notebook(thickness_m: float = 0.01) -> ObjectModel:
    """Two plates of 10 x 10 cm side by side; the second rotates about the edge between them, along y."""
    base, lid = (box_model((0.1, 0.1, thickness_m), middle_m=(x, 0, 0)) for x in (-0.05, 0.05))
    return two_parts(base, lid, (0, 1, 0), name="notebook")


def sampled(points_m: np.ndarray, part: np.ndarray | None = None) -> SampledPoints:
    """Sampled points without normals or faces."""
    count, nothing = len(points_m), np.zeros((len(points_m), 3), np.float32)
    part = np.zeros(count, np.uint8) if part is None else part
    return SampledPoints(
        points_m=np.asarray(points_m, np.float32),
        normals=nothing,
        face=np.zeros(count, np.int32),
        barycentric=nothing,
        part=part,
        method="surface-fps",
    )
