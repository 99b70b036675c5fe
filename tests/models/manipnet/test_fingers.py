"""Promises of the rollout and of ManipNet as a family: it sees no fingers, a stream is a clip, limits hold."""

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
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.mano_hand import mano_hand
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import load_checkpoint
from models.common.family import LeftOut, Sources
from models.common.predicting import PredictionConfig, requests_for
from models.common.training import train_network
from models.manipnet.animate import Gap, new_fingers
from models.manipnet.control import control_of, finger_rotmats_of, hands_of, trajectories_of
from models.manipnet.family import Fingers
from models.manipnet.features import FeatureSettings, outputs, pose_features
from models.manipnet.inverse_kinematics import Limits, reach, target_points
from models.manipnet.lookups import as_right
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.rollout import Follower, Nearest, Predictor, Situation, Task, our_targets, paper_targets, roll_out
from models.manipnet.stream import Stream, TrackedFrame
from models.manipnet.training import MANIPNET, sized

HANDS = load_embedded_hands()
PARAMS = {
    "network": {"encoder": 16},
    "training": {"steps": 4, "batch": 2, "learning_rate": 0.001, "validate_every": 2},
    "loss": {"rows": 4},
}


def trained_twice(root: Path, out: Path) -> Path:
    return train_network(MANIPNET, root, out / "manipnet", PARAMS)


@pytest.fixture(scope="module")
def checkpoints(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fingers")
    trained_twice(annotated_root, out)
    return out


@pytest.fixture(scope="module")
def fingers(annotated: AnnotatedStore, checkpoints: Path) -> Fingers:
    return Fingers.load(Sources(annotated, checkpoints, HANDS, torch.device("cpu")))


def right_hand() -> TrackedHand:
    return mano_hand(HANDS, "right")


def turned(hand: TrackedHand, size_rad: float, seed: int = 0) -> np.ndarray:
    """(1, 15, 3, 3) the neutral pose with every joint turned a little."""
    turn = np.random.default_rng(seed).normal(0, size_rad, (len(hand.rest_rotmats), 3))
    return (hand.rest_rotmats @ rotvec_to_rotmat(turn))[None]


def free(hand: TrackedHand, size_rad: float = 3.0) -> Limits:
    ends = np.full((hand.n_joints - 1, 3), size_rad)
    return Limits.of(hand, -ends, ends)


def same(one: Clip, other: Clip) -> None:
    for side in SIDES:
        for name in ("wrist_m", "global_orient", "hand_pose", "valid"):
            np.testing.assert_array_equal(getattr(one.hands[side], name), getattr(other.hands[side], name))


@pytest.mark.slow
def test_random_fingers_in_the_recording_give_the_same_motion(fingers: Fingers, samples: list[ClipSample]) -> None:
    draws = np.random.default_rng(0)
    for sample in samples:
        changed = sample.hands.copy()
        changed[..., 9:] = draws.normal(size=changed[..., 9:].shape)
        spoilt = replace(sample, hands=changed, joints_m=draws.normal(size=sample.joints_m.shape))
        clean, other = (fingers.sample(requests_for(one, PredictionConfig(samples=1)))[0] for one in (sample, spoilt))
        assert isinstance(clean, Clip)
        assert isinstance(other, Clip)
        same(clean, other)


def test_wrists_and_object_stay_as_they_were_recorded(
    fingers: Fingers, samples: list[ClipSample], annotated: AnnotatedStore
) -> None:
    for sample in samples:
        (made,) = fingers.sample(requests_for(sample, PredictionConfig(samples=1)))
        recorded = annotated.clip(sample.clip_id)
        assert isinstance(made, Clip)
        np.testing.assert_allclose(made.object.translation_m, recorded.object.translation_m, atol=1e-5)
        for row, side in enumerate(SIDES):
            assert made.hands[side].valid.all() == sample.active_hands[row]
            if sample.active_hands[row]:
                np.testing.assert_allclose(made.hands[side].wrist_m, recorded.hands[side].wrist_m, atol=1e-5)


def test_a_request_without_trajectories_is_left_out_with_the_reason(
    fingers: Fingers, samples: list[ClipSample]
) -> None:
    request = replace(requests_for(samples[0], PredictionConfig(samples=1))[0], trajectories=None)
    (answer,) = fingers.sample([request])
    assert isinstance(answer, LeftOut)
    assert "trajectories" in answer.reason


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["off", "paper", "ours"])
def test_a_stream_gives_the_bits_of_the_clip(fingers: Fingers, samples: list[ClipSample], rule) -> None:
    sample, predictor = samples[0], replace(fingers.predictor, rule=rule)
    control, hands = control_of(trajectories_of(sample), sample.object_model), hands_of(HANDS, sample.betas, None)
    start = {side: turned(hands[side], 0.1)[0] for side in SIDES}
    time_s = control.thing.time_s
    whole = roll_out(predictor, [Task(hands[side], side, control, time_s, start[side]) for side in SIDES])
    stream = Stream(predictor, hands, dict.fromkeys(SIDES, sample.object_model), start)
    told, when = [], []
    for frame, now in enumerate(time_s):
        wrists = {side: control.wrists[side].at(now[None])[0] for side in SIDES}
        thing = control.thing.at(now[None])[0]
        angles = None if control.hinge_rad is None else dict.fromkeys(SIDES, control.hinge_rad[frame])
        poses = stream.push(TrackedFrame(now, wrists, dict.fromkeys(SIDES, thing), angles))
        told += poses
        when += [frame] * len(poses)
    told += stream.finish()
    assert 0 < len(when) < len(told) == len(time_s)
    # Frame k needs what is half a second after frame k - 1, and one frame more to be sure of it.
    assert max(frame - number for number, frame in enumerate(when)) == 0.5 * FPS
    for row, side in enumerate(SIDES):
        np.testing.assert_array_equal(np.stack([pose[side] for pose in told]), whole[row])


def test_two_trainings_give_the_same_bytes(annotated_root: Path, checkpoints: Path, tmp_path: Path) -> None:
    again = trained_twice(annotated_root, tmp_path)
    assert again.read_bytes() == (checkpoints / "manipnet" / "model.safetensors").read_bytes()


def test_a_checkpoint_knows_the_step_its_hand_and_how_far_joints_turned(checkpoints: Path) -> None:
    network = load_checkpoint(checkpoints / "manipnet", MANIPNET).network
    assert isinstance(network, ManipNet)
    assert network.config.features.step_s == 1 / FPS
    assert network.config.joints == 16
    assert (network.high_rad > network.low_rad).all()


def test_the_mirrored_hand_in_the_mirrored_scene_makes_the_mirrored_motion(
    fingers: Fingers, samples: list[ClipSample]
) -> None:
    sample = samples[1]
    control = control_of(trajectories_of(sample), sample.object_model)
    left = hands_of(HANDS, sample.betas, None)["left"]
    model = replace(
        sample.object_model,
        vertices_m=sample.object_model.vertices_m * [-1, 1, 1],
        faces=sample.object_model.faces[:, ::-1],
    )
    flip = np.diag([-1.0, 1.0, 1.0])

    def mirrored(motion):
        return replace(motion, rotmats=flip @ motion.rotmats @ flip, position_m=motion.position_m @ flip)

    wrists = {other: mirrored(control.wrists[side]) for side, other in zip(SIDES, reversed(SIDES), strict=True)}
    other = replace(control, wrists=wrists, thing=mirrored(control.thing), model=model)
    time_s = control.thing.time_s
    (plain,) = roll_out(fingers.predictor, [Task(left, "left", control, time_s, left.rest_rotmats)])
    twin = left.mirrored()
    (seen,) = roll_out(fingers.predictor, [Task(twin, "right", other, time_s, twin.rest_rotmats)])
    np.testing.assert_allclose(as_right(left, plain), seen, atol=1e-6)


def test_an_object_in_each_hand_is_sensed_by_that_hand(fingers: Fingers, samples: list[ClipSample]) -> None:
    sample = samples[0]
    control, hands = control_of(trajectories_of(sample), sample.object_model), hands_of(HANDS, sample.betas, None)
    away = replace(control, thing=replace(control.thing, position_m=control.thing.position_m + 0.1))
    time_s = control.thing.time_s[:8]

    def run(left, right):
        tasks = [Task(hands["left"], "left", left, time_s, hands["left"].rest_rotmats)]
        tasks += [Task(hands["right"], "right", right, time_s, hands["right"].rest_rotmats)]
        return roll_out(fingers.predictor, tasks)

    same_object, two_objects = run(control, control), run(control, away)
    np.testing.assert_array_equal(same_object[0], two_objects[0])
    assert not np.allclose(same_object[1], two_objects[1])


def test_joints_reach_the_points_of_another_pose_and_stop_at_their_limits() -> None:
    hand = right_hand()
    start, goal = hand.state(hand.rest_rotmats[None]), hand.state(turned(hand, 0.2))
    weight = np.zeros(hand.n_points)
    weight[target_points(hand)] = 1
    before = np.linalg.norm(start.point_m - goal.point_m, axis=-1)[0, target_points(hand)]
    made = hand.state(reach(hand, free(hand), start, goal.point_m[0], weight, steps=12))
    after = np.linalg.norm(made.point_m - goal.point_m, axis=-1)[0, target_points(hand)]
    assert after.max() < 0.002 < 0.005 < before.max()
    tight = free(hand, 0.05)
    stopped = reach(hand, tight, start, goal.point_m[0], weight, steps=12)
    turn = np.linalg.norm(tight.within(stopped) - stopped)
    assert turn < 1e-9
    assert np.abs(stopped - hand.rest_rotmats).max() > 0.03


def test_a_hinge_turns_about_its_axis_alone_and_points_without_weight_stay() -> None:
    hand = right_hand()
    axis, limit = np.zeros((16, 3)), np.zeros((16, 2))
    axis[2, 2], limit[2] = 1.0, (-0.1, 1.0)
    hinged = replace(hand, hinge_axis=axis, limit_rad=limit)
    limits = free(hinged)
    turn = np.array([[0.3, 0.2, 1.4]])
    put_back = limits.within(hand.rest_rotmats[None] @ rotvec_to_rotmat(np.tile(turn, (15, 1))))
    expected = hand.rest_rotmats[1] @ rotvec_to_rotmat(np.array([0, 0, 1.0]))
    np.testing.assert_allclose(put_back[0, 1], expected, atol=1e-9)
    state = hinged.state(turned(hinged, 0.1))
    still = limits.within(hinged.finger_rotmats(state.joint_rotmats))
    kept = reach(hinged, limits, hinged.state(still), state.point_m[0] + 0.1, np.zeros(hand.n_points))
    np.testing.assert_allclose(kept, still, atol=1e-9)


def test_targets_are_those_of_algorithm_1() -> None:
    # On the plane z = 0 with the object below it: 1 cm deep, 2 cm above, and out of reach.
    points = np.array([[0, 0, -0.01], [0, 0, 0.02], [0, 0, 0.02]])
    found = Nearest(points[:, 2], points * [1, 1, 0], np.tile([0.0, 0, 1], (3, 1)))
    radius, range_m = np.array([0.008, 0.008, 0.0]), 0.03
    predicted = np.array([0.0, 0.1, 1.0])  # 8 mm, 11 mm, and as far as can be said
    paper = paper_targets(points, predicted, radius, range_m, found)
    np.testing.assert_allclose(paper.point_m[:, 2], [0.8 * 0.008 - 0.2 * 0.01, 0.2 * 0.011 + 0.8 * 0.02, 0.02])


def test_targets_of_ours_press_what_is_near_and_stay_on_the_side_they_come_from() -> None:
    # On the plane z = 0 with the object below it: 1 cm deep, 2 cm above it and said to be near, and said to be far.
    points, seen = np.array([[0, 0, -0.01], [0, 0, 0.02], [0, 0, 0.02]]), np.array([[0, 0, 0.01]] * 3)
    found = Nearest(seen[:, 2], seen * [1, 1, 0], np.tile([0.0, 0, 1], (3, 1)))
    radius, predicted = np.full(3, 0.008), np.array([0.5, 0.1, 1.0])
    given = (radius, 0.03, np.array([True, False, False]), radius)
    ours = our_targets(points, predicted, *given, found)
    # Out to where a finger gives way (8 mm), in to what is said (3 mm) and its radius less 7 mm; nothing is drawn off.
    np.testing.assert_allclose(ours.point_m[:, 2], [0.0, 0.004, 0.02], atol=1e-12)
    np.testing.assert_allclose(ours.weight, [1.0, 1.0, 0.5])
    # A plate 4 mm thick: what lies beyond it comes back to the side that the finger was on, not to the nearer one.
    beyond = our_targets(points - [0, 0, 0.02], predicted, *given, found)
    assert beyond.point_m[0, 2] == pytest.approx(0.0)
    # Nothing is known from farther away than 6 cm.
    far = our_targets(points, predicted, *given, Nearest(seen[:, 2] + 0.06, found.closest_m, found.normal))
    np.testing.assert_allclose(far.point_m, points)


def test_our_rule_brings_fingers_out_of_the_object_and_the_network_goes_on_from_its_own_pose() -> None:
    hand, mesh = right_hand(), trimesh.creation.box((0.03, 0.06, 0.03))
    model = ObjectModel("box", np.array(mesh.vertices), np.array(mesh.faces), np.zeros(8, np.uint8))
    network, surface = ManipNet(sized(NetworkConfig(encoder=8), hand)).eval(), surface_index(model)
    state = hand.state(hand.rest_rotmats[None])
    output = np.concatenate([pose_features(hand, state)[0], np.zeros(hand.n_points)])
    placed = RigidTransform(np.eye(3)[None], -state.tip_m[:, 1])  # the box lies about the tip of the middle finger
    deep = {}
    for rule in ("off", "ours"):
        one = Follower(Predictor(network, rule), hand, surface, hand.rest_rotmats)
        one.advance(output, Situation(np.zeros(336), placed, None))
        np.testing.assert_allclose(one.finger_rotmats[0], hand.rest_rotmats, atol=1e-6)
        deep[rule] = -surface.nearest(placed @ hand.state(one.answer).tip_m, None).distance_m.min()
    assert deep["off"] > deep["ours"] + 0.004


def test_a_finger_in_a_plate_leaves_it_on_the_side_that_it_came_from() -> None:
    hand, mesh = right_hand(), trimesh.creation.box((0.05, 0.05, 0.01))
    model = ObjectModel("plate", np.array(mesh.vertices), np.array(mesh.faces), np.zeros(8, np.uint8))

    def bent(turn_rad: float) -> np.ndarray:
        fingers = hand.rest_rotmats.copy()
        fingers[3:6] = fingers[3:6] @ rotvec_to_rotmat(np.tile([0.0, 0.0, turn_rad], (3, 1)))  # the middle finger
        return fingers

    within, tips = hand.state(bent(0.3)[None]), [hand.state(bent(turn)[None]).tip_m[0, 1] for turn in (0.2, 0.4)]
    turn = Rotation.align_vectors([tips[1] - tips[0]], [[0, 0, 1]])[0].as_matrix()
    placed = RigidTransform(turn.T[None], -(turn.T @ within.tip_m[0, 1])[None])  # the tip is in its middle
    predictor, surface = Predictor(ManipNet(sized(NetworkConfig(encoder=8), hand)).eval()), surface_index(model)
    distance_m = surface.nearest(placed @ within.point_m, None).distance_m
    output, heights = outputs(hand, within, distance_m, FeatureSettings())[0], []
    for start in (0.2, 0.4):
        one = Follower(predictor, hand, surface, bent(start))
        one.advance(output, Situation(np.zeros(336), placed, None))
        heights.append((placed @ hand.state(one.answer).tip_m)[0, 1, 2])
    assert heights[0] < -0.004
    assert heights[1] > 0.004


def test_frames_of_a_clip_are_made_from_the_poses_beside_them_alone(
    fingers: Fingers, samples: list[ClipSample]
) -> None:
    sample, frames = samples[0], slice(9, 20)
    control, hand = (
        control_of(trajectories_of(sample), sample.object_model),
        hands_of(HANDS, sample.betas, None)["right"],
    )
    recorded = finger_rotmats_of(sample.hands[1])
    gap = Gap(frames.start, frames.stop, recorded[8], recorded[20])
    made = new_fingers(fingers.predictor, hand, "right", control, gap)
    other = gap._replace(after=hand.rest_rotmats @ rotvec_to_rotmat(np.full((15, 3), 0.2)))
    assert np.abs(made - new_fingers(fingers.predictor, hand, "right", control, other)).max() > 0.05
    assert len(made) == 11
