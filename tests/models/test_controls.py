"""Rows that must lose: each spoils what its name says of the recorded clip, or takes that from a model, and no more."""

import json
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.metrics.asked import read_asked
from hoidata.refinement import HoldSettings, hold_clip
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.store import open_store
from models.baselines.controls import HANDS_AWAY_M
from models.baselines.lookups import NEAREST_CLIP, Lookup, Prompt, by_sentence, of_the_hand
from models.common.family import LeftOut, Sources
from models.common.predicting import PredictionConfig, requests_for, sample_family
from models.registry import load_family
from models.text2hoi.controls import HeldLookup, OtherContact, OwnContact, other_contact_maps
from models.text2hoi.sampler import Text2Hoi
from models.text2hoi.verb_check import VerbCheck

HANDS = load_embedded_hands()
SPOILT = ("static", "reversed", "object-moved", "hands-away", "pressed", "noise")
LOOKUPS = (
    *("prompt-lookup", "prompt-lookup-held", "verb-lookup", "verb-lookup-held", "random-clip", "other-verb"),
    *("swapped-hands", "other-hands", "nearest-clip"),
)
MODELS = ("one-call", "other-contact", "other-prompt-own-contact")


@pytest.fixture(scope="module")
def test(annotated: AnnotatedStore) -> list[ClipSample]:
    """Two clips of a box: lifted with the left hand, passed with the right one; the other hand is a metre away."""
    return list(HoiDataset(annotated, "test", crop="start"))


@pytest.fixture(scope="module")
def train(annotated: AnnotatedStore) -> list[ClipSample]:
    """The box lifted with the left hand, the box passed with the right one, a notebook opened with both."""
    return list(HoiDataset(annotated, "train", crop="start"))


def asked_for(sample: ClipSample, count: int = 2) -> list[Request]:
    return requests_for(sample, PredictionConfig(samples=count))


def answers(sources: Sources, family: str, sample: ClipSample, count: int = 2) -> Sequence[Clip | LeftOut]:
    return load_family(family).load(sources).sample(asked_for(sample, count))


def motions(sources: Sources, family: str, sample: ClipSample, count: int = 2) -> list[Clip]:
    found = [answer for answer in answers(sources, family, sample, count) if isinstance(answer, Clip)]
    assert len(found) == count
    return found


def joints(clip: Clip, side: Side) -> np.ndarray:
    return track_joints(clip.hands[side], HANDS[side])


def acting(sample: ClipSample) -> Side:
    return SIDES[int(sample.active_hands.argmax())]


def in_object(clip: Clip, side: Side) -> np.ndarray:
    return clip.object.world_from_object.inverse() @ joints(clip, side)


@pytest.mark.parametrize("family", [*SPOILT, *LOOKUPS, *MODELS])
def test_every_answer_is_a_motion_as_asked_or_a_reason(sources, test, family):
    for sample in test:
        for request, answer in zip(asked_for(sample), answers(sources, family, sample), strict=True):
            assert answer.clip_id == request.motion_id
            if isinstance(answer, LeftOut):
                assert family in ("other-verb",)
            else:
                assert (answer.n_frames, answer.object.model.name) == (sample.length, sample.object_model.name)
                assert answer.hands[acting(sample)].valid.all()


@pytest.mark.parametrize("family", sorted({*SPOILT} - {"static", "reversed"}))
def test_the_hand_that_was_not_asked_for_is_left_as_it_was(sources, annotated, test, family):
    for sample in test:
        idle: Side = "left" if acting(sample) == "right" else "right"
        np.testing.assert_array_equal(
            motions(sources, family, sample)[0].hands[idle].wrist_m, annotated.clip(sample.clip_id).hands[idle].wrist_m
        )


def test_a_held_lookup_is_the_lookup_with_the_hold_that_ours_has(sources, test):
    for sample in test:
        found, held = (motions(sources, name, sample)[0] for name in ("prompt-lookup", "prompt-lookup-held"))
        side, wanted = acting(sample), hold_clip(HANDS, found, HoldSettings())
        np.testing.assert_array_equal(held.object.translation_m, wanted.object.translation_m)
        np.testing.assert_array_equal(joints(held, side), track_joints(wanted.hands[side], HANDS[side]))
        assert np.abs(joints(held, side) - joints(found, side)).max() > 1e-4


def test_a_held_lookup_is_looked_up_again_by_the_rules_of_ours(sources, test, monkeypatch):
    """The next clip of the ranking; the least unusual of them where none is usual."""
    sample, several = test[0], requests_for(test[0], PredictionConfig(samples=2))
    family = HeldLookup.load(NEAREST_CLIP, replace(sources, settings={"text2hoi": {"max_attempts": 3}}))
    plain = NEAREST_CLIP.load(sources)
    ranked = [plain.sample([replace(several[0], number=number)])[0] for number in range(6)]
    places = [hold_clip(HANDS, own, HoldSettings()).object.translation_m for own in ranked]
    for beyond, taken in (([0, 0], [0, 1]), ([3, 0, 2, 1], [2, 1]), ([0, 3, 0], [0, 2]), ([1, 2, 1, 2, 1, 2], [0, 1])):
        left = [float(own) for own in beyond]
        monkeypatch.setattr(VerbCheck, "fails", lambda self, asked, moved_as: False)
        monkeypatch.setattr(VerbCheck, "beyond", lambda self, asked, numbers, left=left: left.pop(0))
        monkeypatch.setattr("models.text2hoi.controls.carried_share", lambda *told: 1.0)
        found = family.sample(several)
        assert left == []
        for one, number in zip(found, taken, strict=True):
            np.testing.assert_array_equal(one.object.translation_m, places[number])
    monkeypatch.undo()
    # The second of three has no clip to look up; hands of the third carry at the second try.
    monkeypatch.setattr(VerbCheck, "beyond", lambda self, asked, numbers: 0.0)
    monkeypatch.setattr(VerbCheck, "fails", lambda self, asked, moved_as: False)
    shares = [1.0, 0.0, 1.0]
    monkeypatch.setattr("models.text2hoi.controls.carried_share", lambda *told: shares.pop(0))
    nowhere = replace(several[0], motion_id="nowhere")
    lookup = SimpleNamespace(
        sample=lambda asked: [
            LeftOut("nowhere", "no clip") if one.motion_id == "nowhere" else plain.sample([one])[0] for one in asked
        ]
    )
    found = replace(family, lookup=lookup).sample([several[0], nowhere, several[1]])
    assert isinstance(found[1], LeftOut)
    for one, number in ((found[0], 0), (found[2], 2)):
        np.testing.assert_array_equal(one.object.translation_m, places[number])
    monkeypatch.undo()
    told = []
    monkeypatch.setattr(VerbCheck, "fails", lambda self, asked, moved_as: told.append(asked) or True)
    family.sample(several)
    assert told == [sample.verb] * 6


def test_static_holds_the_first_frame_in_which_the_hand_touches(sources, annotated, test):
    for sample in test:
        (made,), recorded = motions(sources, "static", sample, 1), annotated.clip(sample.clip_id)
        first = int(annotated.distances(sample.clip_id, acting(sample)).frame.min())
        assert 0 < first < sample.length - 1
        for frame in (0, sample.length - 1):
            np.testing.assert_array_equal(made.hands["left"].wrist_m[frame], recorded.hands["left"].wrist_m[first])
            np.testing.assert_array_equal(made.object.translation_m[frame], recorded.object.translation_m[first])


def test_a_hand_that_is_not_seen_is_held_where_it_last_was(sources, annotated, test):
    recorded = annotated.clip(test[0].clip_id)
    valid = np.ones(recorded.n_frames, bool)
    valid[:3] = False
    from models.baselines.controls import Recording, backwards

    track = replace(recorded.hands["left"], valid=valid)
    spoilt = replace(recorded, hands={**recorded.hands, "left": track})
    made = backwards(spoilt, Recording(annotated, asked_for(test[0])[0]))
    assert made.hands["left"].valid.all()
    expected = recorded.hands["left"].wrist_m[[*range(recorded.n_frames - 1, 2, -1), 3, 3, 3]]
    np.testing.assert_array_equal(made.hands["left"].wrist_m, expected)


def test_reversed_ends_where_the_clip_begins(sources, annotated, test):
    for sample in test:
        (made,), recorded = motions(sources, "reversed", sample, 1), annotated.clip(sample.clip_id)
        np.testing.assert_array_equal(made.object.translation_m[::-1], recorded.object.translation_m)
        np.testing.assert_array_equal(made.hands["right"].wrist_m[::-1], recorded.hands["right"].wrist_m)
        np.testing.assert_array_equal(made.source_frames, recorded.source_frames)


def test_a_moved_object_lies_10_cm_aside_and_the_hands_are_the_same_to_the_bit(sources, annotated, test):
    for sample in test:
        one, two = motions(sources, "object-moved", sample)
        recorded = annotated.clip(sample.clip_id)
        moved = one.object.translation_m - recorded.object.translation_m
        np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.10, atol=1e-6)
        np.testing.assert_allclose(moved @ recorded.gravity, 0, atol=1e-6)
        assert abs(one.object.translation_m - two.object.translation_m).max() > 0.01
        for side in SIDES:
            for name in ("wrist_m", "global_orient", "hand_pose"):
                made, true = (getattr(clip.hands[side], name) for clip in (one, recorded))
                np.testing.assert_array_equal(made, true)


def test_hands_away_are_held_off_as_rigidly_as_they_were_held_on(sources, annotated, test):
    for sample in test:
        side, recorded = acting(sample), annotated.clip(sample.clip_id)
        (made,) = motions(sources, "hands-away", sample, 1)
        shift = in_object(made, side) - in_object(recorded, side)
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-5)
        points = sample.points.points_m
        nearest = [np.linalg.norm(frame[:, None] - points, axis=2).min() for frame in in_object(made, side)]
        assert min(nearest) == pytest.approx(HANDS_AWAY_M, abs=1e-3)


def off_the_box(points_m: np.ndarray) -> np.ndarray:
    """Distance from the surface of the toy's box (half sides 3, 3 and 5 cm), in its own frame; negative inside."""
    beyond = abs(points_m) - np.array([0.03, 0.03, 0.05])
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def test_pressed_hands_go_1_cm_against_the_surface_they_touch(sources, annotated, test):
    for sample in test:
        side, recorded = acting(sample), annotated.clip(sample.clip_id)
        (made,) = motions(sources, "pressed", sample, 1)
        before, after = in_object(recorded, side), in_object(made, side)
        shift = after - before
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-5)
        assert np.linalg.norm(shift[0, 0]) == pytest.approx(0.01, abs=1e-5)
        assert off_the_box(after).min() < off_the_box(before).min() - 0.003  # the second clip's lies over an edge


@pytest.mark.parametrize("name", ["pressed-deep", "hands-shifted"])
def test_hands_moved_by_3_cm_keep_to_the_object(sources, annotated, test, name):
    for sample in test:
        side, recorded = acting(sample), annotated.clip(sample.clip_id)
        (made,) = motions(sources, name, sample, 1)
        shift = in_object(made, side) - in_object(recorded, side)
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-5)
        assert np.linalg.norm(shift[0, 0]) == pytest.approx(0.03, abs=1e-5)


def test_hands_held_still_are_those_of_the_first_contact_and_the_object_goes_on(sources, annotated, test):
    for sample in test:
        side, recorded = acting(sample), annotated.clip(sample.clip_id)
        (made,) = motions(sources, "hands-still", sample, 1)
        first = int(annotated.distances(sample.clip_id, side).frame.min())
        assert (made.hands[side].wrist_m == recorded.hands[side].wrist_m[first]).all()
        np.testing.assert_array_equal(made.object.translation_m, recorded.object.translation_m)


def test_noise_is_5_mm_at_a_joint_and_never_twice_the_same(sources, annotated, test):
    off = []
    for sample in test:
        one, two = motions(sources, "noise", sample)
        true, side = joints(annotated.clip(sample.clip_id), acting(sample)), acting(sample)
        off += [np.linalg.norm(joints(made, side) - true, axis=2).mean() for made in (one, two)]
        assert abs(one.hands[side].wrist_m - two.hands[side].wrist_m).max() > 1e-3
    assert np.mean(off) == pytest.approx(0.005, abs=4e-4)


def test_other_hands_are_those_of_a_training_clip_around_this_object(sources, annotated, test):
    for sample in test:
        (made,), (found,) = (motions(sources, family, sample, 1) for family in ("other-hands", "random-clip"))
        np.testing.assert_array_equal(made.hands[acting(sample)].wrist_m, found.hands[acting(sample)].wrist_m)
        recorded = annotated.clip(sample.clip_id)
        np.testing.assert_array_equal(made.object.translation_m, recorded.object.translation_m)


def many(train: list[ClipSample], **verbs: str) -> list[ClipSample]:
    """The right hand's training clip with the box under other names and with other verbs."""
    return [replace(train[1], clip_id=f"toy/s1/{name}", verb=verb) for name, verb in verbs.items()]


def test_the_prompt_is_looked_up_by_verb_object_and_hand_before_the_sentence(annotated, train, test):
    (request,) = asked_for(test[1], 1)  # the box passed with the right hand
    prompt, clips = Prompt(annotated), many(train, a="lift", b="pass", c="open", d="pass")
    other = replace(train[1], object_key="another")
    assert sorted(prompt.same([*clips, train[0], other], request)) == [1, 3]
    assert list(prompt.same([clips[0], train[0]], request)) == list(by_sentence([clips[0], train[0]], request))
    assert sorted(prompt.other_verb([*clips, train[0]], request)) == [0, 2]
    assert prompt.other_verb([other, replace(other, verb="lift"), clips[0]], request) == [2, 1]
    assert prompt.same_verb([other, clips[0], train[0], clips[1]], request) == [3, 0]


def test_random_clips_are_of_the_same_hand_and_each_motion_gets_another(train, test):
    clips = [*many(train, a="lift", b="pass", c="open", d="drink"), train[0], train[2]]
    one, two = asked_for(test[1])
    order = of_the_hand(clips, one)
    assert sorted(order) == [0, 1, 2, 3]
    assert order == of_the_hand(clips, two)
    moved = [replace(clip, object=clip.object + np.float32(0.1 * row)) for row, clip in enumerate(clips)]
    lookup = Lookup(moved, of_the_hand)
    starts = [lookup.motion(request) for request in (*asked_for(test[1], 4),)]
    assert len({float(clip.object.translation_m[0, 0]) for clip in starts if isinstance(clip, Clip)}) == 4


def test_swapped_hands_leave_the_hand_asked_for_idle_and_move_the_other(sources, annotated, test):
    for sample in test:
        asked, other = acting(sample), SIDES[1 - int(sample.active_hands.argmax())]
        (made,) = motions(sources, "swapped-hands", sample, 1)
        assert made.hands[asked].valid.all()
        assert made.hands[other].valid.all()
        near = [np.linalg.norm(in_object(made, side), axis=2).min() for side in (asked, other)]
        assert near[1] < 0.2 < 0.5 < near[0]


def test_what_cannot_be_made_is_left_out_with_its_reason(annotated_root, trained, tmp_path):
    """No training clip of the same hand has another verb."""
    counts = sample_family(load_family("other-verb"), annotated_root, trained, tmp_path / "none", {"samples": 2}, HANDS)
    assert counts == {"clips": 0}
    note = json.loads((tmp_path / "none" / "empty.json").read_text())
    assert note == {"reason": "no motion of 4: no training clip of this hand with another verb"}


def test_the_truth_and_what_is_spoilt_of_it_count_as_asked_for_the_recorded_contact(
    annotated_root, annotated, trained, test, tmp_path
):
    for family in ("ground-truth", "hands-away"):
        sample_family(load_family(family), annotated_root, trained, tmp_path / family, {"samples": 1}, HANDS)
        asked = read_asked(tmp_path / family / "clips")
        assert list(asked) == open_store(tmp_path / family / "clips", HANDS).ids
        for sample in test:
            np.testing.assert_array_equal(asked[f"{sample.clip_id}~0"], sample.contact_map)


def test_one_call_calls_the_denoiser_once_and_nothing_else_differs(sources):
    whole, once = (load_family(name).load(sources) for name in ("text2hoi", "one-call"))
    assert isinstance(whole, Text2Hoi)
    assert isinstance(once, Text2Hoi)
    assert whole.config.sampler.steps > once.config.sampler.steps == 1
    assert replace(once.config, sampler=whole.config.sampler) == whole.config


def test_a_contact_map_that_is_given_takes_the_place_of_the_drawn_one_and_of_nothing_else(sources, test):
    model = load_family("text2hoi").load(sources)
    assert isinstance(model, Text2Hoi)
    asked = asked_for(test[0])
    drawn = model.contact_maps(asked)
    plain, same = model.motions(asked), model.motions(asked, contact_maps=drawn)
    for one, two in zip(plain, same, strict=True):
        assert torch.equal(one.refined, two.refined)
    given = [1 - contact_map.amax(0) for contact_map in drawn]
    other = model.motions(asked, contact_maps=given)
    assert all(torch.equal(motion.contact_map, own) for motion, own in zip(other, given, strict=True))
    assert not torch.equal(other[0].refined, plain[0].refined)


def test_other_contact_is_the_map_of_the_clip_of_the_object_that_shares_least(sources, test):
    found = other_contact_maps(sources)
    first, second = test
    assert first.object_key == second.object_key
    np.testing.assert_array_equal(found[first.clip_id] > 0, second.contact_map)
    np.testing.assert_array_equal(found[second.clip_id] > 0, first.contact_map)
    family = load_family("other-contact").load(sources)
    assert isinstance(family, OtherContact)
    _, asked = family.sample_asked(asked_for(first))
    own = family.model.contact_maps(asked_for(first))
    np.testing.assert_array_equal(asked, np.stack([contact_map.amax(0).numpy() > 0 for contact_map in own]))
    alone = OtherContact(family.model, {})
    assert {type(answer) for answer in alone.sample(asked_for(first))} == {LeftOut}


def test_own_contact_is_the_map_of_the_own_prompt_and_the_motion_of_another(sources, test):
    family, other = (load_family(name).load(sources) for name in ("other-prompt-own-contact", "other-prompt"))
    assert isinstance(family, OwnContact)
    asked = asked_for(test[0])
    (first, _), maps = family.sample_asked(asked)
    own = family.other_prompt.model.contact_maps(asked)
    np.testing.assert_array_equal(maps, np.stack([contact_map.amax(0).numpy() > 0 for contact_map in own]))
    (told, _) = other.sample(asked)
    assert isinstance(told, Clip)
    swapped = family.other_prompt.with_other_sentences(asked)
    if not torch.equal(own[0], family.other_prompt.model.contact_maps(swapped)[0]):
        assert abs(joints(first, acting(test[0])) - joints(told, acting(test[0]))).max() > 0
