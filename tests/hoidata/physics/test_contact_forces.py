import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.hands import load_embedded_hands
from hoidata.objects.mesh import mass_properties
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.physics.contact_forces import (
    GRAVITY_M_S2,
    RESIDUAL_LIMIT,
    BodyMotion,
    angular_velocity,
    body_motion,
    cone_edges,
    force_residual,
    hand_patches,
    patch_contacts,
    required_wrench,
    wrench_columns,
)
from hoidata.synthetic.shapes import sharp_box
from tests.builders.objects import box_model, two_parts

DOWN = np.array([0.0, 0.0, -1.0])
SIZE = (0.1, 0.06, 0.2)


def _still(n_frames: int = 5) -> BodyMotion:
    box = mass_properties(*sharp_box(SIZE))
    centre = np.tile([0.1, 0.2, 0.3], (n_frames, 1))
    return BodyMotion(centre, np.tile(box.inertia_kg_m2, (n_frames, 1, 1)), np.tile(np.eye(3), (n_frames, 1, 1)))


def _table_contacts(centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, -SIZE[2] / 2] for x in (-0.05, 0.05) for y in (-0.03, 0.03)])
    return corners + centre, np.tile(DOWN, (4, 1))


def test_a_box_at_rest_is_explained_by_the_table_under_it():
    motion = _still()
    wrench = required_wrench(motion, 30, DOWN)
    np.testing.assert_allclose(wrench[2], [0, 0, GRAVITY_M_S2, 0, 0, 0], atol=1e-9)
    points, normals = _table_contacts(motion.centre_m[2])
    assert force_residual(points, normals, motion.centre_m[2], wrench[2]) < 1e-9


def test_a_hovering_box_without_contacts_lacks_its_weight():
    motion = _still()
    wrench = required_wrench(motion, 30, DOWN)[2]
    assert force_residual(np.zeros((0, 3)), np.zeros((0, 3)), motion.centre_m[2], wrench) == pytest.approx(9.81)


def test_a_box_held_by_one_wall_alone_is_not_explained():
    motion = _still()
    wrench = required_wrench(motion, 30, DOWN)[2]
    wall = motion.centre_m[2] + np.array([[0.05, 0.0, 0.0], [0.05, 0.02, 0.0], [0.05, 0.0, 0.03]])
    assert force_residual(wall, np.tile([1.0, 0, 0], (3, 1)), motion.centre_m[2], wrench) > 1.0


def test_free_fall_with_spin_needs_no_contact():
    times = np.arange(6)[:, None] / 120
    centre = np.array([0.0, 0.0, 1.0]) + times * [0.3, 0.0, 1.0] - 0.5 * GRAVITY_M_S2 * times**2 * [0, 0, 1]
    rotmats = Rotation.from_rotvec(times * [0.0, 0.0, 4.0]).as_matrix()
    inertia = rotmats @ mass_properties(*sharp_box(SIZE)).inertia_kg_m2 @ rotmats.transpose(0, 2, 1)
    wrench = required_wrench(BodyMotion(centre, inertia, rotmats), 120, DOWN)
    assert force_residual(np.zeros((0, 3)), np.zeros((0, 3)), centre[3], wrench[3]) < RESIDUAL_LIMIT


def test_more_friction_is_never_worse():
    rng = np.random.default_rng(0)
    for _ in range(20):
        points = rng.normal(size=(5, 3)) * 0.05
        normals = rng.normal(size=(5, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        wrench = rng.normal(size=6)
        residuals = [force_residual(points, normals, np.zeros(3), wrench, mu) for mu in (0.1, 0.35, 0.8)]
        assert residuals[0] >= residuals[1] - 1e-9
        assert residuals[1] >= residuals[2] - 1e-9


def test_cone_edges_push_inwards_and_slide_by_the_friction_coefficient():
    normals = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    edges = cone_edges(normals, 0.35)
    along = np.einsum("cek,ck->ce", edges, normals)
    np.testing.assert_allclose(along, -1.0)
    np.testing.assert_allclose(np.linalg.norm(edges + normals[:, None], axis=2), 0.35)


def test_an_off_centre_push_from_above_rotates_the_body_to_that_side():
    """A finger at x = 1 presses down: its four edges add up to four pushes, and their torque turns about +y."""
    columns = wrench_columns(np.array([[1.0, 0, 0]]), np.array([[0.0, 0, 1]]), np.zeros(3))
    np.testing.assert_allclose(columns.sum(axis=1), [0, 0, -4, 0, 4, 0], atol=1e-12)


def test_the_inertia_of_a_box_is_the_textbook_one():
    box = mass_properties(*sharp_box(SIZE))
    x, y, z = np.square(SIZE)
    np.testing.assert_allclose(box.inertia_kg_m2, np.diag([y + z, x + z, x + y]) / 12, atol=1e-12)


def test_angular_velocity_is_found_from_rotations():
    spin = np.array([0.3, -1.0, 2.0])
    rotmats = Rotation.from_rotvec(np.arange(7)[:, None] / 30 * spin).as_matrix()
    np.testing.assert_allclose(angular_velocity(rotmats, 30), np.tile(spin, (7, 1)), atol=1e-9)


def test_accelerations_need_three_frames():
    with pytest.raises(ValueError, match="at least 3 frames"):
        required_wrench(_still(2), 30, DOWN)


def _two_boxes() -> ObjectModel:
    base, lid = (
        box_model((0.1, 0.1, 0.04), middle_m=(0.05, 0, -0.02)),
        box_model((0.1, 0.1, 0.02), middle_m=(0.05, 0, 0.01)),
    )
    return two_parts(base, lid, (0, 1, 0))


def test_a_hinged_object_weighs_its_parts_by_volume_and_moves_its_centre_with_the_lid():
    model = _two_boxes()
    motion = body_motion(model, np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.array([0.0, -np.pi / 2]))
    np.testing.assert_allclose(motion.centre_m[0], [0.05, 0, (2 * -0.02 + 0.01) / 3], atol=1e-9)
    # A quarter turn about +y by a negative angle stands the lid up: (x, z) becomes (-z, x).
    np.testing.assert_allclose(motion.centre_m[1], [(2 * 0.05 - 0.01) / 3, 0, (2 * -0.02 + 0.05) / 3], atol=1e-9)


def test_a_closed_hinged_object_has_the_inertia_of_the_whole_box():
    motion = body_motion(_two_boxes(), np.eye(3)[None], np.zeros((1, 3)), np.zeros(1))
    whole = mass_properties(*sharp_box((0.1, 0.1, 0.06)))
    np.testing.assert_allclose(motion.inertia_kg_m2[0], whole.inertia_kg_m2, atol=1e-12)


def test_every_patch_of_a_hand_has_vertices_and_left_mirrors_right():
    pair = load_embedded_hands()
    right, left = hand_patches(pair.right), hand_patches(pair.left)
    assert set(right) == set(range(21))
    np.testing.assert_array_equal(left, right)


def test_one_contact_per_patch_at_its_deepest_vertex():
    points = np.array([[[0.0, 0.0, 0.1005], [0.01, 0.0, 0.098], [0.05, 0.0, 0.11], [-0.05, 0.0, 0.101]]])
    nearest = SurfaceIndex(box_model((0.2, 0.2, 0.2))).nearest(points, None)
    contacts = patch_contacts(nearest, np.array([0, 0, 1, 2]), 0)
    np.testing.assert_allclose(contacts.points_m, [[0.01, 0, 0.1], [-0.05, 0, 0.1]], atol=1e-12)
