"""Distance queries on one object's surface: within a threshold, distance, penetration depth, closest point.

Query positions are in the object frame. Each part is queried in its rest frame, where its surface never changes. So one
index serves all frames of all clips at any hinge angle. All answers are exact. An object with many queries gets a grid
of distances, which only saves tests of triangles.
"""

from collections import OrderedDict
from functools import reduce

import numpy as np

from hoidata.errors import BadInput
from hoidata.objects.distance import SignedDistance, merged_surface
from hoidata.objects.distance_grid import (
    DistanceGrid,
    distance_grid,
    lower_distances,
    mark_within,
    nearest_triangles,
    no_grid,
    sides,
)
from hoidata.objects.line_crossings import INSIDE, settle_sides
from hoidata.objects.model import ObjectModel
from hoidata.objects.solid import NoSolid, Solid
from hoidata.objects.triangle_tree import TriangleTree, triangle_tree

GRID_PAYS_FROM = 1_000_000  # queries; a grid takes 0.1-0.5 s and saves 0.05 us (within) to 0.3 us (depth) per query
ON_SURFACE_M = 1e-6  # below this distance the direction to the surface is rounding, so the triangle's normal is used
MAX_CACHED_TRIANGLES = 1_000_000  # about 200 MB
_indices: OrderedDict[str, "SurfaceIndex"] = OrderedDict()


class PartSurface:
    """Distance queries on one part, in the part's rest frame. The grid is computed after ``grid_after`` queries."""

    def __init__(self, vertices_m: np.ndarray, faces: np.ndarray, closed: bool, grid_after: int) -> None:
        self.tree, self.closed = triangle_tree(vertices_m, faces), closed
        self._grid_after, self._n_queries, self._grid = grid_after, 0, no_grid()

    @property
    def has_grid(self) -> bool:
        """Whether the grid of distances has been computed."""
        return self._grid.value.size > 0

    def grid_for(self, positions_m: np.ndarray) -> DistanceGrid:
        """The grid for a query of these positions; it may have no nodes yet."""
        self._n_queries += len(positions_m)
        return self.grid if self._n_queries > self._grid_after else self._grid

    @property
    def grid(self) -> DistanceGrid:
        """The grid of distances. The first access computes it in 0.1-0.5 s."""
        if not self.has_grid:
            self._grid = distance_grid(self.tree, self.closed)
        return self._grid

    def inside(self, positions_m: np.ndarray) -> np.ndarray:
        """(position,) bool: inside the solid; False if the part bounds no solid."""
        if not self.closed:
            return np.zeros(len(positions_m), bool)
        side = sides(self.tree, self.grid_for(positions_m), positions_m)
        settle_sides(self.tree, positions_m, side)
        return side == INSIDE

    def distance_m(self, positions_m: np.ndarray, most_m: float = np.inf) -> np.ndarray:
        """(position,) distance to the surface, never negative; infinite beyond ``most_m``."""
        distance = np.full(len(positions_m), np.inf)
        lower_distances(self.tree, self.grid_for(positions_m), positions_m, float(most_m), distance)
        return distance

    def signed_m(self, positions_m: np.ndarray, most_m: float = np.inf) -> np.ndarray:
        """(position,) distance to the surface, negative inside; infinite beyond ``most_m`` outside."""
        inside, signed = self.inside(positions_m), np.empty(len(positions_m))
        signed[~inside] = self.distance_m(positions_m[~inside], most_m)
        signed[inside] = -self.distance_m(positions_m[inside])
        return signed

    def nearest(self, positions_m: np.ndarray, most_m: float = np.inf) -> SignedDistance:
        """Signed distance, closest surface point and unit gradient of the distance.

        Positions that are not finite, or outside and farther than ``most_m``, get an infinite distance, and NaN.
        """
        signed = self.signed_m(positions_m, most_m)
        distance = np.abs(signed)
        closest, triangle = np.full((len(positions_m), 3), np.nan), np.zeros(len(positions_m), np.int64)
        nearest_triangles(self.tree, positions_m, distance, closest, triangle)
        offset_m = positions_m - closest
        is_off_surface = distance > ON_SURFACE_M
        gradient = self.tree.triangle[9:12, triangle].T  # the normal, for points on the surface
        gradient[is_off_surface] = offset_m[is_off_surface] / signed[is_off_surface, None]
        return SignedDistance(signed, closest, gradient)


def surface_index(model: ObjectModel) -> "SurfaceIndex":
    """The index of a model, from a cache of the most recently used ones that is keyed by the model's digest."""
    key = model.digest
    if key not in _indices:
        _indices[key] = SurfaceIndex(model)
    _indices.move_to_end(key)
    while len(_indices) > 1 and sum(len(index.model.faces) for index in _indices.values()) > MAX_CACHED_TRIANGLES:
        _indices.popitem(last=False)
    return _indices[key]


class SurfaceIndex:
    """Distance queries on the surface of one object, at the hinge angle of each frame."""

    def __init__(self, model: ObjectModel, grid_after: int = GRID_PAYS_FROM) -> None:
        """Index the parts of a model; each part gets its grid after ``grid_after`` queries.

        Raises BadInput: a part has no triangles.
        """
        self.model = model
        self.solids = model.solids  # by part, the solid that it bounds or the reason why it bounds none
        self.repair_note = _note(model, self.solids)  # repairs, and parts excluded from depths; None without either
        self._surfaces: dict[int, PartSurface] = {}
        self._closed: dict[int, PartSurface] = {}
        for part, solid in self.solids.items():
            if isinstance(solid, Solid):
                self._closed[part] = PartSurface(solid.vertices_m, solid.faces, True, grid_after)
            # Added triangles bound the inside, but are not part of the surface: distances use the original mesh then.
            if isinstance(solid, Solid) and not solid.patched and not _has_cut(model, part):
                self._surfaces[part] = self._closed[part]
            else:
                merged = merged_surface(model.vertices_m, model.faces_of(part))
                self._surfaces[part] = PartSurface(merged.vertices_m, merged.faces, False, grid_after)

    def within(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None, threshold_m: float) -> np.ndarray:
        """Whether each position is closer to the surface than a threshold; False for positions that are not finite.

        Args:
            positions_m: (frame, position, 3), object frame.
            hinge_rad: (frame,) for a hinged object, else None.
            threshold_m: exclusive.

        Returns (frame, position) bool.
        """
        within = np.zeros(positions_m.shape[:2], bool)
        for part, surface in self._surfaces.items():
            positions = self._in_part(positions_m, hinge_rad, part)
            mark_within(surface.tree, surface.grid_for(positions), positions, float(threshold_m), within.reshape(-1))
        return within

    def distance_m(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None, most_m: float = np.inf) -> np.ndarray:
        """(frame, position) float64 unsigned distance to the surface, infinite beyond ``most_m``.

        Arguments as in ``within``.
        """
        distance = np.full(positions_m.shape[:2], np.inf)
        for part, surface in self._surfaces.items():
            positions = self._in_part(positions_m, hinge_rad, part)
            lower_distances(surface.tree, surface.grid_for(positions), positions, float(most_m), distance.reshape(-1))
        return distance

    def depth_m(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None) -> np.ndarray:
        """(frame, position) float64 penetration depth: the distance to the surface inside the solid, 0 outside.

        Inside means a positive winding number: a cavity is outside, and overlapping shells count as one solid. With two
        parts, the larger depth counts. Arguments as in ``within``. Raises BadInput: no part encloses a solid.
        """
        self.check_solid()
        depth = np.zeros(positions_m.shape[:2])
        for part, surface in self._closed.items():
            positions = self._in_part(positions_m, hinge_rad, part)
            inside = np.flatnonzero(surface.inside(positions))
            depth.reshape(-1)[inside] = np.maximum(depth.reshape(-1)[inside], surface.distance_m(positions[inside]))
        return depth

    def nearest(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None, most_m: float = np.inf) -> SignedDistance:
        """Signed distances (frame, position), closest points and gradients (frame, position, 3), object frame.

        Uses ``filled``. With two parts, the smaller signed distance counts. Arguments as in ``within``; positions
        outside and farther than ``most_m`` get an infinite distance, and NaN.
        """
        return reduce(nearer_of, (self._nearest_of(part, positions_m, hinge_rad, most_m) for part in self.filled))

    def _nearest_of(
        self, part: int, positions_m: np.ndarray, hinge_rad: np.ndarray | None, most_m: float
    ) -> SignedDistance:
        nearest = self.filled[part].nearest(self._in_part(positions_m, hinge_rad, part), most_m)
        object_from_part = self.model.object_from_part(part, hinge_rad)
        closest, normal = (array.reshape(positions_m.shape) for array in nearest[1:])
        distance = nearest.distance_m.reshape(positions_m.shape[:2])
        return SignedDistance(distance, object_from_part @ closest, object_from_part.turn(normal))

    @property
    def filled(self) -> dict[int, PartSurface]:
        """By part, the repaired surface of the solid, or the open mesh of a part without a solid."""
        return {part: self._closed.get(part, surface) for part, surface in self._surfaces.items()}

    def prepare(self) -> "SurfaceIndex":
        """Compute all grids now, in 0.1-0.5 s per part, so that no later query waits. Returns self."""
        for surface in {**self._surfaces, **self.filled}.values():
            _ = surface.grid
        return self

    @property
    def solid_trees(self) -> dict[int, TriangleTree]:
        """By part, the triangles of the solid; only parts that bound a solid."""
        return {part: surface.tree for part, surface in self._closed.items()}

    @property
    def is_solid(self) -> bool:
        """Whether some part encloses a solid, so that depths are defined."""
        return bool(self._closed)

    def check_solid(self) -> None:
        """Raise BadInput with the reason if no part encloses a solid."""
        if not self.is_solid:
            why = "; ".join(sorted({solid.why for solid in self.solids.values() if isinstance(solid, NoSolid)}))
            raise BadInput(f"mesh of {self.model.name!r}", "a mesh that encloses a solid", why, "repair the mesh")

    def _in_part(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None, part: int) -> np.ndarray:
        """(frame x position, 3) positions in the part's rest frame."""
        part_from_object = self.model.object_from_part(part, hinge_rad).inverse()
        return np.ascontiguousarray((part_from_object @ np.asarray(positions_m, np.float64)).reshape(-1, 3))


def nearer_of(first: SignedDistance, second: SignedDistance) -> SignedDistance:
    """Of two results for the same positions, the one with the smaller signed distance at each position."""
    nearer = second.distance_m < first.distance_m
    columns = zip(first, second, strict=True)
    return SignedDistance(*(np.where(nearer[(..., *[None] * (a.ndim - nearer.ndim))], b, a) for a, b in columns))


def _has_cut(model: ObjectModel, part: int) -> bool:
    """Whether triangles close the cut between the part and the other part."""
    return len(model.closed_parts[part][1]) > len(model.faces_of(part))


def _note(model: ObjectModel, solids: dict[int, Solid | NoSolid]) -> str | None:
    """Repairs, and parts without an inside, as one sentence; None without either."""
    notes = []
    for part, solid in solids.items():
        name = f"part {part} of {model.name}" if len(solids) > 1 else model.name
        if isinstance(solid, NoSolid):
            notes.append(f"{name} has no inside: {solid.why}")
            continue
        repairs = [*(["cut at the hinge closed"] if _has_cut(model, part) else []), *filter(None, [solid.repairs])]
        if repairs:
            notes.append(f"{name}: {', '.join(repairs)}")
    return "; ".join(notes) or None
