"""Joints of a track against skinning of the whole mesh in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hoidata.clips import HandTrack
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import TIP_VERTICES, HandKinematics, HandModel, load_embedded_hands, track_joints, track_vertices
from tests.builders.clips import random_hand

HANDS = load_embedded_hands()


def with_shared_tips(model: HandModel) -> HandModel:
    """The model with tips that follow several joints and have pose correctives, as in MANO."""
    rng, tips = np.random.default_rng(8), list(TIP_VERTICES)
    weights, pose = model.skin_weights.copy(), model.pose_directions.copy()
    weights[tips] = rng.dirichlet(np.full(16, 0.3), 5)
    pose[tips] += rng.normal(0, 1e-3, pose[tips].shape)
    return replace(model, skin_weights=weights, pose_directions=pose)


def layer_joints_m(track: HandTrack, model: HandModel) -> np.ndarray:
    """float64 joints from all vertices."""
    rotvec = np.concatenate((track.global_orient, track.hand_pose), axis=1, dtype=np.float64).reshape(-1, 16, 3)
    arrays = (track.wrist_m, rotvec_to_rotmat(rotvec), track.betas)
    inputs = [torch.as_tensor(np.asarray(array, dtype=np.float64)) for array in arrays]
    template = None if track.template_m is None else torch.as_tensor(np.asarray(track.template_m, dtype=np.float64))
    return HandKinematics(model, torch.float64)(*inputs, template_m=template)[1].numpy()


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("shared", [False, True], ids=["tips of one joint", "tips of several joints"])
@pytest.mark.parametrize("betas_rows", [1, 300], ids=["one shape", "a shape per frame"])
@pytest.mark.parametrize("personal", [False, True], ids=["the model's template", "a personal template"])
def test_joints_equal_those_of_the_whole_mesh_in_float64(side, shared, betas_rows, personal) -> None:
    model = with_shared_tips(HANDS[side]) if shared else HANDS[side]
    template = (model.template_m * 0.93 + 0.01).astype(np.float32) if personal else None
    track = random_hand(300, 4, betas_rows, template)
    joints = track_joints(track, model)
    assert joints.shape == (300, 21, 3)
    assert joints.dtype == np.float32
    expected = layer_joints_m(track, model)
    # Half a unit in the last place of a float32 below 8 m.
    np.testing.assert_allclose(joints, expected, atol=2.5e-7, rtol=0)
    np.testing.assert_allclose(joints[:, 16:], track_vertices(track, model)[:, list(TIP_VERTICES)], atol=1e-6)


@given(st.integers(0, 2**32), st.integers(1, 40), st.sampled_from([0.0, 1e-9, 1e-6, 1e-3, 1.0, 3.0]))
@settings(max_examples=40, deadline=None)
def test_small_and_large_angles_equal_the_layer(seed: int, n_frames: int, scale: float) -> None:
    track = random_hand(n_frames, seed)
    track = replace(track, hand_pose=track.hand_pose * scale, global_orient=track.global_orient * scale)
    np.testing.assert_allclose(
        track_joints(track, HANDS.right), layer_joints_m(track, HANDS.right), atol=2.5e-7, rtol=0
    )
