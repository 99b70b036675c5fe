"""Evaluation of stores: which clips are compared, how values are reduced to results, which clips are skipped."""

import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from hoidata.clips import SIDES
from hoidata.contact.proximity import ProximityIndex
from hoidata.errors import BadInput
from hoidata.files.arrays import write_npz
from hoidata.hands import load_embedded_hands
from hoidata.metrics import registry
from hoidata.metrics.describe import readme
from hoidata.metrics.evaluate import ClipResult, Sample, _Reference, evaluate_store, intervals_of, match_predictions
from hoidata.metrics.optional_metrics import select_metrics
from hoidata.metrics.pair import Motion
from hoidata.metrics.registry import METRICS, is_better, metric, summarise
from hoidata.metrics.target_contact import FILE_NAME, write_target_contact
from hoidata.objects.sampling import sample_points
from hoidata.store.annotated import load_annotated
from hoidata.store.distances import DistanceEntries
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from tests.builders.annotated import write_annotated_dataset

RIGHT, BOTH = "toy/s3/2", "toy/s3/3"


def written(folder: Path, clips) -> Path:
    write_store(folder, clips, generated_info("predicted"))
    return folder


def named(clip, clip_id, **changes):
    return replace(clip, clip_id=clip_id, **changes)


def test_intervals_contain_the_value_of_their_metric(write_annotated, moved, tmp_path):
    root, clips = write_annotated()
    predicted = [named(moved(c, (0, 0.01 * k, 0)), f"{c.clip_id}~{k}") for c in clips.values() for k in range(3)]
    evaluation = evaluate_store(written(tmp_path / "three", predicted), root)
    assert set(evaluation["intervals"]) <= set(evaluation["figures"])
    for name, ends in evaluation["intervals"].items():
        for low, high in ends.values():
            assert low - 1e-6 <= evaluation["figures"][name] <= high + 1e-6, name


def test_recorded_clips_have_no_error_and_full_contact(write_annotated, tmp_path):
    root, clips = write_annotated()
    evaluation = evaluate_store(written(tmp_path / "same", clips.values()), root)
    assert (evaluation["held_out_clips"], evaluation["motions"], evaluation["left_out"]) == (2, 2, [])
    assert evaluation["figures"]["joint_error_mm"] == 0
    assert evaluation["figures"]["contact_f1"] == 1
    assert set(evaluation["counts"]) == set(evaluation["figures"])
    assert evaluation["counts"]["joint_error_mm"] == {"clips": 2, "motions": 2, "values": 3 * 12}
    assert set(evaluation["figures"]) <= {item.name for item in METRICS}


def test_the_best_sample_of_each_clip_counts_for_joints_and_the_first_two_for_meshes(write_annotated, moved, tmp_path):
    root, clips = write_annotated()
    shifts = {RIGHT: (0.02, 0.03, 0.004), BOTH: (0.008, 0.05, 0.06)}
    predicted = [
        named(moved(clips[clip_id], (shift, 0, 0)), f"{clip_id}~{number}")
        for clip_id, values_of_clip in shifts.items()
        for number, shift in enumerate(values_of_clip)
    ]
    evaluation = evaluate_store(written(tmp_path / "three", predicted[::-1]), root)
    assert evaluation["figures"]["joint_error_mm"] == pytest.approx((4 + 8) / 2, abs=1e-3)
    assert evaluation["motions"] == 6
    assert evaluation["counts"]["penetration_mm"]["motions"] == 4
    two = evaluate_store(written(tmp_path / "two", [p for p in predicted if not p.clip_id.endswith("~2")]), root)
    for name in ("penetration_mm", "contact_distance_mm"):
        assert evaluation["figures"][name] == two["figures"][name]


def test_a_motion_under_another_clips_name_is_measured_against_that_clip(write_annotated, tmp_path):
    root, clips = write_annotated()
    swapped = [named(clips[RIGHT], f"{BOTH}~0"), named(clips[BOTH], f"{RIGHT}~0")]
    evaluation = evaluate_store(written(tmp_path / "swapped", swapped), root)
    assert evaluation["figures"]["joint_error_mm"] > 50
    assert evaluation["figures"]["contact_f1"] < 0.7


def test_left_and_right_hand_are_not_confused(write_annotated, moved, tmp_path):
    root, clips = write_annotated()
    predicted = moved(clips[RIGHT], (0, 0, 0.02), ["right"])
    evaluation = evaluate_store(written(tmp_path / "right", [predicted]), root)
    assert evaluation["figures"]["joint_error_mm"] == pytest.approx(20, abs=1e-3)
    predicted = moved(clips[RIGHT], (0, 0, 0.02), ["left"])
    evaluation = evaluate_store(written(tmp_path / "left", [predicted]), root)
    assert evaluation["figures"]["joint_error_mm"] == 0


def test_predictions_that_cannot_be_compared_are_listed_with_the_reason(write_annotated, make_clip, tmp_path):
    root, clips = write_annotated()
    clip, both = clips[RIGHT], clips[BOTH]
    short = named(clip.take(slice(0, 9)), f"{RIGHT}~1", source_frames=np.arange(70, 79, dtype=np.int32))
    handless = replace(both.hands["left"], valid=np.zeros(12, bool))
    other = make_clip(12, "both", articulated=True)
    predicted = [
        named(clip, f"{RIGHT}~0"),
        short,
        named(both, f"{BOTH}~0", hands=both.hands | {"left": handless}),
        named(other, f"{BOTH}~1"),
        named(clip, "toy/s1/0~0"),
        named(clip, f"{RIGHT}~x"),
    ]
    evaluation = evaluate_store(written(tmp_path / "odd", predicted), root)
    reasons = {item["clip_id"]: item["reason"] for item in evaluation["left_out"]}
    assert set(reasons) == {item.clip_id for item in predicted[1:]}
    assert reasons[f"{RIGHT}~1"].startswith("9 frames, 12 expected")
    assert "left hand" in reasons[f"{BOTH}~0"]
    assert "mesh" in reasons[f"{BOTH}~1"]
    assert evaluation["motions"] == 1


def test_a_clip_without_prediction_is_listed(write_annotated, tmp_path):
    root, clips = write_annotated()
    evaluation = evaluate_store(written(tmp_path / "one", [clips[RIGHT]]), root)
    assert evaluation["left_out"] == [{"clip_id": BOTH, "reason": "no prediction of this clip"}]
    assert evaluation["held_out_clips"] == 2


def test_a_store_without_comparable_clips_is_refused(write_annotated, make_clip, tmp_path):
    root, _ = write_annotated()
    with pytest.raises(BadInput, match=r"<id>~<k>.*unknown"):
        evaluate_store(written(tmp_path / "none", [make_clip(12, clip_id="toy/s9/unknown")]), root)


@pytest.mark.parametrize("start", [0, 4])
def test_a_prediction_of_part_of_the_frames_is_compared_with_that_part(write_annotated, tmp_path, start):
    root, clips = write_annotated()
    part = clips[RIGHT].take(slice(start, start + 7))
    evaluation = evaluate_store(written(tmp_path / "part", [part]), root)
    assert evaluation["figures"]["joint_error_mm"] == 0
    assert evaluation["figures"]["contact_f1"] == 1
    assert evaluation["counts"]["joint_error_mm"]["values"] == 7


@pytest.mark.parametrize("first", [0, 1, 5, 12])
def test_a_motion_numbered_from_zero_starts_at_the_first_frame_of_any_recording(
    write_annotated, make_clip, tmp_path, first
):
    def longer(clip):
        return replace(clip, source_frames=clip.source_frames + np.int32(first))

    root, clips = write_annotated_dataset(
        tmp_path / "later", lambda *args, **kwargs: longer(make_clip(*args, **kwargs))
    )
    part = [replace(clip.take(slice(0, 9)), source_frames=np.arange(9, dtype=np.int32)) for clip in clips.values()]
    evaluation = evaluate_store(written(tmp_path / "part", part), root)
    assert (evaluation["motions"], evaluation["left_out"]) == (2, [])
    assert evaluation["figures"]["joint_error_mm"] == 0


def test_a_touch_in_a_frame_that_was_not_recorded_is_no_contact_of_the_reference(make_clip):
    """Frame 2 is interpolated, the right hand is not tracked in frame 3, and the left hand does not act."""
    clip = make_clip(6, "both")
    right = replace(clip.hands["right"], valid=np.arange(6) != 3)
    frames = np.array([0, 1, 1, 3, 4, 5], np.int32)
    clip = replace(clip, source_frames=frames, hands={**clip.hands, "right": right})
    columns = np.array([[1, 1, 1, 1, 0], [1, 2, 3, 5, 1], [0, 0, 0, 0, 0], [3, 5, 7, 9, 11]])
    points = sample_points(clip.object.model, 256)
    reference = _Reference(
        motion=Motion(clip, {side: np.zeros((6, 21, 3)) for side in SIDES}, load_embedded_hands()),
        sides=("right",),
        entries=DistanceEntries(*columns, np.full(5, 0.01)),
        index=ProximityIndex(points),
        part=points.part,
        threshold_m=0.02,
        table_m=None,
        verb=None,
    )
    assert np.flatnonzero(reference.cut(0, 6)[1].touched).tolist() == [3, 9]


def test_evaluation_uses_threshold_and_points_of_the_contact_stage(write_annotated, tmp_path):
    def of(folder, **settings):
        root, clips = write_annotated(**settings)
        root = root.rename(tmp_path / folder)
        return evaluate_store(written(tmp_path / f"same-{folder}", clips.values()), root)

    wide, narrow = of("wide"), of("narrow", threshold_m=0.012, points=100)
    assert narrow["figures"]["contact_f1"] == 1
    counts = [evaluation["counts"]["contact_distance_mm"]["values"] for evaluation in (narrow, wide)]
    assert 0 < counts[0] < counts[1]


def test_intervals_over_repetitions_use_sample_k_of_all_clips_as_repetition_k(write_annotated, moved, tmp_path):
    root, clips = write_annotated()
    shifts = {RIGHT: (0.0, 0.02, 0.06), BOTH: (0.0, 0.03, 0.09)}
    predicted = [
        named(moved(clips[clip_id], (0, 0, shift)), f"{clip_id}~{number}")
        for clip_id, values_of_clip in shifts.items()
        for number, shift in enumerate(values_of_clip)
    ]
    evaluation = evaluate_store(written(tmp_path / "three", predicted), root)
    alone = [
        evaluate_store(written(tmp_path / f"only-{k}", predicted[k::3]), root)["figures"]["contact_f1"]
        for k in range(3)
    ]
    mean, half = np.mean(alone), 4.302653 * np.std(alone, ddof=1) / np.sqrt(3)  # Student's t, 2 degrees of freedom
    assert evaluation["figures"]["contact_f1"] == pytest.approx(mean, abs=1e-6)
    assert evaluation["intervals"]["contact_f1"]["repetitions"] == pytest.approx([mean - half, mean + half], abs=2e-5)
    assert "repetitions" not in evaluation["intervals"]["joint_error_mm"]  # the best of all has no spread over them
    one = evaluate_store(written(tmp_path / "one", predicted[::3]), root)
    assert not any("repetitions" in ends for ends in one["intervals"].values())


def test_the_bootstrap_resamples_source_sequences_with_all_their_samples(write_annotated, moved, tmp_path):
    root, clips = write_annotated()
    predicted = [
        named(moved(clip, (0, 0, shift)), f"{clip_id}~{number}")
        for clip_id, clip in clips.items()
        for number, shift in enumerate((0.01, 0.03))
    ]
    evaluation = evaluate_store(written(tmp_path / "two", predicted), root)
    # Two sequences: half of the resamples have one of each, a quarter each twice the same.
    each = [
        evaluate_store(written(tmp_path / clip_id[-1], [p for p in predicted if p.clip_id.startswith(clip_id)]), root)
        for clip_id in clips
    ]
    for name in ("jitter_m_s3", "contact_f1"):
        ends = sorted(one["figures"][name] for one in each)
        assert evaluation["intervals"][name]["clips"] == pytest.approx(ends, abs=2e-6)
    assert not any("clips" in ends for ends in each[0]["intervals"].values())


def test_clips_of_one_source_sequence_are_resampled_together():
    def clip(group, value):
        return ClipResult(group, [Sample(0, {"jitter_m_s3": np.array([value])})], [])

    values = {"a": (1.0, 3.0), "b": (7.0, 9.0)}
    apart = [
        clip(f"{name}{number}", value)
        for name, values_of_clip in values.items()
        for number, value in enumerate(values_of_clip)
    ]
    together = [clip(name, value) for name, values_of_clip in values.items() for value in values_of_clip]
    assert intervals_of(metric("jitter_m_s3"), together) == {"clips": [2.0, 8.0]}  # one sequence twice, or the other
    low, high = intervals_of(metric("jitter_m_s3"), apart)["clips"]
    assert 1 < low < 5 < high < 9
    assert intervals_of(metric("jitter_m_s3"), together[:2]) == {}


@pytest.mark.long
def test_results_do_not_depend_on_the_number_of_processes(write_annotated, moved, tmp_path, monkeypatch):
    monkeypatch.setattr("hoidata.metrics.evaluate.WORKERS_PAY_FROM", 0)
    root, clips = write_annotated()
    predicted = [named(moved(c, (0, 0.01 * k, 0)), f"{c.clip_id}~{k}") for c in clips.values() for k in range(2)]
    store = written(tmp_path / "two", predicted)
    one, two = (evaluate_store(store, root, jobs=jobs) for jobs in (1, 2))
    assert json.dumps(one) == json.dumps(two)


def test_target_contact_maps_are_read_per_motion(write_annotated, tmp_path):
    root, clips = write_annotated()
    first, second = (named(clips[RIGHT], f"{RIGHT}~{number}") for number in range(2))
    store = written(tmp_path / "mine" / "clips", [first, second, clips[BOTH]])
    assert "adherence" not in evaluate_store(store, root)["figures"]
    true = load_annotated(root).contact_of(RIGHT, "right") > 0
    for targets, adherence in (([(first, true)], 1), ([(first, ~true)], 0), ([(first, true), (second, ~true)], 0.5)):
        write_target_contact(store.parent, {motion.clip_id: target for motion, target in targets})
        evaluation = evaluate_store(store, root)
        assert evaluation["figures"]["adherence"] == adherence
        assert evaluation["counts"]["adherence"] == {"clips": 1, "motions": len(targets), "values": len(targets)}
    write_target_contact(store.parent, {first.clip_id: true[:-1]})
    reasons = {item["clip_id"]: item["reason"] for item in evaluate_store(store, root)["left_out"]}
    assert reasons == {first.clip_id: "the target contact map has 255 points, 256 expected"}
    write_npz(store.parent / FILE_NAME, {"motion_id": np.array([RIGHT]), "asked": true})
    with pytest.raises(BadInput, match="motion_id"):
        evaluate_store(store, root)


def test_motions_of_estimated_length_are_not_compared_frame_by_frame(write_annotated, make_clip, tmp_path):
    root, clips = write_annotated()
    clip = clips[RIGHT]
    longer = clip.take(np.minimum(np.arange(15), 11))
    longer = replace(longer, source_frames=np.arange(15, dtype=np.int32))
    handless = named(clips[BOTH], f"{BOTH}~1", hands=clips[BOTH].hands | {"left": absent(clips[BOTH].hands["left"])})
    predicted = [named(clip.take(slice(0, 10)), f"{RIGHT}~0"), named(longer, f"{RIGHT}~1"), clips[BOTH], handless]
    folder = tmp_path / "own"
    write_store(folder, predicted, generated_info("predicted", length="own"))
    evaluation = evaluate_store(folder, root)
    assert (evaluation["length"], evaluation["motions"]) == ("own", 3)
    assert [item["clip_id"] for item in evaluation["left_out"]] == [f"{BOTH}~1"]
    figures = evaluation["figures"]
    assert figures["length_error_frames"] == pytest.approx((2 + 3 + 0) / 3, abs=1e-6)
    assert figures["length_error_share"] == pytest.approx((2 + 3 + 0) / 3 / 12, abs=1e-6)
    assert not {item.name for item in METRICS if item.aligned} & set(figures)
    assert {"contact_f1", "jitter_m_s3", "penetration_mm", "slip_cm_s"} <= set(figures)
    assert evaluation["counts"]["jitter_m_s3"]["values"] == (10 - 3) + (15 - 3) + 2 * (12 - 3)
    given_length = evaluate_store(written(tmp_path / "given", clips.values()), root)
    assert given_length["length"] == "given"
    assert "length_error_frames" not in given_length["figures"]


def absent(hand):
    return replace(hand, valid=np.zeros_like(hand.valid))


def test_a_motion_has_the_verb_of_its_reference_and_the_limits_are_reported(write_annotated, tmp_path):
    root, clips = write_annotated()
    evaluation = evaluate_store(written(tmp_path / "same", clips.values()), root)
    assert evaluation["actions"] == {"limits": [], "learnt": {}}  # too few training clips to learn from
    assert evaluation["figures"]["action_named"] == 1  # the one verb there is
    assert "action_followed" not in evaluation["figures"]


def test_samples_are_taken_in_the_order_of_their_numbers():
    ids = ["a~10", "a~2", "b~0", "a", "b~x", "c"]
    samples, skipped = match_predictions(ids, ["a", "b"])
    assert samples == {"a": [(0, "a"), (2, "a~2"), (10, "a~10")], "b": [(0, "b~0")]}
    assert [item.clip_id for item in skipped] == ["b~x", "c"]


def test_values_are_reduced_as_registered():
    clips = [[np.array([1.0, 3.0]), np.array([5.0, 5.0, 5.0])], [np.array([8.0])], [np.zeros(0)]]
    best = replace(metric("joint_error_mm"), reduction="best of a clip's samples")
    assert summarise(best, clips) == ((2 + 8) / 2, 2, 3, 6)
    assert summarise(replace(best, direction="higher"), clips)[0] == (5 + 8) / 2
    assert summarise(replace(best, reduction="mean over motions"), clips)[0] == (2 + 5 + 8) / 3
    assert summarise(replace(best, reduction="mean over frames"), clips)[0] == 27 / 6
    assert summarise(best, [[np.zeros(0)]]) is None


def test_better_follows_the_registered_direction():
    lower, higher = metric("joint_error_mm"), metric("contact_f1")
    assert is_better(lower, 1, 2, None)
    assert not is_better(lower, 2, 2, None)
    assert is_better(higher, 2, 1, None)
    nearer = metric("jitter_m_s3")
    assert is_better(nearer, 4, 1, 3)
    assert not is_better(nearer, 1, 4, 3)
    assert is_better(nearer, 4, 1, None) is None
    assert is_better(metric("realism_si_floor"), 1, 0, 0) is None


def test_every_metric_is_registered_once_and_floors_have_their_metric():
    metrics = select_metrics(["bimart"])
    names = [item.name for item in metrics]
    assert len(set(names)) == len(names) == len({item.title for item in metrics})
    assert {item.floor_of for item in metrics if item.floor_of} <= set(names)
    assert {item.direction for item in metrics} <= set(get_args(registry.Direction))


def test_the_readme_is_generated_from_the_registry():
    path = Path(registry.__file__).with_name("README.md")
    assert path.read_text() == readme(), "run: python -m hoidata.metrics.describe > hoidata/metrics/README.md"


def test_unmeasured_metrics_are_listed_with_reason_and_number_of_clips(make_clip, tmp_path):
    def open_clip(*given_length, **named):
        clip = make_clip(*given_length, **named)
        sheet = replace(clip.object.model, faces=clip.object.model.faces[[4, 6]], name="sheet")  # the side above
        return replace(clip, object=replace(clip.object, model=sheet))

    root, clips = write_annotated_dataset(tmp_path / "annotated", open_clip)
    all_metrics = select_metrics(["bimart"])
    evaluation = evaluate_store(written(tmp_path / "same", clips.values()), root, metrics=all_metrics)
    no_inside = {"the object has no inside": 2}
    for name in ("penetration_mm", "deep_share", "penetration_volume_cm3", "bimart_pen_1cm_corrected"):
        assert name not in evaluation["figures"]
        assert evaluation["unmeasured"][name] == no_inside
    assert evaluation["unmeasured"]["hand_hand_mm"] == {"one hand acts alone": 1}
    assert evaluation["counts"]["hand_hand_mm"]["clips"] == 1
    assert evaluation["unmeasured"]["adherence"] == {"the motion was made without a target contact map": 2}
    assert evaluation["unmeasured"]["bimart_art_paper"] == {"the object has no hinge": 2}
    assert set(evaluation["figures"]) | set(evaluation["unmeasured"]) == {item.name for item in all_metrics}
    for item in all_metrics:  # each clip was measured, or there is a reason
        measured = evaluation["counts"].get(item.name, {"clips": 0})["clips"]
        assert measured + sum(evaluation["unmeasured"].get(item.name, {}).values()) == 2


def test_aligned_metrics_report_the_reason_for_motions_of_estimated_length(write_annotated, tmp_path):
    root, clips = write_annotated()
    shorter = [named(clips[RIGHT].take(slice(0, 10)), f"{RIGHT}~{number}") for number in range(2)]
    write_store(tmp_path / "own", shorter, generated_info("predicted", length="own"))
    evaluation = evaluate_store(tmp_path / "own", root, metrics=select_metrics(["bimart"]))
    reason = {"the family chose the length, so frames cannot be compared": 1}
    aligned = [item.name for item in select_metrics(["bimart"]) if item.aligned]
    assert len(aligned) == 3
    assert [evaluation["unmeasured"][name] for name in aligned] == [reason] * 3
    given_length = evaluate_store(written(tmp_path / "given", clips.values()), root)
    assert given_length["unmeasured"]["length_error_frames"] == {"the length was given": 2}


def test_the_reason_for_no_selected_frame_names_the_selection():
    slip = metric("slip_cm_s")
    assert registry.count_unmeasured(slip, [[np.zeros(0)], [np.zeros(0), np.ones(2)], []]) == {
        f"no such frame: {slip.frames}": 2
    }
