"""The embedded hand: mesh, weights, mirroring, pose correctives and digest."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.geometry.rotations import mirror_rotvec_x
from hoidata.hands import TIP_VERTICES, load_embedded_hands
from hoidata.hands.embedded import ASSET, pose_correctives, vertex_normals

SMPLX_AND_OTHER_TIP_IDS = {3: (317, 320), 6: (443, 444, 445), 9: (671, 673), 12: (554, 556), 15: (744, 745)}


@pytest.fixture(scope="module")
def pair():
    return load_embedded_hands()


def edges(faces):
    return {(int(face[i]), int(face[(i + 1) % 3])) for face in faces for i in range(3)}


@pytest.mark.parametrize("side", ["left", "right"])
def test_mesh_is_a_disc_with_manos_counts(pair, side):
    model = pair[side]
    directed = edges(model.faces)
    boundary = [edge for edge in directed if edge[::-1] not in directed]
    assert model.template_m.shape == (778, 3)
    assert len(directed) == 3 * 1538  # no edge is used twice in one direction: the winding agrees everywhere
    assert len(boundary) == 16
    assert 778 - (len(directed) + 16) // 2 + 1538 == 1  # Euler number of a disc
    assert set(np.unique(model.faces)) == set(range(778))
    following = dict(boundary)
    loop, vertex = 1, following[boundary[0][0]]
    while vertex != boundary[0][0]:
        loop, vertex = loop + 1, following[vertex]
    assert loop == 16  # one loop, at the wrist
    assert np.abs(model.template_m[[a for a, _ in boundary], 0]).min() > 0.1


@pytest.mark.parametrize("side", ["left", "right"])
def test_faces_point_outward(pair, side):
    model = pair[side]
    normals = vertex_normals(model.template_m, model.faces)
    back_of_hand = model.template_m[:, 1].argmax()
    assert normals[back_of_hand, 1] > 0.5
    outward = model.template_m - np.einsum("vj,jk->vk", model.skin_weights, model.rest_joints_m(np.zeros((1, 10)))[0])
    assert ((normals * outward).sum(1) > 0).mean() > 0.8


@pytest.mark.parametrize("side", ["left", "right"])
def test_weights_and_regressor_rows_sum_to_one_and_are_not_negative(pair, side):
    model = pair[side]
    for matrix in (model.skin_weights, model.joint_regressor):
        assert matrix.min() >= 0
        np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-12)
    assert ((model.skin_weights > 0).sum(axis=1) <= 4).all()
    assert ((model.joint_regressor > 0).sum(axis=1) <= 40).all()


def test_fingers_point_to_minus_x_back_up_and_thumb_to_plus_z(pair):
    joints = pair.right.rest_joints_m(np.zeros((1, 10)))[0]
    for first in (1, 4, 7, 10):
        assert joints[0, 0] > joints[first, 0] > joints[first + 1, 0] > joints[first + 2, 0]
    index, middle, pinky, ring, thumb = joints[[1, 4, 7, 10, 13], 2]
    assert thumb > middle
    assert index > middle > ring > pinky
    assert joints[15, 2] > joints[1, 2]


def test_all_tip_ids_used_for_mano_are_on_the_fingertips(pair):
    model = pair.right
    joints = model.rest_joints_m(np.zeros((1, 10)))[0]
    for distal, ids in SMPLX_AND_OTHER_TIP_IDS.items():
        assert (model.skin_weights[list(ids)].argmax(axis=1) == distal).all()
        axis = joints[distal] - joints[distal - 1]
        reach = (model.template_m - joints[distal]) @ axis / np.linalg.norm(axis)
        reach[model.skin_weights.argmax(axis=1) != distal] = -np.inf
        assert reach[list(ids)].min() > reach.max() - 0.006
    assert {ids for group in SMPLX_AND_OTHER_TIP_IDS.values() for ids in group} > set(TIP_VERTICES)


def test_the_wrist_is_not_at_the_origin(pair):
    np.testing.assert_allclose(pair.right.wrist_offset_m(np.zeros((1, 10)))[0], (0.096, 0.006, 0.006), atol=5e-4)
    np.testing.assert_allclose(pair.left.wrist_offset_m(np.zeros((1, 10)))[0], (-0.096, 0.006, 0.006), atol=5e-4)


def test_left_model_mirrors_the_right_one(pair):
    left, right = pair.left, pair.right
    mirror = np.array([-1.0, 1.0, 1.0])
    np.testing.assert_array_equal(left.template_m, right.template_m * mirror)
    np.testing.assert_array_equal(left.shape_directions, right.shape_directions * mirror[:, None])
    np.testing.assert_array_equal(left.mean_pose, mirror_rotvec_x(right.mean_pose.reshape(15, 3)).ravel())
    # Equal coefficients give mirrored poses. GRAB's files without full poses are read with these components.
    flip = np.tile([1.0, -1.0, -1.0], 15)
    np.testing.assert_array_equal(left.components[:24], right.components[:24] * flip)
    # The public fix of MANO's left shape directions applies if this sum is below 1. It must not apply to this hand.
    assert np.abs(left.shape_directions[:, 0] - right.shape_directions[:, 0]).sum() > 1
    rebuilt = pose_correctives(right.template_m, right.faces, right.skin_weights)
    np.testing.assert_array_equal(rebuilt, right.pose_directions)


def test_the_back_of_a_bent_knuckle_rises(pair):
    model, normals = pair.right, vertex_normals(pair.right.template_m, pair.right.faces)
    bent = np.tile(Rotation.from_rotvec([0, 0, 0.5]).as_matrix() - np.eye(3), (15, 1, 1)).ravel()
    risen_m = ((model.pose_directions @ bent) * normals).sum(axis=1)[normals[:, 1] > 0.9]
    assert risen_m.max() > 0.0003
    assert risen_m.min() >= 0


def test_size_follows_the_first_beta_by_a_centimetre_of_hand_length(pair):
    def length_m(beta):
        betas = np.zeros((1, 10))
        betas[0, 0] = beta
        tip = pair.right.template_m[445] + pair.right.shape_directions[445] @ betas[0]
        return np.linalg.norm(tip - pair.right.wrist_offset_m(betas)[0])

    assert 0.18 < length_m(0) < 0.2
    assert abs(length_m(1) - length_m(0) - 0.01) < 0.001
    deviations_m = np.sqrt((pair.right.shape_directions**2).sum(axis=1).mean(axis=0))
    assert (deviations_m > 5e-5).all()  # all ten components move the mesh


def test_pose_components_are_orthonormal_and_the_mean_is_a_curled_hand(pair):
    np.testing.assert_allclose(pair.right.components @ pair.right.components.T, np.eye(45), atol=1e-5)
    assert (pair.right.mean_pose.reshape(15, 3)[:12, 2] > 0.1).all()


def test_the_asset_is_small_and_has_its_provenance():
    assert ASSET.stat().st_size <= 150_000
    with np.load(ASSET) as asset:
        provenance = str(asset["provenance"])
    assert "MakeHuman" in provenance
    assert "CC0" in provenance


def test_a_scaled_hand_has_the_length_from_the_wrist_joint_to_the_middle_fingertip(pair):
    for model, template_m in zip((pair.left, pair.right), pair.templates_of_length(0.2), strict=True):
        wrist_m = model.rest_joints_m(np.zeros(10), template_m)[0]
        assert np.linalg.norm(template_m[TIP_VERTICES[1]] - wrist_m) == pytest.approx(0.2, abs=1e-6)
        assert np.ptp(template_m / model.template_m) < 1e-5


def test_the_digest_depends_on_content_and_side(pair):
    assert pair.left.digest != pair.right.digest
    assert load_embedded_hands().digest == pair.digest
    other = replace(pair.right, template_m=pair.right.template_m + 1e-9)
    assert other.digest != pair.right.digest
