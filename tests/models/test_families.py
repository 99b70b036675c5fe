"""Families answer requests with clips; an answer does not depend on the other requests of the batch."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import ClipSample, HoiDataset, load_sample
from hoidata.batches.requests import MAX_BATCH_SIZE, Sentence, bucket_by_length
from hoidata.clips.clip import SIDES, Clip
from hoidata.contact.maps import f1_score
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.metrics.target_contact import read_target_contact
from hoidata.metrics.verb_ranges import VerbRanges
from hoidata.refinement import refine_grasps
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.store import open_store
from models.baselines.retrieval import Prompt
from models.common.contact_maps import best_threshold, mean_f1, mean_map_by_position
from models.common.family import Sources, motion_clip
from models.common.predicting import PredictionConfig, requests_for, sample_family, spread
from models.common.sampling import SamplerConfig
from models.registry import family_names, load_family, load_network
from models.text2hoi.family import other_prompts
from models.text2hoi.refiner import RefinerModel
from models.text2hoi.sampler import SamplingConfig, Text2Hoi
from tests.builders.clips import build_clip
from tests.builders.stores import write_annotated
from tests.models.toy import FAST

HANDS = load_embedded_hands()
WRIST_X = torch.eye(99)[0]


def samples_of(annotated: AnnotatedStore, split: str) -> list[ClipSample]:
    return list(HoiDataset(annotated, split, crop="start"))


def joints_of(clip: Clip) -> np.ndarray:
    """(side and frame, 21, 3) of the hands that are there."""
    return np.concatenate([track_joints(clip.hands[side], HANDS[side])[clip.hands[side].valid] for side in SIDES])


def answer(sources: Sources, family: str, sample: ClipSample, count: int = 1) -> list[Clip]:
    return load_family(family).load(sources).sample(requests_for(sample, PredictionConfig(samples=count)))


def test_registered_families_have_their_name_and_share_no_network() -> None:
    families = [load_family(name) for name in family_names()]
    assert [family.name for family in families] == family_names()
    networks = [network.name for family in families for network in family.networks]
    assert len(set(networks)) == len(networks)
    assert all(load_network(name).name == name for family in families for name in family.uses)
    with pytest.raises(BadInput, match="text2hoi"):
        load_family("juggler")


def test_features_of_a_recorded_clip_decode_to_it(annotated: AnnotatedStore) -> None:
    for sample in samples_of(annotated, "train"):
        recorded = annotated.clip(sample.clip_id)
        request = requests_for(sample, PredictionConfig())[0]
        decoded = motion_clip(request, torch.from_numpy(sample.hands), torch.from_numpy(sample.object), True)
        np.testing.assert_allclose(decoded.object.translation_m, recorded.object.translation_m, atol=1e-5)
        np.testing.assert_allclose(decoded.object.rotvec, recorded.object.rotvec, atol=1e-4)
        if recorded.object.is_articulated:
            np.testing.assert_allclose(decoded.object.hinge_rad, recorded.object.hinge_rad, atol=1e-6)
        for index, side in enumerate(SIDES):
            assert decoded.hands[side].valid.all() == bool(sample.active_hands[index])
            if sample.active_hands[index]:
                expected = track_joints(recorded.hands[side], HANDS[side])
                np.testing.assert_allclose(track_joints(decoded.hands[side], HANDS[side]), expected, atol=2e-5)


def test_a_motion_for_a_clip_of_unknown_gravity_claims_none(annotated: AnnotatedStore) -> None:
    """Else a hold would ask what falls along an axis that means nothing."""
    sample = samples_of(annotated, "train")[0]
    request = requests_for(replace(sample, gravity_known=False), PredictionConfig())[0]
    motion = motion_clip(request, torch.from_numpy(sample.hands), torch.from_numpy(sample.object), True)
    assert sample.gravity_known
    assert motion.gravity is None
    assert "not known" in motion.gravity_note
    clip = annotated.clip(sample.clip_id)
    store = SimpleNamespace(**{name: getattr(annotated, name) for name in dir(annotated) if not name.startswith("__")})
    store.clip = lambda clip_id: replace(clip, gravity=None, gravity_note="the source does not say")
    assert not load_sample(store, sample.clip_id).gravity_known


@pytest.mark.parametrize(("requested", "expected"), [(0, 12), (5, 5), (7, 7), (12, 12), (40, 12)])
def test_the_requested_number_of_test_clips_is_spread_evenly(requested: int, expected: int) -> None:
    chosen = spread(list(range(12)), requested)
    assert len(chosen) == expected
    assert chosen == sorted(set(chosen))
    assert max(np.diff(chosen)) - min(np.diff(chosen)) <= 1


@pytest.mark.parametrize(("settings", "named"), [({"samples": 0}, "sample.samples"), ({"clips": -1}, "sample.clips")])
def test_a_sampling_of_nothing_is_refused(settings: dict, named: str) -> None:
    with pytest.raises(BadInput, match=named):
        PredictionConfig(**settings)


def test_ground_truth_is_the_recorded_clip(sources: Sources) -> None:
    for sample in samples_of(sources.annotated, "test"):
        (motion,) = answer(sources, "ground-truth", sample)
        recorded = sources.annotated.clip(sample.clip_id)
        np.testing.assert_array_equal(motion.object.translation_m, recorded.object.translation_m)
        np.testing.assert_array_equal(motion.hands["left"].wrist_m, recorded.hands["left"].wrist_m)
        assert motion.clip_id == f"{sample.clip_id}~0"


def test_the_mean_pose_stands_still_at_the_mean_of_the_training_wrists(sources: Sources) -> None:
    train, sample = samples_of(sources.annotated, "train"), samples_of(sources.annotated, "test")[1]
    (motion,) = answer(sources, "mean-pose", sample)
    assert np.ptp(motion.object.translation_m, axis=0).max() == 0
    wrists = np.concatenate([clip.hands[1, :, :3] for clip in train if clip.active_hands[1]])
    moved = wrists.astype(np.float64).mean(axis=0) @ sample.world_from_model[:3, :3].T + sample.world_from_model[:3, 3]
    assert sample.active_hands.tolist() == [False, True]
    np.testing.assert_allclose(motion.hands["right"].wrist_m[0], moved, atol=1e-6)


def test_the_mean_motion_moves_as_the_training_clips_do(sources: Sources) -> None:
    train, sample = samples_of(sources.annotated, "train"), samples_of(sources.annotated, "test")[0]
    (motion,) = answer(sources, "mean-motion", sample)
    rotation = sample.world_from_model[:3, :3]
    gone = (motion.object.translation_m[-1] - motion.object.translation_m[0]) @ rotation
    true = np.mean([clip.object[-1, :3] - clip.object[0, :3] for clip in train], axis=0)
    np.testing.assert_allclose(gone, true, atol=0.02)
    assert np.linalg.norm(true) > 0.05


def test_the_nearest_clip_to_a_training_sentence_is_that_clip_and_the_next_is_another(sources: Sources) -> None:
    sample = samples_of(sources.annotated, "train")[1]
    first, second = answer(sources, "nearest-clip", sample, count=2)
    recorded = sources.annotated.clip(sample.clip_id)
    np.testing.assert_allclose(joints_of(first), track_joints(recorded.hands["right"], HANDS["right"]), atol=2e-5)
    assert abs(first.object.translation_m - second.object.translation_m).max() > 0.01


@pytest.mark.parametrize("name", ["nearest-clip", "prompt-retrieval", "random-clip"])
def test_retrieval_skips_clips_with_an_untracked_acting_hand(name, sources: Sources, monkeypatch):
    whole = samples_of(sources.annotated, "train")
    right, both = (next(one for one in whole if one.hand_type == kind) for kind in ("right", "both"))
    gap = np.arange(both.length) != 3
    idle = replace(right, valid=right.valid & np.array([[False], [True]]))  # the hand that takes no part
    monkeypatch.setattr(Sources, "clips", lambda *_: [replace(both, valid=both.valid & gap), idle])
    lookup = load_family(name).load(sources)
    assert [sample.clip_id for sample in lookup.train] == [right.clip_id]


def test_verbs_derived_from_motion_reach_samples_and_retrieval(tmp_path: Path) -> None:
    clips = [
        build_clip(20, seed=seed, clip_id=f"toy/{subject}/{seed}", subject=subject, verb=None)
        for seed, subject in enumerate(("s1", "s1", "s1", "s2", "s3"))
    ]
    write_annotated(tmp_path, clips)
    annotated = load_annotated(tmp_path)
    assert set(annotated.hand_types["verb_source"]) == {"derived"}
    train, (test,) = samples_of(annotated, "train"), samples_of(annotated, "test")
    assert [one.verb for one in (*train, test)] == [annotated.verb(one.clip_id) for one in (*train, test)]
    (request,) = requests_for(test, PredictionConfig(samples=1))
    assert request.sentence is not None
    assert request.sentence.verb == test.verb is not None
    prompt = Prompt(annotated)
    with_verb = {index for index, one in enumerate(train) if one.verb == test.verb and one.hand_type == test.hand_type}
    assert set(prompt.same_verb(train, request)) == with_verb != set()
    assert set(prompt.other_verb(train, request)).isdisjoint(with_verb)


def test_another_prompt_always_differs(sources: Sources) -> None:
    test = {sample.clip_id: sample for sample in samples_of(sources.annotated, "test")}
    for clip_id, other in other_prompts(sources).items():
        assert other.clip_id in set(test) - {clip_id}
        assert not np.allclose(other.text[0], test[clip_id].text[0])


def test_the_control_conditions_text2hoi_on_another_prompt(sources: Sources) -> None:
    request = requests_for(samples_of(sources.annotated, "test")[0], PredictionConfig(samples=1))[0]
    other, family = other_prompts(sources)[request.clip_id], load_family("other-prompt").load(sources)
    with_other_prompt = replace(
        request, sentence=Sentence(other.sentences[0], other.verb, other.object_words), text=other.text[0]
    )
    assert [plain.sentence for plain in family.with_other_sentences([request])] == [with_other_prompt.sentence]
    np.testing.assert_array_equal(family.with_other_sentences([request])[0].text, with_other_prompt.text)
    (answer_of_control,) = family.sample([request])
    plain, expected = load_family("text2hoi").load(sources).sample([request, with_other_prompt])
    np.testing.assert_allclose(joints_of(answer_of_control), joints_of(expected), atol=1e-5)
    assert abs(joints_of(answer_of_control) - joints_of(plain)).max() > 1e-4


def test_a_motion_does_not_depend_on_the_batch_and_depends_on_its_seed(sources: Sources) -> None:
    family = load_family("text2hoi").load(sources)
    short, long = samples_of(sources.annotated, "test")
    requests = requests_for(short, PredictionConfig(samples=2))
    together = family.sample([*requests, *requests_for(long, PredictionConfig(samples=1))])
    (alone,) = family.sample(requests[:1])
    np.testing.assert_allclose(joints_of(alone), joints_of(together[0]), atol=1e-4)
    assert abs(joints_of(together[0]) - joints_of(together[1])).max() > 1e-3


def test_a_motion_of_ddpm_and_a_diffusion_refiner_does_not_depend_on_the_batch(sources: Sources) -> None:
    model = load_family("text2hoi").load(sources)
    assert isinstance(model, Text2Hoi)
    checkpoint = model.trained["refiner"]
    torch.manual_seed(0)
    refiner = RefinerModel(replace(checkpoint.network.config, output="diffusion")).eval()
    trained = {**model.trained, "refiner": replace(checkpoint, network=refiner)}
    model = replace(model, trained=trained, config=SamplingConfig(SamplerConfig("ddpm", 3)))
    short = requests_for(samples_of(sources.annotated, "test")[0], PredictionConfig(samples=2))
    together = model.sample([*short, replace(short[0], n_frames=short[0].n_frames + 9)])
    (alone,) = model.sample(short[:1])
    np.testing.assert_allclose(joints_of(alone), joints_of(together[0]), atol=1e-3)
    assert abs(joints_of(together[0]) - joints_of(together[1])).max() > 1e-2


def test_a_motion_depends_on_the_sentence_its_verb_and_refinement(
    sources: Sources, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = load_family("text2hoi").load(sources)
    sample = samples_of(sources.annotated, "test")[0]
    request = requests_for(sample, PredictionConfig(samples=1))[0]
    (plain,) = model.sample([request])
    other_text = replace(request, text=np.roll(request.text, 7))
    assert abs(joints_of(plain) - joints_of(model.sample([other_text])[0])).max() > 1e-5
    other_verb = replace(request, sentence=Sentence("Open a box with the left hand.", None, None))
    assert abs(joints_of(plain) - joints_of(model.sample([other_verb])[0])).max() > 1e-5
    # The verb is read from the words, not from the annotation.
    other_annotation = replace(request, sentence=Sentence(sample.sentences[0], "open", None))
    np.testing.assert_array_equal(joints_of(plain), joints_of(model.sample([other_annotation])[0]))
    monkeypatch.setattr(Text2Hoi, "refine", lambda self, batch, hands, *inputs: hands + 0.5 * WRIST_X)
    (moved,), (coarse,) = model.sample([request]), load_family("text2hoi-coarse").load(sources).sample([request])
    shift = sample.world_from_model[:3, :3] @ [0.5, 0, 0]
    np.testing.assert_allclose(
        joints_of(moved) - joints_of(coarse), np.broadcast_to(shift, joints_of(coarse).shape), atol=1e-5
    )


def test_contact_refinement_replaces_the_refiner_by_setting(sources: Sources) -> None:
    request = requests_for(samples_of(sources.annotated, "test")[0], PredictionConfig(samples=1))[0]
    (coarse,), (refined,), (usual,) = (
        load_family(name).load(sources).sample([request])
        for name in ("text2hoi-coarse", "text2hoi-contact", "text2hoi")
    )
    for side, track in refine_grasps(HANDS, coarse).hands.items():
        np.testing.assert_array_equal(refined.hands[side].hand_pose, track.hand_pose)
    assert abs(joints_of(usual) - joints_of(coarse)).max() > 1e-6
    settings = {"text2hoi": {**FAST["text2hoi"], "refine": "contact"}}
    (chosen,) = load_family("text2hoi").load(replace(sources, settings=settings)).sample([request])
    np.testing.assert_array_equal(joints_of(chosen), joints_of(refined))


def test_requests_are_batched_by_hands_and_length(sources: Sources) -> None:
    (request,) = requests_for(samples_of(sources.annotated, "test")[0], PredictionConfig(samples=1))
    flags, draws = ((True, False), (False, True), (True, True)), np.random.default_rng(0)
    requests = [
        replace(request, active_hands=np.array(flags[draws.integers(3)]), n_frames=int(draws.integers(8, 151)))
        for _ in range(4 * MAX_BATCH_SIZE)
    ]
    batches = bucket_by_length(requests)
    assert sorted(number for batch in batches for number in batch) == list(range(len(requests)))
    assert all(
        len(batch) <= MAX_BATCH_SIZE and len({tuple(requests[n].active_hands) for n in batch}) == 1 for batch in batches
    )
    lengths = [[requests[number].n_frames for number in batch] for batch in batches]
    assert all(batch == sorted(batch) for batch in lengths)
    assert len(batches) <= 4 + len(flags)


@pytest.mark.parametrize(
    ("ranks", "taken", "attempts"),
    [
        ([(2, 0.0, 1.0)], 0, 1),
        ([(1, 0.0, 0.0), (2, 0.0, 0.75)], 1, 2),
        ([(1, 0.0, 0.25), (1, 0.0, 0.0), (1, 0.0, 0.0)], 0, 3),
        ([(1, 0.0, 0.0), (1, 0.0, 0.25), (1, 0.0, 0.0)], 1, 3),
        ([(2, -1.0, 0.9), (2, -0.5, 0.8), (2, -1.0, 1.0)], 1, 3),
        ([(0, 0.0, 0.0), (2, -3.0, 0.6), (1, 0.0, 0.9)], 1, 3),
    ],
    ids=["accepted", "the second", "all equal", "carries more", "less unusual", "meets more criteria"],
)
def test_rejected_motions_are_resampled_and_the_best_is_the_answer(
    sources: Sources,
    monkeypatch: pytest.MonkeyPatch,
    ranks: list[tuple[int, float, float]],
    taken: int,
    attempts: int,
) -> None:
    request = requests_for(samples_of(sources.annotated, "test")[0], PredictionConfig(samples=1))[0]
    settings = {"text2hoi": {**FAST["text2hoi"], "attempts": 3}}
    model = load_family("text2hoi").load(replace(sources, settings=settings))
    sampled, left = list[Clip](), list(ranks)

    def rank(self: VerbRanges, verb: str | None, clip: Clip, points: object) -> tuple[int, float, float]:
        assert verb == request.sentence.verb
        sampled.append(clip)
        return left.pop(0)

    monkeypatch.setattr(VerbRanges, "rank", rank)
    (answer,) = model.answers([request])
    assert (answer.attempts, len(sampled), left) == (attempts, attempts, [])
    assert (answer.rank, answer.clip) == (ranks[taken], sampled[taken])
    for one, other in pairwise(sampled):
        assert abs(joints_of(one) - joints_of(other)).max() > 1e-3


def test_one_attempt_is_not_ranked(sources: Sources, monkeypatch: pytest.MonkeyPatch) -> None:
    request = requests_for(samples_of(sources.annotated, "test")[0], PredictionConfig(samples=1))[0]
    model = load_family("text2hoi").load(sources)
    monkeypatch.setattr(VerbRanges, "rank", None)
    assert [answer.attempts for answer in model.answers([request])] == [1]


def test_sampling_writes_a_store_and_the_diagnostics_of_the_family(
    annotated_root: Path, trained: Path, tmp_path: Path
) -> None:
    family, params = load_family("text2hoi"), {"samples": 2, "seed": 1}
    for out in (tmp_path / "a", tmp_path / "b"):
        counts = sample_family(family, annotated_root, trained, out, params, HANDS, settings=FAST)
        assert counts["clips"] == 4
    store = open_store(tmp_path / "a" / "clips", HANDS)
    assert store.ids == ["toy/s3/5~0", "toy/s3/5~1", "toy/s3/6~0", "toy/s3/6~1"]
    assert store.clip("toy/s3/6~1").n_frames == 33
    targets = read_target_contact(tmp_path / "a" / "clips")
    assert list(targets) == store.ids
    assert all(contact_map.shape == (1024,) and contact_map.any() for contact_map in targets.values())
    figures = json.loads((tmp_path / "a" / "diagnostics.json").read_text())
    assert {"f1", "f1_mean_map", "f1_mean_map_by_index", "f1_mean_map_by_position"} <= set(figures["contact"])
    # Training lengths 24, 32, 28 with mean 28; test lengths 24 and 33.
    assert figures["length"]["mae_mean_length_frames"] == pytest.approx(4.5)
    assert figures["contact"]["f1_margin"] == pytest.approx(
        figures["contact"]["f1"] - figures["contact"]["f1_mean_map"], abs=2e-6
    )
    for path in sorted((tmp_path / "a").rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes(), path


def test_families_report_the_sampled_contact_map(
    sources: Sources, annotated_root: Path, trained: Path, tmp_path: Path
) -> None:
    requests = requests_for(samples_of(sources.annotated, "test")[0], PredictionConfig(samples=2))
    model = load_family("text2hoi").load(sources)
    sampled_maps = [answer.touched.numpy() for answer in model.answers(requests)]
    for family in ("text2hoi", "text2hoi-coarse"):
        sampler = load_family(family).load(sources)
        np.testing.assert_array_equal(sampler.sample_with_targets(requests)[1], sampled_maps)
    sample_family(load_family("nearest-clip"), annotated_root, trained, tmp_path / "a", {"samples": 1}, HANDS)
    assert read_target_contact(tmp_path / "a" / "clips") == {}


def test_a_family_that_cannot_answer_gives_the_reason(annotated_root: Path, trained: Path, tmp_path: Path) -> None:
    counts = sample_family(load_family("text2hoi"), annotated_root, tmp_path, tmp_path / "a", {}, HANDS)
    assert counts == {"clips": 0}
    note = json.loads((tmp_path / "a" / "empty.json").read_text())
    assert note == {"reason": "not trained: contact, length, diffusion, refiner"}
    with pytest.raises(BadInput, match="samples"):
        sample_family(load_family("text2hoi"), annotated_root, trained, tmp_path / "a", {"sample": 3}, HANDS)


def test_f1_is_the_harmonic_mean_of_precision_and_recall() -> None:
    predicted, true = np.array([1, 1, 1, 1, 0], bool), np.array([1, 1, 0, 1, 1], bool)
    precision, recall = 3 / 4, 3 / 4
    assert f1_score(predicted, true) == pytest.approx(2 * precision * recall / (precision + recall))
    assert f1_score(np.array([1, 0, 0], bool), np.array([1, 1, 1], bool)) == pytest.approx(2 * 1 * (1 / 3) / (4 / 3))
    nothing = np.zeros(5, bool)
    assert f1_score(nothing, nothing) == 1
    assert f1_score(predicted, nothing) == 0


def test_the_best_threshold_separates_the_maps() -> None:
    probabilities = np.array([[0.1, 0.4, 0.62, 0.9], [0.2, 0.3, 0.7, 0.8]])
    true = np.array([[0, 0, 1, 1], [0, 0, 1, 1]], bool)
    best = best_threshold(probabilities, true)
    assert best == pytest.approx(0.45)
    assert mean_f1(probabilities, true, best) == 1
    assert mean_f1(probabilities, true, 0.65) == pytest.approx((2 / 3 + 1) / 2)


def test_the_mean_map_by_position_reads_the_nearest_training_points() -> None:
    cloud = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    mean_map = mean_map_by_position(np.array([[0.9, 0, 0], [0.1, 0, 0]]), [cloud, cloud], np.array([[1, 0], [1, 1]]))
    np.testing.assert_allclose(mean_map, [0.5, 1.0])
