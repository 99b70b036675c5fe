"""Faults of object meshes: holes, no enclosed volume, several shells, degenerate triangles."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from hoidata.geometry.rows import distinct_rows
from hoidata.objects.distance import unmatched_edges, volume_m3
from hoidata.objects.model import ObjectModel

SLIVER = 1e-6  # twice the area over the longest edge squared


@dataclass(frozen=True)
class SurfaceFacts:
    """Facts of one surface, with coinciding vertices merged and collapsed triangles removed."""

    open_edge_share: float  # fraction of directed edges without exactly one opposite; 0: watertight and oriented
    volume_m3: float  # enclosed volume, negative if the surface is inside out
    hull_m3: float  # volume of the convex hull
    shells: int  # connected components
    degenerate_share: float  # fraction of triangles that are collapsed or slivers

    @property
    def unfilled_share(self) -> float:
        """1 - volume / convex hull: 1 for a surface that encloses no volume, above 1 for one that is inside out."""
        return 1.0 - self.volume_m3 / self.hull_m3 if self.hull_m3 > 0 else 1.0


def surface_facts(vertices_m: np.ndarray, faces: np.ndarray) -> SurfaceFacts:
    """Measure the mesh (vertex, 3), (face, 3), metres."""
    vertices = np.asarray(vertices_m, dtype=np.float64)
    first, number = distinct_rows(vertices)
    unique, merged = vertices[first], number[faces]
    a, b, c = merged.T
    triangles = merged[(a != b) & (b != c) & (c != a)]
    return SurfaceFacts(
        open_edge_share=_open_edge_share(triangles),
        volume_m3=volume_m3(unique, triangles),
        hull_m3=_hull_volume(unique[np.unique(triangles)]),
        shells=_shells(triangles),
        degenerate_share=float(_is_degenerate(unique[merged]).mean()),
    )


def part_facts(model: ObjectModel) -> dict[int, SurfaceFacts]:
    """Measure each part, with the cut at the hinge closed. A rigid object has part 0 only."""
    return {part: surface_facts(*mesh) for part, mesh in model.closed_parts.items()}


def _open_edge_share(faces: np.ndarray) -> float:
    if not len(faces):
        return 1.0
    return float(np.maximum(unmatched_edges(faces)[1], 0).sum() / (3 * len(faces)))


def _hull_volume(vertices_m: np.ndarray) -> float:
    try:
        return float(ConvexHull(vertices_m).volume)
    except (QhullError, ValueError):  # flat, or fewer than four points
        return 0.0


def _shells(faces: np.ndarray) -> int:
    if not len(faces):
        return 0
    used, corner = np.unique(faces, return_inverse=True)
    a, b, c = corner.reshape(-1, 3).T
    links = coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, c])), shape=(len(used), len(used)))
    return int(connected_components(links, directed=False)[0])


def _is_degenerate(corners_m: np.ndarray) -> np.ndarray:
    """Return (face,) bool of triangles (face, 3, 3): whether they are slivers."""
    edges = np.roll(corners_m, -1, axis=1) - corners_m
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return area <= SLIVER * longest**2
