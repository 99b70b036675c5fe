"""Forward kinematics against skinning with 4 x 4 matrices, and its gradients."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from hoidata.clips import HandTrack
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import (
    PARENTS,
    TIP_VERTICES,
    HandKinematics,
    HandModel,
    load_embedded_hands,
    track_joints,
    track_vertices,
)
from tests.builders.clips import random_hand


def torch_inputs(track, dtype=torch.float64):
    rotvec = np.concatenate((track.global_orient, track.hand_pose), 1).reshape(-1, 16, 3)
    arrays = (track.wrist_m, rotvec_to_rotmat(rotvec), track.betas)
    return [torch.as_tensor(array, dtype=dtype) for array in arrays]


def reference_skinning(model, wrist_m, rotvec, betas, template_m):
    """Linear blend skinning of one frame with 4 x 4 matrices, loops and the matrix exponential."""
    template = model.template_m if template_m is None else template_m
    local = [expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])) for x, y, z in rotvec]
    shaped = template + model.shape_directions @ betas
    rest = model.joint_regressor @ shaped
    features = np.concatenate([(rotation - np.eye(3)).ravel() for rotation in local[1:]])
    posed = shaped + model.pose_directions @ features
    world = []
    for joint, parent in enumerate(PARENTS):
        move = np.eye(4)
        move[:3, :3] = local[joint]
        move[:3, 3] = wrist_m if parent < 0 else rest[joint] - rest[parent]
        world.append(move if parent < 0 else world[parent] @ move)
    vertices = np.zeros((778, 3))
    for joint in range(16):
        moved = (posed - rest[joint]) @ world[joint][:3, :3].T + world[joint][:3, 3]
        vertices += model.skin_weights[:, joint, None] * moved
    return vertices, np.array([move[:3, 3] for move in world])


def with_shared_tips(model: HandModel) -> HandModel:
    """The model with tips that follow several joints and have pose correctives, as in MANO."""
    rng, tips = np.random.default_rng(8), list(TIP_VERTICES)
    weights, pose = model.skin_weights.copy(), model.pose_directions.copy()
    weights[tips] = rng.dirichlet(np.full(16, 0.3), 5)
    pose[tips] += rng.normal(0, 1e-3, pose[tips].shape)
    return replace(model, skin_weights=weights, pose_directions=pose)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("shared", [False, True], ids=["tips of one joint", "tips of several joints"])
@pytest.mark.parametrize("betas_rows", [1, 3], ids=["one shape", "a shape per frame"])
@pytest.mark.parametrize("with_template", [False, True])
def test_track_functions_equal_the_reference_skinning(side, shared, betas_rows, with_template):
    model = load_embedded_hands()[side]
    model = with_shared_tips(model) if shared else model
    template = model.template_m * 0.93 + 0.01 if with_template else None
    track = random_hand(3, betas_rows=betas_rows, template_m=template)
    vertices, joints = track_vertices(track, model), track_joints(track, model)
    for frame in range(3):
        rotvec = np.concatenate((track.global_orient[frame], track.hand_pose[frame])).reshape(16, 3)
        expected = reference_skinning(model, track.wrist_m[frame], rotvec, track.betas[frame % betas_rows], template)
        np.testing.assert_allclose(vertices[frame], expected[0], atol=2e-7)
        np.testing.assert_allclose(joints[frame, :16], expected[1], atol=2e-7)
        np.testing.assert_allclose(joints[frame, 16:], expected[0][list(TIP_VERTICES)], atol=2e-7)


def test_the_wrist_joint_is_exactly_at_wrist_m():
    inputs = torch_inputs(random_hand(7), torch.float32)
    joints = HandKinematics(load_embedded_hands().left).joints(*inputs)
    assert torch.equal(joints[:, 0], inputs[0])


def test_positive_rotation_about_z_bends_each_finger_towards_the_palm():
    model = load_embedded_hands().right
    bent = np.zeros((1, 15, 3))
    bent[:, :12, 2] = 0.8
    zero = np.zeros((1, 3))
    betas, valid = np.zeros((1, 10)), random_hand(1).valid
    flat = HandTrack(zero, zero, np.zeros((1, 45)), betas=betas, valid=valid)
    curled = HandTrack(zero, zero, bent.reshape(1, 45), betas=betas, valid=valid)
    drop_m = track_joints(flat, model)[0, 16:20, 1] - track_joints(curled, model)[0, 16:20, 1]
    assert (drop_m > 0.02).all()  # the palm faces -y


def test_gradients_are_right_and_finite_at_zero_pose():
    layer = HandKinematics(load_embedded_hands().right, torch.float64)
    rotvec = torch.zeros(1, 16, 3, dtype=torch.float64, requires_grad=True)
    betas = torch.zeros(1, 10, dtype=torch.float64, requires_grad=True)
    wrist = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)

    def tips(wrist_m, axis_angles, shape):
        return layer.joints(wrist_m, rotvec_to_rotmat(axis_angles), shape)[:, 16:]

    assert torch.autograd.gradcheck(tips, (wrist, rotvec, betas), atol=1e-6)
    gradients = torch.autograd.grad(
        layer(wrist, rotvec_to_rotmat(rotvec), betas)[0].square().sum(), (wrist, rotvec, betas)
    )
    assert all(torch.isfinite(gradient).all() and gradient.abs().max() > 0 for gradient in gradients)


def test_long_tracks_give_the_joints_of_single_frames():
    model = load_embedded_hands().right
    track = random_hand(1030, betas_rows=1030)
    joints = track_joints(track, model)
    assert joints.shape == (1030, 21, 3)
    assert joints.dtype == np.float32
    for frame in (0, 511, 512, 1029):
        one = HandTrack(*(getattr(track, name)[frame : frame + 1] for name in
                          ("wrist_m", "global_orient", "hand_pose", "betas", "valid")))  # fmt: skip
        np.testing.assert_allclose(track_joints(one, model)[0], joints[frame], atol=1e-7)


def test_without_gradients_the_same_vertices_come_from_numpy():
    layer, inputs = HandKinematics(load_embedded_hands().left, torch.float64), torch_inputs(random_hand(3))
    inputs = [array.requires_grad_() for array in inputs]
    expected = layer(*inputs)
    with torch.no_grad():
        got = layer(*inputs)
    assert expected[0].requires_grad
    assert not got[0].requires_grad
    for a, b in zip(expected, got, strict=True):
        torch.testing.assert_close(b, a.detach(), atol=1e-12, rtol=0)
