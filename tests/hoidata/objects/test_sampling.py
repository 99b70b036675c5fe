"""Sampled points: on the surface, even, deterministic, and equal to a plain farthest-point loop."""

import numpy as np
import pytest
import trimesh

from hoidata.errors import BadInput
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.objects.sampling import SampledPoints, sample_points
from tests.builders.objects import model_of, two_parts


def from_barycentric(model: ObjectModel, points: SampledPoints) -> np.ndarray:
    return np.einsum("pc,pcx->px", points.barycentric, model.vertices_m[model.faces[points.face]])


def test_a_cube_of_8_vertices_gives_1024_distinct_points_on_its_surface() -> None:
    model = model_of(trimesh.creation.box((0.1, 0.1, 0.1)))
    points = sample_points(model)
    assert points.method == "surface-fps"
    assert len(np.unique(points.points_m, axis=0)) == 1024
    np.testing.assert_allclose(np.abs(points.points_m).max(axis=1), 0.05, atol=1e-7)
    np.testing.assert_allclose(from_barycentric(model, points), points.points_m, atol=1e-7)
    np.testing.assert_allclose(points.normals, model_normals(model)[points.face], atol=1e-7)


def model_normals(model: ObjectModel) -> np.ndarray:
    return trimesh.Trimesh(model.vertices_m, model.faces, process=False).face_normals


def test_surface_points_fall_on_faces_in_proportion_to_area() -> None:
    model = model_of(trimesh.creation.box((0.1, 0.2, 0.3)))
    points = sample_points(model)
    side = np.abs(points.normals).argmax(axis=1)
    areas = np.array([0.2 * 0.3, 0.1 * 0.3, 0.1 * 0.2])
    np.testing.assert_allclose(np.bincount(side) / 1024, areas / areas.sum(), atol=0.03)


def test_surface_points_leave_no_hole() -> None:
    model = model_of(trimesh.creation.box((0.1, 0.1, 0.1)))
    probes, _ = trimesh.sample.sample_surface(trimesh.Trimesh(model.vertices_m, model.faces), 3000, seed=3)
    gaps = np.linalg.norm(probes[:, None] - sample_points(model).points_m[None], axis=2).min(axis=1)
    # 1024 points on 600 cm^2: an ideal hexagonal layout covers everything within 4.8 mm.
    assert gaps.max() < 0.0065


def test_a_fine_mesh_is_sampled_at_its_vertices_from_the_first() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    model = model_of(sphere)
    points = sample_points(model)
    assert points.method == "vertices-fps"
    np.testing.assert_array_equal(points.points_m[0], sphere.vertices[0].astype(np.float32))
    vertices = {tuple(vertex) for vertex in sphere.vertices.astype(np.float32)}
    assert {tuple(point) for point in points.points_m} <= vertices
    np.testing.assert_allclose(from_barycentric(model, points), points.points_m, atol=1e-7)
    np.testing.assert_allclose(points.normals, points.points_m / 0.05, atol=0.01)


def test_many_vertices_with_one_long_edge_are_sampled_on_the_surface() -> None:
    stretched = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    stretched.vertices[0] *= 2
    assert sample_points(model_of(stretched)).method == "surface-fps"


def test_vertices_off_every_face_are_never_sampled() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    vertices = np.concatenate([[[9.0, 9, 9]], sphere.vertices])
    model = ObjectModel("ball", vertices, sphere.faces + 1, np.zeros(len(vertices), np.uint8))
    assert np.abs(sample_points(model).points_m).max() < 0.051


@pytest.mark.parametrize("subdivisions", [1, 4])
def test_points_of_the_moving_part_are_marked_and_lie_on_its_faces(subdivisions: int) -> None:
    base = trimesh.creation.icosphere(subdivisions, radius=0.05)
    lid = trimesh.creation.icosphere(subdivisions, radius=0.03).apply_translation((0, 0, 0.2))
    model = two_parts(model_of(base), model_of(lid), (1, 0, 0))
    points = sample_points(model)
    np.testing.assert_array_equal(points.part, (points.points_m[:, 2] > 0.1).astype(np.uint8))
    np.testing.assert_array_equal(points.part, model.face_part[points.face])
    assert 0.1 < points.part.mean() < 0.5


def test_sampling_twice_gives_the_same_bytes() -> None:
    model = model_of(trimesh.creation.cylinder(0.03, 0.1))
    first, second = sample_points(model), sample_points(model)
    assert first.points_m.tobytes() == second.points_m.tobytes()
    assert first.barycentric.tobytes() == second.barycentric.tobytes()


def test_a_mesh_without_area_is_refused() -> None:
    with pytest.raises(BadInput, match="faces with area"):
        sample_points(ObjectModel("line", np.zeros((3, 3)), np.array([[0, 1, 2]]), np.zeros(3, np.uint8)))


UP = Hinge(np.array([0.0, 0.0, 1.0]), np.zeros(3))


def grid(columns: int, rows: int, longest_edge_m: float) -> ObjectModel:
    """A flat grid of squares cut along one diagonal, their longest edge."""
    step = longest_edge_m / np.sqrt(2)
    x, y = np.meshgrid(np.arange(columns) * step, np.arange(rows) * step)
    corner = np.arange(columns * rows).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.column_stack((a, b, c)), np.column_stack((a, c, d))])
    vertices = np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size)))
    return ObjectModel("sheet", vertices, faces, np.zeros(x.size, np.uint8))


@pytest.mark.parametrize(
    ("columns", "rows", "longest_edge_m", "method"),
    [
        (32, 32, 0.0199, "vertices-fps"),
        (32, 32, 0.0201, "surface-fps"),
        (33, 31, 0.0199, "surface-fps"),
    ],
    ids=["1024 vertices", "an edge over 2 cm", "1023 vertices"],
)
def test_vertices_serve_from_1024_of_them_and_up_to_edges_of_2_cm(columns, rows, longest_edge_m, method) -> None:
    assert sample_points(grid(columns, rows, longest_edge_m)).method == method


def test_vertices_at_the_seam_of_two_parts_take_a_face_of_their_part() -> None:
    sphere = trimesh.creation.icosphere(4, radius=0.05)
    part = (sphere.vertices[:, 2] > 0).astype(np.uint8)
    model = ObjectModel("split", np.array(sphere.vertices), np.array(sphere.faces), part=part, hinge=UP)
    points = sample_points(model)
    np.testing.assert_array_equal(points.part, points.points_m[:, 2] > 0)
    np.testing.assert_array_equal(model.face_part[points.face], points.part)


def test_touching_parts_keep_separate_normals() -> None:
    sphere = trimesh.creation.icosphere(4, radius=0.05)
    lining = ObjectModel(
        "in", np.array(sphere.vertices), sphere.faces[:, ::-1], np.zeros(len(sphere.vertices), np.uint8)
    )
    points = sample_points(two_parts(model_of(sphere), lining, (1, 0, 0)))
    outwards = np.where(points.part == 1, -1, 1)[:, None] * points.points_m / 0.05
    np.testing.assert_allclose(points.normals, outwards, atol=0.01)
