import numpy as np
import pytest
import trimesh

from hoidata.datasets.grab.adapter import OBJECTS as GRAB_WORDS
from hoidata.datasets.h2o.adapter import ACTIONS
from hoidata.hands import load_embedded_hands
from hoidata.objects.mesh import mass_properties
from hoidata.objects.surface_index import PartSurface, surface_index
from hoidata.splits.definitions import published
from hoidata.synthetic.catalogue import OBJECTS, object_model, object_spec
from hoidata.synthetic.hand_capsules import (
    OPEN_RAD,
    capsule_hands,
    close_fingers,
    gradient,
    grid_field,
    sample_placements,
    seen_by,
)
from hoidata.synthetic.shapes import cylinder, revolved, rounded_box, sharp_box, sphere, torus, united
from tests.builders.objects import igl_signed_m

ALL = [(dataset, spec.name) for dataset, specs in OBJECTS.items() for spec in specs]


def _closed_parts(dataset: str, name: str) -> list[trimesh.Trimesh]:
    model = object_model(dataset, name)
    parts = [0, 1] if model.is_articulated else [0]
    return [trimesh.Trimesh(model.vertices_m, model.faces[model.face_part == part], process=True) for part in parts]


@pytest.mark.parametrize(
    ("solid", "volume"),
    [
        (sharp_box((0.1, 0.2, 0.3)), 0.006),
        (sphere(0.05, 80), 4 / 3 * np.pi * 0.05**3),
        (cylinder(0.03, 0.1, 0.001, 120), np.pi * 0.03**2 * 0.1),
        (torus(0.06, 0.02, 90, 60), 2 * np.pi**2 * 0.06 * 0.02**2),
    ],
)
def test_solids_are_closed_and_have_the_textbook_volume(solid, volume):
    mesh = trimesh.Trimesh(*solid, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(volume, rel=0.005)


def test_a_rounded_box_lies_on_its_analytic_surface():
    size, radius = np.array([0.1, 0.06, 0.04]), 0.005
    points = rounded_box((0.1, 0.06, 0.04), radius).vertices_m
    outside = np.maximum(np.abs(points) - (size / 2 - radius), 0)
    np.testing.assert_allclose(np.linalg.norm(outside, axis=1), radius, atol=1e-12)


def test_a_union_is_one_closed_solid_without_inner_walls():
    union = united(cylinder(0.04, 0.1), sharp_box((0.1, 0.02, 0.02)))
    mesh = trimesh.Trimesh(*union, process=False)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    inside = 2 * 0.02 * 0.02 * 0.0387  # the bar runs 78 mm through the cylinder
    assert mesh.volume == pytest.approx(trimesh.Trimesh(*cylinder(0.04, 0.1)).volume + 0.1 * 0.02**2 - inside, rel=0.01)


def test_a_profile_must_start_and_end_on_the_axis():
    with pytest.raises(ValueError, match="on the axis"):
        revolved([(0.01, 0.0), (0.02, 0.1), (0.0, 0.2)])


@pytest.mark.parametrize(("dataset", "name"), ALL)
@pytest.mark.slow
def test_every_part_of_every_object_is_one_closed_solid(dataset, name):
    for part in _closed_parts(dataset, name):
        assert part.is_watertight
        assert part.is_winding_consistent
        assert part.body_count == 1
        assert part.volume > 2e-5
    model = object_model(dataset, name)
    assert mass_properties(model.vertices_m, model.faces).source == "solid"


@pytest.mark.slow
def test_objects_have_real_names_and_differ_in_shape_and_size():
    names = {dataset: [spec.name for spec in specs] for dataset, specs in OBJECTS.items()}
    assert set(names["h2o"]) <= {noun for _, noun in ACTIONS}
    assert set(names["grab"]) <= set(GRAB_WORDS)
    assert set(names["arctic"]) <= {name.split("/")[1].split("_")[0] for name in published("arctic").sequences}
    volumes = {round(sum(part.volume for part in _closed_parts(*key)), 7) for key in ALL}
    assert len(volumes) == len(ALL) >= 16


@pytest.mark.slow
def test_some_meshes_are_dense_and_even_and_some_coarse():
    dense, coarse = 0, 0
    for key in ALL:
        model = object_model(*key)
        longest = trimesh.Trimesh(model.vertices_m, model.faces, process=False).edges_unique_length.max()
        dense += len(model.vertices_m) >= 1024 and longest <= 0.02
        coarse += len(model.vertices_m) <= 24
    assert dense >= 8
    assert coarse >= 2


@pytest.mark.parametrize("name", [spec.name for spec in OBJECTS["arctic"]])
def test_arctic_objects_turn_about_minus_z_through_their_origin_without_cutting_themselves(name):
    model = object_model("arctic", name)
    assert model.hinge is not None
    np.testing.assert_array_equal(model.hinge.axis, [0, 0, -1])
    np.testing.assert_array_equal(model.hinge.origin_m, 0)
    base, lid = (model.faces[model.face_part == part] for part in (0, 1))
    for angle in (0.0, 0.35, 0.95):
        rotmat = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        moved = model.vertices_m[np.unique(lid)] @ rotmat.T
        assert igl_signed_m(model.vertices_m, base, moved).min() > -1e-6


@pytest.mark.parametrize("key", [("grab", "mug"), ("h2o", "book"), ("grab", "toruslarge"), ("h2o", "spray")])
@pytest.mark.slow
def test_the_search_field_agrees_with_the_mesh_to_half_a_millimetre_near_its_faces(key):
    model = object_model(*key)
    field = grid_field(surface_index(model).filled[0])
    mesh = trimesh.Trimesh(model.vertices_m, model.faces, process=False)
    on_surface, face = trimesh.sample.sample_surface(mesh, 4000, seed=3)
    rng = np.random.default_rng(0)
    points = np.asarray(on_surface) + rng.uniform(-0.003, 0.01, (4000, 1)) * mesh.face_normals[face]
    error = np.abs(field(points) - igl_signed_m(model.vertices_m, model.faces, points))
    assert np.quantile(error, 0.95) < 0.0005
    assert error.max() < 0.003


def test_a_mirrored_field_is_the_field_of_the_mirrored_object():
    model = object_model("grab", "mug")
    turned_round = grid_field(PartSurface(model.vertices_m * [-1, 1, 1], model.faces[:, ::-1], True, 0))
    points = np.random.default_rng(1).uniform(-0.08, 0.1, (600, 3))
    actual, expected = seen_by("left", grid_field(surface_index(model).filled[0]))(points), turned_round(points)
    near = expected < 0.025
    assert near.sum() > 40
    assert np.abs(actual - expected)[near].max() < 0.003


def test_the_gradient_of_a_ball_points_away_from_its_middle():
    field = grid_field(PartSurface(*sphere(0.05, 60), True, 0))
    directions = np.random.default_rng(5).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.einsum("pi,pi->p", gradient(field, 0.052 * directions), directions).min() > 0.98


def test_hinged_objects_stand_with_the_hinge_across_or_upright():
    for spec in OBJECTS["arctic"]:
        axis = spec.upright_from_object @ [0, 0, -1]
        assert np.abs(axis).max() == pytest.approx(1.0)
    assert object_spec("arctic", "microwave").upright_from_object[2, 2] == 1.0


def test_triangles_of_a_union_stand_in_one_order_only():
    union = united(rounded_box((0.1, 0.08, 0.06), 0.01), rounded_box((0.04, 0.04, 0.12), 0.005))
    assert (union.faces.argmin(axis=1) == 0).all()
    assert union.faces.tolist() == sorted(union.faces.tolist())
    assert mass_properties(union.vertices_m, union.faces).volume_m3 > 0.1 * 0.08 * 0.06 * 0.9


def test_hands_that_close_together_close_as_each_alone():
    """Fingers stop at different moments; a hand that still closes must not depend on one that has finished."""
    random = np.random.default_rng(0)

    def ball(points_m: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points_m, axis=-1) - 0.035

    placement = sample_placements(ball, np.tile([0.0, 0.0, 1.0], (6, 1)), np.zeros((6, 3)), (0.0, 1.0), random)
    hands = capsule_hands(load_embedded_hands().right, np.zeros((1, 10))).take(placement.hand)
    wrist_m, flexion_rad = close_fingers(ball, hands, placement)
    assert len({round(float(total), 3) for total in flexion_rad.sum((1, 2))}) == 6
    assert (flexion_rad.sum((1, 2)) > OPEN_RAD.sum() + 1).all()
    for number in range(6):
        one = np.array([number])
        alone = close_fingers(ball, hands.take(one), placement.take(one))
        np.testing.assert_allclose(alone[0][0], wrist_m[number], atol=1e-12)
        np.testing.assert_allclose(alone[1][0], flexion_rad[number], atol=1e-9)
