"""BimArt's object features and distance maps equal k-d tree queries, for each part and in any world frame."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.sensors.part_bps import (
    BasisSettings,
    Nearest,
    PartBps,
    canonical_object,
    distance_map,
    hand_keypoints,
    object_scale,
)
from tests.builders.objects import box_model, model_of, two_parts

COUNT = 40


def lump(size: tuple[float, float, float], middle: tuple[float, float, float], seed: int) -> ObjectModel:
    """A bumpy ellipsoid, so that nearest vertices are unique."""
    mesh = trimesh.creation.icosphere(2, 1.0)
    bumps = 1 + 0.1 * np.random.default_rng(seed).normal(size=(len(mesh.vertices), 1))
    mesh.vertices = mesh.vertices * bumps * size + middle
    return model_of(mesh)


BOTTLE = two_parts(lump((0.05, 0.04, 0.1), (0.03, 0, 0), 0), lump((0.05, 0.04, 0.02), (0.02, 0, 0.12), 1), (0, 0, -1))
ANGLES = np.concatenate((np.linspace(-0.4, 2.0, 9), [0.0]))


@pytest.mark.slow
def test_nearest_vertices_equal_a_tree_query_of_each_frame_and_part_moving_part_first() -> None:
    settings = BasisSettings(COUNT, seed=3)
    bps, scale = PartBps(BOTTLE, settings).nearest_points(ANGLES), object_scale(BOTTLE)
    placed, points = articulate(BOTTLE.vertices_m, BOTTLE.part, BOTTLE.hinge, ANGLES), settings.points()
    for frame, vertices in enumerate(placed):
        for number, part in enumerate((1, 0)):
            part_vertices = np.flatnonzero(BOTTLE.part == part)
            basis_points = slice(number * COUNT, (number + 1) * COUNT)
            nearest = part_vertices[KDTree(scale * vertices[part_vertices]).query(points)[1]]
            np.testing.assert_array_equal(bps.vertex[frame, basis_points], nearest)
            np.testing.assert_allclose(bps.point_m[frame, basis_points], vertices[nearest], atol=1e-6)
            np.testing.assert_allclose(bps.offset[frame, basis_points], scale * vertices[nearest] - points, atol=1e-5)


def test_basis_points_fill_their_ball_evenly_and_come_from_the_seed() -> None:
    points = BasisSettings(4000).points()
    radius = np.linalg.norm(points, axis=1)
    assert radius.max() <= 1
    assert abs((radius < 0.5).mean() - 0.125) < 0.02
    assert np.abs(points.mean(axis=0)).max() < 0.03
    assert not np.array_equal(points, BasisSettings(4000, seed=1).points())


def test_the_scale_brings_the_farthest_vertex_to_0_85_at_any_angle() -> None:
    for vertices in articulate(BOTTLE.vertices_m, BOTTLE.part, BOTTLE.hinge, ANGLES):
        np.testing.assert_allclose(object_scale(BOTTLE) * np.linalg.norm(vertices, axis=1).max(), 0.85, rtol=1e-9)


def test_a_rigid_object_has_no_moving_part() -> None:
    bps = PartBps(canonical_object(box_model(middle_m=(1, 2, 3)))[0], BasisSettings(COUNT)).nearest_points(np.zeros(2))
    np.testing.assert_array_equal(bps.is_present, np.arange(2 * COUNT) >= COUNT)
    assert not bps.offset[:, :COUNT].any()
    assert bps.offset[:, COUNT:].any()


def moved(model: ObjectModel, rotation: np.ndarray, shift: np.ndarray) -> ObjectModel:
    assert model.hinge is not None
    hinge = Hinge(
        rotation @ model.hinge.axis, rotation @ model.hinge.origin_m + shift + 0.3 * (rotation @ model.hinge.axis)
    )
    return replace(model, vertices_m=model.vertices_m @ rotation.T + shift, hinge=hinge)


def test_the_canonical_object_does_not_depend_on_the_pose_of_the_mesh() -> None:
    rotation, shift = rotvec_to_rotmat(np.array([0.4, -1.2, 0.7])), np.array([0.3, 0.2, -0.1])
    for model in (BOTTLE, two_parts(box_model(), lump((0.1, 0.05, 0.02), (0.1, 0, 0), 2), (0, 0.6, 0.8), (0.02, 0, 0))):
        first, second = (canonical_object(variant, "base")[0] for variant in (model, moved(model, rotation, shift)))
        np.testing.assert_allclose(first.vertices_m, second.vertices_m, atol=1e-12)
    assert canonical_object(BOTTLE, "axis")[0] is BOTTLE


def test_the_canonical_frame_has_the_hinge_along_minus_z_and_maps_back() -> None:
    model = moved(BOTTLE, rotvec_to_rotmat(np.array([2.0, 1.0, 0.3])), np.array([0.1, 0, 0]))
    for frame in ("axis", "base"):
        canonical, object_from_canonical = canonical_object(model, frame)
        assert canonical.hinge is not None
        np.testing.assert_allclose(object_from_canonical @ canonical.vertices_m, model.vertices_m, atol=1e-12)
        at_rest, turned = (
            articulate(variant.vertices_m, variant.part, variant.hinge, np.array([0.8]))[0]
            for variant in (model, canonical)
        )
        np.testing.assert_allclose(object_from_canonical @ turned, at_rest, atol=1e-12)


def test_nearest_surface_points_are_equal_in_a_finer_mesh_and_nearest_vertices_are_not() -> None:
    coarse = trimesh.creation.box((0.1, 0.2, 0.05))
    fine = coarse.subdivide().subdivide()
    kinds: tuple[tuple[Nearest, bool], ...] = (("surface", True), ("vertex", False))
    for nearest, same in kinds:
        offsets = [
            PartBps(model_of(mesh), BasisSettings(COUNT, nearest=nearest)).nearest_points(np.zeros(1)).offset
            for mesh in (coarse, fine)
        ]
        assert np.allclose(offsets[0], offsets[1], atol=1e-6) == same


def test_the_nearest_point_is_on_the_closer_part() -> None:
    positions = np.random.default_rng(0).normal(0, 0.1, (len(ANGLES), 7, 3))
    nearest = PartBps(BOTTLE, BasisSettings(4)).nearest_m(positions, ANGLES)
    for frame, vertices in enumerate(articulate(BOTTLE.vertices_m, BOTTLE.part, BOTTLE.hinge, ANGLES)):
        np.testing.assert_allclose(nearest[frame], vertices[KDTree(vertices).query(positions[frame])[1]], atol=1e-12)


def test_a_distance_map_has_the_distance_to_the_nearest_point_of_the_hand() -> None:
    rng = np.random.default_rng(1)
    points, hand = rng.normal(size=(3, 11, 3)), rng.normal(size=(3, 5, 3))
    expected = np.linalg.norm(points[:, :, None] - hand[:, None], axis=-1).min(axis=2)
    np.testing.assert_allclose(distance_map(points, hand), expected, rtol=1e-5)


@pytest.mark.parametrize("count", [20, 64, 100])
def test_keypoints_are_distinct_vertices_of_all_segments(count: int) -> None:
    model = load_embedded_hands().right
    ids = hand_keypoints(model, count)
    assert len(set(ids.tolist())) == count
    segments = model.skin_weights.argmax(axis=1)
    assert set(segments[ids]) == set(segments)
