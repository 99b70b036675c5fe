"""The sampled points an object stands for in contact maps and networks: spread evenly, the same on every machine.

Farthest-point sampling (Eldar et al. 1997; PointNet++) as Text2HOI does it, over the mesh vertices where they are dense
enough, else over a dense area-uniform sample of the surface.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rows import distinct_rows
from hoidata.objects.distance import face_normals
from hoidata.objects.farthest import farthest_points
from hoidata.objects.model import SEAM, ObjectModel

POINT_COUNT = 1024
LONGEST_EDGE_M = 0.02
DENSE_FACTOR = 32
# Roberts' R2 sequence: powers of 1/p, p the plastic number (the real root of p^3 = p + 1).
PLASTIC = 1.3247179572447460
SamplingMethod = Literal["vertices-fps", "surface-fps"]


@dataclass(frozen=True)
class SampledPoints:
    """Points on an object's surface, in the object frame with the hinge at zero.

    points_m: (point, 3) float32. normals: (point, 3) float32, unit. face: (point,) int32, the triangle each lies on;
    barycentric: (point, 3) float32, its position there. part: (point,) uint8, 1 where the hinge moves the point.
    """

    points_m: np.ndarray
    normals: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    part: np.ndarray
    method: SamplingMethod

    def __len__(self) -> int:
        return len(self.points_m)


def sample_points(model: ObjectModel, count: int = POINT_COUNT) -> SampledPoints:
    """``count`` points of the object, farthest-point order.

    "vertices-fps": from the vertices, starting at the first, where at least ``count`` distinct ones lie on faces and no
    edge is longer than 2 cm. "surface-fps": from ``32 count`` points spread over the faces in proportion to area.
    Triangles that span both parts of a hinged object hold no point but a vertex.
    Raises BadInput for a mesh without area.
    """
    corners = np.asarray(model.vertices_m, dtype=np.float64)[model.faces]
    if not len(corners) or not np.linalg.norm(_face_cross(corners), axis=1).any():
        raise BadInput(f"mesh of {model.name!r}", "faces with area", f"{len(corners)} faces without", "repair the mesh")
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    distinct = distinct_rows(model.vertices_m[np.unique(model.faces)]).first
    if len(distinct) >= count and edges.max() <= LONGEST_EDGE_M:
        return _from_vertices(model, count)
    return _from_surface(model, corners, count)


def _from_vertices(model: ObjectModel, count: int) -> SampledPoints:
    on_faces = np.unique(model.faces)
    chosen = on_faces[farthest_points(model.vertices_m[on_faces], count)]
    face, corner = _incident_face(model, chosen)
    return SampledPoints(
        points_m=model.vertices_m[chosen].astype(np.float32),
        normals=_vertex_normals(model)[chosen].astype(np.float32),
        face=face.astype(np.int32),
        barycentric=np.eye(3, dtype=np.float32)[corner],
        part=model.part[chosen].astype(np.uint8),
        method="vertices-fps",
    )


def _incident_face(model: ObjectModel, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each vertex the first face it is a corner of (of its own part where there is one), and which corner."""
    vertex = model.faces.reshape(-1)
    face, corner = np.divmod(np.arange(len(vertex)), 3)
    other_part = model.face_part[face] != model.part[vertex]
    order = np.lexsort((face, other_part, vertex))
    first = order[np.searchsorted(vertex[order], vertices)]
    return face[first], corner[first]


def _vertex_normals(model: ObjectModel) -> np.ndarray:
    """(vertex, 3) unit normals: face normals weighted by their angle at the vertex; coinciding vertices share one."""
    corners = np.asarray(model.vertices_m, dtype=np.float64)[model.faces]
    ahead = _unit(np.roll(corners, -1, axis=1) - corners)
    behind = _unit(np.roll(corners, 1, axis=1) - corners)
    angle = np.arccos(np.clip((ahead * behind).sum(axis=2), -1, 1))
    weighted = angle[:, :, None] * face_normals(model.vertices_m, model.faces)[:, None]
    keys = np.column_stack([model.vertices_m, model.part])
    group = distinct_rows(keys).number
    total = np.zeros((len(keys), 3))
    np.add.at(total, group[model.faces.reshape(-1)], weighted.reshape(-1, 3))
    return _unit(total)[group]


def _from_surface(model: ObjectModel, corners: np.ndarray, count: int) -> SampledPoints:
    corners = np.where((model.face_part == SEAM)[:, None, None], corners[:, :1], corners)  # no area, so no point
    face, barycentric = _spread_over_faces(corners, DENSE_FACTOR * count)
    dense = np.einsum("pc,pcx->px", barycentric, corners[face])
    chosen = farthest_points(dense, count)
    face = face[chosen]
    return SampledPoints(
        points_m=dense[chosen].astype(np.float32),
        normals=face_normals(model.vertices_m, model.faces)[face].astype(np.float32),
        face=face.astype(np.int32),
        barycentric=barycentric[chosen].astype(np.float32),
        part=model.face_part[face],
        method="surface-fps",
    )


def _spread_over_faces(corners: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Systematic sample by area (each face gets its share, rounded up or down), placed by the R2 sequence."""
    area = np.cumsum(np.linalg.norm(_face_cross(corners), axis=1))
    step = np.arange(count)
    face = np.searchsorted(area, (step + 0.5) / count * area[-1], side="right")
    u, v = (0.5 + (step[None] + 1) * np.array([[1 / PLASTIC], [1 / PLASTIC**2]])) % 1
    beyond = u + v > 1
    u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
    return face, np.column_stack([1 - u - v, u, v])


def _face_cross(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
