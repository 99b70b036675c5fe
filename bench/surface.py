"""Exact contact labels, distances and depths of hand vertices beside libigl's, and the volume of a hand in an object.

``python -m bench.surface``. One thread, libigl's own included. The vertices of a hand that wanders about the
object for 60 frames; variants take turns, figures are medians of the processor's time. Compiling, trees and grids are
shown apart. With HOIDATA_MANIPNET also some of its released meshes.
"""

import gzip
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

os.environ["IGL_NUM_THREADS"] = "1"  # read once, when libigl first shares out work

import igl
import numpy as np
import trimesh

from bench.harness import Times, medians, show
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands
from hoidata.objects.distance_grid import distance_grid
from hoidata.objects.mesh import parse_obj
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.objects.solid import Solid
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.objects.triangle_tree import triangle_tree
from hoidata.surface.solid_overlap import SolidOverlap

RUNS, FRAMES, TOUCH_M = 7, 60, 0.005
MANIPNET_MESHES = ("Dining/cup1", "Dining/mug1", "Dining/mug2", "Dining/teapot2", "Primitive/cube_med")


class Asked(NamedTuple):
    """An object, places (frame, vertex, 3) in its frame, hinge angles or None."""

    model: ObjectModel
    places_m: np.ndarray
    hinge_rad: np.ndarray | None


def main() -> None:
    asked = [torus(False), torus(True), sharp("box", (0.08, 0.06, 0.1)), sharp("plate of 2 mm", (0.15, 0.12, 0.002))]
    root = os.environ.get("HOIDATA_MANIPNET")
    asked += [manipnet(Path(root), name) for name in MANIPNET_MESHES] if root else []
    compiled_s = warm_up(asked[0])
    columns = [
        "",
        "libigl us",
        "tree kept",
        "ours, no grid",
        "ours, grid",
        "x",
        "x tree kept",
        "tree, grid ms",
        "wrong",
    ]
    for title, row in (("5 mm labels", label_row), ("distances", distance_row), ("depths", depth_row)):
        note = f", us per vertex, medians of {RUNS} turns of {FRAMES} x 778"
        show(f"Exact {title}{note}", columns, [row(one) for one in asked])
    heads = ["cell", "us per frame", "lines ms", "hand in object cm3"]
    show("Volume of hand in object", ["", *heads], [volume_row(one, cell) for one in asked for cell in (0.002, 0.001)])
    print(f"first calls, compiling or reading what was compiled: {compiled_s:.1f} s")
    if not root:
        print("HOIDATA_MANIPNET is not set: no real meshes")


def wandering_hand(size_m: float, seed: int = 0) -> np.ndarray:
    """(frame, 778, 3) vertices of the flat hand, near the surface of something this large in most frames."""
    random, hand = np.random.default_rng(seed), load_embedded_hands().right.template_m
    way = np.cumsum(random.normal(0, 0.003, (FRAMES, 3)), axis=0)
    rotmats = rotvec_to_rotmat(np.cumsum(random.normal(0, 0.05, (FRAMES, 3)), axis=0))
    return (hand - hand.mean(axis=0)) @ rotmats + (way - way.mean(axis=0) + [0, 0, 0.4 * size_m])[:, None]


def asked_of(name: str, vertices_m: np.ndarray, faces: np.ndarray, part: np.ndarray | None = None) -> Asked:
    hinge = None if part is None else Hinge(np.array([0.0, 0.0, -1.0]), np.zeros(3))
    part = np.zeros(len(vertices_m), np.uint8) if part is None else part
    model = ObjectModel(name, vertices_m - vertices_m.mean(axis=0), np.asarray(faces, dtype=np.int64), part, hinge)
    angles = None if hinge is None else np.linspace(0, 1.2, FRAMES)
    return Asked(model, wandering_hand(float(np.median(np.ptp(vertices_m, axis=0)))), angles)


def torus(articulated: bool) -> Asked:
    """8,000 faces with bumps, 14 cm wide; of the articulated one a hinge turns the second of two."""
    mesh = trimesh.creation.torus(0.05, 0.02, major_sections=80, minor_sections=50)
    vertices = mesh.vertices + 0.004 * np.sin(60 * mesh.vertices[:, ::-1])
    if not articulated:
        return asked_of("torus", vertices, mesh.faces)
    apart = np.array([0.08, 0, 0])
    both = np.concatenate([vertices - apart, vertices + apart])
    part = np.repeat([0, 1], len(vertices)).astype(np.uint8)
    return asked_of("two tori, a hinge", both, np.concatenate([mesh.faces, mesh.faces + len(vertices)]), part)


def sharp(name: str, size_m: tuple[float, float, float]) -> Asked:
    box = trimesh.creation.box(size_m)
    return asked_of(name, np.array(box.vertices), box.faces)


def manipnet(root: Path, name: str) -> Asked:
    path = root / f"objects/{name}.obj.gz"
    mesh = parse_obj(gzip.decompress(path.read_bytes()).decode(), path)
    return asked_of(f"ManipNet {path.name.split('.')[0]}", 0.1 * mesh.vertices, mesh.faces)


def warm_up(asked: Asked) -> float:
    """Seconds of the first calls of everything compiled."""

    def everything() -> None:
        index = SurfaceIndex(asked.model, 0)
        index.within(asked.places_m[:1], None, TOUCH_M)
        index.distance_m(asked.places_m[:1], None)
        index.depth_m(asked.places_m[:1], None)
        SolidOverlap(index, 0.01).volume_m3(asked.places_m[:1], load_embedded_hands().right.faces, None)

    return medians({"": everything}, 1)[""].first


def label_row(asked: Asked) -> list[str]:
    return compared(asked, lambda index: index.within(asked.places_m, asked.hinge_rad, TOUCH_M), labels_wrong)


def distance_row(asked: Asked) -> list[str]:
    return compared(asked, lambda index: index.distance_m(asked.places_m, asked.hinge_rad), largest_error)


def depth_row(asked: Asked) -> list[str]:
    return compared(asked, lambda index: index.depth_m(asked.places_m, asked.hinge_rad), depths_wrong, signed=True)


def compared(
    asked: Asked,
    ours: Callable[[SurfaceIndex], np.ndarray],
    wrong: Callable[[Asked, np.ndarray], str],
    signed: bool = False,
) -> list[str]:
    """One row; libigl gives distances, from which a label or a depth is one step."""
    with_grid, without = SurfaceIndex(asked.model, 0), SurfaceIndex(asked.model, 10**12)
    variants: dict[str, Callable[[], object]] = {
        "libigl": signed_each_call(asked) if signed else unsigned_each_call(asked),
        "no grid": lambda: ours(without),
        "grid": lambda: ours(with_grid),
    }
    if not signed:
        variants["kept"] = tree_kept(asked)
    times = medians(variants, RUNS)
    found = ours(with_grid)
    assert np.array_equal(found, ours(without))
    own, count = times["grid"].processor, found.size
    return [
        asked.model.name,
        per_place(times["libigl"], count),
        per_place(times["kept"], count) if "kept" in times else "-",
        per_place(times["no grid"], count),
        per_place(times["grid"], count),
        f"{times['libigl'].processor / own:.1f}",
        f"{times['kept'].processor / own:.1f}" if "kept" in times else "-",
        built(asked.model),
        wrong(asked, found),
    ]


def per_place(times: Times, count: int) -> str:
    return f"{times.processor / count * 1e6:.3f}"


def built(model: ObjectModel) -> str:
    """Processor milliseconds of trees and grids, all parts together."""
    trees = [triangle_tree(model.vertices_m, faces) for faces in parts_of(model)]
    closed = SurfaceIndex(model).is_solid
    times = medians(
        {
            "tree": lambda: [triangle_tree(model.vertices_m, faces) for faces in parts_of(model)],
            "grid": lambda: [distance_grid(tree, closed) for tree in trees],
        },
        3,
    )
    return f"{times['tree'].processor * 1e3:.0f}, {times['grid'].processor * 1e3:.0f}"


def parts_of(model: ObjectModel) -> list[np.ndarray]:
    if not model.is_articulated:
        return [model.faces]
    return [np.ascontiguousarray(model.faces[model.face_part == part]) for part in (0, 1)]


def posed(asked: Asked) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices of the whole mesh and places for libigl: one call for a rigid object, else one per frame."""
    if asked.hinge_rad is None:
        return [(asked.model.vertices_m, asked.places_m.reshape(-1, 3))]
    model = asked.model
    return list(
        zip(articulate(model.vertices_m, model.part, model.hinge, asked.hinge_rad), asked.places_m, strict=True)
    )


def unsigned_each_call(asked: Asked) -> Callable[[], np.ndarray]:
    calls = posed(asked)

    def work() -> np.ndarray:
        return np.sqrt(
            np.concatenate(
                [igl.point_mesh_squared_distance(places, vertices, asked.model.faces)[0] for vertices, places in calls]
            )
        ).reshape(asked.places_m.shape[:2])

    return work


def tree_kept(asked: Asked) -> Callable[[], np.ndarray]:
    """libigl with its tree built beforehand, one per part; what is left of a frame's pose is moving the places."""
    faces, model, trees = parts_of(asked.model), asked.model, []
    for own in faces:
        trees.append(igl.AABB())
        trees[-1].init(model.vertices_m, own)

    def work() -> np.ndarray:
        best = np.full(asked.places_m.shape[:2], np.inf)
        for part, (tree, own) in enumerate(zip(trees, faces, strict=True)):
            places = asked.places_m
            if part and asked.hinge_rad is not None:
                places = places @ rotvec_to_rotmat(np.array([[0, 0, -1.0]]) * asked.hinge_rad[:, None])
            square = tree.squared_distance(model.vertices_m, own, np.ascontiguousarray(places.reshape(-1, 3)))[0]
            np.minimum(best, np.sqrt(square).reshape(best.shape), out=best)
        return best

    return work


def signed_each_call(asked: Asked) -> Callable[[], np.ndarray]:
    """libigl's signed distance by pseudonormals, of each part at each frame's angle."""
    calls, parts = posed(asked), parts_of(asked.model)
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL

    def work() -> np.ndarray:
        found = [
            np.min([igl.signed_distance(places, vertices, faces, kind)[0] for faces in parts], axis=0)
            for vertices, places in calls
        ]
        return np.maximum(-np.concatenate(found), 0).reshape(asked.places_m.shape[:2])

    return work


def labels_wrong(asked: Asked, labels: np.ndarray) -> str:
    wrong = (labels != (tree_kept(asked)() < TOUCH_M)).sum()
    return f"{wrong} of {labels.size:,} ({labels.mean():.0%} touch)"


def largest_error(asked: Asked, distance_m: np.ndarray) -> str:
    return f"{np.abs(distance_m - tree_kept(asked)()).max():.0e} m"


def depths_wrong(asked: Asked, depth_m: np.ndarray) -> str:
    """Against libigl's distances to the solids, where its winding number says inside."""
    truth = np.zeros(depth_m.size)
    for part, solid in SurfaceIndex(asked.model).solids.items():
        if isinstance(solid, Solid):
            part_from_object = asked.model.object_from_part(part, asked.hinge_rad).inverse()
            places = np.ascontiguousarray((part_from_object @ asked.places_m).reshape(-1, 3))
            maybe = ((places > solid.vertices_m.min(axis=0)) & (places < solid.vertices_m.max(axis=0))).all(axis=1)
            own = places[maybe]
            inside = igl.winding_number(solid.vertices_m, solid.faces, own) > 0.5
            square = igl.point_mesh_squared_distance(own, solid.vertices_m, solid.faces)[0]
            truth[maybe] = np.maximum(truth[maybe], np.where(inside, np.sqrt(square), 0))
    wrong = (np.abs(depth_m.reshape(-1) - truth) > 1e-12).sum()
    return f"{wrong} of {depth_m.size:,} ({(depth_m > 0).mean():.0%} inside)"


def volume_row(asked: Asked, cell_m: float) -> list[str]:
    index, faces = SurfaceIndex(asked.model), load_embedded_hands().right.faces
    overlap = SolidOverlap(index, cell_m)
    times = medians(
        {
            "volume": lambda: overlap.volume_m3(asked.places_m, faces, asked.hinge_rad),
            "lines": lambda: SolidOverlap(index, cell_m),
        },
        RUNS,
    )
    volume = overlap.volume_m3(asked.places_m, faces, asked.hinge_rad)
    return [
        asked.model.name,
        f"{1e3 * cell_m:g} mm",
        f"{times['volume'].processor / FRAMES * 1e6:.0f}",
        f"{times['lines'].processor * 1e3:.0f}",
        f"{1e6 * volume.mean():.3f}",
    ]


if __name__ == "__main__":
    sys.exit(main())
