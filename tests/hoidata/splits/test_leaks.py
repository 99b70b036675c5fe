"""The leak check finds whatever two parts have in common, promised or not; statistics of the training part."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES
from hoidata.splits.definitions import PROMISES, find_leaks
from hoidata.splits.statistics import QUANTILES, summary, training_statistics
from hoidata.store.info import generated_info
from hoidata.store.store import open_store, write_store

FILES = ["raw/a.npz", "raw/b.npz", "mesh/box.ply", "raw/sub/c.npz"]


def clip_row(clip_id: str, **facts) -> dict:
    usual = {"subject": f"of {clip_id}", "object": f"box of {clip_id}", "other_objects": [], "source_files": []}
    usual |= {"verb": "lift", "hand_type": "left"}
    return usual | {"sequence": clip_id, "first_source_frame": 0, "last_source_frame": 9, "clip_id": clip_id} | facts


def leaks(rows: list[dict], parts: dict[str, str | None], promises=(), **more):
    patterns = {"files": FILES, "motion_files": ["raw/*.npz"]} | more
    return find_leaks(pd.DataFrame(rows), parts, promises, **patterns)


CASES = {
    "subject": ({"subject": "s1"}, {"subject": "s1"}, "s1"),
    "object": ({"object": "mug"}, {"object": "cup", "other_objects": ["mug"]}, "mug"),
    "sequence": (
        {"sequence": "x", "subject": "s1"},
        {"sequence": "x", "subject": "s2", "first_source_frame": 50},
        "x",
    ),
    "file": ({"source_files": [0, 2]}, {"source_files": [0, 2]}, "raw/a.npz"),
    "composition": ({"object": "mug"}, {"object": "mug#1a2b3c4d"}, "lift | mug | left"),
    "frame": (
        {"sequence": "x", "subject": "s1"},
        {"sequence": "x", "subject": "s1", "first_source_frame": 9},
        "a (train) and b (test) overlap",
    ),
}


@pytest.mark.parametrize("kind", CASES)
def test_what_two_parts_share_is_found_and_breaks_the_promise(kind):
    first, second, name = CASES[kind]
    rows = [clip_row("a", **first), clip_row("b", **second)]
    result = leaks(rows, {"a": "train", "b": "test"}, [kind])
    assert result.shared[kind] == (name,)
    assert kind in result.broken
    assert not leaks(rows, {"a": "test", "b": "test"}, [kind]).shared[kind]
    assert not leaks(rows, {"a": None, "b": "test"}, [kind]).shared[kind]


def test_clips_that_share_nothing_break_no_promise():
    result = leaks(
        [clip_row("a", source_files=[0]), clip_row("b", source_files=[1])], {"a": "train", "b": "validation"}, PROMISES
    )
    assert result.broken == ()
    assert result.promised == PROMISES
    assert result.as_json() == {kind: {"promised": True, "in_two_parts": 0, "first": []} for kind in PROMISES}


def test_a_table_may_stand_in_both_parts():
    rows = [clip_row("a", other_objects=["table"]), clip_row("b", other_objects=["table", "cup"])]
    assert leaks(rows, {"a": "train", "b": "test"}, ["object"]).shared["object"] == ()


def test_a_mesh_may_serve_both_parts_but_a_motion_file_in_a_subfolder_may_not():
    rows = [clip_row("a", source_files=[2, 3]), clip_row("b", source_files=[2, 3])]
    assert leaks(rows, {"a": "train", "b": "test"}, ["file"]).shared["file"] == ("raw/sub/c.npz",)


def test_a_copy_under_another_name_is_a_leak_whatever_was_promised():
    rows = [clip_row("a"), clip_row("b"), clip_row("c")]
    result = leaks(rows, {"a": "train", "b": "test", "c": "test"}, digests={"a": "1", "b": "1", "c": "2"})
    assert result.shared["motion"] == ("a = b",)
    assert result.broken == ("motion",)
    within = leaks(rows, {"a": "train", "b": "train", "c": "test"}, digests={"a": "1", "b": "1", "c": "2"})
    assert within.shared["motion"] == ()


def test_sequences_of_two_subjects_share_no_frames_though_they_have_one_name():
    rows = [clip_row("a", subject="s1", sequence="cup_1"), clip_row("b", subject="s2", sequence="cup_1")]
    assert leaks(rows, {"a": "train", "b": "test"}).shared["frame"] == ()


def test_overlaps_are_seen_across_a_clip_in_between():
    """a lasts over b and reaches c: neighbours alone would miss it."""
    spans = {"a": (0, 100), "b": (10, 20), "c": (90, 120)}
    rows = [
        clip_row(name, subject="s", sequence="x", first_source_frame=first, last_source_frame=last)
        for name, (first, last) in spans.items()
    ]
    result = leaks(rows, {"a": "train", "b": "train", "c": "test"})
    assert result.broken == ("frame",)
    assert result.shared["frame"] == ("a (train) and c (test) overlap",)


def test_what_is_not_promised_is_still_recorded():
    result = leaks([clip_row("a", subject="s1"), clip_row("b", subject="s1")], {"a": "train", "b": "test"}, ["object"])
    assert result.broken == ()
    assert result.as_json()["subject"] == {"promised": False, "in_two_parts": 1, "first": ["s1"]}


def hand_types(clip_ids, nearest=0.01) -> pd.DataFrame:
    rows = {"clip_id": clip_ids, "min_left_m": [nearest] * len(clip_ids), "min_right_m": [None] * len(clip_ids)}
    return pd.DataFrame(rows).set_index("clip_id", drop=False)


@pytest.fixture
def store(make_clip, tmp_path):
    """A rigid and an articulated clip; the left hand is lost in some frames, its betas vary; no right hand in b."""
    a = make_clip(12, "both", seed=1, clip_id="test/s1/a")
    b = make_clip(20, "both", articulated=True, seed=2, clip_id="test/s2/b")
    left, right = a.hands["left"], b.hands["right"]
    valid = np.arange(12) % 3 > 0
    betas = np.random.default_rng(0).normal(size=(12, 10)).astype(np.float32)
    wild = np.where(valid[:, None], left.wrist_m, 1e6).astype(np.float32)
    a = replace(a, hands={**a.hands, "left": replace(left, valid=valid, betas=betas, wrist_m=wild)})
    b = replace(b, hands={**b.hands, "right": replace(right, valid=np.zeros(20, bool))})
    write_store(tmp_path / "clips", [a, b], generated_info("test"))
    return open_store(tmp_path / "clips")


def test_statistics_of_one_column_are_those_of_the_definition():
    values = [3.0, -1.0, 4.0, 1.5, 9.25]
    statistics = summary(np.array(values)[:, None])
    mean = sum(values) / 5
    assert statistics["count"] == 5
    assert statistics["mean"] == [pytest.approx(mean, rel=1e-8)]
    assert statistics["std"] == [pytest.approx(math.sqrt(sum((v - mean) ** 2 for v in values) / 5), rel=1e-8)]
    assert (statistics["min"], statistics["max"]) == ([-1.0], [9.25])
    ordered = sorted(values)
    for fraction, got in zip(QUANTILES, statistics["quantile_values"][0], strict=True):
        position = fraction * 4
        below = int(position)
        above = min(below + 1, 4)
        assert got == pytest.approx(ordered[below] + (position - below) * (ordered[above] - ordered[below]), rel=1e-8)


def test_quantities_of_hands_count_valid_frames_only(store):
    statistics = training_statistics(store, store.ids, hand_types(store.ids))
    assert (statistics["clips"], statistics["frames"]) == (2, 32)
    counts = {name: facts["count"] for name, facts in statistics["quantities"].items()}
    assert counts["left_wrist_m"] == counts["left_orient_6d"] == counts["left_wrist_to_object_m"] == 8 + 20
    assert counts["right_hand_pose"] == 12
    assert counts["left_betas"] == 8 + 1
    assert counts["right_betas"] == 1
    assert counts["object_translation_m"] == 32
    assert counts["object_hinge_rad"] == 20
    assert counts["n_frames"] == 2
    assert statistics["quantities"]["n_frames"]["mean"] == [16.0]
    assert (counts["left_closest_m"], counts["right_closest_m"]) == (2, 0)
    assert max(statistics["quantities"]["left_wrist_m"]["max"]) < 10


@pytest.mark.parametrize("side", SIDES)
def test_positions_and_rotations_agree_with_another_computation(store, side):
    quantities = training_statistics(store, store.ids, hand_types(store.ids))["quantities"]
    clips = [store.clip(clip_id) for clip_id in store.ids]
    shift, rotations_6d, object_rotations_6d = [], [], []
    for clip in clips:
        hand, moved = clip.hands[side], clip.object
        for frame in np.flatnonzero(hand.valid):
            shift.append(hand.wrist_m[frame].astype(float) - moved.translation_m[frame].astype(float))
            rotations_6d.append(Rotation.from_rotvec(hand.global_orient[frame]).as_matrix()[:, :2].ravel())
        object_rotations_6d += [Rotation.from_rotvec(rotvec).as_matrix()[:, :2].ravel() for rotvec in moved.rotvec]
    np.testing.assert_allclose(quantities[f"{side}_wrist_from_object_m"]["mean"], np.mean(shift, axis=0), atol=1e-6)
    distances = [math.dist(offset, (0, 0, 0)) for offset in shift]
    np.testing.assert_allclose(quantities[f"{side}_wrist_to_object_m"]["max"], [max(distances)], atol=1e-6)
    np.testing.assert_allclose(quantities[f"{side}_orient_6d"]["std"], np.std(rotations_6d, axis=0), atol=1e-6)
    np.testing.assert_allclose(quantities["object_orient_6d"]["mean"], np.mean(object_rotations_6d, axis=0), atol=1e-6)


def test_every_stored_number_of_a_hand_has_its_columns(store):
    quantities = training_statistics(store, store.ids, hand_types(store.ids))["quantities"]
    widths = {"wrist_m": 3, "wrist_from_object_m": 3, "orient_6d": 6, "hand_pose": 45, "betas": 10, "closest_m": 1}
    for name, width in widths.items():
        facts = quantities[f"left_{name}"]
        assert {len(facts[key]) for key in ("mean", "std", "min", "max", "quantile_values")} == {width}
        assert all(len(values) == len(QUANTILES) == 7 for values in facts["quantile_values"])
        assert facts["unit"]


def test_no_training_clip_gives_counts_of_zero(store):
    statistics = training_statistics(store, [], hand_types(store.ids))
    assert {facts["count"] for facts in statistics["quantities"].values()} == {0}
