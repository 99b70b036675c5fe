"""An object's motion is told for the verb whose training clips move it most alike, and held against the sentence's."""

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
from models.text2hoi.verb_check import VerbCheck, action_results, asked_verb, read_verb
from models.text2hoi.verb_reading import readings_of

HANDS = load_embedded_hands()


@pytest.fixture(scope="module")
def diffusion(trained: Path) -> Checkpoint:
    return load_checkpoint(trained / "diffusion", DIFFUSION)


@pytest.fixture(scope="module")
def check(diffusion: Checkpoint) -> VerbCheck:
    made = VerbCheck.of(diffusion, HANDS)
    assert made is not None
    return made


def clips_of(annotated: AnnotatedStore, split: str) -> list[ClipSample]:
    return list(HoiDataset(annotated, split, crop="start"))


def asked_for(sample: ClipSample) -> Request:
    return requests_for(sample, PredictionConfig(samples=1))[0]


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_a_recorded_clip_moves_as_its_verb(annotated: AnnotatedStore, check: VerbCheck, split: str) -> None:
    for sample in clips_of(annotated, split):
        numbers = check.numbers(annotated.store.clip(sample.clip_id), sample.points)
        assert check.moved_as(numbers) == sample.verb


def test_what_is_unusual_is_told_for_the_verb_that_the_sentence_was_read_as(
    annotated: AnnotatedStore, diffusion: Checkpoint, check: VerbCheck
) -> None:
    usual = {"lift": {"path_m": (0.0, 0.5), "rise_m": (0.0, 0.5)}}
    strict = replace(check, actions=replace(check.actions, usual=usual))
    for sample in clips_of(annotated, "train"):
        asked = asked_verb(diffusion, asked_for(sample))
        numbers = check.numbers(annotated.store.clip(sample.clip_id), sample.points)
        assert asked == sample.verb
        assert strict.unusual(asked, numbers) == ()
        said = ("length of the path 900 cm (usual: at most 50)",) if sample.verb == "lift" else ()
        assert strict.unusual(asked, numbers | {"path_m": 9.0}) == said
        assert strict.unusual(None, numbers | {"path_m": 9.0}) == ()
        assert strict.beyond(asked, numbers) == strict.beyond(None, numbers | {"path_m": 9.0}) == 0
        both = numbers | {"path_m": 9.0, "rise_m": 1.5}  # 17 widths and 2
        assert strict.beyond(asked, both) == (pytest.approx(17) if sample.verb == "lift" else 0)


def test_a_hand_that_is_faster_than_any_of_training_is_unusual_whatever_the_verb(
    annotated: AnnotatedStore, diffusion: Checkpoint, check: VerbCheck
) -> None:
    speeds = list[float]()
    for sample in clips_of(annotated, "train"):
        clip = annotated.store.clip(sample.clip_id)
        acting = [clip.hands[side] for side in SIDES if clip.hands[side].valid.all()]
        joints = [track_joints(hand, HANDS[side]) for hand, side in zip(acting, SIDES, strict=True)]
        speeds.append(30 * max(float(np.linalg.norm(own[1:] - own[:-1], axis=2).max()) for own in joints))
        assert check.numbers(clip, sample.points)["joint_m_s"] == pytest.approx(speeds[-1], rel=1e-4)
    assert check.fastest_m_s == pytest.approx(max(speeds), rel=1e-4)
    number = int(np.argmax(speeds))
    sample = clips_of(annotated, "train")[number]
    clip = annotated.store.clip(sample.clip_id)
    wild, gone = clip.hands["left"].wrist_m.copy(), clip.hands["left"].valid.copy()
    wild[5] += [0, 0, 2.0]
    away = replace(clip, hands={**clip.hands, "left": replace(clip.hands["left"], wrist_m=wild)})
    found = check.numbers(away, sample.points)
    assert found["joint_m_s"] == pytest.approx(60, rel=0.1)
    for asked in (None, sample.verb):
        (said,) = [own for own in check.unusual(asked, found) if own.startswith("fastest joint")]
        assert said == f"fastest joint {found['joint_m_s']:.3g} m/s (usual: at most {1.1 * max(speeds):.3g})"
        assert check.beyond(asked, found) == pytest.approx(found["joint_m_s"] / (1.1 * max(speeds)) - 1, rel=1e-3)
    gone[5] = False
    left = replace(clip.hands["left"], wrist_m=wild, valid=gone)
    assert check.numbers(replace(clip, hands={**clip.hands, "left": left}), sample.points)["joint_m_s"] < 2 * max(
        speeds
    )
    results = {key: own for key, own in diffusion.info["results"].items() if key != "fastest_joint_m_s"}
    older = VerbCheck.of(replace(diffusion, info={**diffusion.info, "results": results}), HANDS)
    assert older is not None
    assert not [own for own in older.unusual(None, found) if own.startswith("joint_m_s")]
    assert older.beyond(None, found) == 0


def slide_cm_s(clip: Clip, points_m: np.ndarray) -> float:
    """Of joints nearer than 2 cm to a point of a rigid object that moves at 2 cm/s and more below them."""
    slides, thing = list[float](), clip.object
    for side in SIDES:
        joints_m, valid = track_joints(clip.hands[side], HANDS[side]).astype(np.float64), clip.hands[side].valid
        for frame in np.flatnonzero(valid[1:] & valid[:-1]):
            (turn, place), (next_turn, next_place) = (
                (thing.world_from_object.rotation[now], thing.world_from_object.translation[now])
                for now in (frame, frame + 1)
            )
            for here, there in zip(joints_m[frame], joints_m[frame + 1], strict=True):
                own, later = turn.T @ (here - place), next_turn.T @ (there - next_place)
                touches = all(np.linalg.norm(points_m - at, axis=1).min() < 0.02 for at in (own, later))
                if touches and 30 * np.linalg.norm(next_turn @ own + next_place - here) > 0.02:
                    slides.append(3000 * float(np.linalg.norm(later - own)))
    return float(np.mean(slides)) if slides else 0.0


def test_hands_that_slide_more_than_in_training_clips_of_the_verb_are_unusual(
    annotated: AnnotatedStore, diffusion: Checkpoint, check: VerbCheck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hoidata.actions.action.LEAST_CLIPS", 1)
    samples, corpus = clips_of(annotated, "train"), Corpus.of(annotated, 0)
    found = {
        str(one.verb): check.numbers(annotated.store.clip(one.clip_id), one.points)["slip_cm_s"] for one in samples
    }
    for sample in samples:
        if sample.verb != "open":
            slide = slide_cm_s(annotated.store.clip(sample.clip_id), sample.points.points_m)
            assert found[str(sample.verb)] == pytest.approx(slide, rel=1e-3)
    results = action_results(diffusion.network, corpus)
    spread = float(np.std(list(found.values())))  # that of all: one clip a verb does not deviate from itself
    strict = VerbCheck.of(replace(diffusion, info={**diffusion.info, "results": results}), HANDS)
    assert strict is not None
    for verb, slip in found.items():
        assert results["most_slip_cm_s"][verb] == pytest.approx(slip + spread / 2)
        numbers = strict.numbers(annotated.store.clip(samples[0].clip_id), samples[0].points)
        still, held, slides = (
            numbers | {"slip_cm_s": own} for own in (0, slip + 0.49 * spread, 3 * (slip + spread / 2))
        )
        for usual in (still, held):
            assert not [own for own in strict.unusual(verb, usual) if own.startswith("slip")]
        said = f"slip of hands {slides['slip_cm_s']:.3g} cm/s (usual: at most {slip + spread / 2:.3g})"
        assert said in strict.unusual(verb, slides)
        assert strict.beyond(verb, slides) >= 2 - 1e-9
        assert replace(strict, actions=check.actions, fastest_m_s=float("inf")).beyond(verb, slides) == pytest.approx(2)
    monkeypatch.setattr("models.text2hoi.verb_check.joint_slips_cm_s", lambda *told: np.zeros(0))
    assert set(action_results(diffusion.network, corpus)["most_slip_cm_s"].values()) == {0.025}


def test_clips_without_a_verb_and_verbs_of_few_clips_have_no_bounds(
    annotated: AnnotatedStore, diffusion: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    corpus = Corpus.of(annotated, 0)
    assert action_results(diffusion.network, corpus)["most_slip_cm_s"] == {}  # one clip of each verb
    monkeypatch.setattr("hoidata.actions.action.LEAST_CLIPS", 1)
    monkeypatch.setattr("models.text2hoi.verb_check.verb_of", lambda store, clip_id: None)
    nothing = action_results(diffusion.network, corpus)
    assert nothing["most_slip_cm_s"] == {}
    resting = VerbCheck.read(nothing | {"fastest_joint_m_s": 0.0}, 0.02, HANDS)
    assert resting.beyond(None, {"joint_m_s": 1.0, "slip_cm_s": 9.0}) == 0


def test_a_motion_fails_where_it_is_of_another_verb_than_its_sentence_was_read_as(
    annotated: AnnotatedStore, diffusion: Checkpoint, check: VerbCheck
) -> None:
    for sample in clips_of(annotated, "train"):
        request = asked_for(sample)
        read = read_verb(diffusion, torch.from_numpy(request.text))
        assert read is not None
        assert read[0] == sample.verb
        fails = {verb: check.fails(asked_verb(diffusion, request), verb) for verb in ("lift", "pass", "open")}
        assert fails == {verb: verb != sample.verb for verb in fails}
        assert not check.fails(asked_verb(diffusion, request), None)


def test_how_likely_a_verb_is_is_said_as_it_was_read_not_as_the_network_is_told(
    annotated: AnnotatedStore, diffusion: Checkpoint
) -> None:
    reading, text = readings_of(diffusion.network)[0], {s.verb: s.text[0] for s in clips_of(annotated, "train")}
    one, other = (torch.from_numpy(text[verb]) for verb in sorted(text)[:2])
    doubtful = 0
    for between in (one + share * (other - one) for share in np.linspace(0, 1, 101)):
        said, told = read_verb(diffusion, between), float(reading(between[None]).max())
        assert said is not None
        assert said[1] == pytest.approx(float(reading.read(between[None]).max()), abs=1e-3)
        doubtful += said[1] < told - 0.05
    assert doubtful


def test_nothing_is_said_without_gravity_or_of_a_verb_that_no_clip_shows(
    annotated: AnnotatedStore, check: VerbCheck
) -> None:
    sample = clips_of(annotated, "train")[0]
    clip = replace(annotated.store.clip(sample.clip_id), gravity=None)
    assert check.moved_as(check.numbers(clip, sample.points)) is None
    strange = replace(check, actions=replace(check.actions, centroids={"pour": np.zeros(1)}))
    assert not strange.fails(sample.verb, "pour")


def test_a_network_that_keeps_no_actions_or_is_told_no_verbs_has_no_check(diffusion: Checkpoint) -> None:
    older = {**diffusion.info, "results": {"validation_loss": 1.0}}
    assert VerbCheck.of(replace(diffusion, info=older), HANDS) is None
    told_features = replace(diffusion, network=torch.nn.Linear(1, 1))
    assert VerbCheck.of(told_features, HANDS) is None
    assert read_verb(told_features, torch.zeros(512)) is None


def test_actions_come_back_from_a_file_whatever_the_order_of_its_keys(annotated: AnnotatedStore) -> None:
    actions = replace(training_actions(annotated), usual={"lift": {"path_m": (0.1, 0.5)}})
    read = Actions.read(json.loads(json.dumps(actions.record, sort_keys=True)))
    assert {verb: dict(zip(read.scale, own, strict=True)) for verb, own in read.centroids.items()} == {
        verb: dict(zip(actions.scale, own, strict=True)) for verb, own in actions.centroids.items()
    }
    assert read.usual == actions.usual
    draws = np.random.default_rng(0)
    for _ in range(20):
        numbers = {name: mean + deviation * draws.normal() for name, (mean, deviation) in actions.scale.items()}
        assert read.named(numbers) == actions.named(numbers)
