"""A stream says what a whole clip does: at any rate of the tracker, and as soon as it has what its network reads."""

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
from models.manipnet.rollout import Predictor, Task, roll_out
from models.manipnet.stream import Stream, TrackedFrame
from models.manipnet.training import hand_examples, prepared
from tests.builders.objects import box_model

HANDS: dict[Side, TrackedHand] = {side: mano_hand(load_embedded_hands(), side) for side in SIDES}
BOX = box_model((0.06, 0.06, 0.1))
START: dict[Side, np.ndarray] = {side: hand.rest_rotmats for side, hand in HANDS.items()}


def waves(seed: int, time_s: np.ndarray, size: float) -> np.ndarray:
    """(frame, 3) smooth numbers up to about ``size``, a wave each."""
    draws = np.random.default_rng(seed)
    return size * np.sin(2 * np.pi * draws.uniform(0.3, 0.8, 3) * time_s[:, None] + draws.uniform(0, 2 * np.pi, 3))


def tracked(fps: int, length_s: float) -> Control:
    """Both hands play with a box, as a tracker of this rate sees it."""
    time_s = np.arange(round(length_s * fps) + 1) / fps
    body = Motion(time_s, rotvec_to_rotmat(waves(0, time_s, 0.8)), waves(1, time_s, 0.1))
    wrists: dict[Side, Motion] = {}
    for number, (side, hand) in enumerate(HANDS.items()):
        turn = rotvec_to_rotmat(waves(2 + number, time_s, 0.6))
        palm = turn @ hand.wrist_from_canonical @ [0.08, 0.0, -0.05]
        wrists[side] = Motion(time_s, turn, body.position_m - palm + waves(4 + number, time_s, 0.02))
    return Control(wrists, body, BOX)


def predictor(step_s: float) -> Predictor:
    """A network that has learnt nothing but what poses look like."""
    torch.manual_seed(0)
    settings, control, time_s = FeatureSettings(step_s=step_s), tracked(30, 1.0), np.arange(31) / 30
    examples = []
    for number, (side, hand) in enumerate(HANDS.items()):
        fingers = hand.rest_rotmats @ rotvec_to_rotmat(0.2 * np.random.default_rng(number).normal(size=(31, 15, 3)))
        usable, surface = np.ones(31, bool), surface_index(BOX)
        examples.append(hand_examples(control, side, hand, fingers, time_s, usable, surface, settings))
    config = NetworkConfig(encoder=8, features=settings)
    return Predictor(prepared(config, HANDS["right"], examples).eval())


def streamed(said_by: Predictor, control: Control) -> tuple[list[dict[Side, np.ndarray]], list[float]]:
    """What a stream of a tracker's frames says, and when it says it: the time of its last frame by then."""
    stream, told, when_s = Stream(said_by, HANDS, dict.fromkeys(SIDES, BOX), START), [], []
    for number, now_s in enumerate(control.thing.time_s):
        wrists: dict[Side, RigidTransform] = {side: frame(motion, number) for side, motion in control.wrists.items()}
        poses = stream.push(TrackedFrame(now_s, wrists, dict.fromkeys(SIDES, frame(control.thing, number))))
        told += poses
        when_s += [now_s] * len(poses)
    return told + stream.finish(), when_s


def frame(motion: Motion, number: int) -> RigidTransform:
    return RigidTransform(motion.rotmats[number], motion.position_m[number])


def assert_is_the_clip(told: list[dict[Side, np.ndarray]], said_by: Predictor, control: Control) -> None:
    time_s = np.arange(len(told)) / (1 / said_by.settings.step_s)
    tasks = [Task(HANDS[side], side, control, time_s, START[side]) for side in SIDES]
    for side, whole in zip(SIDES, roll_out(said_by, tasks), strict=True):
        assert len(np.unique(whole, axis=0)) == len(whole)
        np.testing.assert_array_equal(np.stack([pose[side] for pose in told]), whole)


@pytest.mark.slow
@pytest.mark.parametrize(("tracker_hz", "step_hz"), [(50, 60), (50, 30)])
def test_a_stream_is_the_clip_bit_for_bit_whatever_the_rate_of_the_tracker(tracker_hz, step_hz):
    said_by, control = predictor(1 / step_hz), tracked(tracker_hz, 3.0)
    told, _ = streamed(said_by, control)
    assert len(told) == 3 * step_hz + 1
    assert_is_the_clip(told, said_by, control)


@pytest.mark.parametrize("number", [0, 40, 99])
def test_where_a_body_is_does_not_depend_on_frames_that_are_not_beside_that_time(number):
    whole = tracked(50, 3.0).thing
    kept = slice(number, number + 50)
    part = Motion(whole.time_s[kept], whole.rotmats[kept], whole.position_m[kept])
    times = np.concatenate([part.time_s, np.random.default_rng(0).uniform(part.time_s[0], part.time_s[-1], 1000)])
    for asked in (times, times[: len(part.time_s)], times[-1:]):
        one, other = part.at(asked), whole.at(asked)
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.translation, other.translation)


def test_a_time_on_a_frame_is_that_frame_whatever_else_is_asked_for_beside_it():
    body = tracked(50, 1.0).thing
    asked = np.stack([body.time_s[:-1], body.time_s[:-1] + 0.007])
    np.testing.assert_array_equal(body.at(asked).rotation[0], body.rotmats[:-1])
    np.testing.assert_array_equal(body.at(asked).translation[0], body.position_m[:-1])


@pytest.mark.slow
def test_a_stream_answers_once_it_has_what_its_network_reads_with_the_bits_of_the_clip():
    said_by, control, ahead_s = predictor(1 / 60), tracked(60, 1.5), 0.5
    told, when_s = streamed(said_by, control)
    assert_is_the_clip(told, said_by, control)
    # Pose k is told from what is known a step before it; one frame more makes sure that it is there.
    waited = [when - (number - 1) / 60 for number, when in enumerate(when_s) if number]
    assert max(waited) <= ahead_s + 1 / 60 + 1e-6
    assert min(waited) > ahead_s - 1e-6
