"""Simplify a triangle mesh with one boundary by half-edge collapses, so that the result is a subset of the vertices.

Cost: quadric error (Garland and Heckbert 1997) plus a light term for long edges. Because no vertex is created, skin
weights and morph targets of the result are those of the kept vertices.
"""

import heapq
from dataclasses import dataclass

import numpy as np

_MAX_VALENCE = 9
_LENGTH_WEIGHT = 1e-5


@dataclass(frozen=True)
class _Limits:
    """What a collapse must keep: cosine between old and new face normal, and shape (1 = equilateral) of new faces."""

    cosine: float = 0.2
    shape: float = 0.08
    valence: int = _MAX_VALENCE

    def relaxed(self) -> "_Limits":
        return _Limits(self.cosine * 0.5, self.shape * 0.5, self.valence + 1)


def simplify_disc(
    points_m: np.ndarray, triangles: np.ndarray, n_boundary: int, n_vertices: int
) -> tuple[np.ndarray, np.ndarray]:
    """Reduce to ``n_boundary`` boundary edges and ``n_vertices`` vertices.

    Gives the ids of the kept points (ascending) and the faces (face, 3) that count in them. RuntimeError when no legal
    collapse is left after relaxing the limits four times.
    """
    mesh = _Mesh(points_m, triangles)
    mesh.reduce(lambda: len(mesh.boundary) > n_boundary, on_boundary=True)
    mesh.reduce(lambda: len(mesh.around) > n_vertices, on_boundary=False)
    kept = np.array(sorted(mesh.around))
    faces = np.array(sorted(mesh.faces))
    return kept, np.searchsorted(kept, faces)


class _Mesh:
    def __init__(self, points_m: np.ndarray, triangles: np.ndarray) -> None:
        self.points = points_m
        self.faces = {_turned(face) for face in triangles.tolist()}
        self.around: dict[int, set[tuple[int, int, int]]] = {}
        for face in self.faces:
            for vertex in face:
                self.around.setdefault(vertex, set()).add(face)
        self.boundary = self._boundary_vertices()
        self.quadric = {vertex: self._quadric(vertex) for vertex in self.around}
        self.version = dict.fromkeys(self.around, 0)

    def reduce(self, wanted, on_boundary: bool) -> None:
        limits, relaxations = _Limits(), 0
        heap = self._all_candidates(on_boundary)
        while wanted():
            if not heap:
                if relaxations == 4:
                    raise RuntimeError(f"no legal collapse left at {len(self.around)} vertices")
                limits, relaxations = limits.relaxed(), relaxations + 1
                heap = self._all_candidates(on_boundary)
                continue
            _, gone, kept, stamp = heapq.heappop(heap)
            if gone not in self.around or kept not in self.around or stamp != self.version[gone] + self.version[kept]:
                continue
            if self._is_legal(gone, kept, limits):
                for vertex in self._collapse(gone, kept):
                    self._push(heap, vertex, on_boundary)

    def neighbours(self, vertex: int) -> set[int]:
        return {other for face in self.around[vertex] for other in face} - {vertex}

    def _boundary_vertices(self) -> set[int]:
        edges = {(face[i], face[(i + 1) % 3]) for face in self.faces for i in range(3)}
        return {vertex for edge in edges if edge[::-1] not in edges for vertex in edge}

    def _quadric(self, vertex: int) -> np.ndarray:
        total = np.zeros((4, 4))
        for face in sorted(self.around[vertex]):
            first, second, third = self.points[list(face)]
            cross = np.cross(second - first, third - first)
            double_area = np.linalg.norm(cross)
            if double_area > 0:
                plane = np.append(cross, -cross @ first) / double_area
                total += double_area * np.outer(plane, plane)
        return total

    def _all_candidates(self, on_boundary: bool) -> list:
        heap: list = []
        for vertex in sorted(self.around):
            self._push(heap, vertex, on_boundary, both_ways=False)
        heapq.heapify(heap)
        return heap

    def _push(self, heap: list, vertex: int, on_boundary: bool, both_ways: bool = True) -> None:
        for other in sorted(self.neighbours(vertex)):
            for gone, kept in ((vertex, other), (other, vertex)) if both_ways else ((vertex, other),):
                if (gone in self.boundary) != on_boundary or (on_boundary and not self._is_boundary_edge(gone, kept)):
                    continue
                stamp = self.version[gone] + self.version[kept]
                heapq.heappush(heap, (self._cost(gone, kept, on_boundary), gone, kept, stamp))

    def _is_boundary_edge(self, first: int, second: int) -> bool:
        return len(self.around[first] & self.around[second]) == 1

    def _cost(self, gone: int, kept: int, on_boundary: bool) -> float:
        edge = self.points[kept] - self.points[gone]
        if on_boundary:
            return float(edge @ edge)
        point = np.append(self.points[kept], 1.0)
        return float(point @ (self.quadric[gone] + self.quadric[kept]) @ point + _LENGTH_WEIGHT * (edge @ edge) ** 1.5)

    def _is_legal(self, gone: int, kept: int, limits: _Limits) -> bool:
        shared = self.around[gone] & self.around[kept]
        common = self.neighbours(gone) & self.neighbours(kept)
        if len(common) != len(shared):
            return False
        if len(self.neighbours(gone) | self.neighbours(kept)) - 2 > limits.valence:
            return False
        if any(len(self.neighbours(vertex)) <= 3 and vertex not in self.boundary for vertex in common):
            return False
        return all(self._keeps_shape(face, gone, kept, limits) for face in self.around[gone] - shared)

    def _keeps_shape(self, face: tuple[int, int, int], gone: int, kept: int, limits: _Limits) -> bool:
        old = self.points[list(face)]
        new = self.points[[kept if vertex == gone else vertex for vertex in face]]
        before, after = (np.cross(corner[1] - corner[0], corner[2] - corner[0]) for corner in (old, new))
        area = np.linalg.norm(after)
        if before @ after <= limits.cosine * np.linalg.norm(before) * area:
            return False
        edges = new - np.roll(new, 1, axis=0)
        return 2 * np.sqrt(3.0) * area / (edges * edges).sum() > limits.shape

    def _collapse(self, gone: int, kept: int) -> list[int]:
        ring = self.neighbours(gone) | self.neighbours(kept)
        for face in self.around.pop(gone):
            self.faces.discard(face)
            for vertex in face:
                if vertex != gone:
                    self.around[vertex].discard(face)
            if kept not in face:
                new = _turned([kept if vertex == gone else vertex for vertex in face])
                self.faces.add(new)
                for vertex in new:
                    self.around[vertex].add(new)
        self.boundary.discard(gone)
        self.quadric[kept] = self.quadric[kept] + self.quadric.pop(gone)
        touched = sorted(ring - {gone})
        for vertex in touched:
            self.version[vertex] += 1
        return touched


def _turned(face) -> tuple[int, int, int]:
    """The same face starting at its smallest vertex, so that equal faces are equal tuples."""
    start = min(range(3), key=lambda corner: face[corner])
    return face[start], face[(start + 1) % 3], face[(start + 2) % 3]
