"""Pose, trajectory and output features: inverses, motion of the scene, the mirror, known motions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Side
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.control import Control, Motion
from models.manipnet.features import (
    FeatureSettings,
    hand_inputs,
    joint_rotmats_of,
    output_distances,
    pose_features,
    trajectory_features,
)
from tests.builders.objects import box_model
from tests.builders.sensing import small_hand, turns

MIRROR = np.diag([-1.0, 1.0, 1.0])
RATE = 60
SETTINGS = FeatureSettings()


def wandering(seed: int, frames: int = 120) -> Motion:
    random = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.02, (frames, 3)), axis=0)).as_matrix()
    return Motion(np.arange(frames) / RATE, turn, np.cumsum(random.normal(0, 0.002, (frames, 3)), axis=0))


def control() -> Control:
    model = box_model(middle_m=(0.02, 0.01, 0.0))
    return Control({"left": wandering(1), "right": wandering(2)}, wandering(3), model)


def moved(motion: Motion, turn: np.ndarray, way: np.ndarray) -> Motion:
    return Motion(motion.time_s, turn @ motion.rotmats, motion.position_m @ turn.T + way)


def seen_in_mirror(motion: Motion) -> Motion:
    return Motion(motion.time_s, MIRROR @ motion.rotmats @ MIRROR, motion.position_m @ MIRROR)


def other_side_of_the_mirror(given: Control) -> Control:
    wrists: dict[Side, Motion] = {
        "left": seen_in_mirror(given.wrists["right"]),
        "right": seen_in_mirror(given.wrists["left"]),
    }
    model = given.model
    mesh = replace(model, vertices_m=model.vertices_m @ MIRROR, faces=model.faces[:, ::-1])
    return Control(wrists, seen_in_mirror(given.thing), mesh)


HANDS = {"small": small_hand(), "mano": mano_hand(load_embedded_hands(), "right")}


@pytest.mark.parametrize("hand", HANDS.values(), ids=HANDS)
def test_joint_rotations_come_back_from_the_features_of_either_hand(hand: TrackedHand):
    for own in (hand, hand.mirrored()):
        state = own.state(turns(5 * (hand.n_joints - 1), 0.5, 0).reshape(5, -1, 3, 3))
        found = joint_rotmats_of(own, pose_features(own, state))
        np.testing.assert_allclose(found, state.joint_rotmats, atol=1e-12)
        shaken = pose_features(own, state) + np.random.default_rng(0).normal(0, 0.1, (5, 1))
        turned = joint_rotmats_of(own, shaken)
        np.testing.assert_allclose(
            turned @ turned.swapaxes(-1, -2), np.broadcast_to(np.eye(3), turned.shape), atol=1e-12
        )
        np.testing.assert_allclose(np.linalg.det(turned), 1)


def test_moving_the_scene_changes_nothing_and_the_mirrored_scene_gives_the_other_hand_the_same():
    given, hand, time_s, settings = control(), small_hand(), np.array([0.7, 0.71, 1.3]), SETTINGS
    poses = turns(3 * 5, 0.3, 4).reshape(3, 5, 3, 3)
    surface = SurfaceIndex(given.model)
    one = hand_inputs(given, "right", hand, hand.state(poses), time_s, surface, settings)
    turn, way = turns(1, 2.0, 8)[0], np.array([1.0, -2.0, 3.0])
    wrists = {side: moved(motion, turn, way) for side, motion in given.wrists.items()}
    there = Control(wrists, moved(given.thing, turn, way), given.model)
    two = hand_inputs(there, "right", hand, hand.state(poses), time_s, surface, settings)
    mirrored, left = other_side_of_the_mirror(given), hand.mirrored()
    state = left.state(MIRROR @ poses @ MIRROR)
    three = hand_inputs(mirrored, "left", left, state, time_s, SurfaceIndex(mirrored.model), settings)
    for first, *others in zip(one, two, three, strict=True):
        for other in others:
            np.testing.assert_allclose(first, other, atol=1e-9)


def test_the_present_sample_is_the_wrist_itself_and_a_known_spin_is_said_in_the_wrists_axes():
    """The object turns about the world's z by 2 rad/s before a wrist at rest that is turned about x."""
    time_s = np.arange(120) / RATE
    still = Motion(
        time_s, np.tile(Rotation.from_euler("x", 90, degrees=True).as_matrix(), (120, 1, 1)), np.zeros((120, 3))
    )
    other = Motion(time_s, np.tile(np.eye(3), (120, 1, 1)), np.tile([0.0, 0.3, 0.4], (120, 1)))
    spin = Rotation.from_rotvec(2 * time_s[:, None] * [0, 0, 1]).as_matrix()
    thing = Motion(time_s, spin, np.tile([0.1, 0.0, 0.0], (120, 1)))
    given = Control({"left": other, "right": still}, thing, box_model())
    rows = trajectory_features(given, "right", small_hand(), np.array([1.0]), SETTINGS).reshape(21, 16)
    np.testing.assert_allclose(rows[:, 0], 0.5)
    np.testing.assert_allclose(rows[10, 1:10], [0, 0, 0, 0, 0, 1, 0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rows[:, 10:13], np.tile([0.1, 0, 0], (21, 1)), atol=1e-12)
    np.testing.assert_allclose(
        rows[:, 13:], np.tile([0, 2.0, 0], (21, 1)), atol=1e-9
    )  # z of the world is the wrist's y


def test_a_motion_between_frames_turns_evenly_and_is_held_beyond_its_ends():
    motion = Motion(
        np.array([0.0, 1.0]), Rotation.from_euler("z", [[0], [90]], degrees=True).as_matrix(), np.eye(3)[:2]
    )
    found = motion.at(np.array([-1.0, 0.25, 1.0, 3.0]))
    angles = Rotation.from_matrix(found.rotation).as_euler("xyz", degrees=True)[:, 2]
    np.testing.assert_allclose(angles, [0, 22.5, 90, 90])
    np.testing.assert_allclose(found.translation[1], [0.75, 0.25, 0])


def test_a_short_trajectory_has_fewer_samples_and_fewer_sensed_times():
    short = FeatureSettings(future_s=0.1, sensors=replace(SETTINGS.sensors, times_s=(0.0, 0.1)))
    hand, given = small_hand(), control()
    found = hand_inputs(
        given, "right", hand, hand.state(hand.rest_rotmats[None]), np.array([1.0]), SurfaceIndex(given.model), short
    )
    assert found.trajectory.shape == (1, 13 * 16)
    assert found.sensors.shape == (1, 1000 + 2 * (hand.n_sensors + hand.n_points) + 3 * hand.n_points)


def test_output_distances_are_shares_of_3_cm_beyond_the_capsule():
    hand = small_hand()
    distance_m = np.tile([-0.01, 0.01, 0.025, 0.04, 0.05, 0.1, 0.0, 0.015, 0.03, 0.06, 0.1], (1, 1))
    found = output_distances(hand, distance_m, SETTINGS)[0]
    np.testing.assert_allclose(found, [0, 0, 0.5, 1, 1, 1, 0, 0.5, 1, 1, 1])
    wide = output_distances(hand, distance_m, replace(SETTINGS, range_m=0.06))[0]
    np.testing.assert_allclose(wide[:4], [0, 0, 0.25, 0.5])
