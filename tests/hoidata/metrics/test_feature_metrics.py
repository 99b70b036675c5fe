"""Figures of features against closed forms, explicit loops and what theory says of chance and of few clips."""

import statistics
from dataclasses import replace

import numpy as np
import pytest

from hoidata.metrics.encoded import UNKNOWN, EncodedSet
from hoidata.metrics.feature_measures import ranks
from hoidata.metrics.feature_metrics import FEATURE_METRICS, feature_findings
from hoidata.metrics.feature_sets import TOO_SMALL, FeatureFigure, fid_frechet, fid_paired, frechet_distance, kid
from hoidata.metrics.unmeasured import Unmeasured

CLIPS, LABELS = 60, ("close", "lift", "open")


def encoded(features, samples=1, encoder="corrected", seed=0, **changes) -> EncodedSet:
    """One row per clip and sample, all of the first sample first; sentences far apart, logits that know nothing."""
    rows = len(features)
    clip = np.tile(np.arange(rows // samples), samples)
    random = np.random.default_rng(seed)
    made = EncodedSet(
        encoder,
        "digest",
        LABELS,
        np.asarray(features, np.float64),
        random.normal(size=(rows, len(LABELS))),
        clip % len(LABELS),
        clip,
        np.repeat(np.arange(samples), rows // samples),
        np.array([f"verb {number}" for number in clip]),
        np.array([f"object {number % 4}" for number in clip]),
        np.array([f"sequence {number // 2}" for number in clip]),
    )
    return replace(made, **changes)


def feature_figures(*sets) -> dict[str, FeatureFigure]:
    """What ``feature_findings`` gives, without figures that could not be measured."""
    return {name: own for name, own in feature_findings(*sets).items() if isinstance(own, FeatureFigure)}


def normal(rows, size=4, seed=0, shift=0.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, size)) + shift


def test_the_frechet_distance_of_gaussians_that_share_axes_is_the_closed_form():
    turn = np.linalg.qr(normal(5, 5))[0]
    one, other = np.array([4.0, 1.0, 0.25, 0.0, 9.0]), np.array([1.0, 1.0, 4.0, 2.25, 0.0])
    mean, other_mean = normal(2, 5, seed=1)
    expected = np.square(mean - other_mean).sum() + np.square(np.sqrt(one) - np.sqrt(other)).sum()
    covariances = [turn * values @ turn.T for values in (one, other)]
    assert frechet_distance(mean, covariances[0], other_mean, covariances[1]) == pytest.approx(expected, rel=1e-6)


def test_the_frechet_distance_of_gaussians_that_share_no_axes_is_the_closed_form_of_two_dimensions():
    root, other_root = normal(2, 2), normal(2, 2, seed=1)
    one, other = root @ root.T, other_root @ other_root.T
    product = one @ other
    expected = np.trace(one + other) - 2 * np.sqrt(np.trace(product) + 2 * np.sqrt(np.linalg.det(product)))
    zero = np.zeros(2)
    assert frechet_distance(zero, one, zero, other) == pytest.approx(expected, rel=1e-9)
    assert frechet_distance(zero, other, zero, one) == pytest.approx(expected, rel=1e-9)


def test_equal_sets_have_no_distance_and_a_shift_counts_squared():
    one = normal(64)
    assert fid_frechet(one, one) == pytest.approx(0, abs=1e-9)
    assert fid_frechet(one, one + 2.0) == pytest.approx(4 * 4)


def test_two_halves_of_one_gaussian_come_nearer_with_their_number_as_theory_says():
    size, found = 8, {}
    for rows in (64, 256, 1024):
        draws = [fid_frechet(normal(rows, size, seed), normal(rows, size, 1000 + seed)) for seed in range(30)]
        found[rows] = np.mean(draws)
        # Leading order in 1 / N: 2 tr C / N of the means, D (D + 1) / 2 N of the covariances.
        assert found[rows] == pytest.approx((2 * size + size * (size + 1) / 2) / rows, rel=0.15)
    assert found[64] > 3 * found[256] > 9 * found[1024]


def test_a_frechet_distance_of_less_than_four_clips_per_feature_is_refused_in_words():
    assert fid_frechet(normal(31, 8), normal(64, 8)) is None
    assert fid_frechet(normal(64, 8), normal(31, 8)) is None
    assert fid_frechet(normal(32, 8), normal(32, 8)) is not None
    few, many = encoded(normal(20, 8)), encoded(normal(200, 8))
    found = feature_figures(few, few, many)
    for name in ("fid_frechet_corrected", "fid_frechet_train_corrected", "fid_frechet_floor_corrected"):
        assert (found[name].value, found[name].note) == (None, TOO_SMALL)


def test_repetitions_of_few_clips_are_taken_together_against_the_training_clips():
    few, many = encoded(normal(40, 4), samples=4), encoded(normal(200, 4))
    found = feature_figures(few, encoded(normal(10, 4)), many)["fid_frechet_train_corrected"]
    assert found.value == pytest.approx(fid_frechet(few.features, many.features))
    assert found.note == "all repetitions together"


def test_the_paired_distance_is_the_released_formula():
    one, other = normal(6, 5), normal(6, 5, seed=1)
    for own, rival, value in zip(one, other, fid_paired(one, other), strict=True):
        apart = sum((a - b) ** 2 for a, b in zip(own, rival, strict=True))
        assert value == pytest.approx(apart + (statistics.stdev(own) - statistics.stdev(rival)) ** 2)
    found = feature_figures(encoded(other), encoded(one))["fid_paired_corrected"]
    assert found.value == pytest.approx(fid_paired(one, other).mean())
    assert found.bootstrap.low < found.value < found.bootstrap.high


def test_the_kernel_distance_is_the_unbiased_double_sum():
    one, other = normal(7, 3), normal(9, 3, seed=1)
    kernel = lambda a, b: (a @ b / 3 + 1) ** 3  # noqa: E731
    within = [np.mean([kernel(a, b) for i, a in enumerate(s) for j, b in enumerate(s) if i != j]) for s in (one, other)]
    across = np.mean([kernel(a, b) for a in one for b in other])
    assert kid(one, other) == pytest.approx(sum(within) - 2 * across)
    truth = encoded(one)
    assert feature_figures(truth, truth)["kid_corrected"].value == 0
    draws = np.array([kid(normal(20, 3, 2 * seed), normal(20, 3, 2 * seed + 1)) for seed in range(400)])
    assert abs(draws.mean()) < 3 * draws.std() / 20
    assert (draws < 0).any()


def test_diversity_is_over_all_pairs_and_the_released_one_lets_a_clip_meet_itself():
    features = normal(CLIPS, 4)
    apart = [np.linalg.norm(a - b) for i, a in enumerate(features) for b in features[:i]]
    predicted = encoded(np.tile(features, (40, 1)), samples=40, encoder="paper")
    found = feature_figures(predicted, encoded(features, encoder="paper"))
    assert found["diversity_paper"].value == pytest.approx(np.mean(apart))
    assert found["diversity_released_paper"].value == pytest.approx((1 - 1 / CLIPS) * np.mean(apart), rel=0.02)


def test_a_collapsed_system_has_no_diversity_and_one_motion_per_prompt_no_multimodality_by_prompt():
    one = encoded(np.tile(normal(1, 4), (CLIPS, 1)))
    found = feature_figures(one, encoded(normal(CLIPS, 4)))
    assert found["diversity_corrected"].value == 0
    assert "multimodality_by_prompt_corrected" not in found


def test_multimodality_by_label_leaves_out_a_label_of_one_clip_and_says_so():
    features, label = normal(5, 3), np.array([0, 0, 0, 1, UNKNOWN])
    truth = encoded(features, label=label)
    found = feature_figures(truth, truth)["multimodality_by_label_corrected"]
    pairs = [np.linalg.norm(features[i] - features[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert found.value == pytest.approx(np.mean(pairs))
    assert found.note == "1 label of one clip left out"


def test_multimodality_by_prompt_is_over_the_motions_made_for_one_clip():
    features = normal(6, 3)
    found = feature_figures(encoded(features, samples=3), encoded(normal(2, 3)))["multimodality_by_prompt_corrected"]
    apart = lambda *rows: np.linalg.norm(features[rows[0]] - features[rows[1]])  # noqa: E731
    each = [
        np.mean([apart(start, start + 2), apart(start, start + 4), apart(start + 2, start + 4)]) for start in (0, 1)
    ]
    assert found.value == pytest.approx(np.mean(each))
    assert (found.clips, found.motions) == (2, 6)


def test_accuracy_counts_ties_as_misses_and_leaves_labels_out_that_were_never_learnt():
    logits = np.array([[3.0, 1.0, 2.0], [3.0, 1.0, 2.0], [0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    own = encoded(normal(4), logits=logits, label=np.array([0, 2, 1, UNKNOWN]))
    found = feature_figures(own, own)
    assert found["accuracy_top1_corrected"].value == pytest.approx(1 / 3)
    assert found["accuracy_top1_corrected"].clips == 3
    assert found["accuracy_top3_corrected"].value == 1


def test_a_duplicate_of_the_own_sentence_is_a_hit_and_a_tie_with_another_is_none():
    distance = np.array([[0.5, 0.1, 0.9], [0.5, 0.1, 0.9], [0.1, 0.1, 0.9]])
    own = np.array([[True, True, False], [True, False, False], [True, False, False]])
    assert ranks(distance, own).tolist() == [0, 1, 1]


def with_text(features, text, **changes) -> EncodedSet:
    return encoded(
        features, encoder="text-motion", text=np.asarray(text), logits=np.zeros((len(features), 0)), **changes
    )


def test_motions_at_their_own_sentence_are_all_found_and_random_ones_as_often_as_chance():
    text = normal(400, 6)
    right = with_text(text, text)
    found = feature_figures(right, right)
    assert found["r_precision_top1_text_motion"].value == found["r_precision_hard_top1_text_motion"].value == 1
    assert found["matching_distance_text_motion"].value == 0
    random = with_text(normal(400, 6, seed=1), text)
    found = feature_figures(random, right)
    for k in (1, 2, 3):
        chance = found[f"r_precision_top{k}_floor_text_motion"].value
        assert chance == pytest.approx(k / 32)
        sigma = np.sqrt(chance * (1 - chance) / 400)
        assert abs(found[f"r_precision_top{k}_text_motion"].value - chance) < 3 * sigma


def test_groups_hold_distinct_sentences_only_and_shrink_where_there_are_fewer():
    text = normal(30, 6)
    prompts = np.array([f"verb {number % 5}" for number in range(30)])
    own = with_text(text[np.arange(30) % 5], text[np.arange(30) % 5], prompt=prompts)
    found = feature_figures(own, own)
    assert found["r_precision_top1_text_motion"].value == 1
    assert found["r_precision_top1_floor_text_motion"].value == pytest.approx(1 / 5)
    assert found["r_precision_top1_text_motion"].note == "groups of 5"


def test_hard_groups_hold_sentences_about_the_same_object():
    text = normal(8, 6)
    wrong = with_text(np.roll(text, 4, axis=0), text)  # 4 objects: clip n sits at the sentence of n + 4, of its object
    found = feature_figures(wrong, wrong)
    assert found["r_precision_hard_top1_text_motion"].value == 0
    assert found["r_precision_hard_top2_text_motion"].value == 1
    assert found["r_precision_hard_top1_text_motion"].note == "groups of 2"


def test_motions_that_are_training_clips_are_memorised_and_the_truth_is_not():
    train, truth = normal(CLIPS, 4), normal(CLIPS, 4, seed=1)
    known, test = encoded(train, encoder="path"), encoded(truth, encoder="path")
    name = "memorised_share_path"
    assert feature_figures(test, test, known)[name].value == 0
    assert feature_figures(encoded(train + 1e-3, encoder="path"), test, known)[name].value > 0.9
    assert name not in feature_figures(test, test)


def test_the_order_of_clips_changes_no_figure():
    predicted, truth = encoded(normal(3 * CLIPS, 4), samples=3), encoded(normal(CLIPS, 4, seed=1))
    order, other = np.random.default_rng(2).permutation(3 * CLIPS), np.random.default_rng(3).permutation(CLIPS)
    found = feature_figures(predicted, truth, truth)
    again = feature_figures(predicted.take(order), truth.take(other), truth)
    assert found.keys() == again.keys()
    for name, figure in found.items():
        assert figure.value == pytest.approx(again[name].value), name


def test_figures_stand_inside_their_intervals_over_clips():
    predicted = encoded(normal(4 * CLIPS, 4, shift=0.3), samples=4)
    found = feature_figures(predicted, encoded(normal(CLIPS, 4, seed=1)), encoded(normal(200, 4, seed=2)))
    inside = [name for name, figure in found.items() if figure.bootstrap is not None]
    assert {"fid_frechet_corrected", "kid_corrected", "diversity_corrected", "accuracy_top1_corrected"} <= set(inside)
    for name in inside:
        assert found[name].bootstrap.low <= found[name].value <= found[name].bootstrap.high, name


def test_features_of_other_weights_are_refused():
    own = encoded(normal(8))
    with pytest.raises(ValueError, match="different encoders"):
        feature_figures(own, replace(own, digest="other"))


def test_every_figure_is_registered_once_and_floors_have_their_metric():
    names = [item.name for item in FEATURE_METRICS]
    assert len(set(names)) == len(names) == len({item.title for item in FEATURE_METRICS})
    assert {item.floor_of for item in FEATURE_METRICS if item.floor_of} <= set(names)


def test_figures_of_features_that_could_not_be_measured_have_a_reason():
    one = encoded(normal(CLIPS, 4), encoder="path")
    assert feature_findings(one, one)["memorised_share_path"] == Unmeasured("there are no training clips")
    known = encoded(normal(5, 3), label=np.array([0, 0, 1, UNKNOWN, UNKNOWN]))
    found = feature_findings(known, known)
    assert found["accuracy_top1_corrected"].without == "the verb is in no training clip"
    assert found["accuracy_top1_corrected"].clips == 3
    assert found["multimodality_by_prompt_corrected"] == Unmeasured("the clip has one motion")
    alone = encoded(normal(2, 3), label=np.array([0, 1]))
    assert feature_findings(alone, alone)["multimodality_by_label_corrected"] == Unmeasured("no label has two clips")
