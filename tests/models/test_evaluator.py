"""The evaluator: inputs and networks against independent implementations, invariances, and training."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES, Clip
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.feature_metrics import FEATURE_METRICS
from hoidata.metrics.pair import Motion
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from models.common.repeatable import make_repeatable
from models.evaluator import stage
from models.evaluator.encoders import MotionEvaluator, load_evaluators, weights_digest
from models.evaluator.inputs import CORRECTED_SIZE, OBJECT, Examples, corrected_input, padded, random_frames
from models.evaluator.networks import EncoderConfig, MotionEncoder, rotated
from models.evaluator.settings import EvaluatorSettings
from models.evaluator.stage import train_evaluators
from models.evaluator.training import Classification, Pairing
from tests.builders.clips import build_clip, in_another_world, with_hand, with_object
from tests.builders.objects import box_model

PAPER, CORRECTED = EncoderConfig("planar", 11, 128), EncoderConfig("recurrent", 11, 16)
PAIR = EncoderConfig("recurrent", 64, 16, text=512)
LABELS = tuple(f"verb {number}" for number in range(11))


def motion_of(clip: Clip) -> Motion:
    hands = load_embedded_hands()
    return Motion(clip, {side: track_joints(clip.hands[side], hands[side]) for side in SIDES}, hands)


def evaluator(config: EncoderConfig) -> MotionEvaluator:
    torch.manual_seed(0)
    return MotionEvaluator("toy", MotionEncoder(config).eval(), LABELS, "")


def of(config: EncoderConfig, *clips: Clip, sides=("right",)) -> np.ndarray:
    encoding = evaluator(config).encode([motion_of(clip) for clip in clips], [sides] * len(clips))
    return np.concatenate((encoding.features, encoding.logits), axis=1)


def paper_input_by_the_sheet(clip: Clip, sides: tuple[str, ...]) -> np.ndarray:
    """Facts sheet 3.2 with loops, for a clip in which gravity is -z."""
    joints, last = motion_of(clip).joints_m, clip.n_frames - 1
    frames = [int(number * last / 14) for number in range(15)]
    first = "right" if "right" in sides else "left"
    wrist = joints[first][frames[0]][0].astype(np.float64)
    out = np.zeros((15, 42, 3))
    for step, frame in enumerate(frames):
        for number, side in enumerate(("left", "right")):
            for joint in range(21) if side in sides else ():
                out[step, 21 * number + joint] = joints[side][frame][joint] - wrist
    return out


def paper_network_by_the_sheet(network: MotionEncoder, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Facts sheet 3.1 step by step: features and logits of (15, 42, 3) joints."""
    weights = {name: tensor.double().numpy() for name, tensor in network.state_dict().items()}
    sigmoid = lambda x: 1 / (1 + np.exp(-x))  # noqa: E731
    total = np.zeros(128)
    for view, plane in enumerate(([0, 1], [0, 2])):
        steps = list(joints[:, :, plane].reshape(15, 84))
        for layer in range(2):
            at = lambda kind: weights[f"trunk.views.{view}.{kind}_l{layer}"]  # noqa: E731, B023
            hidden, cell, outputs = np.zeros(128), np.zeros(128), []
            for step in steps:
                gates = at("weight_ih") @ step + at("bias_ih") + at("weight_hh") @ hidden + at("bias_hh")
                enter, forget, new, leave = np.split(gates, 4)
                cell = sigmoid(forget) * cell + sigmoid(enter) * np.tanh(new)
                hidden = sigmoid(leave) * np.tanh(cell)
                outputs.append(hidden)
            steps = outputs
        kernel, bias = weights[f"trunk.mixers.{view}.weight"][0, 0], weights[f"trunk.mixers.{view}.bias"][0]
        wide = np.pad(steps[-1], 1)
        total += [kernel @ wide[unit : unit + 3] + bias for unit in range(128)]
    return 0.1 * np.tanh(total), weights["head.weight"] @ total + weights["head.bias"]


@pytest.mark.parametrize(("hand", "frames"), [("right", 30), ("left", 47), ("both", 15), ("both", 9)])
def test_paper_equals_an_independent_implementation(hand, frames):
    clip = build_clip(frames, hand)
    sides = SIDES if hand == "both" else (hand,)
    paper = evaluator(PAPER)
    encoding = paper.encode([motion_of(clip)], [sides])
    feature, logits = paper_network_by_the_sheet(paper.network, paper_input_by_the_sheet(clip, sides))
    assert encoding.features[0] == pytest.approx(feature, abs=1e-5)
    assert encoding.logits[0] == pytest.approx(logits, abs=1e-5)


@pytest.mark.parametrize(("config", "count"), [(PAPER, 484_755), (CORRECTED, 63_627 + 64)])
def test_the_networks_have_the_documented_number_of_parameters(config, count):
    """And one more input: the turn, which the sheet's network could not learn."""
    assert sum(weight.numel() for weight in MotionEncoder(config).parameters()) == count


@pytest.mark.parametrize("config", [PAPER, CORRECTED, PAIR])
def test_an_encoding_does_not_depend_on_the_batch(config):
    clips = [build_clip(frames, seed=frames) for frames in (9, 30, 61, 200)]
    together = of(config, *clips)
    assert together == pytest.approx(np.concatenate([of(config, clip) for clip in clips]), abs=1e-6)
    assert together == pytest.approx(of(config, *clips[::-1])[::-1], abs=1e-6)
    assert np.array_equal(together, of(config, *clips))


@pytest.mark.parametrize("config", [PAPER, CORRECTED, PAIR])
def test_values_of_an_inactive_hand_change_nothing(config):
    clip = build_clip()
    other = with_hand(clip, "left", wrist_m=clip.hands["left"].wrist_m + 7, valid=~clip.hands["left"].valid)
    assert np.array_equal(of(config, clip), of(config, other))
    unseen = clip.hands["right"].valid.copy()
    unseen[10:13] = False
    moved = clip.hands["right"].wrist_m.copy()
    moved[10:13] += 3
    missing = with_hand(clip, "right", valid=unseen)
    assert np.array_equal(of(config, missing), of(config, with_hand(clip, "right", valid=unseen, wrist_m=moved)))


def test_moving_the_object_changes_corrected_and_not_paper():
    clip = build_clip(40)
    moved = with_object(clip, translation_m=clip.object.translation_m + np.float32([0.1, 0, 0]))
    assert np.array_equal(of(PAPER, clip), of(PAPER, moved))
    assert np.abs(of(CORRECTED, clip) - of(CORRECTED, moved)).max() > 1e-2


def test_the_shape_of_a_distant_object_does_not_matter():
    clip = build_clip(30)
    away = with_hand(clip, "right", wrist_m=clip.hands["right"].wrist_m + np.float32([0, 0, 1]))
    other = with_object(away, model=box_model((0.3, 0.02, 0.1)))
    assert np.array_equal(of(CORRECTED, away), of(CORRECTED, other))


def test_augmentation_rotates_a_clip_about_gravity():
    clip, angle = build_clip(30, "both", articulated=True), 0.8
    world = in_another_world(clip, Rotation.from_euler("z", angle), np.array([0.4, -0.2, 0.1]))
    inputs = [corrected_input(motion_of(item), SIDES) for item in (clip, world)]
    rotated_input = rotated(torch.from_numpy(inputs[0])[None], torch.tensor([angle]))[0]
    assert rotated_input.shape == (10, CORRECTED_SIZE)
    assert rotated_input.numpy() == pytest.approx(inputs[1], abs=1e-5)


@pytest.mark.parametrize("degrees", [-70, 70, 540])
def test_the_heading_gives_the_direction_of_rotation_for_any_initial_heading(degrees):
    spun = np.radians(np.linspace(0, degrees, 60))[:, None] * [0, 0, 1]
    clip = with_object(build_clip(60), rotvec=spun.astype(np.float32))
    world = in_another_world(clip, Rotation.from_euler("z", 1.9), np.zeros(3))
    for item in (clip, world):
        heading_rad = corrected_input(motion_of(item), SIDES)[:, OBJECT.stop - 1]
        assert np.degrees(heading_rad) == pytest.approx(np.linspace(0, degrees, 60)[::3], abs=0.01)


def test_a_tilted_world_is_rotated_upright():
    clip = build_clip(30)
    tilted = in_another_world(clip, Rotation.from_euler("x", 0.7), np.zeros(3))
    for config in (PAPER, CORRECTED):
        assert of(config, tilted) == pytest.approx(of(config, clip), abs=1e-4)


def test_training_samples_one_frame_from_each_of_fifteen_segments():
    low, high = random_frames(45, np.zeros(15)), random_frames(45, np.full(15, 0.999))
    assert low.tolist() == list(range(0, 45, 3))
    assert high.tolist() == list(range(2, 45, 3))
    assert random_frames(9, np.full(15, 0.999)).max() == 8


def test_clips_of_the_same_prompt_are_not_negatives():
    network, prompts = evaluator(PAIR).network, [0, 0, 1, 2]
    logits, text = torch.randn(4, 64), torch.randn(4, 4, 512)
    loss = Pairing().loss(network, logits, (text, torch.tensor(prompts)), None)
    motions, sentences = torch.nn.functional.normalize(logits, dim=-1), network.of_text(text[:, 0])
    alike = (motions @ sentences.T / 0.07).detach().double().numpy()
    wrong = []
    for table in (alike, alike.T):
        for anchor in range(4):
            rivals = [
                table[anchor, other] for other in range(4) if other == anchor or prompts[other] != prompts[anchor]
            ]
            wrong.append(np.log(np.exp(rivals).sum()) - table[anchor, anchor])
    assert loss.item() == pytest.approx(np.mean(wrong), rel=1e-5)


def test_clips_of_one_prompt_choose_no_epoch(annotated):
    """Without negatives every loss is zero."""
    train = Examples.of(annotated, "train")
    assert len(set(train.prompts().tolist())) > 1
    assert Pairing().can_evaluate(train)
    same = {name: [getattr(train, name)[0]] * len(train) for name in ("verbs", "objects", "hands")}
    assert not Pairing().can_evaluate(replace(train, **same))


def test_rare_classes_weigh_more_and_untrained_labels_nothing(annotated):
    train = Examples.of(annotated, "train")
    task = Classification.of(train, "softmax")
    assert task.labels == ("lift", "open", "pass")
    assert task.weights.tolist() == [1, 1, 1]
    of_verbs = replace(train, ids=["a"] * 200, verbs=["lift"] * 120 + ["open"] * 78 + ["pass"] * 2)
    weights = Classification.of(of_verbs, "softmax").weights
    assert weights.tolist() == pytest.approx([200 / 360, 200 / 234, 5])  # and not 33, which would decide the network
    network, logits = evaluator(CORRECTED).network, torch.randn(3, 3)
    loss_of_two = task.loss(network, logits[:2], (torch.tensor([0, 2]),), None)
    assert task.loss(network, logits, (torch.tensor([0, 2, -1]),), None) == loss_of_two


@pytest.fixture(scope="module")
def trained(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluators")
    settings = EvaluatorSettings(("paper", "corrected", "text-motion"), seeds=(0, 1, 2), most_steps=8)
    train_evaluators(annotated_root, out, settings)
    return out


@pytest.mark.slow
def test_the_stage_writes_the_accuracy_on_recorded_clips(trained):
    info = json.loads((trained / "info.json").read_text())
    assert info["labels"] == ["lift", "open", "pass"]
    assert info["clips"] == {"train": 3, "validation": 2, "test": 2}
    assert set(info["evaluators"]) == {"paper", "corrected", "text-motion"}
    for name, network_info in info["evaluators"].items():
        assert set(network_info["by_seed"]) == {"0", "1", "2"}
        assert (trained / name / "model.safetensors").is_file()
    assert {one.name: one.digest for one in load_evaluators(trained)} == {
        name: network_info["digest"] for name, network_info in info["evaluators"].items()
    }


@pytest.mark.long
def test_equal_trainings_give_equal_bytes_and_another_seed_other_weights(annotated_root, tmp_path):
    def files(folder, seed, jobs=1):
        settings = EvaluatorSettings(("corrected", "paper"), seeds=(seed, seed + 2), most_steps=3)
        train_evaluators(annotated_root, tmp_path / folder, settings, jobs=jobs)
        return [path.read_bytes() for path in sorted((tmp_path / folder).rglob("*.*"))]

    make_repeatable(threads=1)
    assert files("one", 0) == files("again", 0) == files("two at once", 0, jobs=2) != files("other", 1)


@pytest.mark.slow
def test_a_killed_run_resumes_after_its_finished_trainings_with_equal_bytes(annotated_root, tmp_path, monkeypatch):
    settings = EvaluatorSettings(("corrected",), seeds=(0, 1, 2), most_steps=3)
    done, fitted = [], stage._trained

    def killed_in_the_third(name, seed, *arguments):
        done.append(seed)
        if len(done) == 3:
            raise KeyboardInterrupt
        return fitted(name, seed, *arguments)

    train_evaluators(annotated_root, tmp_path / "whole", settings)
    monkeypatch.setattr(stage, "_trained", killed_in_the_third)
    with pytest.raises(KeyboardInterrupt):
        train_evaluators(annotated_root, tmp_path / "out", settings, progress=tmp_path / "progress")
    assert not (tmp_path / "out").exists()
    train_evaluators(annotated_root, tmp_path / "out", settings, progress=tmp_path / "progress")
    assert done == [0, 1, 2, 2]
    uninterrupted, resumed = (
        [path.read_bytes() for path in sorted((tmp_path / one).rglob("*.*"))] for one in ("whole", "out")
    )
    assert uninterrupted == resumed
    assert not (tmp_path / "progress").exists()


@pytest.mark.slow
def test_finished_trainings_of_other_settings_or_code_are_not_read(annotated_root, tmp_path, monkeypatch):
    settings = EvaluatorSettings(("corrected",), most_steps=3)
    done, fitted = [], stage._trained
    monkeypatch.setattr(stage, "_trained", lambda *arguments: done.append(arguments[1]) or fitted(*arguments))
    monkeypatch.setattr(stage.shutil, "rmtree", lambda *_, **__: None)  # as if each run were killed at its end
    for changed, code in ((settings, "a"), (settings, "a"), (settings, "b"), (replace(settings, most_steps=2), "b")):
        train_evaluators(annotated_root, tmp_path / "out", changed, progress=tmp_path / "progress", code=code)
    assert len(done) == 3


def test_nothing_is_written_with_fewer_than_two_labels(tmp_path, make_clip):
    from tests.builders.annotated import write_annotated_dataset

    root, _ = write_annotated_dataset(tmp_path / "one-verb", make_clip)
    reason = train_evaluators(root, tmp_path / "out", EvaluatorSettings(("corrected",)))
    assert reason == "training clips: 1, labels among them: 1; nothing to tell apart"
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_feature_metrics_are_written_with_the_digests_of_the_weights(trained, annotated_root, annotated, tmp_path):
    clips = [annotated.clip(clip_id) for clip_id in annotated.ids("test")]
    predicted = [replace(clip, clip_id=f"{clip.clip_id}~{number}") for clip in clips for number in range(2)]
    write_store(tmp_path / "truth", predicted, generated_info("truth"))
    encoders = load_evaluators(trained)
    evaluation = evaluate_store(tmp_path / "truth", annotated_root, encoders=encoders)
    assert evaluation["evaluators"].pop("path")
    assert {name: registered["digest"] for name, registered in evaluation["evaluators"].items()} == {
        one.name: one.digest for one in encoders
    }
    figures, registered = evaluation["figures"], {item.name for item in FEATURE_METRICS}
    assert figures["fid_paired_paper"] == figures["fid_paired_corrected"] == 0
    assert evaluation["notes"]["fid_frechet_corrected"] == "N too small"
    assert "fid_frechet_corrected" not in figures
    assert evaluation["unmeasured"]["fid_frechet_corrected"] == {"N too small": len(clips)}
    expected = {item.name for item in FEATURE_METRICS if item.encoder in {*evaluation["evaluators"], "path"}}
    assert expected <= set(figures) | set(evaluation["unmeasured"])
    assert {name for name in figures if name.endswith(("_paper", "_corrected", "_text_motion", "_path"))} <= registered
    assert figures["joint_error_mm"] == 0
    assert np.sum(evaluation["evaluators"]["corrected"]["confusion"]) == 4
    json.dumps(evaluation, allow_nan=False)


def test_the_digest_is_of_weights_and_configuration():
    one, other = evaluator(CORRECTED).network, evaluator(CORRECTED).network
    assert weights_digest(one) == weights_digest(other)
    with torch.no_grad():
        other.head.bias[0] += 1e-6
    assert weights_digest(one) != weights_digest(other)


def test_padding_is_ignored():
    motion, lengths = padded([np.ones((4, CORRECTED_SIZE)), np.ones((9, CORRECTED_SIZE))])
    network, changed = evaluator(CORRECTED).network, motion.clone()
    changed[0, 4:] = 5
    with torch.no_grad():
        assert torch.equal(network(motion, lengths)[0], network(changed, lengths)[0])
