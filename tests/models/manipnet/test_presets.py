"""ManipNet's preset `paper`, by the numbers printed in Zhang et al. 2021, and the rate of a network's steps."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
import yaml

from hoidata.batches.dataset import ClipSample
from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.datasets import RawTree
from hoidata.datasets.manipnet.adapter import read_hand_recording
from hoidata.geometry.motion import Motion
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.distance import SignedDistance
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import sense
from hoidata.sensors.mano_hand import mano_hands
from hoidata.settings import build_config
from hoidata.store.annotated import AnnotatedStore
from models.common.family import Sources
from models.common.predicting import PredictionConfig, requests_for
from models.common.training import TrainingSpec, train_network
from models.manipnet.control import Control
from models.manipnet.family import FingerSampler
from models.manipnet.features import FeatureSettings, hand_inputs, outputs, pose_features, trajectory_features
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.rollout import (
    FrameContext,
    HandRollout,
    Predictor,
    RolloutTask,
    Rule,
    paper_targets,
    roll_out,
)
from models.manipnet.training import MANIPNET, clip_examples, sized_config
from pipelines.stages.train import TrainParams
from tests.builders.manipnet import KEY, lift_rows, write_skin, write_tree
from tests.builders.objects import box_model
from tests.builders.sensing import small_hand

SECTION: dict[str, Any] = yaml.safe_load((Path(__file__).parents[3] / "params.yaml").read_text())["train"]
HANDS = load_embedded_hands()


def training_plan(preset: Literal["paper", "ours"]) -> TrainingSpec:
    params = build_config(TrainParams, {**SECTION, "preset": preset, "size": "full"}, "params.yaml: train")
    return TrainingSpec.of(MANIPNET, params.of("manipnet"))


def features(preset: Literal["paper", "ours"]) -> FeatureSettings:
    return training_plan(preset).network.features


PAPER = features("paper")


@pytest.fixture(scope="module")
def own_hand(tmp_path_factory: pytest.TempPathFactory) -> TrackedHand:
    """A hand of 17 joints, 5 tips and 104 sensors, as ManipNet's recordings have it."""
    root = tmp_path_factory.mktemp("manipnet")
    raw = write_tree(root, *lift_rows(40))
    write_skin(root)
    return read_hand_recording(RawTree(raw.root), KEY).tracked_hand("right")


def still(position_m: list[float], rotvec: list[float] | None = None, time_s: np.ndarray | None = None) -> Motion:
    times = np.arange(3.0) if time_s is None else time_s
    rotmat = rotvec_to_rotmat(np.array(rotvec or [0.0, 0, 0]))
    return Motion(times, np.tile(rotmat, (len(times), 1, 1)), np.tile(np.array(position_m), (len(times), 1)))


def scene(body: Motion, right: Motion, model: ObjectModel) -> Control:
    return Control({"left": still([0.0, 0.3, 0.4]), "right": right}, body, model)


def test_the_papers_network_has_2356_inputs_and_220_outputs(own_hand: TrackedHand) -> None:
    state = own_hand.state(own_hand.rest_rotmats[None])
    control = scene(still([0.1, 0, 0]), still([0.0, 0, 0]), box_model())
    inputs = hand_inputs(control, "right", own_hand, state, np.ones(1), PAPER)
    assert [part.shape[1] for part in inputs] == [198, 336, 1822]
    assert outputs(own_hand, state, np.zeros((1, 22)), PAPER).shape == (1, 220)
    config = sized_config(training_plan("paper").network, own_hand)
    assert (sum(config.inputs), config.output) == (2356, 220)
    # Sec. 6.2: three encoders to 512, two blocks of two layers 1536 x 1536, one decoder.
    layers = [(size, 512) for size in (198, 336, 1822)] + 4 * [(1536, 1536)] + [(1536, 220)]
    assert sum(p.numel() for p in ManipNet(config).parameters()) == sum((a + 1) * b for a, b in layers)


def test_the_papers_pose_is_position_and_two_axes_of_22_joints(own_hand: TrackedHand) -> None:
    state = own_hand.state(own_hand.rest_rotmats[None] @ rotvec_to_rotmat(np.array([0.1, 0.2, 0.3])))
    vectors, axes = pose_features(own_hand, state, PAPER).reshape(66, 3), own_hand.wrist_from_canonical
    np.testing.assert_allclose(vectors[:17], state.joint_m[0] @ axes, atol=1e-12)
    np.testing.assert_allclose(vectors[17:22], state.tip_m[0] @ axes, atol=1e-12)
    orientation = [*range(17), *own_hand.tip_joint]  # a tip has the orientation of the last bone
    for number, joint in enumerate(orientation):
        rotmat = axes.T @ state.joint_rotmats[0, joint] @ axes
        np.testing.assert_allclose(vectors[22 + 2 * number], rotmat[:, 2], atol=1e-12)
        np.testing.assert_allclose(vectors[23 + 2 * number], rotmat[:, 1], atol=1e-12)


@pytest.mark.parametrize(("settings", "about_z"), [(PAPER, 2.0), (features("ours"), 1.0)], ids=["paper", "ours"])
def test_angular_velocity_is_the_objects_own_in_the_paper_and_relative_to_the_wrist_in_ours(settings, about_z) -> None:
    """Both rotate about the world's z: the object at 2 rad/s, the wrist at 1 rad/s."""
    time_s = np.arange(241) / 120
    turning = [rotvec_to_rotmat(rate * time_s[:, None] * [0, 0, 1]) for rate in (2, 1)]
    body, wrist = (Motion(time_s, rotmats, np.zeros((241, 3))) for rotmats in turning)
    control = scene(body, wrist, box_model())
    samples = trajectory_features(control, "right", small_hand(), np.array([1.0]), settings).reshape(21, 16)
    np.testing.assert_allclose(samples[:, 13:], np.tile([0, 0, about_z], (21, 1)), atol=1e-6)


def test_the_object_is_at_its_centre_of_mass_in_the_paper_and_at_its_box_centre_in_ours() -> None:
    corners = np.array([[0.0, 0, 0], [0.08, 0, 0], [0, 0.06, 0], [0, 0, 0.04]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    tetrahedron = ObjectModel("tetra", corners, faces, np.zeros(4, np.uint8))
    control = scene(still([0.1, 0, 0]), still([0.0, 0, 0]), tetrahedron)
    for settings, centre in ((PAPER, [0.02, 0.015, 0.01]), (features("ours"), [0.04, 0.03, 0.02])):
        samples = trajectory_features(control, "right", small_hand(), np.array([1.0]), settings).reshape(21, 16)
        np.testing.assert_allclose(samples[:, 10:13], np.tile(np.add(centre, [0.1, 0, 0]), (21, 1)), atol=1e-9)


@pytest.mark.parametrize("preset", ["paper", "ours"])
def test_the_ambient_cube_is_18_cm_wide_and_turns_with_the_wrist_in_the_paper_and_with_the_knuckle_in_ours(
    preset: Literal["paper", "ours"],
) -> None:
    """A box of 2 mm is in the middle of cell (2, 7, 6). Sec. 5.1: cells of 1.8 cm, centre (4, 0, 9) cm."""
    hand, bend = small_hand(), rotvec_to_rotmat(np.array([0.0, 0.6, 0]))
    fingers = hand.rest_rotmats.copy()
    fingers[hand.middle_knuckle - 1] = bend
    state, cell = hand.state(fingers[None]), np.array([2, 7, 6])
    axes = np.eye(3) if preset == "paper" else bend
    middle = state.joint_m[0, hand.middle_knuckle] + [0.04, 0, -0.09] + axes @ (0.018 * (cell - 4.5))
    sensors = features(preset).sensors
    wrist = RigidTransform(np.tile(np.eye(3), (1, 6, 1, 1)), np.tile(-middle, (1, 6, 1)))
    readings = sense(hand, state, wrist, None, SurfaceIndex(box_model((0.002, 0.002, 0.002))), sensors)
    assert np.flatnonzero(readings.ambient[0]).tolist() == [276]
    assert readings.ambient[0, 276] == 1
    assert readings.proximity_m.shape[1] == 6


def test_the_papers_sensors_measure_at_most_10_cm_on_either_side_now_and_in_half_a_second() -> None:
    hand, sensors = small_hand(), PAPER.sensors
    state = hand.state(hand.rest_rotmats[None])
    assert sensors.times_s == (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    for size, shift, sign in ((2.0, 0.0, -1), (0.01, 1.0, 1)):
        here = RigidTransform(np.tile(np.eye(3), (1, 6, 1, 1)), np.full((1, 6, 3), shift))
        readings = sense(hand, state, here, None, SurfaceIndex(box_model((size, size, size))), sensors)
        np.testing.assert_allclose(readings.distance_m, sign * 0.1)
        np.testing.assert_allclose(readings.proximity_m, sign * 0.1)


def test_algorithm_1_moves_all_joints_predicted_within_2_8_cm_however_far_the_object_is() -> None:
    count = 4
    points = np.tile([0.0, 0, 0.2], (count, 1))
    nearest = SignedDistance(points[:, 2], points * [1, 1, 0], np.tile([0.0, 0, 1], (count, 1)))
    predicted_m = np.array([0.0, 0.0279, 0.0281, 0.035])
    target = paper_targets(points, predicted_m / 0.035, np.zeros(count), PAPER.range_m, nearest)
    np.testing.assert_allclose(target.point_m[:, 2], [0.16, 0.2 * 0.0279 + 0.16, 0.2, 0.2])
    np.testing.assert_array_equal(target.weight, 1)


@pytest.mark.parametrize(("definition", "rule"), [("paper", "paper"), ("ours", "ours")])
def test_the_rule_of_post_processing_is_that_of_the_preset(definition: Literal["paper", "ours"], rule: Rule) -> None:
    hand = small_hand()
    settings = FeatureSettings(definition=definition)
    network = ManipNet(sized_config(NetworkConfig(encoder=8, features=settings), hand)).eval()
    state = hand.state(hand.rest_rotmats[None])
    # The box is around the tip of the middle finger; all joints are predicted at its surface.
    output = np.concatenate([pose_features(hand, state, settings)[0], np.zeros(hand.n_points)])
    box, placed = box_model((0.03, 0.06, 0.03)), RigidTransform(np.eye(3)[None], -state.tip_m[:, 2])
    answers = {}
    chosen: tuple[Rule, ...] = ("preset", rule)
    for number, name in enumerate(chosen):
        rollout = HandRollout(Predictor(network, name), hand, SurfaceIndex(box), hand.rest_rotmats)
        # Sec. 6.4: predicted distances are clamped to be non-negative.
        output[-hand.n_points :] = -number
        rollout.advance(output, FrameContext(np.zeros((1, 336)), placed[None], None))
        answers[number] = rollout.answer
        # Sec. 6.4: the post-processed pose is the next input.
        assert np.array_equal(rollout.finger_rotmats, rollout.answer) == (rule == "paper")
        assert not np.allclose(rollout.answer, hand.rest_rotmats)
    np.testing.assert_array_equal(answers[0], answers[1])


def test_the_papers_training_is_adam_at_1e_4_with_32_recorded_steps_at_60_hz() -> None:
    plan = training_plan("paper")
    training, loss = plan.training, plan.loss
    assert (training.learning_rate, training.weight_decay, training.schedule) == (1e-4, 0.0, "constant")
    assert training.batch * loss.steps_per_clip == 32
    assert loss.perturbed_fraction == 0
    assert plan.network.keep_probability == 0.7
    assert features("paper").step_s == 1 / 60
    assert features("ours").step_s == 1 / FPS


def test_examples_at_60_hz_are_those_of_30_hz_and_those_between(samples: list[ClipSample]) -> None:
    sample, pair = samples[0], HANDS
    slow, fast = (clip_examples(sample, pair, replace(PAPER, step_s=1 / rate))[0] for rate in (30, 60))
    n_frames = sample.length
    assert (len(slow.inputs), len(fast.inputs)) == (n_frames - 1, 2 * n_frames - 2)
    np.testing.assert_array_equal(fast.frame, np.repeat(slow.frame, 2))
    pose = slice(0, 189)  # of a hand with 16 joints and 5 tips
    np.testing.assert_allclose(fast.inputs[::2, pose], slow.inputs[:, pose], atol=1e-6)
    np.testing.assert_allclose(fast.outputs[1::2], slow.outputs, atol=1e-5)
    between = fast.inputs[1::2, pose]
    assert np.abs(between - (slow.inputs[:, pose] + slow.outputs[:, pose]) / 2).max() < 0.01


def test_an_untracked_frame_ends_the_steps_at_60_hz(samples: list[ClipSample]) -> None:
    valid = samples[0].valid.copy()
    valid[:, 5] = False
    examples = clip_examples(replace(samples[0], valid=valid), HANDS, PAPER)[0]
    assert sorted({*range(samples[0].length - 1)} - {*examples.frame.tolist()}) == [4, 5]


def test_a_rollout_at_60_hz_gives_every_second_pose_at_30_hz(samples: list[ClipSample]) -> None:
    torch.manual_seed(0)
    hand, model = mano_hands(HANDS, samples[0].betas, None)["right"], box_model()
    settings = FeatureSettings(step_s=1 / 60)
    network = ManipNet(sized_config(NetworkConfig(encoder=8, features=settings), hand)).eval()
    side: Side = "right"
    control = scene(still([0.1, 0, 0]), still([0.0, 0, 0]), model)
    poses = {}
    for rate in (30, 60, 45):
        task = RolloutTask(hand=hand, side=side, control=control, time_s=np.arange(7) / rate, start=hand.rest_rotmats)
        (poses[rate],) = roll_out(Predictor(network, "off"), [task])
    np.testing.assert_array_equal(poses[30][:4], poses[60][::2])
    np.testing.assert_array_equal(poses[45][3], poses[60][4])
    assert np.abs(poses[60][1] - poses[60][0]).max() > 1e-3


def test_a_network_of_preset_paper_gives_fingers_for_each_frame_of_a_clip(
    annotated: AnnotatedStore, annotated_root: Path, samples: list[ClipSample], tmp_path: Path
) -> None:
    """Trained in two steps: its 60 Hz steps and its rule are those of the checkpoint."""
    params = {
        "network": {"encoder": 8, "features": SECTION["paper"]["manipnet"]["network"]["features"]},
        "training": {"steps": 2, "batch": 2, "learning_rate": 0.001, "validate_every": 2},
    }
    train_network(MANIPNET, annotated_root, tmp_path / "manipnet", params)
    sampler = FingerSampler.load(Sources(annotated, tmp_path, HANDS, torch.device("cpu")))
    assert (sampler.predictor.settings, sampler.predictor.chosen_rule) == (PAPER, "paper")
    (motion,) = sampler.sample(requests_for(samples[0], PredictionConfig(samples=1)))
    assert motion.n_frames == samples[0].length
    side = SIDES[int(samples[0].active_hands[1])]
    poses = motion.hands[side].hand_pose
    assert np.isfinite(poses).all()
    assert np.abs(np.diff(poses, axis=0)).max() > 1e-3
