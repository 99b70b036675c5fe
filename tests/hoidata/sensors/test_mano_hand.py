"""MANO-layout hands as tracked hands: joints, tips and skin equal those of the hand model."""

from types import SimpleNamespace

import numpy as np
import pytest

from hoidata.clips.clip import SIDES
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import TIP_VERTICES, load_embedded_hands, track_joints, track_rotmats, track_vertices
from hoidata.physics.mano_capsules import hand_capsules
from hoidata.sensors.mano_hand import N_SENSORS, canonical_axes, mano_hand, sensor_vertices

HANDS = load_embedded_hands()


def track(frames: int = 7, template_m: np.ndarray | None = None) -> SimpleNamespace:
    random = np.random.default_rng(0)
    return SimpleNamespace(
        wrist_m=random.normal(size=(frames, 3)),
        global_orient=random.normal(size=(frames, 3)),
        hand_pose=random.normal(0, 0.4, (frames, 45)),
        betas=random.normal(size=(1, 10)),
        template_m=template_m,
    )


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("personal", [False, True])
def test_joints_tips_sensors_and_capsules_are_those_of_the_model(side, personal):
    hand_track = track(template_m=HANDS[side].template_m * 1.1 if personal else None)
    hand = mano_hand(HANDS, side, hand_track.betas[0], hand_track.template_m)
    rotmats = track_rotmats(hand_track)
    fingers = rotmats[:, 1:]
    state = hand.state(fingers).placed(RigidTransform(rotmats[:, 0], hand_track.wrist_m))
    vertices = track_vertices(hand_track, HANDS[side])
    np.testing.assert_allclose(state.joint_m, track_joints(hand_track, HANDS[side])[:, :16], atol=1e-6)
    np.testing.assert_allclose(state.tip_m, vertices[:, list(TIP_VERTICES)], atol=1e-6)
    np.testing.assert_allclose(state.sensor_m, vertices[:, list(sensor_vertices(HANDS.right))], atol=1e-6)
    np.testing.assert_allclose(state.capsule_end_m, hand_capsules(hand_track, HANDS[side]).end_m, atol=1e-6)
    np.testing.assert_allclose(hand.finger_rotmats(state.joint_rotmats), fingers, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(state.sensor_normal, axis=-1), 1)


def test_the_left_hand_of_the_embedded_pair_is_the_right_one_in_a_mirror():
    left, mirrored = mano_hand(HANDS, "left"), mano_hand(HANDS, "right").mirrored()
    poses = track_rotmats(track())[:, 1:]
    for one, other in zip(left.state(poses), mirrored.state(poses), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    np.testing.assert_array_equal(left.wrist_from_canonical, mirrored.wrist_from_canonical)
    assert (mirrored.side, mirrored.mirrored().side) == ("left", "right")


def test_104_sensors_face_out_of_the_palm_side_of_each_finger_and_are_apart():
    hand = mano_hand(HANDS, "right")
    assert len(set(sensor_vertices(HANDS.right))) == hand.n_sensors == N_SENSORS
    segment, positions = hand.skin.weight[5:].argmax(axis=1), hand.skin.point_m[5:]
    on_thumb = segment >= 13
    assert set(segment[~on_thumb]) == set(range(13))
    assert on_thumb.sum() >= 8
    assert ((hand.skin.normal[5:] @ canonical_axes(HANDS.right))[~on_thumb, 2] < -0.8).all()
    apart = np.linalg.norm(positions[:, None] - positions, axis=-1) + np.eye(N_SENSORS)
    assert apart.min() > 0.004


def test_canonical_axes_point_to_the_fingers_the_thumb_and_out_of_the_back():
    for side, determinant in (("right", 1), ("left", -1)):
        axes, hand = canonical_axes(HANDS[side]), mano_hand(HANDS, side)
        flat = hand.state(np.tile(np.eye(3), (1, 15, 1, 1))).joint_m[0] @ axes
        assert np.linalg.det(axes) == pytest.approx(determinant)
        assert flat[6, 0] > flat[4, 0] > 0.05  # middle finger
        assert flat[13, 1] > 0.01  # thumb
        assert (hand.skin.normal[5:] @ axes)[:, 2].mean() < -0.5  # out of the palm
