"""The rollout and the family of ManipNet: recorded fingers are not read, a stream equals a clip, limits hold."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.batches.dataset import ClipSample
from hoidata.clips.clip import FPS, SIDES, Clip
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.distance import SignedDistance
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.mano_hand import mano_hand, mano_hands
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import load_checkpoint
from models.common.family import Skipped, Sources
from models.common.predicting import PredictionConfig, requests_for
from models.common.training import train_network
from models.manipnet.animate import Gap, predict_fingers
from models.manipnet.control import control_of, finger_rotmats_of, trajectories_of
from models.manipnet.family import FingerSampler, diagnose, recorded_hands, thinned
from models.manipnet.features import FeatureSettings, mirrored_to_right, outputs, pose_features
from models.manipnet.inverse_kinematics import Limits, reach
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.rollout import (
    FrameContext,
    HandRollout,
    Predictor,
    RolloutTask,
    our_targets,
    paper_targets,
    roll_out,
)
from models.manipnet.stream import Stream, TrackedFrame
from models.manipnet.training import MANIPNET, sized_config

HANDS = load_embedded_hands()
PARAMS = {
    "network": {"encoder": 16},
    "training": {"steps": 4, "batch": 2, "learning_rate": 0.001, "validate_every": 2},
    "loss": {"steps_per_clip": 4},
}


@pytest.fixture(scope="module")
def checkpoints(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fingers")
    train_network(MANIPNET, annotated_root, out / "manipnet", PARAMS)
    return out


@pytest.fixture(scope="module")
def fingers(annotated: AnnotatedStore, checkpoints: Path) -> FingerSampler:
    return FingerSampler.load(Sources(annotated, checkpoints, HANDS, torch.device("cpu")))


def right_hand() -> TrackedHand:
    return mano_hand(HANDS, "right")


def perturbed_pose(hand: TrackedHand, size_rad: float, seed: int = 0) -> np.ndarray:
    """(1, 15, 3, 3) the neutral pose with a small random rotation of each joint."""
    rotvec = np.random.default_rng(seed).normal(0, size_rad, (len(hand.rest_rotmats), 3))
    return (hand.rest_rotmats @ rotvec_to_rotmat(rotvec))[None]


def free(hand: TrackedHand, size_rad: float = 3.0) -> Limits:
    ends = np.full((hand.n_joints - 1, 3), size_rad)
    return Limits.of(hand, -ends, ends)


def assert_same_hands(one: Clip, other: Clip) -> None:
    for side in SIDES:
        for name in ("wrist_m", "global_orient", "hand_pose", "valid"):
            np.testing.assert_array_equal(getattr(one.hands[side], name), getattr(other.hands[side], name))


@pytest.mark.slow
def test_random_fingers_in_the_recording_give_the_same_motion(
    fingers: FingerSampler, samples: list[ClipSample]
) -> None:
    rng = np.random.default_rng(0)
    for sample in samples:
        random_hands = sample.hands.copy()
        random_hands[..., 9:] = rng.normal(size=random_hands[..., 9:].shape)
        corrupted = replace(sample, hands=random_hands, joints_m=rng.normal(size=sample.joints_m.shape))
        original, other = (
            fingers.sample(requests_for(one_sample, PredictionConfig(samples=1)))[0]
            for one_sample in (sample, corrupted)
        )
        assert_same_hands(original, other)


def test_wrists_and_object_are_those_of_the_recording(
    fingers: FingerSampler, samples: list[ClipSample], annotated: AnnotatedStore
) -> None:
    for sample in samples:
        (motion,) = fingers.sample(requests_for(sample, PredictionConfig(samples=1)))
        recorded = annotated.clip(sample.clip_id)
        np.testing.assert_allclose(motion.object.translation_m, recorded.object.translation_m, atol=1e-5)
        for side_index, side in enumerate(SIDES):
            assert motion.hands[side].valid.all() == sample.active_hands[side_index]
            if sample.active_hands[side_index]:
                np.testing.assert_allclose(motion.hands[side].wrist_m, recorded.hands[side].wrist_m, atol=1e-5)


def test_a_request_without_trajectories_is_skipped_with_the_reason(
    fingers: FingerSampler, samples: list[ClipSample]
) -> None:
    request = replace(requests_for(samples[0], PredictionConfig(samples=1))[0], trajectories=None)
    (answer,) = fingers.sample([request])
    assert isinstance(answer, Skipped)
    assert "trajectories" in answer.reason


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["off", "paper", "ours"])
def test_a_stream_equals_the_rollout_of_the_clip_bit_for_bit(
    fingers: FingerSampler, samples: list[ClipSample], rule
) -> None:
    sample, predictor = samples[0], replace(fingers.predictor, rule=rule)
    control, hands = control_of(trajectories_of(sample), sample.object_model), mano_hands(HANDS, sample.betas, None)
    start = {side: perturbed_pose(hands[side], 0.1)[0] for side in SIDES}
    time_s = control.object_motion.time_s
    whole = roll_out(
        predictor,
        [RolloutTask(hand=hands[side], side=side, control=control, time_s=time_s, start=start[side]) for side in SIDES],
    )
    stream = Stream(predictor, hands, dict.fromkeys(SIDES, sample.object_model), start)
    poses, push_frames = [], []
    for frame, now_s in enumerate(time_s):
        wrists = {side: control.wrists[side].at(now_s[None])[0] for side in SIDES}
        object_pose = control.object_motion.at(now_s[None])[0]
        angles = None if control.hinge_rad is None else dict.fromkeys(SIDES, control.hinge_rad[frame])
        new_poses = stream.push(TrackedFrame(now_s, wrists, dict.fromkeys(SIDES, object_pose), angles))
        poses += new_poses
        push_frames += [frame] * len(new_poses)
    poses += stream.finish()
    assert 0 < len(push_frames) < len(poses) == len(time_s)
    # Pose k needs the inputs half a second after frame k - 1; the stream waits for one more frame.
    assert max(frame - number for number, frame in enumerate(push_frames)) == 0.5 * FPS
    for side_index, side in enumerate(SIDES):
        np.testing.assert_array_equal(np.stack([pose[side] for pose in poses]), whole[side_index])


def test_thinned_training_frames_are_spread_over_all_hands(
    annotated: AnnotatedStore, samples: list[ClipSample], checkpoints: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hands = [hand for sample in samples for hand in recorded_hands(sample, HANDS)]
    total = sum(len(hand.tracked) for hand in hands)
    assert [len(hand.tracked) for hand in thinned(hands)] == [len(hand.tracked) for hand in hands]
    monkeypatch.setattr("models.manipnet.family.MAX_TRAINING_FRAMES", total // 4)
    fewer = thinned(hands)
    assert sum(len(hand.tracked) for hand in fewer) <= total // 4 + len(hands)
    assert all(len(hand.tracked) >= 2 for hand in fewer)
    sources = Sources(annotated, checkpoints, HANDS, torch.device("cpu"))
    errors = diagnose(sources)["manipnet"]
    assert errors["joint_error_nearest_frame_mm"] < errors["joint_error_mean_pose_mm"]


def test_a_checkpoint_stores_step_hand_and_joint_limits(checkpoints: Path) -> None:
    network = load_checkpoint(checkpoints / "manipnet", MANIPNET).network
    assert network.config.features.step_s == 1 / FPS
    assert network.config.joints == 16
    assert (network.high_rad > network.low_rad).all()


def test_the_mirrored_hand_in_the_mirrored_scene_has_the_mirrored_motion(
    fingers: FingerSampler, samples: list[ClipSample]
) -> None:
    sample = samples[1]
    control = control_of(trajectories_of(sample), sample.object_model)
    left = mano_hands(HANDS, sample.betas, None)["left"]
    model = replace(
        sample.object_model,
        vertices_m=sample.object_model.vertices_m * [-1, 1, 1],
        faces=sample.object_model.faces[:, ::-1],
    )
    flip = np.diag([-1.0, 1.0, 1.0])

    def mirrored(motion):
        return replace(motion, rotmats=flip @ motion.rotmats @ flip, position_m=motion.position_m @ flip)

    wrists = {other: mirrored(control.wrists[side]) for side, other in zip(SIDES, reversed(SIDES), strict=True)}
    other = replace(control, wrists=wrists, object_motion=mirrored(control.object_motion), model=model)
    time_s = control.object_motion.time_s
    (plain,) = roll_out(
        fingers.predictor,
        [RolloutTask(hand=left, side="left", control=control, time_s=time_s, start=left.rest_rotmats)],
    )
    twin = left.mirrored()
    (from_twin,) = roll_out(
        fingers.predictor, [RolloutTask(hand=twin, side="right", control=other, time_s=time_s, start=twin.rest_rotmats)]
    )
    np.testing.assert_allclose(mirrored_to_right(left, plain), from_twin, atol=1e-6)


def test_an_object_in_each_hand_is_sensed_by_that_hand(fingers: FingerSampler, samples: list[ClipSample]) -> None:
    sample = samples[0]
    control, hands = control_of(trajectories_of(sample), sample.object_model), mano_hands(HANDS, sample.betas, None)
    moved_object = replace(
        control, object_motion=replace(control.object_motion, position_m=control.object_motion.position_m + 0.1)
    )
    time_s = control.object_motion.time_s[:8]

    def run(left, right):
        tasks = [
            RolloutTask(hand=hands[side], side=side, control=control, time_s=time_s, start=hands[side].rest_rotmats)
            for side, control in zip(SIDES, (left, right), strict=True)
        ]
        return roll_out(fingers.predictor, tasks)

    same_object, two_objects = run(control, control), run(control, moved_object)
    np.testing.assert_array_equal(same_object[0], two_objects[0])
    assert not np.allclose(same_object[1], two_objects[1])


def test_joints_reach_the_points_of_another_pose_and_stop_at_their_limits() -> None:
    hand = right_hand()
    start, goal = hand.state(hand.rest_rotmats[None]), hand.state(perturbed_pose(hand, 0.2))
    weight = np.ones(hand.n_points)
    before = np.linalg.norm(start.point_m - goal.point_m, axis=-1)[0]
    reached = hand.state(reach(hand, free(hand), start, goal.point_m[0], weight, steps=12))
    after = np.linalg.norm(reached.point_m - goal.point_m, axis=-1)[0]
    assert after.max() < 0.002 < 0.005 < before.max()
    tight = free(hand, 0.05)
    stopped = reach(hand, tight, start, goal.point_m[0], weight, steps=12)
    excess = np.linalg.norm(tight.within(stopped) - stopped)
    assert excess < 1e-9
    assert np.abs(stopped - hand.rest_rotmats).max() > 0.03


def test_a_hinge_joint_rotates_about_its_axis_only_and_points_without_weight_stay() -> None:
    hand = right_hand()
    axis, limit = np.zeros((16, 3)), np.zeros((16, 2))
    axis[2, 2], limit[2] = 1.0, (-0.1, 1.0)
    hinged = replace(hand, hinge_axis=axis, limit_rad=limit)
    limits = free(hinged)
    rotvec = np.array([[0.3, 0.2, 1.4]])
    clamped = limits.within(hand.rest_rotmats[None] @ rotvec_to_rotmat(np.tile(rotvec, (15, 1))))
    expected = hand.rest_rotmats[1] @ rotvec_to_rotmat(np.array([0, 0, 1.0]))
    np.testing.assert_allclose(clamped[0, 1], expected, atol=1e-9)
    state = hinged.state(perturbed_pose(hinged, 0.1))
    still = limits.within(hinged.finger_rotmats(state.joint_rotmats))
    unchanged = reach(hinged, limits, hinged.state(still), state.point_m[0] + 0.1, np.zeros(hand.n_points))
    np.testing.assert_allclose(unchanged, still, atol=1e-9)


def test_targets_are_those_of_algorithm_1() -> None:
    # The object is below the plane z = 0. Points: 1 cm deep; 2 cm above and predicted near; 2 cm above, predicted far.
    points = np.array([[0, 0, -0.01], [0, 0, 0.02], [0, 0, 0.02]])
    nearest = SignedDistance(points[:, 2], points * [1, 1, 0], np.tile([0.0, 0, 1], (3, 1)))
    radius, range_m = np.array([0.008, 0.008, 0.0]), 0.03
    predicted = np.array([0.0, 0.1, 1.0])  # 8 mm, 11 mm, and the end of the range
    paper = paper_targets(points, predicted, radius, range_m, nearest)
    np.testing.assert_allclose(paper.point_m[:, 2], [0.8 * 0.008 - 0.2 * 0.01, 0.2 * 0.011 + 0.8 * 0.02, 0.02])


def test_our_targets_press_near_points_and_stay_on_the_side_of_the_previous_pose() -> None:
    # The object is below the plane z = 0. Points: 1 cm deep; 2 cm above and predicted near; 2 cm above, predicted far.
    points, surface_points = np.array([[0, 0, -0.01], [0, 0, 0.02], [0, 0, 0.02]]), np.array([[0, 0, 0.01]] * 3)
    nearest = SignedDistance(surface_points[:, 2], surface_points * [1, 1, 0], np.tile([0.0, 0, 1], (3, 1)))
    radius, predicted = np.full(3, 0.008), np.array([0.5, 0.1, 1.0])
    arguments = (radius, 0.03, np.array([True, False, False]), radius)
    ours = our_targets(points, predicted, *arguments, nearest)
    # Out to the indentation limit (8 mm); in to the predicted distance (3 mm), plus radius, minus 7 mm; the last stays.
    np.testing.assert_allclose(ours.point_m[:, 2], [0.0, 0.004, 0.02], atol=1e-12)
    np.testing.assert_allclose(ours.weight, [1.0, 1.0, 0.5])
    # A plate of 4 mm: a point beyond it returns to the side of the previous pose, not to the closer side.
    beyond = our_targets(points - [0, 0, 0.02], predicted, *arguments, nearest)
    assert beyond.point_m[0, 2] == pytest.approx(0.0)
    # Surfaces farther than 6 cm have no effect.
    far = our_targets(
        points, predicted, *arguments, SignedDistance(surface_points[:, 2] + 0.06, nearest.closest_m, nearest.normal)
    )
    np.testing.assert_allclose(far.point_m, points)


def test_our_rule_moves_fingers_out_of_the_object_and_keeps_the_predicted_pose_as_input() -> None:
    hand, mesh = right_hand(), trimesh.creation.box((0.03, 0.06, 0.03))
    model = ObjectModel("box", np.array(mesh.vertices), np.array(mesh.faces), np.zeros(8, np.uint8))
    network, surface = ManipNet(sized_config(NetworkConfig(encoder=8), hand)).eval(), surface_index(model)
    state = hand.state(hand.rest_rotmats[None])
    output = np.concatenate([pose_features(hand, state, FeatureSettings())[0], np.zeros(hand.n_points)])
    object_from_wrist = RigidTransform(
        np.eye(3)[None], -state.tip_m[:, 1]
    )  # the box surrounds the tip of the middle finger
    depth_m = {}
    for rule in ("off", "ours"):
        rollout = HandRollout(Predictor(network, rule), hand, surface, hand.rest_rotmats)
        rollout.advance(output, FrameContext(np.zeros((1, 336)), object_from_wrist[None], None))
        np.testing.assert_allclose(rollout.finger_rotmats[0], hand.rest_rotmats, atol=1e-6)
        depth_m[rule] = -surface.nearest(object_from_wrist @ hand.state(rollout.answer).tip_m, None).distance_m.min()
    assert depth_m["off"] > depth_m["ours"] + 0.004


def test_a_finger_in_a_plate_leaves_it_on_the_side_of_the_previous_pose() -> None:
    hand, mesh = right_hand(), trimesh.creation.box((0.05, 0.05, 0.01))
    model = ObjectModel("plate", np.array(mesh.vertices), np.array(mesh.faces), np.zeros(8, np.uint8))

    def bent(turn_rad: float) -> np.ndarray:
        fingers = hand.rest_rotmats.copy()
        fingers[3:6] = fingers[3:6] @ rotvec_to_rotmat(np.tile([0.0, 0.0, turn_rad], (3, 1)))  # the middle finger
        return fingers

    within, tips = hand.state(bent(0.3)[None]), [hand.state(bent(turn)[None]).tip_m[0, 1] for turn in (0.2, 0.4)]
    turn = Rotation.align_vectors([tips[1] - tips[0]], [[0, 0, 1]])[0].as_matrix()
    object_from_wrist = RigidTransform(
        turn.T[None], -(turn.T @ within.tip_m[0, 1])[None]
    )  # the tip is in the plate's middle
    predictor, surface = Predictor(ManipNet(sized_config(NetworkConfig(encoder=8), hand)).eval()), surface_index(model)
    distance_m = surface.nearest(object_from_wrist @ within.point_m, None).distance_m
    output, heights = outputs(hand, within, distance_m, FeatureSettings())[0], []
    for start in (0.2, 0.4):
        rollout = HandRollout(predictor, hand, surface, bent(start))
        rollout.advance(output, FrameContext(np.zeros((1, 336)), object_from_wrist[None], None))
        heights.append((object_from_wrist @ hand.state(rollout.answer).tip_m)[0, 1, 2])
    assert heights[0] < -0.004
    assert heights[1] > 0.004


def test_new_fingers_depend_on_the_poses_before_and_after_the_gap(
    fingers: FingerSampler, samples: list[ClipSample]
) -> None:
    sample, frames = samples[0], slice(9, 20)
    control, hand = (
        control_of(trajectories_of(sample), sample.object_model),
        mano_hands(HANDS, sample.betas, None)["right"],
    )
    recorded = finger_rotmats_of(sample.hands[1])
    gap = Gap(frames.start, frames.stop, recorded[8], recorded[20])
    predicted = predict_fingers(fingers.predictor, hand, "right", control, gap)
    other_gap = gap._replace(after=hand.rest_rotmats @ rotvec_to_rotmat(np.full((15, 3), 0.2)))
    assert np.abs(predicted - predict_fingers(fingers.predictor, hand, "right", control, other_gap)).max() > 0.05
    assert len(predicted) == 11
