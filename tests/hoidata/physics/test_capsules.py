"""Capsules against boxes and spheres whose distances are known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import TIP_VERTICES, load_embedded_hands, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.physics.capsules import Capsules, ObjectPoses, capsule_contacts
from hoidata.physics.mano_capsules import N_CAPSULES, fit_capsules, hand_capsules
from tests.builders.clips import random_hand
from tests.builders.objects import box_model, two_parts

SIZE = np.array([0.1, 0.08, 0.06])


BOX = box_model(tuple(SIZE))


def _still(n_frames: int = 1) -> ObjectPoses:
    return ObjectPoses(np.tile(np.eye(3), (n_frames, 1, 1)), np.zeros((n_frames, 3)))


def tin(lid_m: float, origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ObjectModel:
    """Two flat boxes, the upper one so much higher, on a hinge along y."""
    flat = (0.1, 0.1, 0.02)
    return two_parts(box_model(flat), box_model(flat, middle_m=(0, 0, lid_m)), (0, 1, 0), origin_m)


def _capsule(start, end, radius: float) -> Capsules:
    return Capsules(np.array([[start]], dtype=float), np.array([[end]], dtype=float), np.array([radius]))


def _box_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance to the box, by its formula."""
    outside = np.abs(points) - SIZE / 2
    return np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0)


def test_a_capsule_that_dips_into_the_top_touches_there_with_the_depth_of_its_lower_end():
    contacts = capsule_contacts(BOX, _still(), _capsule([0.01, 0, 0.05], [0.02, 0, 0.036], 0.01))
    assert contacts.depth_m == pytest.approx([0.004], abs=1e-6)
    np.testing.assert_allclose(contacts.point_m, [[0.02, 0, 0.03]], atol=1e-9)
    np.testing.assert_allclose(contacts.normal, [[0, 0, 1]], atol=1e-9)
    beside = _capsule([0, 0, 0.0415], [0.01, 0, 0.0415], 0.01)
    assert not len(capsule_contacts(BOX, _still(), beside).frame)


def test_an_axis_inside_the_object_still_has_its_normal_outwards():
    contacts = capsule_contacts(BOX, _still(), _capsule([0, 0, 0.025], [0.01, 0, 0.02], 0.01))
    assert contacts.depth_m == pytest.approx([0.02], abs=1e-6)
    np.testing.assert_allclose(contacts.normal, [[0, 0, 1]], atol=1e-9)


def test_at_an_edge_the_normal_points_from_the_edge_to_the_axis():
    corner = np.array([SIZE[0] / 2, 0, SIZE[2] / 2])
    half_axis = np.array([0, 0.01, 0])
    middle = corner + 0.006 * np.array([0.6, 0, 0.8])
    contacts = capsule_contacts(BOX, _still(), _capsule(middle - half_axis, middle + half_axis, 0.01))
    np.testing.assert_allclose(contacts.normal, [[0.6, 0, 0.8]], atol=1e-6)
    assert contacts.depth_m == pytest.approx([0.004], abs=1e-9)


def test_depths_of_random_capsules_are_those_of_a_dense_search_by_formula():
    rng = np.random.default_rng(0)
    start = rng.normal(size=(1, 400, 3)) * 0.06
    end = start + rng.normal(size=(1, 400, 3)) * 0.02
    radius = rng.uniform(0.005, 0.02, 400)
    fraction = np.linspace(0, 1, 2001)[:, None, None]
    truth = radius - _box_distance(start[0] + fraction * (end - start)[0]).min(axis=0)
    contacts = capsule_contacts(BOX, _still(), Capsules(start, end, radius))
    clear = np.abs(truth) > 1e-4
    hit = np.isin(np.arange(400), contacts.capsule)
    np.testing.assert_array_equal(hit[clear], truth[clear] > 0)
    np.testing.assert_allclose(contacts.depth_m, truth[contacts.capsule], atol=1e-4)
    assert 50 < hit.sum() < 350
    np.testing.assert_allclose(_box_distance(contacts.point_m), 0, atol=1e-9)


def test_contacts_move_with_the_world():
    rng = np.random.default_rng(1)
    capsules = Capsules(rng.normal(size=(3, 20, 3)) * 0.05, rng.normal(size=(3, 20, 3)) * 0.05, np.full(20, 0.01))
    rotation = Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix()
    shift = np.array([1.0, 2.0, 3.0])
    moved = Capsules(capsules.start_m @ rotation.T + shift, capsules.end_m @ rotation.T + shift, capsules.radius_m)
    poses = ObjectPoses(np.tile(rotation, (3, 1, 1)), np.tile(shift, (3, 1)))
    still, world = (capsule_contacts(BOX, *args) for args in ((_still(3), capsules), (poses, moved)))
    np.testing.assert_array_equal(still.frame * 100 + still.capsule, world.frame * 100 + world.capsule)
    np.testing.assert_allclose(still.point_m @ rotation.T + shift, world.point_m, atol=1e-9)
    np.testing.assert_allclose(still.normal @ rotation.T, world.normal, atol=1e-6)


def test_each_capsule_has_one_contact_per_frame_and_absent_hands_have_none():
    start = np.zeros((2, 3, 3))
    start[:, :, 2] = 0.03
    start[1, 1] = np.nan
    capsules = Capsules(start, start + np.array([0.01, 0, 0]), np.array([0.01, 0.01, 0.02]))
    contacts = capsule_contacts(BOX, _still(2), capsules)
    assert list(zip(contacts.frame.tolist(), contacts.capsule.tolist(), strict=True)) == [
        (0, 0),
        (0, 1),
        (0, 2),
        (1, 0),
        (1, 2),
    ]


def test_the_middle_of_the_axis_can_give_point_and_normal_while_depth_stays():
    across = _capsule([0.03, 0, 0.037], [0.06, 0, 0.034], 0.01)
    deepest = capsule_contacts(BOX, _still(), across)
    centre = deepest.at_middle()
    assert deepest.depth_m == pytest.approx(centre.depth_m)
    np.testing.assert_allclose(centre.point_m, [[0.045, 0, 0.03]], atol=1e-9)
    assert deepest.point_m[0, 0] > 0.0499


def test_a_lid_is_touched_where_its_hinge_has_put_it():
    model = tin(0.03, (-0.05, 0.0, 0.02))
    poses = _still(2)._replace(hinge_rad=np.array([0.0, -np.pi / 2]))
    # The lid's top centre (0, 0, 0.04) turns a quarter about (-0.05, 0, 0.02): up and back.
    turned = rotvec_to_rotmat(np.array([0.0, -np.pi / 2, 0.0])) @ np.array([0.05, 0, 0.02]) + [-0.05, 0.0, 0.02]
    start_m = np.array([[[0, 0, 0.045]], [turned + np.array([-0.005, 0, 0])]])
    contacts = capsule_contacts(model, poses, Capsules(start_m, start_m + np.array([0, 0.001, 0]), np.array([0.01])))
    assert contacts.frame.tolist() == [0, 1]
    assert contacts.part.tolist() == [1, 1]
    np.testing.assert_allclose(contacts.depth_m, 0.005, atol=1e-6)
    np.testing.assert_allclose(contacts.normal, [[0, 0, 1], [-1, 0, 0]], atol=1e-6)


def test_a_capsule_in_the_gap_between_two_parts_touches_the_one_it_is_deeper_in():
    model = tin(0.036)
    poses = _still()._replace(hinge_rad=np.zeros(1))
    for height, touched, up in ((0.017, 0, 1), (0.019, 1, -1)):  # the gap is from 10 to 26 mm
        contacts = capsule_contacts(model, poses, _capsule([0, 0, height], [0.01, 0, height], 0.01))
        assert contacts.part.tolist() == [touched]
        np.testing.assert_allclose(contacts.depth_m, 0.003, atol=1e-6)
        np.testing.assert_allclose(contacts.normal, [[0, 0, up]], atol=1e-6)


def test_a_hinged_object_without_angles_is_refused():
    with pytest.raises(BadInput, match="a hinge angle for every frame"):
        capsule_contacts(tin(0.03), _still(), _capsule([0, 0, 0], [0, 0, 0.01], 0.01))


@pytest.mark.parametrize("side", ["left", "right"])
def test_capsules_of_a_posed_hand_are_inside_its_skin_and_reach_the_fingertips(side):
    model, track = load_embedded_hands()[side], random_hand(3, seed=2)
    track = replace(track, hand_pose=0.6 * track.hand_pose)
    capsules = hand_capsules(track, model)
    assert capsules.start_m.shape == (3, N_CAPSULES, 3)
    vertices = track_vertices(track, model).astype(np.float64)
    local = fit_capsules(model, track.betas[0])
    gaps = _signed_gaps(vertices, capsules)
    # Skin lies about where the capsules are: the median vertex within 4 mm of them, no fingertip farther than 3 mm.
    assert np.median(np.abs(gaps)) < 0.004
    assert np.abs(gaps[:, list(TIP_VERTICES)]).max() < 0.003
    assert ((local.radius_m > 0.004) & (local.radius_m < 0.025)).all()
    assert [local.joint[number] for number in (16, 17, 18)] == [13, 14, 15]


def test_both_sides_have_the_same_radii():
    pair, betas = load_embedded_hands(), np.random.default_rng(3).normal(size=10)
    left, right = (fit_capsules(pair[side], betas).radius_m for side in ("left", "right"))
    np.testing.assert_allclose(left, right, atol=2e-4)


def test_the_capsule_cache_distinguishes_shapes_and_personal_meshes():
    model, track = load_embedded_hands().right, random_hand(2, seed=2)
    wide = (model.template_m * 1.2).astype(np.float32)
    shapes = [(track.betas, None), (track.betas + 1, None), (track.betas, wide), (track.betas, None)]
    for betas, template_m in shapes:
        capsules = hand_capsules(replace(track, betas=betas, template_m=template_m), model)
        np.testing.assert_array_equal(capsules.radius_m, fit_capsules(model, betas[0], template_m).radius_m)
    with pytest.raises(ValueError, match="read-only"):
        capsules.radius_m[0] = 1


def test_the_shape_of_capsules_is_that_of_the_first_frame_in_which_the_hand_is_tracked():
    model, track = load_embedded_hands().right, random_hand(3, seed=2)
    betas = np.concatenate([np.zeros((1, 10)), track.betas, track.betas])  # zeros: not tracked in frame 0
    capsules = hand_capsules(replace(track, betas=betas, valid=np.array([False, True, True])), model)
    np.testing.assert_array_equal(capsules.radius_m, fit_capsules(model, track.betas[0]).radius_m)


def _signed_gaps(points: np.ndarray, capsules: Capsules) -> np.ndarray:
    """(frame, point) signed distance to the union of capsules, by the formula of a segment."""
    axis = (capsules.end_m - capsules.start_m)[:, None]
    away = points[:, :, None] - capsules.start_m[:, None]
    along = np.clip((away * axis).sum(-1) / (axis**2).sum(-1), 0, 1)
    return (np.linalg.norm(away - along[..., None] * axis, axis=-1) - capsules.radius_m).min(axis=-1)
