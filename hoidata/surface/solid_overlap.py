"""Intersection volume of a hand and an object in each frame.

Parallel lines along x of the object's part, through the cell centres of a square lattice (1 mm by default), intersect
both solids. The common length along a line is exact; each line represents its cell. A fan closes the hand at the wrist.
Inside means a positive winding number: a cavity is outside, and a hand that intersects itself counts once. The volumes
of an object's parts are added.

Compared with exact mesh intersections (CGAL, 20 poses of a hand in a torus, 19 cm3 on average), the error is at most
0.05 cm3 for cells of 1 mm and 0.25 cm3 for cells of 2 mm.
"""

import numpy as np

from hoidata.errors import BadInput
from hoidata.objects.line_crossings import Intervals, common_length_m, intervals_inside
from hoidata.objects.solid import patched_holes
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.objects.triangle_tree import TriangleTree

CELL_M = 0.001
_MOST_LINES = 1 << 22


class SolidOverlap:
    """The intervals of a lattice of lines inside one object. Build it once per object for all clips."""

    def __init__(self, index: SurfaceIndex, cell_m: float = CELL_M) -> None:
        """Intersect the object's parts with the lattice.

        Raises BadInput: no part encloses a solid, or the lattice is too fine for the object's size.
        """
        index.check_solid()
        self.index, self.cell_m = index, cell_m
        self._lines = {part: _lines_through(index.model.name, tree, cell_m) for part, tree in index.solid_trees.items()}

    def volume_m3(self, vertices_m: np.ndarray, faces: np.ndarray, hinge_rad: np.ndarray | None) -> np.ndarray:
        """Intersection volume of a hand with the object.

        Args:
            vertices_m: (frame, vertex, 3) of the hand, object frame.
            faces: (face, 3), outward by the right-hand rule.
            hinge_rad: (frame,) for a hinged object, else None.

        Returns (frame,) cubic metres.
        """
        volume = np.zeros(len(vertices_m))
        for part, lines in self._lines.items():
            part_from_object = self.index.model.object_from_part(part, hinge_rad).inverse()
            local = part_from_object @ np.asarray(vertices_m, np.float64)
            near = _frames_near(local, lines)
            hand_frames_m, closed = patched_holes(local[near], np.asarray(faces, dtype=np.int64))
            for frame, hand_vertices_m in zip(near, hand_frames_m, strict=True):
                volume[frame] += common_length_m(np.ascontiguousarray(hand_vertices_m), closed, lines) * self.cell_m**2
        return volume


def _lines_through(name: str, tree: TriangleTree, cell_m: float) -> Intervals:
    size = tree.box[0, 3:] - tree.box[0, :3]
    if not cell_m > 0 or np.prod(size[1:] / cell_m) > _MOST_LINES:
        got = " x ".join(f"{side:.3g}" for side in size)
        raise BadInput(f"mesh of {name!r}", f"at most {_MOST_LINES} cells of {cell_m} m", f"{got} m", "larger cells")
    return intervals_inside(tree, cell_m)


def _frames_near(local_m: np.ndarray, lines: Intervals) -> np.ndarray:
    """Frames in which the bounding boxes of hand and part overlap."""
    if not len(lines.start_m):
        return np.zeros(0, int)
    low = np.concatenate(([lines.start_m.min()], lines.low_m))
    high = np.concatenate(([lines.stop_m.max()], lines.low_m + lines.shape * lines.cell_m))
    return np.flatnonzero(((local_m.min(axis=1) < high) & (local_m.max(axis=1) > low)).all(axis=1))
