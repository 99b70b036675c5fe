"""BimArt's object features and contact maps beside a k-d tree of every frame, part and hand, as the release has them.

``python -m bench bimart``. One thread; a hinged object of 3,908 vertices, 512 basis points per part, a path of 300
frames (10 s) in which the hinge goes through 90 degrees and back. Ours starts without anything known of the object
("first path": arcs are found on the way) or knows it from an earlier path. The release asks for the nearest hand vertex
of every object vertex; ours, and a tree asked as little, only of the 1,024 that the basis points picked. Medians of the
processor's time of paths that take turns; the answers are compared.
"""

import numpy as np
import trimesh
from scipy.spatial import KDTree

from bench.harness import medians, show
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.sensors.part_bps import BasisSettings, PartBps, distance_map

FRAMES, COUNT, HAND = 300, 512, 778


def thing() -> ObjectModel:
    """A bumpy body of 2,562 vertices and a lid of 1,346, which turns about -z."""
    draws, parts = np.random.default_rng(0), []
    body, lid = trimesh.creation.icosphere(4, 1.0), trimesh.creation.uv_sphere(1.0, count=[30, 24])
    for mesh, size, middle in ((body, (0.12, 0.09, 0.05), (0.12, 0, 0)), (lid, (0.12, 0.09, 0.02), (-0.12, 0, 0))):
        mesh.vertices = mesh.vertices * (1 + 0.05 * draws.normal(size=(len(mesh.vertices), 1))) * size + middle
        parts.append(mesh)
    part = np.repeat(np.array([0, 1], np.uint8), [len(own.vertices) for own in parts])
    vertices = np.concatenate([own.vertices for own in parts])
    faces = np.concatenate((body.faces, lid.faces + len(body.vertices)))
    hinge = Hinge(np.array([0.0, 0.0, -1.0]), np.zeros(3))
    return ObjectModel("two bodies", vertices, faces, part, hinge)


def reference_bps(model: ObjectModel, settings: BasisSettings, scale: float, placed: np.ndarray) -> np.ndarray:
    """(frame, place) vertices by a tree of every frame and part."""
    points, members = settings.points(), [np.flatnonzero(model.part == part) for part in (1, 0)]
    rows = [np.concatenate([own[KDTree(scale * frame[own]).query(points)[1]] for own in members]) for frame in placed]
    return np.stack(rows)


def reference_maps(asked: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """(hand, frame, point) distances of asked points (frame, point, 3) by a tree of every hand and frame."""
    both = [[KDTree(hand).query(own)[0] for hand, own in zip(side, asked, strict=True)] for side in hands]
    return np.array(both)


def main() -> None:
    model, settings = thing(), BasisSettings(COUNT)
    angles = np.pi / 2 * np.sin(np.linspace(0, np.pi, FRAMES))
    placed = articulate(model.vertices_m, model.part, model.hinge, angles)
    known = PartBps(model, settings)
    seen = known.look(angles)
    draws = np.random.default_rng(1)
    drift = np.cumsum(draws.normal(0, 0.002, (2, FRAMES, 1, 3)), axis=1)
    hands = draws.normal(0, 0.05, (2, 1, HAND, 3)) + drift + np.array([0.0, 0.05, 0.1])
    wrong = np.mean(reference_bps(model, settings, known.scale, placed) != seen.vertex)
    maps = np.stack([distance_map(seen.place_m, hand) for hand in hands])
    apart = np.abs(maps - reference_maps(seen.place_m.astype(np.float64), hands)).max()
    times = medians(
        {
            "trees": lambda: reference_bps(model, settings, known.scale, placed),
            "first": lambda: PartBps(model, settings).look(angles),
            "again": lambda: known.look(angles),
            "maps, trees, every vertex": lambda: reference_maps(placed, hands),
            "maps, trees, picked vertices": lambda: reference_maps(seen.place_m, hands),
            "maps": lambda: [distance_map(seen.place_m, hand) for hand in hands],
        },
        runs=5,
    )
    rows = []
    for title, ours, baseline in (
        ("part-BPS, first path of an object", "first", "trees"),
        ("part-BPS, a later path", "again", "trees"),
        ("maps of both hands", "maps", "maps, trees, every vertex"),
        ("maps of both hands", "maps", "maps, trees, picked vertices"),
    ):
        own, other = (1e3 * times[name].processor / FRAMES for name in (ours, baseline))
        rows.append((title, baseline, f"{own:.3f}", f"{other:.2f}", f"{other / own:.0f}x"))
    columns = ["", "beside", "ms a frame", "its ms a frame", "faster"]
    show(f"{len(model.vertices_m):,} vertices, {COUNT} basis points per part", columns, rows)
    print(f"vertices that differ: {100 * wrong:.3f} %; distances differ by at most {1e6 * apart:.2f} um")
