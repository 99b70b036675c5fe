"""Negative controls and retrieval baselines: each perturbs the property in its name, and nothing else."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.metrics.target_contact import read_target_contact
from hoidata.refinement import refine_grasps
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.store import open_store
from models.baselines import controls
from models.baselines.controls import HANDS_AWAY_M, PerturbedRecording
from models.baselines.retrieval import Prompt, Retrieval, by_sentence, of_the_hand
from models.common.family import Skipped, Sources
from models.common.predicting import PredictionConfig, requests_for, sample_family
from models.registry import load_family
from models.text2hoi.controls import OtherContact, other_contact_maps
from models.text2hoi.refiner import CoarseMotion, RefinerModel

HANDS = load_embedded_hands()
PERTURBED = ("static", "reversed", "object-moved", "hands-away", "pressed", "noise", "noise-refined", "pressed-refined")
LOOKUPS = tuple(f"{kind}-retrieval{refined}" for kind in ("prompt", "verb") for refined in ("", "-refined"))
LOOKUPS += ("random-clip", "other-verb", "swapped-hands", "other-hands", "nearest-clip")
MODELS = ("one-call", "other-contact", "other-prompt-own-contact")


@pytest.fixture(scope="module")
def test(annotated: AnnotatedStore) -> list[ClipSample]:
    """Two clips of a box: lifted with the left hand, passed with the right one; the other hand is a metre away."""
    return list(HoiDataset(annotated, "test", crop="start"))


@pytest.fixture(scope="module")
def train(annotated: AnnotatedStore) -> list[ClipSample]:
    """The box lifted with the left hand, the box passed with the right one, a notebook opened with both."""
    return list(HoiDataset(annotated, "train", crop="start"))


def requests_of(sample: ClipSample, count: int = 2) -> list[Request]:
    return requests_for(sample, PredictionConfig(samples=count))


def answers(sources: Sources, family: str, sample: ClipSample, count: int = 2) -> Sequence[Clip | Skipped]:
    return load_family(family).load(sources).sample(requests_of(sample, count))


def motions(sources: Sources, family: str, sample: ClipSample, count: int = 2) -> list[Clip]:
    clips = [answer for answer in answers(sources, family, sample, count) if isinstance(answer, Clip)]
    assert len(clips) == count
    return clips


def joints(clip: Clip, side: Side) -> np.ndarray:
    return track_joints(clip.hands[side], HANDS[side])


def acting(sample: ClipSample) -> Side:
    return SIDES[int(sample.active_hands.argmax())]


def in_object(clip: Clip, side: Side) -> np.ndarray:
    return clip.object.world_from_object.inverse() @ joints(clip, side)


@pytest.mark.parametrize("family", [*PERTURBED, *LOOKUPS, *MODELS])
def test_every_answer_is_the_requested_motion_or_a_reason(sources, test, family):
    for sample in test:
        for request, answer in zip(requests_of(sample), answers(sources, family, sample), strict=True):
            assert answer.clip_id == request.motion_id
            if isinstance(answer, Skipped):
                assert family in ("other-verb",)
            else:
                assert (answer.n_frames, answer.object.model.name) == (sample.length, sample.object_model.name)
                assert answer.hands[acting(sample)].valid.all()


@pytest.mark.parametrize("family", sorted({*PERTURBED} - {"static", "reversed"}))
def test_a_hand_that_was_not_requested_is_unchanged(sources, annotated, test, family):
    for sample in test:
        idle: Side = "left" if acting(sample) == "right" else "right"
        np.testing.assert_array_equal(
            motions(sources, family, sample)[0].hands[idle].wrist_m, annotated.clip(sample.clip_id).hands[idle].wrist_m
        )


def test_refined_retrieval_is_retrieval_with_contact_refinement(sources, test):
    for sample in test:
        retrieved, refined = (
            motions(sources, name, sample)[0] for name in ("prompt-retrieval", "prompt-retrieval-refined")
        )
        side, expected = acting(sample), refine_grasps(HANDS, retrieved)
        np.testing.assert_array_equal(refined.object.translation_m, expected.object.translation_m)
        np.testing.assert_array_equal(joints(refined, side), track_joints(expected.hands[side], HANDS[side]))
        assert np.abs(joints(refined, side) - joints(retrieved, side)).max() > 1e-4


def test_static_repeats_the_first_frame_with_contact(sources, annotated, test):
    for sample in test:
        (perturbed,), recorded = motions(sources, "static", sample, 1), annotated.clip(sample.clip_id)
        first = int(annotated.distances(sample.clip_id, acting(sample)).frame.min())
        assert 0 < first < sample.length - 1
        for frame in (0, sample.length - 1):
            np.testing.assert_array_equal(perturbed.hands["left"].wrist_m[frame], recorded.hands["left"].wrist_m[first])
            np.testing.assert_array_equal(perturbed.object.translation_m[frame], recorded.object.translation_m[first])


def test_an_invalid_hand_is_taken_from_the_nearest_valid_frame(sources, annotated, test):
    recorded = annotated.clip(test[0].clip_id)
    valid = np.ones(recorded.n_frames, bool)
    valid[:3] = False
    from models.baselines.controls import Recording, backwards

    track = replace(recorded.hands["left"], valid=valid)
    spoilt = replace(recorded, hands={**recorded.hands, "left": track})
    reversed_clip = backwards(spoilt, Recording(annotated, requests_of(test[0])[0]))
    assert reversed_clip.hands["left"].valid.all()
    expected = recorded.hands["left"].wrist_m[[*range(recorded.n_frames - 1, 2, -1), 3, 3, 3]]
    np.testing.assert_array_equal(reversed_clip.hands["left"].wrist_m, expected)


def test_reversed_ends_where_the_clip_begins(sources, annotated, test):
    for sample in test:
        (perturbed,), recorded = motions(sources, "reversed", sample, 1), annotated.clip(sample.clip_id)
        np.testing.assert_array_equal(perturbed.object.translation_m[::-1], recorded.object.translation_m)
        np.testing.assert_array_equal(perturbed.hands["right"].wrist_m[::-1], recorded.hands["right"].wrist_m)
        np.testing.assert_array_equal(perturbed.source_frames, recorded.source_frames)


def test_a_moved_object_is_10_cm_away_and_the_hands_are_bit_identical(sources, annotated, test):
    for sample in test:
        one, two = motions(sources, "object-moved", sample)
        recorded = annotated.clip(sample.clip_id)
        moved = one.object.translation_m - recorded.object.translation_m
        np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.10, atol=1e-6)
        np.testing.assert_allclose(moved @ recorded.gravity, 0, atol=1e-6)
        assert abs(one.object.translation_m - two.object.translation_m).max() > 0.01
        for side in SIDES:
            for name in ("wrist_m", "global_orient", "hand_pose"):
                perturbed, true = (getattr(clip.hands[side], name) for clip in (one, recorded))
                np.testing.assert_array_equal(perturbed, true)


@pytest.mark.parametrize("first_measured", [1, 8])
def test_hands_away_move_rigidly_with_the_object_and_touch_it_in_no_frame(
    sources, annotated, test, monkeypatch, first_measured
):
    monkeypatch.setattr(controls, "FIRST_FRAMES_MEASURED", first_measured)
    for sample in test:
        side, recorded = acting(sample), annotated.clip(sample.clip_id)
        (perturbed,) = motions(sources, "hands-away", sample, 1)
        shift = in_object(perturbed, side) - in_object(recorded, side)
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-5)
        points = sample.points.points_m
        nearest = [np.linalg.norm(frame[:, None] - points, axis=2).min() for frame in in_object(perturbed, side)]
        assert min(nearest) == pytest.approx(HANDS_AWAY_M, abs=1e-3)


def off_the_box(points_m: np.ndarray) -> np.ndarray:
    """Distance from the surface of the test's box (half sides 3, 3 and 5 cm) in the object frame; negative inside."""
    beyond = abs(points_m) - np.array([0.03, 0.03, 0.05])
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def test_pressed_hands_move_1_cm_into_the_touched_surface(sources, annotated, test):
    for sample in test:
        side, recorded = acting(sample), annotated.clip(sample.clip_id)
        (perturbed,) = motions(sources, "pressed", sample, 1)
        before, after = in_object(recorded, side), in_object(perturbed, side)
        shift = after - before
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-5)
        assert np.linalg.norm(shift[0, 0]) == pytest.approx(0.01, abs=1e-5)
        assert off_the_box(after).min() < off_the_box(before).min() - 0.003  # the second clip's lies over an edge


@pytest.mark.parametrize("name", ["pressed-deep", "hands-shifted"])
def test_hands_moved_by_3_cm_follow_the_object(sources, annotated, test, name):
    for sample in test:
        side, recorded = acting(sample), annotated.clip(sample.clip_id)
        (perturbed,) = motions(sources, name, sample, 1)
        shift = in_object(perturbed, side) - in_object(recorded, side)
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-5)
        assert np.linalg.norm(shift[0, 0]) == pytest.approx(0.03, abs=1e-5)


def test_frozen_hands_are_those_of_the_first_contact_and_the_object_moves(sources, annotated, test):
    for sample in test:
        side, recorded = acting(sample), annotated.clip(sample.clip_id)
        (perturbed,) = motions(sources, "hands-still", sample, 1)
        first = int(annotated.distances(sample.clip_id, side).frame.min())
        assert (perturbed.hands[side].wrist_m == recorded.hands[side].wrist_m[first]).all()
        np.testing.assert_array_equal(perturbed.object.translation_m, recorded.object.translation_m)


def test_noise_is_5_mm_at_a_joint_and_never_twice_the_same(sources, annotated, test):
    off = []
    for sample in test:
        one, two = motions(sources, "noise", sample)
        true, side = joints(annotated.clip(sample.clip_id), acting(sample)), acting(sample)
        off += [np.linalg.norm(joints(perturbed, side) - true, axis=2).mean() for perturbed in (one, two)]
        assert abs(one.hands[side].wrist_m - two.hands[side].wrist_m).max() > 1e-3
    assert np.mean(off) == pytest.approx(0.005, abs=4e-4)


@dataclass(frozen=True)
class Untracked:
    """A control whose acting hand is not tracked in the first three frames."""

    control: PerturbedRecording

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[list[Clip], list[np.ndarray]]:
        clips, maps = self.control.sample_with_targets(requests)
        hidden = []
        for clip in clips:
            tracks = {side: replace(track, valid=np.arange(clip.n_frames) >= 3) for side, track in clip.hands.items()}
            hidden.append(replace(clip, hands=tracks))
        return hidden, maps


@pytest.mark.parametrize("name", ["noise", "pressed"])
def test_a_refined_control_has_the_hands_of_the_refiner_and_the_recorded_object(sources, test, name, monkeypatch):
    """The refiner is replaced by one that lifts both hands by 1 cm."""

    def lifted(network: RefinerModel, coarse: CoarseMotion, draw: object) -> torch.Tensor:
        return coarse.hands + torch.eye(99)[2] * 0.01

    monkeypatch.setattr("models.text2hoi.sampler.refine", lifted)
    model = load_family(f"{name}-refined").load(sources)
    for sample in test:
        side, (perturbed,) = acting(sample), motions(sources, name, sample, 1)
        for control, first in ((model.control, 0), (Untracked(model.control), 3)):
            (refined,) = replace(model, control=control).sample(requests_of(sample, 1))
            moved = (joints(refined, side) - joints(perturbed, side))[first:]
            np.testing.assert_allclose(moved, np.broadcast_to(-0.01 * perturbed.gravity, moved.shape), atol=2e-5)
            assert np.flatnonzero(refined.hands[side].valid)[0] == first
            np.testing.assert_array_equal(refined.object.rotvec, perturbed.object.rotvec)
            np.testing.assert_array_equal(refined.object.translation_m, perturbed.object.translation_m)


def test_other_hands_come_from_a_training_clip_and_the_object_is_recorded(sources, annotated, test):
    for sample in test:
        (combined,), (retrieved,) = (motions(sources, family, sample, 1) for family in ("other-hands", "random-clip"))
        np.testing.assert_array_equal(combined.hands[acting(sample)].wrist_m, retrieved.hands[acting(sample)].wrist_m)
        recorded = annotated.clip(sample.clip_id)
        np.testing.assert_array_equal(combined.object.translation_m, recorded.object.translation_m)


def many(train: list[ClipSample], **verbs: str) -> list[ClipSample]:
    """The right hand's training clip with the box under other names and with other verbs."""
    return [replace(train[1], clip_id=f"toy/s1/{name}", verb=verb) for name, verb in verbs.items()]


def test_retrieval_by_prompt_matches_verb_object_and_hand_before_the_sentence(annotated, train, test):
    (request,) = requests_of(test[1], 1)  # the box passed with the right hand
    prompt, clips = Prompt(annotated), many(train, a="lift", b="pass", c="open", d="pass")
    other = replace(train[1], object_key="another")
    assert sorted(prompt.same([*clips, train[0], other], request)) == [1, 3]
    assert list(prompt.same([clips[0], train[0]], request)) == list(by_sentence([clips[0], train[0]], request))
    assert sorted(prompt.other_verb([*clips, train[0]], request)) == [0, 2]
    assert prompt.other_verb([other, replace(other, verb="lift"), clips[0]], request) == [2, 1]
    assert prompt.same_verb([other, clips[0], train[0], clips[1]], request) == [3, 0]


def test_random_clips_have_the_same_hand_and_differ_per_motion(train, test):
    clips = [*many(train, a="lift", b="pass", c="open", d="drink"), train[0], train[2]]
    one, two = requests_of(test[1])
    order = of_the_hand(clips, one)
    assert sorted(order) == [0, 1, 2, 3]
    assert order == of_the_hand(clips, two)
    moved = [replace(clip, object=clip.object + np.float32(0.1 * index)) for index, clip in enumerate(clips)]
    lookup = Retrieval(moved, of_the_hand)
    starts = [lookup.motion(request) for request in (*requests_of(test[1], 4),)]
    assert len({float(clip.object.translation_m[0, 0]) for clip in starts if isinstance(clip, Clip)}) == 4


def test_swapped_hands_move_the_hand_that_was_not_requested(sources, annotated, test):
    for sample in test:
        requested, other = acting(sample), SIDES[1 - int(sample.active_hands.argmax())]
        (swapped,) = motions(sources, "swapped-hands", sample, 1)
        assert swapped.hands[requested].valid.all()
        assert swapped.hands[other].valid.all()
        near = [np.linalg.norm(in_object(swapped, side), axis=2).min() for side in (requested, other)]
        assert near[1] < 0.2 < 0.5 < near[0]


def test_impossible_answers_have_a_reason(annotated_root, trained, tmp_path):
    """No training clip of the same hand has another verb."""
    counts = sample_family(load_family("other-verb"), annotated_root, trained, tmp_path / "none", {"samples": 2}, HANDS)
    assert counts == {"clips": 0}
    note = json.loads((tmp_path / "none" / "empty.json").read_text())
    assert note == {"reason": "no motion of 4: no training clip of this hand with another verb"}


def test_recorded_and_perturbed_clips_have_the_recorded_target_contact(
    annotated_root, annotated, trained, test, tmp_path
):
    for family in ("ground-truth", "hands-away"):
        sample_family(load_family(family), annotated_root, trained, tmp_path / family, {"samples": 1}, HANDS)
        targets = read_target_contact(tmp_path / family / "clips")
        assert list(targets) == open_store(tmp_path / family / "clips", HANDS).ids
        for sample in test:
            np.testing.assert_array_equal(targets[f"{sample.clip_id}~0"], sample.contact_map)


def test_one_call_calls_the_denoiser_once_and_nothing_else_differs(sources):
    whole, once = (load_family(name).load(sources) for name in ("text2hoi", "one-call"))
    assert whole.config.sampler.steps > once.config.sampler.steps == 1
    assert replace(once.config, sampler=whole.config.sampler) == whole.config


def test_a_given_contact_map_replaces_only_the_sampled_one(sources, test):
    model = load_family("text2hoi").load(sources)
    requests = requests_of(test[0])
    sampled_maps = model.contact_maps(requests)
    plain, same = model.answers(requests), model.answers(requests, contact_maps=sampled_maps)
    for one, two in zip(plain, same, strict=True):
        assert torch.equal(one.coarse, two.coarse)
        np.testing.assert_array_equal(joints(one.clip, acting(test[0])), joints(two.clip, acting(test[0])))
    flipped_maps = [1 - contact_map.amax(0) for contact_map in sampled_maps]
    other = model.answers(requests, contact_maps=flipped_maps)
    assert all(
        torch.equal(motion.touched, flipped_map > 0) for motion, flipped_map in zip(other, flipped_maps, strict=True)
    )
    assert not torch.equal(other[0].coarse, plain[0].coarse)


def test_other_contact_is_the_map_with_least_overlap_on_the_same_object(sources, test):
    other_maps = other_contact_maps(sources)
    first, second = test
    assert first.object_key == second.object_key
    np.testing.assert_array_equal(other_maps[first.clip_id] > 0, second.contact_map)
    np.testing.assert_array_equal(other_maps[second.clip_id] > 0, first.contact_map)
    family = load_family("other-contact").load(sources)
    _, targets = family.sample_with_targets(requests_of(first))
    sampled_maps = family.model.contact_maps(requests_of(first))
    np.testing.assert_array_equal(targets, np.stack([contact_map.amax(0).numpy() > 0 for contact_map in sampled_maps]))
    alone = OtherContact(family.model, {})
    assert {type(answer) for answer in alone.sample(requests_of(first))} == {Skipped}


def test_own_contact_combines_the_contact_of_the_prompt_with_another_prompts_motion(sources, test):
    family, other = (load_family(name).load(sources) for name in ("other-prompt-own-contact", "other-prompt"))
    requests = requests_of(test[0])
    (first, _), maps = family.sample_with_targets(requests)
    sampled_maps = family.other_prompt.model.contact_maps(requests)
    np.testing.assert_array_equal(maps, np.stack([contact_map.amax(0).numpy() > 0 for contact_map in sampled_maps]))
    (with_other_prompt, _) = other.sample(requests)
    if not torch.equal(
        sampled_maps[0], family.other_prompt.model.contact_maps(family.other_prompt.with_other_sentences(requests))[0]
    ):
        assert abs(joints(first, acting(test[0])) - joints(with_other_prompt, acting(test[0]))).max() > 0
