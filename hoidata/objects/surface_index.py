"""One object's surface, ready for many questions: is a point nearer than a threshold, how far is it, how deep inside.

Positions are in the object frame; each part answers in its own rest frame, where its surface never changes, so one
index serves every frame of every clip at every hinge angle. All answers are exact: a grid of distances only saves
looking at triangles, and is made when an object is asked about so often that this pays.
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

GRID_PAYS_FROM = 1_000_000  # positions; a grid takes 0.1-0.5 s and saves 0.05 us (within) to 0.3 us (depth) on each
ON_SURFACE_M = 1e-6  # nearer than this the direction to the surface is rounding; the triangle's normal is used
MOST_TRIANGLES_KEPT = 1_000_000  # in memory, about 200 MB
_indices: OrderedDict[str, "SurfaceIndex"] = OrderedDict()


class PartSurface:
    """One part's triangles in a tree, and their grid once it pays. Positions are in the part's rest frame."""

    def __init__(self, vertices_m: np.ndarray, faces: np.ndarray, closed: bool, grid_from: int) -> None:
        self.tree, self.closed = triangle_tree(vertices_m, faces), closed
        self._grid_from, self._asked, self._grid = grid_from, 0, no_grid()

    @property
    def has_grid(self) -> bool:
        return self._grid.value.size > 0

    def grid_for(self, positions_m: np.ndarray) -> DistanceGrid:
        """The grid to answer about these positions with."""
        self._asked += len(positions_m)
        return self.grid if self._asked > self._grid_from else self._grid

    @property
    def grid(self) -> DistanceGrid:
        """Made when it is first asked for, which takes 0.1-0.5 s."""
        if not self.has_grid:
            self._grid = distance_grid(self.tree, self.closed)
        return self._grid

    def inside(self, positions_m: np.ndarray) -> np.ndarray:
        """(position,) bool: inside the solid; never where the part bounds none."""
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

    def nearest(self, positions_m: np.ndarray) -> SignedDistance:
        """Signed distance and nearest place; ``normal`` is the gradient of the distance, outward, of length 1.

        Of positions that are not finite the distance is infinite, the rest NaN.
        """
        signed = self.signed_m(positions_m)
        distance = np.abs(signed)
        closest, triangle = np.full((len(positions_m), 3), np.nan), np.zeros(len(positions_m), np.int64)
        nearest_triangles(self.tree, positions_m, distance, closest, triangle)
        way = positions_m - closest
        away = distance > ON_SURFACE_M
        gradient = self.tree.triangle[9:12, triangle].T
        gradient[away] = way[away] / signed[away, None]
        return SignedDistance(signed, closest, gradient)


def surface_index(model: ObjectModel) -> "SurfaceIndex":
    """The index of a model; those used last are kept in memory, by what mesh, parts and hinge are."""
    key = model.digest
    if key not in _indices:
        _indices[key] = SurfaceIndex(model)
    _indices.move_to_end(key)
    while len(_indices) > 1 and sum(len(kept.model.faces) for kept in _indices.values()) > MOST_TRIANGLES_KEPT:
        _indices.popitem(last=False)
    return _indices[key]


class SurfaceIndex:
    """The surface of one object; of a hinged one that of both parts, at the angle of each frame.

    solids: by part, the solid it bounds, or why there is none. solid_note: None where every part is one as it is, else
    a sentence that says what was repaired or left out of depths. grid_from: a part gets its grid when it is asked about
    more positions than this. Raises BadInput for a part without triangles.
    """

    def __init__(self, model: ObjectModel, grid_from: int = GRID_PAYS_FROM) -> None:
        self.model = model
        self.solids = model.solids
        self.solid_note = _note(model, self.solids)
        self._surfaces: dict[int, PartSurface] = {}
        self._closed: dict[int, PartSurface] = {}
        for part, solid in self.solids.items():
            if isinstance(solid, Solid):
                self._closed[part] = PartSurface(solid.vertices_m, solid.faces, True, grid_from)
            if isinstance(solid, Solid) and not solid.patched and not _has_cut(model, part):
                self._surfaces[part] = self._closed[part]
            else:
                merged = merged_surface(model.vertices_m, model.faces_of(part))
                self._surfaces[part] = PartSurface(merged.vertices_m, merged.faces, False, grid_from)

    def within(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None, threshold_m: float) -> np.ndarray:
        """(frame, position) bool: the distance to the surface is less than ``threshold_m``.

        positions_m: (frame, position, 3), object frame, metres. hinge_rad: (frame,) for a hinged object, else None.
        Positions that are not finite are not within.
        """
        within = np.zeros(positions_m.shape[:2], bool)
        for part, surface in self._surfaces.items():
            positions = self._in_part(positions_m, hinge_rad, part)
            mark_within(surface.tree, surface.grid_for(positions), positions, float(threshold_m), within.reshape(-1))
        return within

    def distance_m(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None, most_m: float = np.inf) -> np.ndarray:
        """(frame, position) float64 distance to the surface, metres, never negative; infinite beyond ``most_m``.

        Arguments as in ``within``.
        """
        distance = np.full(positions_m.shape[:2], np.inf)
        for part, surface in self._surfaces.items():
            positions = self._in_part(positions_m, hinge_rad, part)
            lower_distances(surface.tree, surface.grid_for(positions), positions, float(most_m), distance.reshape(-1))
        return distance

    def depth_m(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None) -> np.ndarray:
        """(frame, position) float64 distance to the surface for positions inside the solid, metres, 0 outside.

        Inside is what the surface winds around (a cavity is outside, two shells that overlap count as one solid); of
        two parts the one that it is deeper in counts. Arguments as in ``within``. Raises BadInput where no part
        encloses a solid.
        """
        self.check_solid()
        depth = np.zeros(positions_m.shape[:2])
        for part, surface in self._closed.items():
            positions = self._in_part(positions_m, hinge_rad, part)
            inside = np.flatnonzero(surface.inside(positions))
            depth.reshape(-1)[inside] = np.maximum(depth.reshape(-1)[inside], surface.distance_m(positions[inside]))
        return depth

    def nearest(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None) -> SignedDistance:
        """Signed distances (frame, position), nearest places and gradients (frame, position, 3), object frame.

        Of ``filled``; of two parts the one whose signed distance is less. Arguments as in ``within``.
        """
        return reduce(nearer_of, (self._nearest_of(part, positions_m, hinge_rad) for part in self.filled))

    def _nearest_of(self, part: int, positions_m: np.ndarray, hinge_rad: np.ndarray | None) -> SignedDistance:
        found = self.filled[part].nearest(self._in_part(positions_m, hinge_rad, part))
        object_from_part = self.model.object_from_part(part, hinge_rad)
        closest, normal = (array.reshape(positions_m.shape) for array in found[1:])
        distance = found.distance_m.reshape(positions_m.shape[:2])
        return SignedDistance(distance, object_from_part @ closest, object_from_part.turn(normal))

    @property
    def filled(self) -> dict[int, PartSurface]:
        """By part the solid's surface, with its repairs, or the open mesh where there is no solid."""
        return {part: self._closed.get(part, surface) for part, surface in self._surfaces.items()}

    def prepare(self) -> "SurfaceIndex":
        """Make all grids now, 0.1-0.5 s for each part, for whoever cannot wait later; gives itself back."""
        for surface in {**self._surfaces, **self.filled}.values():
            _ = surface.grid
        return self

    @property
    def solid_trees(self) -> dict[int, TriangleTree]:
        """By part, the triangles of the solid it bounds; parts that bound none are left out."""
        return {part: surface.tree for part, surface in self._closed.items()}

    @property
    def is_solid(self) -> bool:
        """Some part encloses a solid, so that depths can be asked for."""
        return bool(self._closed)

    def check_solid(self) -> None:
        """Raises BadInput where no part encloses a solid, with the reason."""
        if not self.is_solid:
            why = "; ".join(sorted({solid.why for solid in self.solids.values() if isinstance(solid, NoSolid)}))
            raise BadInput(f"mesh of {self.model.name!r}", "a mesh that encloses a solid", why, "repair the mesh")

    def _in_part(self, positions_m: np.ndarray, hinge_rad: np.ndarray | None, part: int) -> np.ndarray:
        """(frame x position, 3) positions in the part's rest frame."""
        part_from_object = self.model.object_from_part(part, hinge_rad).inverse()
        return np.ascontiguousarray((part_from_object @ np.asarray(positions_m, np.float64)).reshape(-1, 3))


def nearer_of(first: SignedDistance, second: SignedDistance) -> SignedDistance:
    """Of two answers about the same positions, each time the one whose signed distance is less."""
    nearer = second.distance_m < first.distance_m
    columns = zip(first, second, strict=True)
    return SignedDistance(*(np.where(nearer[(..., *[None] * (a.ndim - nearer.ndim))], b, a) for a, b in columns))


def _has_cut(model: ObjectModel, part: int) -> bool:
    """Triangles close the part where the other part was cut off it."""
    return len(model.closed_part(part)[1]) > len(model.faces_of(part))


def _note(model: ObjectModel, solids: dict[int, Solid | NoSolid]) -> str | None:
    """What was repaired, and what has no inside; None where there is nothing to say."""
    said = []
    for part, solid in solids.items():
        name = f"part {part} of {model.name}" if len(solids) > 1 else model.name
        if isinstance(solid, NoSolid):
            said.append(f"{name} has no inside: {solid.why}")
            continue
        repairs = [*(["cut at the hinge closed"] if _has_cut(model, part) else []), *filter(None, [solid.repairs])]
        if repairs:
            said.append(f"{name}: {', '.join(repairs)}")
    return "; ".join(said) or None
