"""The feature layout and slip of clips, against independent formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.clips.features import hand_features, object_features, upright
from hoidata.clips.slip import MOVING_CM_S, joint_slips_cm_s, touched_parts
from hoidata.hands.kinematics import track_rotmats
from tests.builders.clips import build_clip
from tests.builders.objects import box_model

TURN = Rotation.from_euler("xyz", (20, -35, 70), degrees=True)
ORIGIN_M = np.array([0.3, -0.2, 0.9])


def columns(rotations: Rotation) -> np.ndarray:
    """The first two columns, row by row."""
    return rotations.as_matrix()[..., :2].reshape(*rotations.as_matrix().shape[:-2], 6)


def test_hand_features_are_the_turned_wrist_and_sixteen_rotations_in_float32():
    track = build_clip().hands["right"]
    features = hand_features(track, TURN.as_matrix(), ORIGIN_M)
    assert (features.shape, features.dtype) == ((30, 99), np.float32)
    np.testing.assert_allclose(features[:, :3], TURN.apply(track.wrist_m - ORIGIN_M), atol=1e-6)
    np.testing.assert_allclose(features[:, 3:9], columns(TURN * Rotation.from_rotvec(track.global_orient)), atol=1e-6)
    fingers = track_rotmats(track)[:, 1:, :, :2].reshape(30, -1)
    np.testing.assert_allclose(features[:, 9:], fingers, atol=1e-6)


@pytest.mark.parametrize("articulated", [False, True])
def test_object_features_are_the_turned_pose_and_the_hinge_angle(articulated):
    track = build_clip(articulated=articulated).object
    features = object_features(track, TURN.as_matrix(), ORIGIN_M)
    assert (features.shape, features.dtype) == ((30, 10), np.float32)
    np.testing.assert_allclose(features[:, :3], TURN.apply(track.translation_m - ORIGIN_M), atol=1e-6)
    np.testing.assert_allclose(features[:, 3:9], columns(TURN * Rotation.from_rotvec(track.rotvec)), atol=1e-6)
    np.testing.assert_array_equal(features[:, 9], track.hinge_rad if articulated else 0)


@pytest.mark.parametrize("gravity", [(0, 0, -1), (0, 0, 9.81), (0, -9.81, 0), (0.3, 0.5, -0.1), (-1e-12, 0, -1)])
def test_upright_is_the_smallest_rotation_that_turns_gravity_down(gravity):
    direction = np.array(gravity) / np.linalg.norm(gravity)
    rotation = upright(np.array(gravity))
    np.testing.assert_allclose(rotation @ direction, (0, 0, -1), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
    angle = Rotation.from_matrix(rotation).magnitude()
    assert angle == pytest.approx(np.arccos(np.clip(-direction[2], -1, 1)), abs=1e-6)


def test_upright_is_the_identity_where_gravity_is_unknown():
    np.testing.assert_array_equal(upright(None), np.eye(3))


def test_a_joint_slips_by_its_motion_over_a_part_that_moves_and_nowhere_else():
    """A box moves along x at 10 cm/s, then stands; a joint moves along y over it at 4 cm/s."""
    frames = np.arange(20)
    along_x = np.minimum(frames, 10) * 0.10 / FPS
    position_m = np.stack((along_x, np.zeros(20), np.zeros(20)), axis=1)
    track = ObjectTrack(box_model(), np.tile([0.0, 0, 0.5], (20, 1)), position_m, None)
    joints = np.repeat(position_m[:, None], 21, axis=1) + np.array([0.0, 1, 0]) * (frames * 0.04 / FPS)[:, None, None]
    touched = np.full((20, 21), -1)
    touched[3:15, 7] = 0  # seven intervals while it moves, from frame 3 to frame 10
    np.testing.assert_allclose(joint_slips_cm_s(track, joints, touched), np.full(7, 4.0), rtol=1e-6)
    slow = replace(track, translation_m=position_m * 0.9 * MOVING_CM_S / 10)
    assert len(joint_slips_cm_s(slow, joints, touched)) == 0


def test_a_joint_touches_the_part_of_its_nearest_point_in_whatever_order_entries_come() -> None:
    frame, joint = np.array([0, 0, 0, 1, 1, 2]), np.array([4, 4, 4, 4, 20, 4])
    distance_m, part = np.array([0.010, 0.004, 0.012, 0.005, 0.001, 0.015]), np.array([1, 0, 1, 1, 0, 0])
    for order in (np.arange(6), np.arange(6)[::-1], np.array([1, 3, 0, 5, 2, 4])):
        touched = touched_parts(4, frame[order], joint[order], distance_m[order], part[order])
        expected = np.full((4, 21), -1)
        expected[0, 4], expected[1, 4], expected[1, 20], expected[2, 4] = 0, 1, 0, 0
        np.testing.assert_array_equal(touched, expected)
    nothing = np.zeros(0, int)
    assert (touched_parts(3, nothing, nothing, np.zeros(0), nothing) == -1).all()
