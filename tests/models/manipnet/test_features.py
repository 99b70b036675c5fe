"""Pose, trajectory and output features: inverses, motion of the scene, the mirror, known motions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Side
from hoidata.geometry.motion import Motion
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.control import Control
from models.manipnet.features import (
    FeatureSettings,
    hand_inputs,
    joint_rotmats_of,
    output_distances,
    pose_features,
    trajectory_features,
)
from tests.builders.objects import box_model
from tests.builders.sensing import random_rotations, small_hand

MIRROR = np.diag([-1.0, 1.0, 1.0])
RATE = 60
SETTINGS = FeatureSettings(step_s=1 / RATE)
PAPER = FeatureSettings(definition="paper", step_s=1 / RATE)


def wandering(seed: int, frames: int = 120) -> Motion:
    random = np.random.default_rng(seed)
    rotmats = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.02, (frames, 3)), axis=0)).as_matrix()
    return Motion(np.arange(frames) / RATE, rotmats, np.cumsum(random.normal(0, 0.002, (frames, 3)), axis=0))


def control() -> Control:
    model = box_model(middle_m=(0.02, 0.01, 0.0))
    return Control({"left": wandering(1), "right": wandering(2)}, wandering(3), model)


def moved(motion: Motion, rotation: np.ndarray, translation: np.ndarray) -> Motion:
    return Motion(motion.time_s, rotation @ motion.rotmats, motion.position_m @ rotation.T + translation)


def mirrored_motion(motion: Motion) -> Motion:
    return Motion(motion.time_s, MIRROR @ motion.rotmats @ MIRROR, motion.position_m @ MIRROR)


def mirrored_scene(scene: Control) -> Control:
    wrists: dict[Side, Motion] = {
        "left": mirrored_motion(scene.wrists["right"]),
        "right": mirrored_motion(scene.wrists["left"]),
    }
    model = scene.model
    mesh = replace(model, vertices_m=model.vertices_m @ MIRROR, faces=model.faces[:, ::-1])
    return Control(wrists, mirrored_motion(scene.object_motion), mesh)


HANDS = {"small": small_hand(), "mano": mano_hand(load_embedded_hands(), "right")}


@pytest.mark.parametrize("settings", [SETTINGS, PAPER], ids=["ours", "paper"])
@pytest.mark.parametrize("hand", HANDS.values(), ids=HANDS)
def test_joint_rotations_are_recovered_from_the_features_of_either_hand(hand: TrackedHand, settings: FeatureSettings):
    for one_hand in (hand, hand.mirrored()):
        state = one_hand.state(random_rotations(5 * (hand.n_joints - 1), 0.5, 0).reshape(5, -1, 3, 3))
        rotmats = joint_rotmats_of(one_hand, pose_features(one_hand, state, settings), settings)
        np.testing.assert_allclose(rotmats, state.joint_rotmats, atol=1e-12)
        noisy = pose_features(one_hand, state, settings) + np.random.default_rng(0).normal(0, 0.1, (5, 1))
        from_noisy = joint_rotmats_of(one_hand, noisy, settings)
        np.testing.assert_allclose(
            from_noisy @ from_noisy.swapaxes(-1, -2), np.broadcast_to(np.eye(3), from_noisy.shape), atol=1e-12
        )
        np.testing.assert_allclose(np.linalg.det(from_noisy), 1)


@pytest.mark.parametrize("settings", [SETTINGS, PAPER], ids=["ours", "paper"])
def test_inputs_are_unchanged_when_the_scene_moves_or_is_mirrored_with_the_hand(settings: FeatureSettings):
    scene, hand, time_s = control(), small_hand(), np.array([0.7, 0.71, 1.3])
    poses = random_rotations(3 * 5, 0.3, 4).reshape(3, 5, 3, 3)
    original = hand_inputs(scene, "right", hand, hand.state(poses), time_s, settings)
    rotation, translation = random_rotations(1, 2.0, 8)[0], np.array([1.0, -2.0, 3.0])
    wrists = {side: moved(motion, rotation, translation) for side, motion in scene.wrists.items()}
    moved_scene = Control(wrists, moved(scene.object_motion, rotation, translation), scene.model)
    moved_inputs = hand_inputs(moved_scene, "right", hand, hand.state(poses), time_s, settings)
    mirrored, left = mirrored_scene(scene), hand.mirrored()
    state = left.state(MIRROR @ poses @ MIRROR)
    mirrored_inputs = hand_inputs(mirrored, "left", left, state, time_s, settings)
    for first, *others in zip(original, moved_inputs, mirrored_inputs, strict=True):
        for other in others:
            np.testing.assert_allclose(first, other, atol=1e-9)


def test_the_present_sample_is_the_wrist_and_angular_velocity_is_in_the_wrists_axes():
    """The object rotates about the world's z at 2 rad/s; the wrist rests and is rotated about x."""
    time_s = np.arange(120) / RATE
    still = Motion(
        time_s, np.tile(Rotation.from_euler("x", 90, degrees=True).as_matrix(), (120, 1, 1)), np.zeros((120, 3))
    )
    other = Motion(time_s, np.tile(np.eye(3), (120, 1, 1)), np.tile([0.0, 0.3, 0.4], (120, 1)))
    spin = Rotation.from_rotvec(2 * time_s[:, None] * [0, 0, 1]).as_matrix()
    object_motion = Motion(time_s, spin, np.tile([0.1, 0.0, 0.0], (120, 1)))
    scene = Control({"left": other, "right": still}, object_motion, box_model())
    samples = trajectory_features(scene, "right", small_hand(), np.array([1.0]), SETTINGS).reshape(21, 16)
    np.testing.assert_allclose(samples[:, 0], 0.5)
    np.testing.assert_allclose(samples[10, 1:10], [0, 0, 0, 0, 0, 1, 0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(samples[:, 10:13], np.tile([0.1, 0, 0], (21, 1)), atol=1e-12)
    np.testing.assert_allclose(
        samples[:, 13:], np.tile([0, 2.0, 0], (21, 1)), atol=1e-9
    )  # z of the world is the wrist's y


def test_motion_is_interpolated_evenly_and_constant_beyond_its_ends():
    motion = Motion(
        np.array([0.0, 1.0]), Rotation.from_euler("z", [[0], [90]], degrees=True).as_matrix(), np.eye(3)[:2]
    )
    pose = motion.at(np.array([-1.0, 0.25, 1.0, 3.0]))
    angles = Rotation.from_matrix(pose.rotation).as_euler("xyz", degrees=True)[:, 2]
    np.testing.assert_allclose(angles, [0, 22.5, 90, 90])
    np.testing.assert_allclose(pose.translation[1], [0.75, 0.25, 0])


def test_a_short_trajectory_has_fewer_samples_and_fewer_sensed_times():
    short = FeatureSettings(future_s=0.1)
    hand, scene = small_hand(), control()
    inputs = hand_inputs(scene, "right", hand, hand.state(hand.rest_rotmats[None]), np.array([1.0]), short)
    assert inputs[1].shape == (1, 13 * 16)
    assert inputs[2].shape == (1, 1000 + 2 * (hand.n_sensors + hand.n_points) + 3 * hand.n_points)


def test_output_distances_are_fractions_of_3_cm_from_the_capsule():
    hand = small_hand()
    distance_m = np.tile([-0.01, 0.01, 0.025, 0.04, 0.05, 0.1, 0.0, 0.015, 0.03, 0.06, 0.1], (1, 1))
    fractions = output_distances(hand, distance_m, SETTINGS)[0]
    np.testing.assert_allclose(fractions, [0, 0, 0.5, 1, 1, 1, 0, 0.5, 1, 1, 1])


def test_the_papers_output_distances_are_fractions_of_3_5_cm_from_the_joint():
    hand = small_hand()
    distance_m = np.tile([-0.01, 0.007, 0.0175, 0.028, 0.035, 0.1, 0.0, 0.007, 0.014, 0.035, 0.04], (1, 1))
    fractions = output_distances(hand, distance_m, PAPER)[0]
    np.testing.assert_allclose(fractions, [0, 0.2, 0.5, 0.8, 1, 1, 0, 0.2, 0.4, 1, 1])
