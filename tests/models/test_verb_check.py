"""The verb check: generated motions compared with the training clips of their verb."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.actions.action import Actions, training_actions
from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.common.corpus import Corpus
from models.common.predicting import PredictionConfig, requests_for
from models.text2hoi.diffusion_training import DIFFUSION
from models.text2hoi.verb_check import VerbCheck, action_results, classified_verb, requested_verb
from models.text2hoi.verb_classifier import verb_classifiers_of

HANDS = load_embedded_hands()


@pytest.fixture(scope="module")
def diffusion(trained: Path) -> Checkpoint:
    return load_checkpoint(trained / "diffusion", DIFFUSION)


@pytest.fixture(scope="module")
def check(diffusion: Checkpoint) -> VerbCheck:
    verb_check = VerbCheck.of(diffusion, HANDS)
    assert verb_check is not None
    return verb_check


def clips_of(annotated: AnnotatedStore, split: str) -> list[ClipSample]:
    return list(HoiDataset(annotated, split, crop="start"))


def request_for(sample: ClipSample) -> Request:
    return requests_for(sample, PredictionConfig(samples=1))[0]


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_a_recorded_clip_moves_as_its_verb(annotated: AnnotatedStore, check: VerbCheck, split: str) -> None:
    for sample in clips_of(annotated, split):
        numbers = check.numbers(annotated.store.clip(sample.clip_id), sample.points)
        assert check.moved_as(numbers) == sample.verb


def test_measures_outside_the_range_of_the_sentences_verb_are_reported(
    annotated: AnnotatedStore, diffusion: Checkpoint, check: VerbCheck
) -> None:
    usual = {"lift": {"path_m": (0.0, 0.5), "rise_m": (0.0, 0.5)}}
    strict = replace(check, actions=replace(check.actions, usual=usual))
    for sample in clips_of(annotated, "train"):
        verb = requested_verb(diffusion, request_for(sample))
        numbers = check.numbers(annotated.store.clip(sample.clip_id), sample.points)
        assert verb == sample.verb
        assert strict.unusual(verb, numbers) == ()
        expected = ("length of the path 900 cm (usual: at most 50)",) if sample.verb == "lift" else ()
        assert strict.unusual(verb, numbers | {"path_m": 9.0}) == expected
        assert strict.unusual(None, numbers | {"path_m": 9.0}) == ()
        assert strict.beyond(verb, numbers) == strict.beyond(None, numbers | {"path_m": 9.0}) == 0
        two_outliers = numbers | {"path_m": 9.0, "rise_m": 1.5}  # 17 widths and 2
        assert strict.beyond(verb, two_outliers) == (pytest.approx(17) if sample.verb == "lift" else 0)


def test_a_hand_faster_than_in_all_training_clips_is_unusual_for_every_verb(
    annotated: AnnotatedStore, diffusion: Checkpoint, check: VerbCheck
) -> None:
    speeds = list[float]()
    for sample in clips_of(annotated, "train"):
        clip = annotated.store.clip(sample.clip_id)
        acting = [clip.hands[side] for side in SIDES if clip.hands[side].valid.all()]
        joints = [track_joints(hand, HANDS[side]) for hand, side in zip(acting, SIDES, strict=True)]
        speeds.append(30 * max(float(np.linalg.norm(value[1:] - value[:-1], axis=2).max()) for value in joints))
        assert check.numbers(clip, sample.points)["joint_m_s"] == pytest.approx(speeds[-1], rel=1e-4)
    assert check.fastest_m_s == pytest.approx(max(speeds), rel=1e-4)
    number = int(np.argmax(speeds))
    sample = clips_of(annotated, "train")[number]
    clip = annotated.store.clip(sample.clip_id)
    wrist_m, valid = clip.hands["left"].wrist_m.copy(), clip.hands["left"].valid.copy()
    wrist_m[5] += [0, 0, 2.0]
    fast_clip = replace(clip, hands={**clip.hands, "left": replace(clip.hands["left"], wrist_m=wrist_m)})
    numbers = check.numbers(fast_clip, sample.points)
    assert numbers["joint_m_s"] == pytest.approx(60, rel=0.1)
    for verb in (None, sample.verb):
        (note,) = [value for value in check.unusual(verb, numbers) if value.startswith("fastest joint")]
        assert note == f"fastest joint {numbers['joint_m_s']:.3g} m/s (usual: at most {1.1 * max(speeds):.3g})"
        assert check.beyond(verb, numbers) == pytest.approx(numbers["joint_m_s"] / (1.1 * max(speeds)) - 1, rel=1e-3)
    valid[5] = False
    track = replace(clip.hands["left"], wrist_m=wrist_m, valid=valid)
    assert check.numbers(replace(clip, hands={**clip.hands, "left": track}), sample.points)["joint_m_s"] < 2 * max(
        speeds
    )
    results = {key: value for key, value in diffusion.info["results"].items() if key != "fastest_joint_m_s"}
    older = VerbCheck.of(replace(diffusion, info={**diffusion.info, "results": results}), HANDS)
    assert older is not None
    assert not [value for value in older.unusual(None, numbers) if value.startswith("joint_m_s")]
    assert older.beyond(None, numbers) == 0


def slide_cm_s(clip: Clip, points_m: np.ndarray) -> float:
    """Mean slip of joints within 2 cm of a rigid object whose surface below them moves at 2 cm/s or more."""
    slides, track = list[float](), clip.object
    for side in SIDES:
        joints_m, valid = track_joints(clip.hands[side], HANDS[side]).astype(np.float64), clip.hands[side].valid
        for frame in np.flatnonzero(valid[1:] & valid[:-1]):
            (rotation, position), (next_rotation, next_position) = (
                (track.world_from_object.rotation[now], track.world_from_object.translation[now])
                for now in (frame, frame + 1)
            )
            for joint_m, next_joint_m in zip(joints_m[frame], joints_m[frame + 1], strict=True):
                local, next_local = rotation.T @ (joint_m - position), next_rotation.T @ (next_joint_m - next_position)
                touches = all(
                    np.linalg.norm(points_m - point_m, axis=1).min() < 0.02 for point_m in (local, next_local)
                )
                if touches and 30 * np.linalg.norm(next_rotation @ local + next_position - joint_m) > 0.02:
                    slides.append(3000 * float(np.linalg.norm(next_local - local)))
    return float(np.mean(slides)) if slides else 0.0


def test_hands_that_slide_more_than_in_training_clips_of_the_verb_are_unusual(
    annotated: AnnotatedStore, diffusion: Checkpoint, check: VerbCheck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hoidata.actions.action.MIN_CLIPS", 1)
    samples, corpus = clips_of(annotated, "train"), Corpus.of(annotated, 0)
    numbers_of = {one.verb: check.numbers(annotated.store.clip(one.clip_id), one.points) for one in samples}
    slips = {str(verb): numbers["slip_cm_s"] for verb, numbers in numbers_of.items()}
    for sample in samples:
        if sample.verb != "open":
            slide = slide_cm_s(annotated.store.clip(sample.clip_id), sample.points.points_m)
            assert slips[str(sample.verb)] == pytest.approx(slide, rel=1e-3)
    results = action_results(diffusion.network, corpus)
    spread = float(np.std(list(slips.values())))  # over all verbs, because one clip per verb has no deviation
    strict = VerbCheck.of(replace(diffusion, info={**diffusion.info, "results": results}), HANDS)
    assert strict is not None
    for verb, slip in slips.items():
        assert results["most_slip_cm_s"][verb] == pytest.approx(slip + spread / 2)
        numbers = strict.numbers(annotated.store.clip(samples[0].clip_id), samples[0].points)
        still, within, slides = (
            numbers | {"slip_cm_s": value} for value in (0, slip + 0.49 * spread, 3 * (slip + spread / 2))
        )
        for usual in (still, within):
            assert not [value for value in strict.unusual(verb, usual) if value.startswith("slip")]
        note = f"slip of hands {slides['slip_cm_s']:.3g} cm/s (usual: at most {slip + spread / 2:.3g})"
        assert note in strict.unusual(verb, slides)
        assert strict.beyond(verb, slides) >= 2 - 1e-9
        assert replace(strict, actions=check.actions, fastest_m_s=float("inf")).beyond(verb, slides) == pytest.approx(2)
    monkeypatch.setattr("models.text2hoi.verb_check.joint_slips_cm_s", lambda *arguments: np.zeros(0))
    assert set(action_results(diffusion.network, corpus)["most_slip_cm_s"].values()) == {0.025}


def test_clips_without_a_verb_and_verbs_of_few_clips_have_no_bounds(
    annotated: AnnotatedStore, diffusion: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    corpus = Corpus.of(annotated, 0)
    assert action_results(diffusion.network, corpus)["most_slip_cm_s"] == {}  # one clip of each verb
    monkeypatch.setattr("hoidata.actions.action.MIN_CLIPS", 1)
    monkeypatch.setattr("models.text2hoi.verb_check.verb_of", lambda store, clip_id: None)
    nothing = action_results(diffusion.network, corpus)
    assert nothing["most_slip_cm_s"] == {}
    resting = VerbCheck.read(nothing | {"fastest_joint_m_s": 0.0}, 0.02, HANDS)
    assert resting.beyond(None, {"joint_m_s": 1.0, "slip_cm_s": 9.0}) == 0


def test_a_motion_fails_if_it_moves_as_another_verb_than_its_sentences(
    annotated: AnnotatedStore, diffusion: Checkpoint, check: VerbCheck
) -> None:
    for sample in clips_of(annotated, "train"):
        request = request_for(sample)
        verb_read = classified_verb(diffusion, torch.from_numpy(request.text))
        assert verb_read is not None
        assert verb_read[0] == sample.verb
        fails = {verb: check.fails(requested_verb(diffusion, request), verb) for verb in ("lift", "pass", "open")}
        assert fails == {verb: verb != sample.verb for verb in fails}
        assert not check.fails(requested_verb(diffusion, request), None)


def test_the_reported_probability_of_a_verb_is_not_sharpened(annotated: AnnotatedStore, diffusion: Checkpoint) -> None:
    classifier, text = (
        verb_classifiers_of(diffusion.network)[0],
        {s.verb: s.text[0] for s in clips_of(annotated, "train")},
    )
    one, other = (torch.from_numpy(text[verb]) for verb in sorted(text)[:2])
    doubtful = 0
    for between in (one + fraction * (other - one) for fraction in np.linspace(0, 1, 101)):
        result, sharpened = classified_verb(diffusion, between), float(classifier(between[None]).max())
        assert result is not None
        assert result[1] == pytest.approx(float(classifier.probabilities(between[None]).max()), abs=1e-3)
        doubtful += result[1] < sharpened - 0.05
    assert doubtful


def test_nothing_is_reported_without_gravity_or_for_an_unknown_verb(
    annotated: AnnotatedStore, check: VerbCheck
) -> None:
    sample = clips_of(annotated, "train")[0]
    clip = replace(annotated.store.clip(sample.clip_id), gravity=None)
    assert check.moved_as(check.numbers(clip, sample.points)) is None
    strange = replace(check, actions=replace(check.actions, centroids={"pour": np.zeros(1)}))
    assert not strange.fails(sample.verb, "pour")


def test_a_network_without_actions_or_verb_classifier_has_no_check(diffusion: Checkpoint) -> None:
    older = {**diffusion.info, "results": {"validation_loss": 1.0}}
    assert VerbCheck.of(replace(diffusion, info=older), HANDS) is None
    without_verbs = replace(diffusion, network=torch.nn.Linear(1, 1))
    assert VerbCheck.of(without_verbs, HANDS) is None
    assert classified_verb(without_verbs, torch.zeros(512)) is None


def test_actions_are_restored_from_a_file_with_any_order_of_keys(annotated: AnnotatedStore) -> None:
    actions = replace(training_actions(annotated), usual={"lift": {"path_m": (0.1, 0.5)}})
    restored = Actions.read(json.loads(json.dumps(actions.record, sort_keys=True)))
    assert {
        verb: dict(zip(restored.scale, centroid, strict=True)) for verb, centroid in restored.centroids.items()
    } == {verb: dict(zip(actions.scale, centroid, strict=True)) for verb, centroid in actions.centroids.items()}
    assert restored.usual == actions.usual
    random = np.random.default_rng(0)
    for _ in range(20):
        numbers = {name: mean + deviation * random.normal() for name, (mean, deviation) in actions.scale.items()}
        assert restored.nearest_verb(numbers) == actions.nearest_verb(numbers)
