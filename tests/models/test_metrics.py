"""Measures of evaluation against values computed by hand."""

import numpy as np
import pytest
import trimesh

from hoidata.objects.model import Hinge, ObjectModel
from models.common import metrics


def box(size: tuple[float, float, float], shift: float = 0.0) -> trimesh.Trimesh:
    made = trimesh.creation.box(size)
    made.apply_translation((shift, 0, 0))
    return made


def test_f1_is_the_harmonic_mean_of_precision_and_recall() -> None:
    predicted, true = np.array([1, 1, 1, 0, 0], bool), np.array([1, 1, 0, 1, 0], bool)
    precision, recall = 2 / 3, 2 / 3
    assert metrics.f1_score(predicted, true) == pytest.approx(2 * precision * recall / (precision + recall))
    nothing = np.zeros(5, bool)
    assert metrics.f1_score(nothing, nothing) == 1
    assert metrics.f1_score(predicted, nothing) == 0


def test_the_best_threshold_separates_the_maps() -> None:
    chances = np.array([[0.1, 0.4, 0.62, 0.9], [0.2, 0.3, 0.7, 0.8]])
    true = np.array([[0, 0, 1, 1], [0, 0, 1, 1]], bool)
    best = metrics.best_threshold(chances, true)
    assert best == pytest.approx(0.45)
    assert metrics.mean_f1(chances, true, best) == 1
    assert metrics.mean_f1(chances, true, 0.65) == pytest.approx((2 / 3 + 1) / 2)


def test_the_mean_map_by_place_reads_the_nearest_training_points() -> None:
    cloud = np.array([[[0.0, 0, 0], [1.0, 0, 0]], [[0.0, 0, 0], [1.0, 0, 0]]])
    maps = np.array([[1, 0], [1, 1]])
    found = metrics.spatial_mean_map(np.array([[0.9, 0, 0], [0.1, 0, 0]]), cloud, maps)
    np.testing.assert_allclose(found, [0.5, 1.0])


def test_joint_error_is_in_millimetres_over_present_frames() -> None:
    true = np.zeros((2, 3, 21, 3))
    predicted = true + np.array([0.003, 0.004, 0.0])
    predicted[1] += 9.0
    present = np.array([[True, True, False], [False, False, False]])
    assert metrics.joint_error_mm(predicted, true, present) == pytest.approx(5.0)


def test_depth_is_measured_to_the_nearest_face() -> None:
    mesh = box((0.1, 0.2, 0.2))
    model = ObjectModel("box", mesh.vertices, mesh.faces, np.zeros(8, np.uint8))
    points = np.array([[[0.04, 0, 0], [0.06, 0, 0], [0.0, 0.0, 0.0]]])
    np.testing.assert_allclose(metrics.depths_m(model, points, None), [[0.01, 0, 0.05]], atol=1e-9)
    np.testing.assert_allclose(metrics.surface_distances_m(model, points, None), [[0.01, 0.01, 0.05]], atol=1e-9)


def test_depth_follows_the_hinge() -> None:
    base, lid = box((0.1, 0.1, 0.02), -0.05), box((0.1, 0.1, 0.02), 0.05)
    vertices = np.concatenate([base.vertices, lid.vertices])
    faces = np.concatenate([base.faces, lid.faces + 8])
    hinge = Hinge(np.array([0.0, 1.0, 0.0]), np.zeros(3))
    model = ObjectModel("notebook", vertices, faces, (np.arange(16) >= 8).astype(np.uint8), hinge)
    # Closed at 0; at -90 degrees about y the lid stands up along +z.
    points = np.array([[[0.05, 0, 0], [0, 0, 0.05]]] * 2)
    found = metrics.depths_m(model, points, np.array([0.0, -np.pi / 2]))
    np.testing.assert_allclose(found, [[0.01, 0], [0, 0.01]], atol=1e-9)


def test_points_move_into_the_object_frame() -> None:
    turn = np.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]])
    local = np.array([[[0.1, 0.2, 0.3]]])
    world = local @ turn.transpose(0, 2, 1) + np.array([1.0, 2, 3])
    np.testing.assert_allclose(metrics.points_in_object_frame(world, turn, np.array([[1.0, 2, 3]])), local)
