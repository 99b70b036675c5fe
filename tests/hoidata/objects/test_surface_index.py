"""Exact labels, distances and depths of the surface index against libigl, brute force and formulas."""

import gzip
import os
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.objects.mesh import parse_obj
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.objects.solid import Solid
from hoidata.objects.surface_index import PartSurface, SurfaceIndex, surface_index
from tests.builders.objects import box_model, model_of, two_parts

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
AT_ONCE, NEVER = 0, 10**12  # from how many places on there is a grid
THRESHOLD_M = 0.005
CLEAR_M = 1e-12  # libigl's and our rounding may differ by less


def bumpy_torus() -> trimesh.Trimesh:
    torus = trimesh.creation.torus(0.05, 0.02, major_sections=40, minor_sections=24)
    torus.vertices += 0.004 * np.sin(60 * torus.vertices[:, ::-1])
    return torus


MESHES = {
    "box": trimesh.creation.box((0.06, 0.04, 0.1)),
    "plate of 2 mm": trimesh.creation.box((0.15, 0.12, 0.002)),
    "needle": trimesh.creation.cylinder(0.0005, 0.2, sections=5),
    "bumpy torus": bumpy_torus(),
    "cone": trimesh.creation.cone(0.03, 0.12, sections=60),
}


def queries(vertices_m: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Places all round a mesh: a quarter in its box, a quarter at its vertices, the rest at the threshold."""
    rng = np.random.default_rng(seed)
    low, high = vertices_m.min(axis=0) - 0.03, vertices_m.max(axis=0) + 0.03
    spread = rng.uniform(low, high, (count // 4, 3))
    corners = vertices_m[rng.integers(len(vertices_m), size=count - len(spread))]
    away = rng.normal(size=corners.shape)
    away *= rng.uniform(0, 2 * THRESHOLD_M, (len(corners), 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    along = corners[rng.permutation(len(corners))]
    weight = np.where(rng.random((len(corners), 1)) < 0.5, 0, rng.random((len(corners), 1)))
    return np.concatenate([spread, corners + weight * (along - corners) + away])


def igl_distance(model: ObjectModel, places_m: np.ndarray) -> np.ndarray:
    return np.sqrt(igl.point_mesh_squared_distance(places_m, model.vertices_m, model.faces.astype(np.int64))[0])


def brute_distance(corners_m: np.ndarray, places_m: np.ndarray) -> np.ndarray:
    """(place,) float64 distances to triangles (face, 3, 3): the plane where the foot is inside, else three segments."""
    a = corners_m[None]
    best = np.full((len(places_m), len(corners_m)), np.inf)
    for start, stop in ((0, 1), (1, 2), (2, 0)):
        edge = a[:, :, stop] - a[:, :, start]
        from_start = places_m[:, None] - a[:, :, start]
        square = (edge**2).sum(-1)
        along = np.clip((from_start * edge).sum(-1) / np.where(square > 0, square, 1), 0, 1)
        best = np.minimum(best, np.linalg.norm(from_start - along[..., None] * edge, axis=-1))
    normal = np.cross(a[:, :, 1] - a[:, :, 0], a[:, :, 2] - a[:, :, 0])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1)
    height = ((places_m[:, None] - a[:, :, 0]) * normal).sum(-1)
    foot = places_m[:, None] - height[..., None] * normal
    inside = np.broadcast_to(length[..., 0] > 0, height.shape).copy()
    for start, stop in ((0, 1), (1, 2), (2, 0)):
        inside &= (np.cross(a[:, :, stop] - a[:, :, start], foot - a[:, :, start]) * normal).sum(-1) >= 0
    return np.where(inside, np.minimum(best, np.abs(height)), best).min(axis=1)


def has_grids(index: SurfaceIndex) -> bool:
    """Every part has been asked about so often that it has its grid."""
    return all(surface.has_grid for surface in index._surfaces.values())


@pytest.mark.parametrize("grid_after", [AT_ONCE, NEVER], ids=["grid", "no grid"])
@pytest.mark.parametrize("name", MESHES)
def test_labels_and_distances_equal_libigl_s(name: str, grid_after: int) -> None:
    model = model_of(MESHES[name])
    index, places = SurfaceIndex(model, grid_after), queries(model.vertices_m, 24_000)
    expected = igl_distance(model, places)
    assert (np.abs(expected - THRESHOLD_M) < 0.002).mean() > 0.1
    clear = np.abs(expected - THRESHOLD_M) > CLEAR_M
    assert not has_grids(index)
    np.testing.assert_array_equal(
        (expected < THRESHOLD_M)[clear], index.within(places[None], None, THRESHOLD_M)[0][clear]
    )
    np.testing.assert_allclose(index.distance_m(places[None], None)[0], expected, atol=1e-14)
    assert has_grids(index) == (grid_after == AT_ONCE)
    near = index.distance_m(places[None], None, 0.02)[0]
    np.testing.assert_array_equal(np.isinf(near), expected > 0.02)
    np.testing.assert_allclose(near[expected <= 0.02], expected[expected <= 0.02], atol=1e-14)


def test_distances_to_degenerate_triangles_equal_brute_force() -> None:
    """On a coarse lattice triangles collapse to segments, coincide, cross, and places lie on them."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        corners = rng.integers(0, 4, (rng.integers(1, 30), 3)) * np.array([0.01, 0.02, rng.choice([0, 1e-7, 0.01])])
        faces = rng.integers(0, len(corners), (rng.integers(1, 40), 3))
        model = ObjectModel("soup", corners, faces, np.zeros(len(corners), np.uint8))
        distinct = [len(np.unique(corners[face], axis=0)) == 3 for face in faces]
        if not any(distinct):
            continue
        places = np.concatenate([rng.integers(-2, 6, (60, 3)) * 0.01, rng.uniform(-0.02, 0.08, (60, 3))])
        expected = brute_distance(corners[faces[distinct]], places)
        for grid_after in (AT_ONCE, NEVER):
            index = SurfaceIndex(model, grid_after)
            distance_m = index.distance_m(places[None], None)[0]
            np.testing.assert_allclose(distance_m, expected, atol=1e-14)
            for threshold_m in (0.01, 0.02, 1e-9):
                within = index.within(places[None], None, threshold_m)[0]
                np.testing.assert_array_equal(within, distance_m < threshold_m)


def test_a_grid_changes_no_bit_of_the_results() -> None:
    model = model_of(MESHES["bumpy torus"])
    with_grid, without = SurfaceIndex(model, AT_ONCE), SurfaceIndex(model, NEVER)
    places = queries(model.vertices_m, 5000, seed=2)[None]
    for ask in (lambda i: i.distance_m(places, None), lambda i: i.depth_m(places, None)):
        np.testing.assert_array_equal(ask(with_grid), ask(without))
    for threshold_m in (1e-6, 0.001, 0.02, 0.1):
        np.testing.assert_array_equal(
            with_grid.within(places, None, threshold_m), with_grid.distance_m(places, None) < threshold_m
        )


def test_the_threshold_is_exclusive_and_the_maximum_inclusive() -> None:
    model = model_of(trimesh.creation.box((0.5, 0.5, 0.5)))
    places = np.array([[[0.0, 0.0, 0.5], [0.0, 0.0, 0.25]]])
    for grid_after in (AT_ONCE, NEVER):
        index = SurfaceIndex(model, grid_after)
        np.testing.assert_array_equal(index.within(places, None, 0.25), [[False, True]])
        np.testing.assert_array_equal(index.distance_m(places, None, 0.25), [[0.25, 0]])
        np.testing.assert_array_equal(index.distance_m(places, None, 0.0), [[np.inf, 0]])
        np.testing.assert_array_equal(index.within(places, None, 0.0), [[False, False]])


def laptop() -> ObjectModel:
    """Two plates, the upper turned by a slanted hinge."""
    base, lid = box_model((0.2, 0.15, 0.01)), box_model((0.2, 0.15, 0.004), middle_m=(0, 0, 0.008))
    axis = np.array([1, 0.1, 0.05]) / np.linalg.norm([1, 0.1, 0.05])
    return two_parts(base, lid, tuple(axis), (0, 0.075, 0.006), "laptop")


@pytest.mark.parametrize("grid_after", [AT_ONCE, NEVER], ids=["grid", "no grid"])
def test_distances_and_depths_of_parts_are_right_at_all_angles(grid_after: int) -> None:
    model, angles = laptop(), np.linspace(-2.5, 4, 40)
    posed = articulate(model.vertices_m, model.part, model.hinge, angles)
    places = np.stack([queries(vertices, 300, seed) for seed, vertices in enumerate(posed)])
    index = SurfaceIndex(model, grid_after)
    for ask in (index.distance_m, index.depth_m):
        assert np.ptp(ask(places, angles), axis=1).min() > 0
    distance_m, inside = index.distance_m(places, angles), index.depth_m(places, angles)
    within = index.within(places, angles, THRESHOLD_M)
    for frame, vertices in enumerate(posed):
        whole = ObjectModel("posed", vertices, model.faces, model.part)
        expected = igl_distance(whole, places[frame])
        np.testing.assert_allclose(distance_m[frame], expected, atol=1e-12)
        np.testing.assert_array_equal(within[frame], expected < THRESHOLD_M)
        signed = [
            igl.signed_distance(places[frame], vertices, model.faces[model.face_part == part].astype(np.int64))[0]
            for part in (0, 1)
        ]
        np.testing.assert_allclose(inside[frame], np.maximum(-np.minimum(*signed), 0), atol=1e-12)


def test_an_articulated_object_without_angles_is_refused() -> None:
    with pytest.raises(BadInput, match="hinge angle"):
        SurfaceIndex(laptop()).within(np.zeros((1, 1, 3)), None, THRESHOLD_M)


def test_results_are_unchanged_when_object_and_points_move_or_are_mirrored() -> None:
    mesh = MESHES["cone"]
    places = queries(np.array(mesh.vertices), 3000, seed=5)
    plain = SurfaceIndex(model_of(mesh))
    distance, depth = plain.distance_m(places[None], None), plain.depth_m(places[None], None)
    rotation, part = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), np.zeros(len(mesh.vertices), np.uint8)
    moved = ObjectModel("moved", mesh.vertices @ rotation.T + [1, 2, -0.5], np.array(mesh.faces), part)
    mirrored = ObjectModel("mirrored", mesh.vertices * [-1, 1, 1], mesh.faces[:, ::-1], part)
    assert depth.any()
    for model, positions in ((moved, places @ rotation.T + [1, 2, -0.5]), (mirrored, places * [-1, 1, 1])):
        np.testing.assert_allclose(SurfaceIndex(model).distance_m(positions[None], None), distance, atol=1e-14)
        np.testing.assert_allclose(SurfaceIndex(model).depth_m(positions[None], None), depth, atol=1e-14)


def test_triangles_without_area_are_segments_and_nan_points_are_infinitely_far() -> None:
    """A needle folded flat: its corners are distinct, its area is zero."""
    vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.05, 0, 0], [0, 0.1, 0]])
    model = ObjectModel("flat", vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(4, np.uint8))
    places = np.array([[[0.08, 0.0, 0.003], [0.05, -0.004, 0.0], [np.nan, 0, 0]]])
    index = SurfaceIndex(model)
    np.testing.assert_allclose(index.distance_m(places, None)[0], [0.003, 0.004, np.inf], atol=1e-17)
    np.testing.assert_array_equal(index.within(places, None, 0.0035)[0], [True, False, False])


def test_the_index_is_cached_by_mesh_hinge_and_parts() -> None:
    model = laptop()
    again = ObjectModel(
        model.name, model.vertices_m.copy(), model.faces.copy(), part=model.part.copy(), hinge=model.hinge
    )
    assert surface_index(model) is surface_index(again)
    assert model.hinge is not None
    other = replace(model, hinge=Hinge(model.hinge.axis, np.zeros(3)))
    assert surface_index(other) is not surface_index(model)
    swapped = replace(model, part=1 - model.part)
    assert surface_index(swapped) is not surface_index(model)


def test_only_recently_used_indices_are_cached(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hoidata.objects.surface_index.MAX_CACHED_TRIANGLES", 30)
    boxes = [model_of(trimesh.creation.box((0.1, 0.1, size)), f"box of {size}") for size in (0.1, 0.2, 0.3)]
    first, second = surface_index(boxes[0]), surface_index(boxes[1])
    assert surface_index(boxes[0]) is first
    surface_index(boxes[2])
    assert surface_index(boxes[0]) is first
    assert surface_index(boxes[1]) is not second


@pytest.mark.long
@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the meshes are not part of this repository")
def test_contact_labels_and_depths_on_manipnet_s_meshes_equal_libigl_s() -> None:
    n_queriesries = 0
    for path in sorted(Path(ROOT).glob("objects/*/*.obj.gz")):
        mesh = parse_obj(gzip.decompress(path.read_bytes()).decode(), path)
        model = ObjectModel(path.stem, 0.1 * mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))
        places = queries(model.vertices_m, 10_000)
        expected, few = igl_distance(model, places), places[:2000]
        with_grid, without = SurfaceIndex(model, AT_ONCE), SurfaceIndex(model, NEVER)
        solid = with_grid.solids[0]
        assert isinstance(solid, Solid)
        inside = igl.winding_number(solid.vertices_m, solid.faces, few) > 0.5
        depth = np.sqrt(igl.point_mesh_squared_distance(few, solid.vertices_m, solid.faces)[0])
        for index in (with_grid, without):
            np.testing.assert_array_equal(index.within(places[None], None, THRESHOLD_M)[0], expected < THRESHOLD_M)
            np.testing.assert_allclose(index.distance_m(places[None], None)[0], expected, atol=1e-12)
            np.testing.assert_allclose(index.depth_m(few[None], None)[0], np.where(inside, depth, 0), atol=1e-12)
        n_queriesries += len(places)
    assert n_queriesries >= 150_000


def test_closest_points_and_gradients_of_a_ball_are_exact_and_nan_stays_nan():
    ball = SurfaceIndex(model_of(trimesh.creation.icosphere(5, 0.05)))
    positions = np.random.default_rng(0).normal(0, 0.05, (2, 50, 3))
    nearest = ball.nearest(positions, None)
    length = np.linalg.norm(positions, axis=-1)
    np.testing.assert_allclose(nearest.distance_m, length - 0.05, atol=1e-4)
    np.testing.assert_allclose(nearest.normal, positions / length[..., None], atol=0.05)
    np.testing.assert_allclose(
        nearest.closest_m + nearest.distance_m[..., None] * nearest.normal, positions, atol=1e-12
    )
    lost = ball.nearest(np.full((1, 1, 3), np.nan), None)
    assert np.isinf(lost.distance_m).all()
    assert np.isnan(lost.closest_m).all()


def test_the_closest_point_next_to_a_vertex_is_that_vertex():
    rod = trimesh.creation.cylinder(0.03, 0.1, sections=40)
    surface = PartSurface(rod.vertices, rod.faces, True, 10**9)
    positions = np.repeat(np.asarray(rod.vertices), 50, axis=0)
    positions[:, 2] += np.sign(positions[:, 2]) * 10 ** np.random.default_rng(0).uniform(-12, -7, len(positions))
    nearest = surface.nearest(positions)
    np.testing.assert_allclose(nearest.closest_m, np.repeat(np.asarray(rod.vertices), 50, axis=0), atol=1e-9)


# Seeds of which 74, 153 and 1 of 4,000 places were far from the place that was said to be theirs.
@pytest.mark.parametrize(("seed", "shaken"), [(21, False), (30, False), (183, True)])
def test_the_closest_point_on_sliver_triangles_has_the_reported_distance(seed: int, shaken: bool) -> None:
    drawn = np.random.default_rng(seed)
    vertices = np.outer(drawn.normal(size=40), drawn.normal(size=3))  # on a line, but for rounding
    if shaken:
        vertices *= 10.0 ** drawn.integers(-3, 3)
        vertices += drawn.normal(size=3) * drawn.choice([0, 0, 1, 1e3])
        vertices += drawn.normal(size=vertices.shape) * 10.0 ** drawn.uniform(-18, -3)
    faces = drawn.integers(0, 40, (60, 3))
    corners, size = vertices[faces], np.ptp(vertices, axis=0).max()
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-300
    near = drawn.integers(0, 60, 4000)
    positions = corners[near, 0] + normals[near] * size * 10 ** drawn.uniform(-6, 0, (4000, 1))
    nearest = PartSurface(vertices, faces, False, 10**9).nearest(positions)
    apart = np.linalg.norm(positions - nearest.closest_m, axis=1)
    np.testing.assert_allclose(apart, nearest.distance_m, atol=1e-6 * size)


def test_the_signed_distance_inside_a_cube_is_that_to_its_nearest_face():
    cube = SurfaceIndex(box_model((0.2, 0.2, 0.2)))
    points = np.array([[[0.0, 0.0, 0.09], [0.0, 0.0, 0.12]], [[0.0, 0.0, 0.11], [0.0, 0.0, 0.3]]])
    nearest = cube.nearest(points, None)
    np.testing.assert_allclose(nearest.distance_m[0], [-0.01, 0.02], atol=1e-12)
    np.testing.assert_allclose(cube.depth_m(points, None).max(axis=1), [0.01, 0.0], atol=1e-12)
    np.testing.assert_allclose(nearest.closest_m[0, 0], [0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(nearest.normal[0, 0], [0, 0, 1], atol=1e-12)


def test_the_closest_point_on_a_moved_lid_is_on_the_lid():
    base, lid = (
        box_model((0.1, 0.1, 0.04), middle_m=(0.05, 0, -0.021)),
        box_model((0.1, 0.1, 0.02), middle_m=(0.05, 0, 0.011)),
    )
    model = two_parts(base, lid, (0, -1, 0))
    angles = np.array([0.4, 1.1])
    top = articulate(np.array([[0.05, 0.0, 0.021 + 0.005]]), np.ones(1), model.hinge, angles)
    nearest = SurfaceIndex(model).nearest(top, angles)
    np.testing.assert_allclose(nearest.distance_m[:, 0], 0.005, atol=1e-9)
    surface = articulate(np.array([[0.05, 0.0, 0.021]]), np.ones(1), model.hinge, angles)
    np.testing.assert_allclose(nearest.closest_m, surface, atol=1e-9)
