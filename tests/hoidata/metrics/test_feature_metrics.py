"""Feature metrics against closed forms, explicit loops, and theory for random guessing and small sets."""

import statistics
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hoidata.metrics.encoded import UNKNOWN, EncodedSet
from hoidata.metrics.feature_metrics import FEATURE_METRICS, feature_results
from hoidata.metrics.feature_sets import (
    TOO_SMALL,
    FeatureMetricResult,
    fid_frechet,
    fid_paired,
    frechet_distance,
    kid,
    mean_matrix,
    mean_of_pairs,
    mean_with_itself,
)
from hoidata.metrics.unmeasured import Unmeasured

CLIPS, LABELS = 60, ("close", "lift", "open")


def encoded(features, samples=1, encoder="corrected", seed=0, **changes) -> EncodedSet:
    """One row per clip and sample, all first samples first; distant sentences and uninformative logits."""
    rows = len(features)
    clip = np.tile(np.arange(rows // samples), samples)
    random = np.random.default_rng(seed)
    encoding = EncodedSet(
        encoder=encoder,
        digest="digest",
        labels=LABELS,
        features=np.asarray(features, np.float64),
        logits=random.normal(size=(rows, len(LABELS))),
        label=clip % len(LABELS),
        clip=clip,
        sample=np.repeat(np.arange(samples), rows // samples),
        prompt=np.array([f"verb {number}" for number in clip]),
        object=np.array([f"object {number % 4}" for number in clip]),
        group=np.array([f"sequence {number // 2}" for number in clip]),
    )
    return replace(encoding, **changes)


def measured_features(*sets) -> dict[str, FeatureMetricResult]:
    """The results of ``feature_results`` without unmeasured metrics."""
    return {name: result for name, result in feature_results(*sets).items() if isinstance(result, FeatureMetricResult)}


def normal(rows, size=4, seed=0, shift=0.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, size)) + shift


def test_the_frechet_distance_of_gaussians_that_share_axes_is_the_closed_form():
    rotation = np.linalg.qr(normal(5, 5))[0]
    one, other = np.array([4.0, 1.0, 0.25, 0.0, 9.0]), np.array([1.0, 1.0, 4.0, 2.25, 0.0])
    mean, other_mean = normal(2, 5, seed=1)
    expected = np.square(mean - other_mean).sum() + np.square(np.sqrt(one) - np.sqrt(other)).sum()
    covariances = [rotation * values @ rotation.T for values in (one, other)]
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


def test_the_distance_of_halves_of_a_gaussian_shrinks_with_size_as_in_theory():
    size, results = 8, {}
    for rows in (64, 256, 1024):
        draws = [fid_frechet(normal(rows, size, seed), normal(rows, size, 1000 + seed)) for seed in range(30)]
        results[rows] = np.mean(draws)
        # Leading order in 1 / N: 2 tr C / N of the means, D (D + 1) / 2 N of the covariances.
        assert results[rows] == pytest.approx((2 * size + size * (size + 1) / 2) / rows, rel=0.15)
    assert results[64] > 3 * results[256] > 9 * results[1024]


def test_a_frechet_distance_below_four_clips_per_feature_is_refused_with_a_reason():
    assert fid_frechet(normal(31, 8), normal(64, 8)) is None
    assert fid_frechet(normal(64, 8), normal(31, 8)) is None
    assert fid_frechet(normal(32, 8), normal(32, 8)) is not None
    few, many = encoded(normal(20, 8)), encoded(normal(200, 8))
    results = measured_features(few, few, many)
    for name in ("fid_frechet_corrected", "fid_frechet_train_corrected", "fid_frechet_floor_corrected"):
        assert (results[name].value, results[name].note) == (None, TOO_SMALL)


def test_equal_repetitions_do_not_make_a_set_large_enough():
    few, many = normal(20, 8), encoded(normal(200, 8))
    copies = encoded(np.tile(few, (4, 1)), samples=4)
    result = measured_features(copies, encoded(few), many)["fid_frechet_train_corrected"]
    assert (result.value, result.note) == (None, TOO_SMALL)


def test_repetitions_of_few_clips_are_pooled_against_the_training_clips():
    few, many = encoded(normal(40, 4), samples=4), encoded(normal(200, 4))
    results = measured_features(few, encoded(normal(10, 4)), many)["fid_frechet_train_corrected"]
    assert results.value == pytest.approx(fid_frechet(few.features, many.features))
    assert results.note == "all repetitions together"


def test_the_paired_distance_is_the_released_formula():
    one, other = normal(6, 5), normal(6, 5, seed=1)
    for row, paired, value in zip(one, other, fid_paired(one, other), strict=True):
        square = sum((a - b) ** 2 for a, b in zip(row, paired, strict=True))
        assert value == pytest.approx(square + (statistics.stdev(row) - statistics.stdev(paired)) ** 2)
    results = measured_features(encoded(other), encoded(one))["fid_paired_corrected"]
    assert results.value == pytest.approx(fid_paired(one, other).mean())
    assert results.bootstrap.low < results.value < results.bootstrap.high


def test_the_kernel_distance_is_the_unbiased_double_sum():
    one, other = normal(7, 3), normal(9, 3, seed=1)
    kernel = lambda a, b: (a @ b / 3 + 1) ** 3  # noqa: E731
    within = [np.mean([kernel(a, b) for i, a in enumerate(s) for j, b in enumerate(s) if i != j]) for s in (one, other)]
    across = np.mean([kernel(a, b) for a in one for b in other])
    assert kid(one, other) == pytest.approx(sum(within) - 2 * across)
    truth = encoded(one)
    assert measured_features(truth, truth)["kid_corrected"].value == 0
    draws = np.array([kid(normal(20, 3, 2 * seed), normal(20, 3, 2 * seed + 1)) for seed in range(400)])
    assert abs(draws.mean()) < 3 * draws.std() / 20
    assert (draws < 0).any()


def test_diversity_uses_all_pairs_and_the_released_one_pairs_a_clip_with_itself():
    features = normal(CLIPS, 4)
    apart = [np.linalg.norm(a - b) for i, a in enumerate(features) for b in features[:i]]
    predicted = encoded(np.tile(features, (40, 1)), samples=40, encoder="paper")
    results = measured_features(predicted, encoded(features, encoder="paper"))
    assert results["diversity_paper"].value == pytest.approx(np.mean(apart))
    assert results["diversity_released_paper"].value == pytest.approx((1 - 1 / CLIPS) * np.mean(apart), rel=0.02)


def test_a_collapsed_system_has_no_diversity_and_one_motion_per_prompt_no_multimodality_by_prompt():
    one = encoded(np.tile(normal(1, 4), (CLIPS, 1)))
    results = measured_features(one, encoded(normal(CLIPS, 4)))
    assert results["diversity_corrected"].value == 0
    assert "multimodality_by_prompt_corrected" not in results


def test_multimodality_by_label_skips_labels_of_one_clip_with_a_note():
    features, label = normal(5, 3), np.array([0, 0, 0, 1, UNKNOWN])
    truth = encoded(features, label=label)
    results = measured_features(truth, truth)["multimodality_by_label_corrected"]
    pairs = [np.linalg.norm(features[i] - features[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert results.value == pytest.approx(np.mean(pairs))
    assert results.note == "1 label of one clip left out"


def test_multimodality_by_prompt_uses_the_motions_of_one_clip():
    features = normal(6, 3)
    results = measured_features(encoded(features, samples=3), encoded(normal(2, 3)))[
        "multimodality_by_prompt_corrected"
    ]
    apart = lambda *rows: np.linalg.norm(features[rows[0]] - features[rows[1]])  # noqa: E731
    each = [
        np.mean([apart(start, start + 2), apart(start, start + 4), apart(start + 2, start + 4)]) for start in (0, 1)
    ]
    assert results.value == pytest.approx(np.mean(each))
    assert (results.clips, results.motions) == (2, 6)


def test_accuracy_counts_ties_as_misses_and_skips_untrained_labels():
    logits = np.array([[3.0, 1.0, 2.0], [3.0, 1.0, 2.0], [0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    motions = encoded(normal(4), logits=logits, label=np.array([0, 2, 1, UNKNOWN]))
    results = measured_features(motions, motions)
    assert results["accuracy_top1_corrected"].value == pytest.approx(1 / 3)
    assert results["accuracy_top1_corrected"].clips == 3
    assert results["accuracy_top3_corrected"].value == 1


def with_text(features, text, **changes) -> EncodedSet:
    return encoded(
        features, encoder="text-motion", text=np.asarray(text), logits=np.zeros((len(features), 0)), **changes
    )


def test_r_precision_is_one_for_matching_features_and_chance_for_random_ones():
    text = normal(400, 6)
    right = with_text(text, text)
    results = measured_features(right, right)
    assert results["r_precision_top1_text_motion"].value == results["r_precision_hard_top1_text_motion"].value == 1
    assert results["matching_distance_text_motion"].value == 0
    random = with_text(normal(400, 6, seed=1), text)
    results = measured_features(random, right)
    for k in (1, 2, 3):
        chance = results[f"r_precision_top{k}_floor_text_motion"].value
        assert chance == pytest.approx(k / 32)
        sigma = np.sqrt(chance * (1 - chance) / 400)
        assert abs(results[f"r_precision_top{k}_text_motion"].value - chance) < 3 * sigma


def test_groups_have_distinct_sentences_and_shrink_if_there_are_fewer():
    text = normal(30, 6)
    prompts = np.array([f"verb {number % 5}" for number in range(30)])
    motions = with_text(text[np.arange(30) % 5], text[np.arange(30) % 5], prompt=prompts)
    results = measured_features(motions, motions)
    assert results["r_precision_top1_text_motion"].value == 1
    assert results["r_precision_top1_floor_text_motion"].value == pytest.approx(1 / 5)
    assert results["r_precision_top1_text_motion"].note == "groups of 5"


def test_a_tie_with_another_sentence_is_a_miss():
    motions = with_text(normal(8, 6), np.ones((8, 6)))
    assert measured_features(motions, motions)["r_precision_top3_text_motion"].value == 0


def test_hard_groups_have_sentences_about_the_same_object():
    text = normal(8, 6)
    wrong = with_text(np.roll(text, 4, axis=0), text)  # 4 objects: clip n sits at the sentence of n + 4, of its object
    results = measured_features(wrong, wrong)
    assert results["r_precision_hard_top1_text_motion"].value == 0
    assert results["r_precision_hard_top2_text_motion"].value == 1
    assert results["r_precision_hard_top1_text_motion"].note == "groups of 2"


def test_copies_of_training_clips_are_memorised_and_recorded_clips_are_not():
    features, truth = normal(CLIPS, 4), normal(CLIPS, 4, seed=1)
    train, test = encoded(features, encoder="path"), encoded(truth, encoder="path")
    name = "memorised_share_path"
    assert measured_features(test, test, train)[name].value == 0
    assert measured_features(encoded(features + 1e-3, encoder="path"), test, train)[name].value > 0.9
    assert name not in measured_features(test, test)


def test_the_order_of_clips_changes_no_result():
    predicted, truth = encoded(normal(3 * CLIPS, 4), samples=3), encoded(normal(CLIPS, 4, seed=1))
    order, other = np.random.default_rng(2).permutation(3 * CLIPS), np.random.default_rng(3).permutation(CLIPS)
    results = measured_features(predicted, truth, truth)
    again = measured_features(predicted.take(order), truth.take(other), truth)
    assert results.keys() == again.keys()
    for name, figure in results.items():
        assert figure.value == pytest.approx(again[name].value), name


def test_results_are_inside_their_intervals_over_clips():
    predicted = encoded(normal(4 * CLIPS, 4, shift=0.3), samples=4)
    results = measured_features(predicted, encoded(normal(CLIPS, 4, seed=1)), encoded(normal(200, 4, seed=2)))
    inside = [name for name, figure in results.items() if figure.bootstrap is not None]
    assert {"fid_frechet_corrected", "kid_corrected", "diversity_corrected", "accuracy_top1_corrected"} <= set(inside)
    for name in inside:
        assert results[name].bootstrap.low <= results[name].value <= results[name].bootstrap.high, name


def test_features_of_different_weights_are_refused():
    motions = encoded(normal(8))
    with pytest.raises(ValueError, match="different encoders"):
        measured_features(motions, replace(motions, digest="other"))


def test_every_feature_metric_is_registered_once_and_lower_bounds_have_their_metric():
    names = [item.name for item in FEATURE_METRICS]
    assert len(set(names)) == len(names) == len({item.title for item in FEATURE_METRICS})
    assert {item.floor_of for item in FEATURE_METRICS if item.floor_of} <= set(names)


def test_unmeasured_feature_metrics_have_a_reason():
    one = encoded(normal(CLIPS, 4), encoder="path")
    assert feature_results(one, one)["memorised_share_path"] == Unmeasured("there are no training clips")
    train = encoded(normal(5, 3), label=np.array([0, 0, 1, UNKNOWN, UNKNOWN]))
    results = feature_results(train, train)
    assert results["accuracy_top1_corrected"].without == "the verb is in no training clip"
    assert results["accuracy_top1_corrected"].clips == 3
    assert results["multimodality_by_prompt_corrected"] == Unmeasured("the clip has one motion")
    alone = encoded(normal(2, 3), label=np.array([0, 1]))
    assert feature_results(alone, alone)["multimodality_by_label_corrected"] == Unmeasured("no label has two clips")


def test_clips_that_share_no_repetition_have_no_distance():
    """Clips 0 and 1 are in one repetition only, clips 2 and 3 in the other; within each, all pairs are 10 apart."""
    runs = [SimpleNamespace(clip=np.array(pair)) for pair in ([0, 1], [2, 3])]
    matrix = mean_matrix(SimpleNamespace(clips=np.arange(4), repetitions=runs), lambda run: 10 - 10 * np.eye(2))
    assert np.isnan(matrix[:2, 2:]).all()
    weights = np.array([[1.0, 1, 1, 1], [2, 0, 1, 1], [1, 0, 1, 0]])
    np.testing.assert_array_equal(mean_of_pairs(matrix, weights), [10, 10, np.nan])
    np.testing.assert_array_equal(mean_with_itself(matrix, weights), [5, 2.5, 0])
