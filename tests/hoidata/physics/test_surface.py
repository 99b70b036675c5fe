import numpy as np
import pytest

from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import articulate
from hoidata.physics.surface import (
    hand_patches,
    patch_contacts,
    penetration_depth_m,
    surface_distances,
)
from tests.builders.objects import box_model, hinged_box, two_parts

CUBE = box_model((0.2, 0.2, 0.2))


def test_depth_inside_a_cube_is_the_distance_to_its_nearest_face():
    points = np.array([[[0.0, 0.0, 0.09], [0.0, 0.0, 0.12]], [[0.0, 0.0, 0.11], [0.0, 0.0, 0.3]]])
    found = surface_distances(CUBE, None, points)
    np.testing.assert_allclose(found.distance_m[0], [-0.01, 0.02], atol=1e-12)
    np.testing.assert_allclose(penetration_depth_m(found), [0.01, 0.0], atol=1e-12)
    np.testing.assert_allclose(found.closest_m[0, 0], [0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(found.normal[0, 0], [0, 0, 1], atol=1e-12)


def test_points_beyond_the_reach_are_infinitely_far():
    found = surface_distances(CUBE, None, np.array([[[0.0, 0.0, 0.15]]]), reach_m=0.03)
    assert np.isinf(found.distance_m).all()


def test_a_moved_lid_is_met_where_it_is():
    base, lid = (
        box_model((0.1, 0.1, 0.04), middle_m=(0.05, 0, -0.021)),
        box_model((0.1, 0.1, 0.02), middle_m=(0.05, 0, 0.011)),
    )
    model = two_parts(base, lid, (0, -1, 0))
    angles = np.array([0.4, 1.1])
    top = articulate(np.array([[0.05, 0.0, 0.021 + 0.005]]), np.ones(1), model.hinge, angles)
    found = surface_distances(model, angles, top)
    np.testing.assert_allclose(found.distance_m[:, 0], 0.005, atol=1e-9)
    surface = articulate(np.array([[0.05, 0.0, 0.021]]), np.ones(1), model.hinge, angles)
    np.testing.assert_allclose(found.closest_m, surface, atol=1e-9)


def test_a_hinged_object_without_its_angles_is_refused():
    with pytest.raises(BadInput, match="a hinge angle for every frame"):
        surface_distances(hinged_box(), None, np.zeros((1, 1, 3)))


def test_every_patch_of_a_hand_has_vertices_and_left_mirrors_right():
    pair = load_embedded_hands()
    right, left = hand_patches(pair.right), hand_patches(pair.left)
    assert set(right) == set(range(21))
    np.testing.assert_array_equal(left, right)


def test_one_contact_per_patch_at_its_deepest_vertex():
    points = np.array([[[0.0, 0.0, 0.1005], [0.01, 0.0, 0.098], [0.05, 0.0, 0.11], [-0.05, 0.0, 0.101]]])
    found = surface_distances(CUBE, None, points)
    contacts = patch_contacts(found, np.array([0, 0, 1, 2]), 0)
    np.testing.assert_allclose(contacts.points_m, [[0.01, 0, 0.1], [-0.05, 0, 0.1]], atol=1e-12)
