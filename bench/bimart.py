"""Part-based BPS and contact maps compared with a k-d tree per frame, part and hand, as in BimArt's release.

``python -m bench bimart``. One thread; a hinged object of 3,908 vertices; 512 basis points per part; a motion of 300
frames (10 s) in which the hinge opens by 90 degrees and closes. "first path" builds the cache of the object, "a later
path" uses it. The release queries the nearest hand vertex of each object vertex. Our maps, and one of the baselines,
query only the 1,024 nearest object points of the BPS. Times are medians of processor time; results are compared.
"""

import numpy as np
import trimesh
from scipy.spatial import KDTree

from bench.harness import medians, show
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.sensors.part_bps import BasisSettings, PartBps, distance_map

FRAMES, COUNT, HAND = 300, 512, 778


def hinged_object() -> ObjectModel:
    """A bumpy body of 2,562 vertices, and a lid of 1,346 that rotates about -z."""
    rng, parts = np.random.default_rng(0), []
    body, lid = trimesh.creation.icosphere(4, 1.0), trimesh.creation.uv_sphere(1.0, count=[30, 24])
    for mesh, size, centre in ((body, (0.12, 0.09, 0.05), (0.12, 0, 0)), (lid, (0.12, 0.09, 0.02), (-0.12, 0, 0))):
        mesh.vertices = mesh.vertices * (1 + 0.05 * rng.normal(size=(len(mesh.vertices), 1))) * size + centre
        parts.append(mesh)
    part = np.repeat(np.array([0, 1], np.uint8), [len(mesh.vertices) for mesh in parts])
    vertices = np.concatenate([mesh.vertices for mesh in parts])
    faces = np.concatenate((body.faces, lid.faces + len(body.vertices)))
    hinge = Hinge(np.array([0.0, 0.0, -1.0]), np.zeros(3))
    return ObjectModel(name="two bodies", vertices_m=vertices, faces=faces, part=part, hinge=hinge)


def reference_bps(model: ObjectModel, settings: BasisSettings, scale: float, posed_m: np.ndarray) -> np.ndarray:
    """(frame, N) index of the nearest vertex of each basis point, by a tree per frame and part."""
    points, members = settings.points(), [np.flatnonzero(model.part == part) for part in (1, 0)]
    by_frame = [
        np.concatenate([vertex_ids[KDTree(scale * frame[vertex_ids]).query(points)[1]] for vertex_ids in members])
        for frame in posed_m
    ]
    return np.stack(by_frame)


def reference_maps(points_m: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """(hand, frame, point) distances of points (frame, point, 3), by a tree per hand and frame."""
    distances = [
        [KDTree(hand).query(frame_points)[0] for hand, frame_points in zip(side, points_m, strict=True)]
        for side in hands
    ]
    return np.array(distances)


def main() -> None:
    model, settings = hinged_object(), BasisSettings(COUNT)
    angles = np.pi / 2 * np.sin(np.linspace(0, np.pi, FRAMES))
    posed_m = articulate(model.vertices_m, model.part, model.hinge, angles)
    cached_bps = PartBps(model, settings)
    nearest = cached_bps.nearest_points(angles)
    rng = np.random.default_rng(1)
    drift = np.cumsum(rng.normal(0, 0.002, (2, FRAMES, 1, 3)), axis=1)
    hands = rng.normal(0, 0.05, (2, 1, HAND, 3)) + drift + np.array([0.0, 0.05, 0.1])
    differing = np.mean(reference_bps(model, settings, cached_bps.scale, posed_m) != nearest.vertex)
    maps = np.stack([distance_map(nearest.point_m, hand) for hand in hands])
    largest_error_m = np.abs(maps - reference_maps(nearest.point_m.astype(np.float64), hands)).max()
    times = medians(
        {
            "trees": lambda: reference_bps(model, settings, cached_bps.scale, posed_m),
            "first": lambda: PartBps(model, settings).nearest_points(angles),
            "again": lambda: cached_bps.nearest_points(angles),
            "maps, trees, every vertex": lambda: reference_maps(posed_m, hands),
            "maps, trees, picked vertices": lambda: reference_maps(nearest.point_m, hands),
            "maps": lambda: [distance_map(nearest.point_m, hand) for hand in hands],
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
        ours_ms, baseline_ms = (1e3 * times[name].processor / FRAMES for name in (ours, baseline))
        rows.append((title, baseline, f"{ours_ms:.3f}", f"{baseline_ms:.2f}", f"{baseline_ms / ours_ms:.0f}x"))
    columns = ["", "baseline", "ms per frame", "baseline's ms per frame", "speed-up"]
    show(f"{len(model.vertices_m):,} vertices, {COUNT} basis points per part", columns, rows)
    print(f"vertices that differ: {100 * differing:.3f} %; distances differ by at most {1e6 * largest_error_m:.2f} um")
