"""Generated motions compared with the training clips of their verb; the rank of candidates in rejection sampling."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hoidata.actions.action import Actions, training_actions
from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.clips.clip import SIDES, Clip
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.metrics.verb_ranges import VerbRanges, training_ranges
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.text2hoi.diffusion_training import DIFFUSION, verb_ranges

HANDS = load_embedded_hands()


@pytest.fixture(scope="module")
def diffusion(trained: Path) -> Checkpoint:
    return load_checkpoint(trained / "diffusion", DIFFUSION)


@pytest.fixture(scope="module")
def ranges(diffusion: Checkpoint) -> VerbRanges:
    stored = verb_ranges(diffusion, HANDS)
    return stored


def test_measures_outside_the_range_of_the_verb_are_violations(annotated: AnnotatedStore, ranges: VerbRanges) -> None:
    usual = {"lift": {"path_m": (0.0, 0.5), "rise_m": (0.0, 0.5)}}
    strict = replace(ranges, actions=replace(ranges.actions, usual=usual)).actions
    for sample in clips_of(annotated, "train"):
        numbers = ranges.numbers(annotated.store.clip(sample.clip_id), sample.points)
        assert strict.unusual(str(sample.verb), numbers) == ()
        two_outliers = numbers | {"path_m": 9.0, "rise_m": 1.5}  # 17 widths and 2
        assert max(strict.violations("lift", two_outliers).values()) == pytest.approx(17)
        assert strict.violations("pour", two_outliers) == {}


def test_a_hand_faster_than_in_all_training_clips_is_unusual_for_every_verb(
    annotated: AnnotatedStore, ranges: VerbRanges
) -> None:
    speeds = list[float]()
    for sample in clips_of(annotated, "train"):
        clip = annotated.store.clip(sample.clip_id)
        acting = [clip.hands[side] for side in SIDES if clip.hands[side].valid.all()]
        joints = [track_joints(hand, HANDS[side]) for hand, side in zip(acting, SIDES, strict=True)]
        speeds.append(30 * max(float(np.linalg.norm(value[1:] - value[:-1], axis=2).max()) for value in joints))
        assert ranges.numbers(clip, sample.points)["joint_m_s"] == pytest.approx(speeds[-1], rel=1e-4)
    number = int(np.argmax(speeds))
    sample = clips_of(annotated, "train")[number]
    clip = annotated.store.clip(sample.clip_id)
    wrist_m, valid = clip.hands["left"].wrist_m.copy(), clip.hands["left"].valid.copy()
    wrist_m[5] += [0, 0, 2.0]
    fast_clip = replace(clip, hands={**clip.hands, "left": replace(clip.hands["left"], wrist_m=wrist_m)})
    numbers = ranges.numbers(fast_clip, sample.points)
    assert numbers["joint_m_s"] == pytest.approx(60, rel=0.1)
    for verb in ranges.actions.centroids:
        (note,) = [value for value in ranges.actions.unusual(verb, numbers) if value.startswith("fastest joint")]
        assert note == f"fastest joint {numbers['joint_m_s']:.3g} m/s (usual: at most {1.1 * max(speeds):.3g})"
        violation = ranges.actions.violations(verb, numbers)["joint_m_s"]
        assert violation == pytest.approx(numbers["joint_m_s"] / (1.1 * max(speeds)) - 1, rel=1e-3)
    valid[5] = False
    track = replace(clip.hands["left"], wrist_m=wrist_m, valid=valid)
    slow = ranges.numbers(replace(clip, hands={**clip.hands, "left": track}), sample.points)
    assert slow["joint_m_s"] < 2 * max(speeds)


def clips_of(annotated: AnnotatedStore, split: str) -> list[ClipSample]:
    return list(HoiDataset(annotated, split, crop="start"))


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_a_recorded_clip_moves_as_its_verb(annotated: AnnotatedStore, ranges: VerbRanges, split: str) -> None:
    for sample in clips_of(annotated, split):
        numbers = ranges.numbers(annotated.store.clip(sample.clip_id), sample.points)
        assert ranges.actions.nearest_verb(numbers) == sample.verb


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


def test_hands_that_slide_more_than_in_training_clips_of_the_verb_are_unusual(
    annotated: AnnotatedStore, ranges: VerbRanges, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert all("slip_cm_s" not in limits for limits in ranges.actions.usual.values())  # one clip of each verb
    monkeypatch.setattr("hoidata.actions.action.MIN_CLIPS", 1)
    samples = clips_of(annotated, "train")
    numbers_of = {one.verb: ranges.numbers(annotated.store.clip(one.clip_id), one.points) for one in samples}
    slips = {str(verb): numbers["slip_cm_s"] for verb, numbers in numbers_of.items()}
    for sample in samples:
        if sample.verb != "open":
            slide = slide_cm_s(annotated.store.clip(sample.clip_id), sample.points.points_m)
            assert slips[str(sample.verb)] == pytest.approx(slide, rel=1e-3)
    strict = training_ranges(annotated)
    spread = float(np.std(list(slips.values())))  # over all verbs, because one clip per verb has no deviation
    for verb, slip in slips.items():
        assert strict.usual[verb]["slip_cm_s"] == (0, pytest.approx(slip + spread / 2))
        numbers = numbers_of[verb]
        still, within, slides = (
            numbers | {"slip_cm_s": value} for value in (0, slip + 0.49 * spread, 3 * (slip + spread / 2))
        )
        for usual in (still, within):
            assert "slip_cm_s" not in strict.violations(verb, usual)
        note = f"slip of hands {slides['slip_cm_s']:.3g} cm/s (usual: at most {slip + spread / 2:.3g})"
        assert note in strict.unusual(verb, slides)
        assert strict.violations(verb, slides)["slip_cm_s"] == pytest.approx(2)
    monkeypatch.setattr("hoidata.metrics.verb_ranges.joint_slips_cm_s", lambda *arguments: np.zeros(0))
    assert {limits["slip_cm_s"][1] for limits in training_ranges(annotated).usual.values()} == {0.025}
    monkeypatch.setattr(type(annotated), "verb", lambda store, clip_id: None)
    assert training_ranges(annotated).usual == {}


@pytest.mark.parametrize(
    ("carried", "moved_as", "violation", "rank"),
    [
        (1.0, "lift", 0.0, (2, 0.0, 1.0)),
        (0.5, "lift", 3.0, (2, -3.0, 0.5)),
        (0.25, "lift", 0.0, (1, 0.0, 0.25)),
        (1.0, "pass", 3.0, (1, 0.0, 1.0)),
        (0.0, "pass", 3.0, (0, 0.0, 0.0)),
        (1.0, None, 1.0, (2, -1.0, 1.0)),
    ],
    ids=["accepted", "unusual", "does not carry", "another verb", "neither", "verb not known"],
)
def test_candidates_are_ranked_by_carrying_verb_and_violation(
    annotated: AnnotatedStore,
    ranges: VerbRanges,
    monkeypatch: pytest.MonkeyPatch,
    carried: float,
    moved_as: str | None,
    violation: float,
    rank: tuple[int, float, float],
) -> None:
    sample = clips_of(annotated, "train")[0]
    monkeypatch.setattr("hoidata.metrics.verb_ranges.carried_fraction", lambda hands, clip: carried)
    monkeypatch.setattr(Actions, "nearest_verb", lambda self, numbers: moved_as)
    monkeypatch.setattr(Actions, "violations", lambda self, verb, numbers: {"path_m": violation, "rise_m": 0.0})
    assert ranges.rank("lift", annotated.store.clip(sample.clip_id), sample.points) == rank


def test_nothing_is_compared_without_gravity_for_an_unknown_verb_or_without_ranges(
    annotated: AnnotatedStore, ranges: VerbRanges, diffusion: Checkpoint
) -> None:
    sample = clips_of(annotated, "train")[0]
    clip = replace(annotated.store.clip(sample.clip_id), gravity=None)
    assert ranges.actions.nearest_verb(ranges.numbers(clip, sample.points)) is None
    assert ranges.is_other("lift", "pass")
    assert not ranges.is_other("lift", "lift")
    assert not ranges.is_other("pour", "lift")
    assert not ranges.is_other(None, "lift")
    older = {**diffusion.info, "results": {"validation_loss": 1.0}}
    assert verb_ranges(replace(diffusion, info=older), HANDS) is None
