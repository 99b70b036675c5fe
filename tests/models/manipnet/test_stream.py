"""A stream gives the poses of the whole clip, at any tracker rate, as soon as the network's inputs have arrived."""

import numpy as np
import pytest
import torch

from hoidata.clips.clip import SIDES, Side
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.control import Control, Motion
from models.manipnet.features import FeatureSettings
from models.manipnet.network import NetworkConfig
from models.manipnet.rollout import Predictor, RolloutTask, roll_out
from models.manipnet.stream import Stream, TrackedFrame
from models.manipnet.training import build_network, hand_examples
from tests.builders.objects import box_model

HANDS: dict[Side, TrackedHand] = {side: mano_hand(load_embedded_hands(), side) for side in SIDES}
BOX = box_model((0.06, 0.06, 0.1))
START: dict[Side, np.ndarray] = {side: hand.rest_rotmats for side, hand in HANDS.items()}


def waves(seed: int, time_s: np.ndarray, size: float) -> np.ndarray:
    """(frame, 3) sine waves with amplitude ``size``."""
    rng = np.random.default_rng(seed)
    return size * np.sin(2 * np.pi * rng.uniform(0.3, 0.8, 3) * time_s[:, None] + rng.uniform(0, 2 * np.pi, 3))


def tracked(fps: int, length_s: float) -> Control:
    """Both hands move around a box, at a tracker's frame rate."""
    time_s = np.arange(round(length_s * fps) + 1) / fps
    body = Motion(time_s, rotvec_to_rotmat(waves(0, time_s, 0.8)), waves(1, time_s, 0.1))
    wrists: dict[Side, Motion] = {}
    for number, (side, hand) in enumerate(HANDS.items()):
        rotmats = rotvec_to_rotmat(waves(2 + number, time_s, 0.6))
        palm = rotmats @ hand.wrist_from_canonical @ [0.08, 0.0, -0.05]
        wrists[side] = Motion(time_s, rotmats, body.position_m - palm + waves(4 + number, time_s, 0.02))
    return Control(wrists, body, BOX)


def predictor(step_s: float) -> Predictor:
    """An untrained network with normalisation and joint limits."""
    torch.manual_seed(0)
    settings, control, time_s = FeatureSettings(step_s=step_s), tracked(30, 1.0), np.arange(31) / 30
    examples = []
    for number, (side, hand) in enumerate(HANDS.items()):
        fingers = hand.rest_rotmats @ rotvec_to_rotmat(0.2 * np.random.default_rng(number).normal(size=(31, 15, 3)))
        usable, surface = np.ones(31, bool), surface_index(BOX)
        examples.append(hand_examples(control, side, hand, fingers, time_s, usable, surface, settings))
    config = NetworkConfig(encoder=8, features=settings)
    return Predictor(build_network(config, HANDS["right"], examples).eval())


def streamed(model: Predictor, control: Control) -> tuple[list[dict[Side, np.ndarray]], list[float]]:
    """The poses of a stream, and for each that ``push`` returned the time of the pushed frame."""
    stream, poses, when_s = Stream(model, HANDS, dict.fromkeys(SIDES, BOX), START), [], []
    for number, now_s in enumerate(control.object_motion.time_s):
        wrists: dict[Side, RigidTransform] = {side: frame(motion, number) for side, motion in control.wrists.items()}
        new_poses = stream.push(TrackedFrame(now_s, wrists, dict.fromkeys(SIDES, frame(control.object_motion, number))))
        poses += new_poses
        when_s += [now_s] * len(new_poses)
    return poses + stream.finish(), when_s


def frame(motion: Motion, number: int) -> RigidTransform:
    return RigidTransform(motion.rotmats[number], motion.position_m[number])


def assert_is_the_clip(poses: list[dict[Side, np.ndarray]], model: Predictor, control: Control) -> None:
    time_s = np.arange(len(poses)) / (1 / model.settings.step_s)
    tasks = [
        RolloutTask(hand=HANDS[side], side=side, control=control, time_s=time_s, start=START[side]) for side in SIDES
    ]
    for side, whole in zip(SIDES, roll_out(model, tasks), strict=True):
        assert len(np.unique(whole, axis=0)) == len(whole)
        np.testing.assert_array_equal(np.stack([pose[side] for pose in poses]), whole)


@pytest.mark.long
@pytest.mark.parametrize(("tracker_hz", "step_hz"), [(50, 60), (50, 30)])
def test_a_stream_equals_the_clip_bit_for_bit_at_any_tracker_rate(tracker_hz, step_hz):
    model, control = predictor(1 / step_hz), tracked(tracker_hz, 3.0)
    poses, _ = streamed(model, control)
    assert len(poses) == 3 * step_hz + 1
    assert_is_the_clip(poses, model, control)


@pytest.mark.parametrize("number", [0, 40, 99])
def test_an_interpolated_pose_depends_on_its_two_neighbouring_frames_only(number):
    whole = tracked(50, 3.0).object_motion
    frames = slice(number, number + 50)
    part = Motion(whole.time_s[frames], whole.rotmats[frames], whole.position_m[frames])
    times = np.concatenate([part.time_s, np.random.default_rng(0).uniform(part.time_s[0], part.time_s[-1], 1000)])
    for time_s in (times, times[: len(part.time_s)], times[-1:]):
        one, other = part.at(time_s), whole.at(time_s)
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.translation, other.translation)


def test_the_pose_at_a_frames_time_is_that_frame():
    body = tracked(50, 1.0).object_motion
    time_s = np.stack([body.time_s[:-1], body.time_s[:-1] + 0.007])
    np.testing.assert_array_equal(body.at(time_s).rotation[0], body.rotmats[:-1])
    np.testing.assert_array_equal(body.at(time_s).translation[0], body.position_m[:-1])


@pytest.mark.slow
def test_a_stream_returns_a_pose_as_soon_as_its_inputs_have_arrived():
    model, control, ahead_s = predictor(1 / 60), tracked(60, 1.5), 0.5
    poses, when_s = streamed(model, control)
    assert_is_the_clip(poses, model, control)
    # Pose k needs the inputs one step before it; the stream waits for one more frame.
    waited = [when - (number - 1) / 60 for number, when in enumerate(when_s) if number]
    assert max(waited) <= ahead_s + 1 / 60 + 1e-6
    assert min(waited) > ahead_s - 1e-6
