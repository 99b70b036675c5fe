"""A stream gives the poses of the whole clip as soon as the network's inputs have arrived, and survives a tracker."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hoidata.clips.clip import SIDES, Side
from hoidata.geometry.motion import Motion
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.control import Control
from models.manipnet.features import FeatureSettings
from models.manipnet.network import NetworkConfig
from models.manipnet.rollout import Predictor, RolloutTask, roll_out
from models.manipnet.stream import Sample, Stream, TrackedFrame, add_sample, joined_at
from models.manipnet.training import build_network, hand_examples, joined, perturbed_poses, step_loss
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
        usable = np.ones(31, bool)
        examples.append(hand_examples(control, side, hand, fingers, time_s, usable, settings))
    config = NetworkConfig(encoder=8, features=settings)
    return Predictor(build_network(config, HANDS["right"], examples).eval())


def streamed(model: Predictor, control: Control) -> tuple[list[dict[Side, np.ndarray]], list[float]]:
    """The poses of a stream, and for each that ``push`` returned the time of the pushed frame."""
    stream, poses, when_s = new_stream(model), [], []
    for tracked_frame in frames_of(control):
        new_poses = stream.push(tracked_frame)
        poses += new_poses
        when_s += [tracked_frame.time_s] * len(new_poses)
    return poses + stream.finish(), when_s


def new_stream(model: Predictor) -> Stream:
    return Stream(model, HANDS, dict.fromkeys(SIDES, BOX), START)


def frames_of(control: Control) -> list[TrackedFrame]:
    """The frames of a tracker without faults."""
    return [
        TrackedFrame(
            float(now_s),
            {side: frame(motion, number) for side, motion in control.wrists.items()},
            dict.fromkeys(SIDES, frame(control.object_motion, number)),
        )
        for number, now_s in enumerate(control.object_motion.time_s)
    ]


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


STEP_HZ, TRACKER_HZ = 30, 60


@pytest.fixture(scope="module")
def trained() -> Predictor:
    """A network that follows smooth fingers, from recorded and from perturbed poses; an untrained one is not steady."""
    torch.manual_seed(0)
    settings, control, time_s = FeatureSettings(step_s=1 / STEP_HZ), tracked(STEP_HZ, 8.0), np.arange(241) / STEP_HZ
    usable, examples = np.ones(241, bool), []
    for number, (side, hand) in enumerate(HANDS.items()):
        bend = np.stack([waves(10 * number + joint, time_s, 0.3) for joint in range(15)], axis=1)
        fingers = hand.rest_rotmats @ rotvec_to_rotmat(bend)
        for start in (None, perturbed_poses(fingers, fingers, number)):
            examples.append(hand_examples(control, side, hand, fingers, time_s, usable, settings, start))
    network = build_network(NetworkConfig(encoder=32, features=settings), HANDS["right"], examples)
    steps = joined(examples)
    inputs, targets = torch.from_numpy(steps.inputs), torch.from_numpy(steps.outputs)
    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    for _ in range(150):
        optimiser.zero_grad()
        step_loss(network, inputs, targets).backward()
        optimiser.step()
    return Predictor(network.eval())


NAN = RigidTransform(np.full((3, 3), np.nan), np.full(3, np.nan))
SHEARED = RigidTransform(np.diag([1.0, 1, 3]), np.zeros(3))
AWAY_M = np.array([0.3, 0.0, 0.0])
KINDS = ("wrist", "repeated", "elsewhere", "nan", "sheared", "object", "frames", "time", "late")


def with_fault(frames: list[TrackedFrame | None], kind: str, side: Side, faulty: slice) -> None:
    """Put a fault into some frames, in place; None: no frame arrives."""
    first = faulty.start
    if kind == "late":
        frames[first], frames[first + 3] = frames[first + 3], frames[first]
    for number in range(len(frames))[faulty]:
        one = frames[number]
        if one is None:
            continue
        wrist = one.wrists[side]
        changed: dict[str, RigidTransform | None] = {
            "wrist": None,
            "nan": NAN,
            "sheared": SHEARED,
            "elsewhere": RigidTransform(wrist.rotation, wrist.translation + AWAY_M),
        }
        if kind in changed:
            frames[number] = replace(one, wrists={**one.wrists, side: changed[kind]})
        elif kind == "object":
            frames[number] = replace(one, objects={})
        elif kind == "frames":
            frames[number] = None
        elif kind == "time":
            frames[number] = replace(one, time_s=float("nan"))
        elif kind == "repeated":
            frames[number] = replace(one, time_s=(first - 1) / TRACKER_HZ)


def poses_with_faults(
    model: Predictor, control: Control, faults: list[tuple[str, Side, slice]]
) -> list[dict[Side, np.ndarray]]:
    frames: list[TrackedFrame | None] = [*frames_of(control)]
    for kind, side, faulty in faults:
        with_fault(frames, kind, side, faulty)
    stream = new_stream(model)
    poses = [pose for one in frames if one is not None for pose in stream.push(one)]
    return poses + stream.finish()


def random_faults(seed: int, length_s: float) -> list[tuple[str, Side, slice]]:
    """Faults of 1 frame to 1.5 s, at least 1.5 s apart."""
    rng, faults, now_s = np.random.default_rng(seed), [], 1.0
    while now_s < length_s - 2.0:
        long_s = float(rng.choice([1 / TRACKER_HZ, 0.1, 0.4, 0.7, 1.5]))
        first = round(now_s * TRACKER_HZ)
        faulty = slice(first, first + round(long_s * TRACKER_HZ))
        faults.append((str(rng.choice(KINDS)), SIDES[rng.integers(2)], faulty))
        now_s += long_s + float(rng.uniform(1.5, 2.5))
    return faults


def points_m(side: Side, poses: list[dict[Side, np.ndarray]]) -> np.ndarray:
    """(frame, point, 3) joints and tips, wrist frame."""
    return HANDS[side].state(np.stack([pose[side] for pose in poses])).point_m


def largest_step_m(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).max())


def assert_survived(
    whole: list[dict[Side, np.ndarray]], poses: list[dict[Side, np.ndarray]], faults: list[tuple[str, Side, slice]]
) -> None:
    """All poses are there; none jumps more than without faults (``whole``); 0.5 s after a fault they are like those."""
    assert len(poses) == len(whole)
    time_s, away = np.arange(len(whole)) / STEP_HZ, np.ones(len(whole), bool)
    for _, _, faulty in faults:
        # The look-ahead reads a fault 0.5 s before it.
        away &= ~((time_s > faulty.start / TRACKER_HZ - 0.55) & (time_s < (faulty.stop + 3) / TRACKER_HZ + 0.5))
    for side in SIDES:
        expected, got = points_m(side, whole), points_m(side, poses)
        assert np.isfinite(got).all()
        assert largest_step_m(got) < 1.2 * largest_step_m(expected)
        assert np.linalg.norm(got - expected, axis=-1).mean(axis=1)[away].max() < 0.008


@pytest.fixture(scope="module")
def whole(trained: Predictor) -> list[dict[Side, np.ndarray]]:
    """The poses of three seconds without faults."""
    return streamed(trained, tracked(TRACKER_HZ, 3.0))[0]


@pytest.mark.parametrize(
    "kind", [kind if kind in KINDS[:3] else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]
)
def test_a_stream_survives_each_fault_and_recovers_within_half_a_second(trained: Predictor, whole, kind: str) -> None:
    faults: list[tuple[str, Side, slice]] = [(kind, "right", slice(30, 34)), (kind, "left", slice(75, 118))]
    assert_survived(whole, poses_with_faults(trained, tracked(TRACKER_HZ, 3.0), faults), faults)


@pytest.mark.long
def test_a_stream_survives_half_a_minute_of_random_faults(trained: Predictor) -> None:
    control, faults = tracked(TRACKER_HZ, 30.0), random_faults(0, 30.0)
    assert_survived(streamed(trained, control)[0], poses_with_faults(trained, control, faults), faults)


def test_lost_fingers_are_kept_and_the_other_hand_goes_on(trained: Predictor) -> None:
    faults: list[tuple[str, Side, slice]] = [("wrist", "left", slice(60, 120))]
    poses = poses_with_faults(trained, tracked(TRACKER_HZ, 2.5), faults)
    left = np.stack([pose["left"] for pose in poses])
    np.testing.assert_array_equal(left[31:60], np.repeat(left[30:31], 29, axis=0))
    steps = np.linalg.norm(np.diff(points_m("right", poses)[31:60], axis=0), axis=-1).max(axis=1)
    assert steps.min() > 1e-4


def test_one_tracked_hand_gets_fingers_and_the_other_keeps_its_pose(trained: Predictor) -> None:
    control, stream = tracked(TRACKER_HZ, 1.5), new_stream(trained)
    for one in frames_of(control):
        stream.push(replace(one, wrists={"right": one.wrists["right"]}, objects={"right": one.objects["right"]}))
    poses = stream.finish()
    assert all(np.array_equal(pose["left"], START["left"]) for pose in poses)
    assert largest_step_m(points_m("right", poses)) > 1e-3


def test_a_hand_that_appears_later_is_blended_from_its_start_pose(trained: Predictor) -> None:
    faults: list[tuple[str, Side, slice]] = [("wrist", "left", slice(0, 60))]
    poses = poses_with_faults(trained, tracked(TRACKER_HZ, 3.0), faults)
    left = points_m("left", poses)
    assert largest_step_m(left[:31]) == 0
    apart_m = np.linalg.norm(left - left[0], axis=-1).max(axis=1)
    assert 0 < apart_m[31] < 0.2 * apart_m.max()


@pytest.mark.parametrize("rounding_s", [-1e-12, 0.0, 1e-12])
def test_a_repeated_time_may_be_rounded_otherwise(trained: Predictor, whole, rounding_s: float) -> None:
    frames: list[TrackedFrame | None] = [*frames_of(tracked(TRACKER_HZ, 3.0))]
    for number in range(60, 90):  # more than are needed to set the clock back
        if (one := frames[number]) is not None:
            frames[number] = replace(one, time_s=59 / TRACKER_HZ + rounding_s)
    stream = new_stream(trained)
    poses = [pose for one in frames if one is not None for pose in stream.push(one)] + stream.finish()
    assert len(poses) == len(whole)


@pytest.mark.parametrize("jump_s", [-2.0, 1e6])
def test_a_clock_that_is_set_delays_the_stream_by_a_moment_only(trained: Predictor, jump_s: float) -> None:
    control, stream, count = tracked(TRACKER_HZ, 4.0), new_stream(trained), 0
    for number, one in enumerate(frames_of(control)):
        count += len(stream.push(replace(one, time_s=one.time_s + jump_s * (number >= 120))))
    # The clock continues after a pause of 0.75 s; up to 10 frames are dropped as late.
    assert abs(count + len(stream.finish()) - STEP_HZ * 4.75) <= 6


@pytest.mark.parametrize("ahead_s", [3.0, 1e3])
def test_one_wrong_time_changes_nothing_but_its_frame(trained: Predictor, whole, ahead_s: float) -> None:
    frames = [*frames_of(tracked(TRACKER_HZ, 3.0))]
    frames.insert(60, replace(frames[60], time_s=frames[60].time_s + ahead_s))
    stream = new_stream(trained)
    poses = [pose for one in frames for pose in stream.push(one)] + stream.finish()
    np.testing.assert_array_equal(points_m("right", poses), points_m("right", whole))
    assert stream.dropped == 1


def test_times_in_milliseconds_are_dropped_and_a_stream_without_frames_ends(trained: Predictor) -> None:
    stream = new_stream(trained)
    assert stream.finish() == []
    poses = [stream.push(replace(one, time_s=1e3 * one.time_s)) for one in frames_of(tracked(TRACKER_HZ, 1.0))]
    assert stream.dropped == TRACKER_HZ
    assert len([pose for ready in poses for pose in ready] + stream.finish()) == 1


def test_an_exchanged_object_is_sensed_and_the_fingers_do_not_jump(trained: Predictor) -> None:
    control, poses = tracked(TRACKER_HZ, 4.0), {}
    for exchanged in (False, True):
        stream, poses[exchanged] = new_stream(trained), []
        for number, one in enumerate(frames_of(control)):
            if exchanged and number == 120:
                stream.exchange("right", box_model((0.02, 0.02, 0.3)))
            poses[exchanged] += stream.push(one)
    same, other = points_m("right", poses[False]), points_m("right", poses[True])
    np.testing.assert_array_equal(same[:46], other[:46])
    assert np.linalg.norm(same - other, axis=-1)[70:].max() > 0.001
    assert largest_step_m(other) < 1.2 * largest_step_m(same)


def sample_at(time_s: float, position_m: float, angle_rad: float = 0.0) -> Sample:
    rotation = rotvec_to_rotmat(np.array([0.0, 0.0, angle_rad]))
    return Sample(time_s, RigidTransform(rotation, np.array([position_m, 0.0, 0.0])), 0.0)


@pytest.mark.parametrize(
    ("position_m", "angle_rad", "starts_new"),
    [(0.16, 0.6, False), (0.18, 0.0, True), (0.0, 0.7, True), (0.0, np.pi, True)],
)
def test_a_body_faster_than_10_m_or_40_rad_per_second_starts_a_new_trajectory(
    position_m, angle_rad, starts_new
) -> None:
    trajectories: list[list[Sample]] = []
    for sample in (sample_at(0.0, 0.0), sample_at(1 / 60, position_m, angle_rad)):
        add_sample(trajectories, sample, 0.5)
    assert len(trajectories) == (2 if starts_new else 1)


def test_the_other_wrist_is_joined_over_gaps_and_cut_at_jumps() -> None:
    trajectories: list[list[Sample]] = []
    times_s, positions_m = [0.0, 0.1, 1.1, 1.2, 1.21, 1.3], [0.0, 0.1, 0.2, 0.3, 5.0, 5.1]
    for time_s, position_m in zip(times_s, positions_m, strict=True):
        add_sample(trajectories, sample_at(time_s, position_m), 0.5)
    assert len(trajectories) == 3
    for now_s, expected in ((-1.0, times_s[:4]), (0.5, times_s[:4]), (1.205, times_s[:4]), (1.25, times_s[4:])):
        assert [sample.time_s for sample in joined_at(trajectories, now_s)] == expected
    assert joined_at([], 0.0) == []
