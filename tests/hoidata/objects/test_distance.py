"""Signed distance against formulas for a sphere and a box, and on split, open and broken meshes."""

import numpy as np
import pytest
import trimesh

from hoidata.errors import BadInput
from hoidata.objects.distance import SignedDistance, closest_points
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex


def signed_distance(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> SignedDistance:
    model = ObjectModel("mesh", np.array(vertices), np.array(faces), np.zeros(len(vertices), np.uint8))
    return SignedDistance(*(array[0] for array in SurfaceIndex(model).nearest(points[None], None)))


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    outside = np.linalg.norm(np.maximum(np.abs(points) - half, 0), axis=1)
    return outside + np.minimum((np.abs(points) - half).max(axis=1), 0)


@pytest.fixture
def queries() -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.08, 0.08, (2000, 3))


def test_signed_distance_to_a_box_equals_the_formula(queries: np.ndarray) -> None:
    box = trimesh.creation.box((0.06, 0.04, 0.1))
    result = signed_distance(box.vertices, box.faces, queries)
    np.testing.assert_allclose(result.distance_m, box_distance(queries, np.array((0.03, 0.02, 0.05))), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(result.closest_m - queries, axis=1), abs(result.distance_m), atol=1e-12)


def test_signed_distance_to_a_fine_sphere_is_radius_minus_its_sagitta(queries: np.ndarray) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    result = signed_distance(sphere.vertices, sphere.faces, queries)
    error = result.distance_m - (np.linalg.norm(queries, axis=1) - 0.05)
    assert np.abs(error).max() < 1e-4
    away = np.linalg.norm(queries, axis=1) > 0.01
    outward = result.closest_m / np.linalg.norm(result.closest_m, axis=1, keepdims=True)
    assert (result.normal * outward).sum(axis=1)[away].min() > 0.99


def test_a_mesh_split_into_separate_triangles_gives_the_same_signs(queries: np.ndarray) -> None:
    box = trimesh.creation.box((0.06, 0.04, 0.1))
    soup = box.vertices[box.faces].reshape(-1, 3)
    split = signed_distance(soup, np.arange(len(soup)).reshape(-1, 3), queries)
    np.testing.assert_allclose(split.distance_m, signed_distance(box.vertices, box.faces, queries).distance_m)


@pytest.mark.parametrize("missing", [0, 1], ids=["closed", "open"])
def test_an_inverted_mesh_has_the_same_inside(queries: np.ndarray, missing: int) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    vertices, faces = sphere.vertices + np.array([0.3, 0, 0]), sphere.faces[missing:]
    outward = signed_distance(vertices, faces, queries + np.array([0.3, 0, 0]))
    inward = signed_distance(vertices, faces[:, ::-1], queries + np.array([0.3, 0, 0]))
    assert (outward.distance_m < 0).sum() > 100
    np.testing.assert_allclose(inward.distance_m, outward.distance_m, atol=1e-12)
    np.testing.assert_allclose(inward.normal, outward.normal, atol=1e-12)


def test_a_box_with_a_small_hole_still_knows_its_inside() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    points = np.array([[0.0, 0, 0], [0.02, 0, 0], [0.1, 0, 0]])
    result = signed_distance(sphere.vertices, sphere.faces[1:], points)
    assert (result.distance_m < 0).tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("vertices", "faces"), [(np.zeros((3, 3)), [[0, 1, 2]]), (np.full((3, 3), np.nan), [[0, 1, 2]])]
)
def test_a_mesh_without_a_surface_is_refused(vertices: np.ndarray, faces: list) -> None:
    with pytest.raises(BadInput, match="object mesh"):
        signed_distance(vertices, np.array(faces), np.zeros((1, 3)))


def test_a_distance_is_that_to_its_closest_point(queries: np.ndarray) -> None:
    box = trimesh.creation.box((0.06, 0.04, 0.1))
    result = closest_points(box.vertices, box.faces, queries)
    np.testing.assert_allclose(result.distance_m, np.linalg.norm(result.closest_m - queries, axis=1), atol=1e-12)
