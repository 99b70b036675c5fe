"""How much of a hand is inside an object: the volume that both fill, frame by frame.

Both solids are met by parallel lines, one in the middle of each cell of a square lattice (1 mm if not said otherwise)
laid across the x axis of the object's part. Along a line the common length is exact; across, each line stands for its
cell. A hand is closed at the wrist by a fan about the middle of its edge. What either surface winds around is inside:
cavities are not, and a hand that enters itself counts once. Two parts of an object are added up.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.errors import BadInput
from hoidata.objects.solid import Solid, patched_holes, volume_m3
from hoidata.objects.surface_index import SurfaceIndex, in_part
from hoidata.objects.triangle_tree import DEEPEST, crossing, crossings, triangle_tree

CELL_M = 0.001
_MOST_LINES = 1 << 22


class _Lines(NamedTuple):
    """The lines through a solid. low_m: (2,) y and z of the lattice's corner; cell_m: of a cell; shape: (2,) cells.

    first: (line + 1,) where each line's stretches start; start_m, stop_m: (stretch,) x, rising along a line.
    """

    low_m: np.ndarray
    cell_m: float
    shape: np.ndarray
    first: np.ndarray
    start_m: np.ndarray
    stop_m: np.ndarray


class SolidOverlap:
    """The solid parts of one object under a lattice of lines. Build once per object, use for all its clips.

    Raises BadInput where no part encloses a solid, or where the lattice would be too fine for the object's size.
    """

    def __init__(self, index: SurfaceIndex, cell_m: float = CELL_M) -> None:
        index.check_solid()
        self.index, self.cell_m = index, cell_m
        self._lines = {
            part: _lines_through(index.model.name, solid, cell_m)
            for part, solid in index.solids.items()
            if isinstance(solid, Solid)
        }

    def volume_m3(self, vertices_m: np.ndarray, faces: np.ndarray, hinge_rad: np.ndarray | None) -> np.ndarray:
        """(frame,) volume that a hand and the object both fill, cubic metres.

        vertices_m: (frame, vertex, 3) of the hand, object frame; faces: (face, 3), outward by the right-hand rule.
        hinge_rad: (frame,) for a hinged object, else None.
        """
        volume = np.zeros(len(vertices_m))
        for part, lines in self._lines.items():
            local = in_part(self.index.model, vertices_m, hinge_rad, part)
            near = _frames_near(local, lines)
            places, closed = patched_holes(local[near], np.asarray(faces, dtype=np.int64))
            for frame, own in zip(near, places, strict=True):
                volume[frame] += _common_length_m(np.ascontiguousarray(own), closed, lines) * self.cell_m**2
        return volume


def hand_volume_m3(vertices_m: np.ndarray, faces: np.ndarray) -> float:
    """Volume of one hand (vertex, 3) closed at the wrist, by the divergence theorem."""
    return volume_m3(*patched_holes(vertices_m, faces))


def _lines_through(name: str, solid: Solid, cell_m: float) -> _Lines:
    low, high = solid.vertices_m.min(axis=0), solid.vertices_m.max(axis=0)
    if not cell_m > 0 or np.prod((high - low)[1:] / cell_m) > _MOST_LINES:
        size = " x ".join(f"{side:.3g}" for side in high - low)
        raise BadInput(f"mesh of {name!r}", f"at most {_MOST_LINES} cells of {cell_m} m", f"{size} m", "larger cells")
    shape = np.ceil((high - low)[1:] / cell_m).astype(np.int64)
    corner = (low + high)[1:] / 2 - shape * cell_m / 2  # the lattice lies evenly about the middle of the part
    tree = triangle_tree(solid.vertices_m, solid.faces)
    first, start, stop = _stretches(tree, corner, cell_m, shape)
    return _Lines(corner, cell_m, shape, first, start, stop)


def _frames_near(local_m: np.ndarray, lines: _Lines) -> np.ndarray:
    """Frames in which the boxes of hand and part overlap."""
    if not len(lines.start_m):
        return np.zeros(0, int)
    low = np.concatenate(([lines.start_m.min()], lines.low_m))
    high = np.concatenate(([lines.stop_m.max()], lines.low_m + lines.shape * lines.cell_m))
    return np.flatnonzero(((local_m.min(axis=1) < high) & (local_m.max(axis=1) > low)).all(axis=1))


@njit(cache=True)
def _stretches(tree, low_m, cell_m, shape):  # pragma: no cover (compiled)
    """Where each line runs inside the solid."""
    _, box, link, _, corner, vertices_m = tree
    stack, places, turns = np.empty(DEEPEST, np.int64), np.empty(len(corner)), np.empty(len(corner))
    first = np.zeros(shape[0] * shape[1] + 1, np.int64)
    start, stop = [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for j in range(shape[0]):
        for k in range(shape[1]):
            y, z = low_m[0] + (j + 0.5) * cell_m, low_m[1] + (k + 0.5) * cell_m
            count = crossings(box, link, corner, vertices_m, y, z, stack, places, turns)
            _sort(places, turns, count)
            winding = 0.0
            for number in range(count):
                if winding > 0:
                    start.append(places[number - 1])
                    stop.append(places[number])
                winding -= turns[number]
            first[j * shape[1] + k + 1] = len(start)
    return first, np.array(start), np.array(stop)


@njit(cache=True)
def _sort(places, turns, count):  # pragma: no cover (compiled)
    """By place; a line has a handful of crossings."""
    for number in range(1, count):
        place, turn, at = places[number], turns[number], number
        while at and places[at - 1] > place:
            places[at], turns[at] = places[at - 1], turns[at - 1]
            at -= 1
        places[at], turns[at] = place, turn


@njit(cache=True)
def _common_length_m(vertices_m, faces, lines):  # pragma: no cover (compiled)
    """Summed over all lines, the length inside both the closed surface and the stretches."""
    low_m, cell_m, shape, first, start_m, stop_m = lines
    newest = np.full(shape[0] * shape[1], -1, np.int64)  # of each line, its newest crossing
    older, places, turns = [0 for _ in range(0)], [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for face in range(len(faces)):
        a, b, c = faces[face]
        j_start, j_stop = _cells_between(vertices_m, a, b, c, 1, low_m[0], cell_m, shape[0])
        k_start, k_stop = _cells_between(vertices_m, a, b, c, 2, low_m[1], cell_m, shape[1])
        for j in range(j_start, j_stop):
            for k in range(k_start, k_stop):
                line = j * shape[1] + k
                if first[line] == first[line + 1]:
                    continue
                y, z = low_m[0] + (j + 0.5) * cell_m, low_m[1] + (k + 0.5) * cell_m
                turn, place = crossing(vertices_m, a, b, c, y, z)
                if turn != 0:
                    older.append(int(newest[line]))
                    newest[line] = len(places)
                    places.append(place)
                    turns.append(turn)
    return _summed(newest, older, places, turns, first, start_m, stop_m)


@njit(cache=True, inline="always")
def _cells_between(vertices_m, a, b, c, axis, low_m, cell_m, count):  # pragma: no cover (compiled)
    """Cells along an axis whose middle lies within a triangle's extent, and a little beyond."""
    least = min(vertices_m[a, axis], vertices_m[b, axis], vertices_m[c, axis])
    most = max(vertices_m[a, axis], vertices_m[b, axis], vertices_m[c, axis])
    start = int(np.floor((least - low_m) / cell_m - 0.5))
    stop = int(np.ceil((most - low_m) / cell_m - 0.5)) + 1
    return max(start, 0), min(stop, count)


@njit(cache=True)
def _summed(newest, older, places, turns, first, start_m, stop_m):  # pragma: no cover (compiled)
    length = 0.0
    own_places, own_turns = np.empty(len(places)), np.empty(len(places))
    for line in range(len(newest)):
        count, number = 0, newest[line]
        while number >= 0:
            own_places[count], own_turns[count] = places[number], turns[number]
            count += 1
            number = older[number]
        _sort(own_places, own_turns, count)
        winding = 0.0
        for number in range(count):
            if winding > 0:
                for stretch in range(first[line], first[line + 1]):
                    begin = max(own_places[number - 1], start_m[stretch])
                    length += max(min(own_places[number], stop_m[stretch]) - begin, 0.0)
            winding -= own_turns[number]
    return length
