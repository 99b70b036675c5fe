"""The leak check finds whatever two parts have in common, promised or not."""

import pandas as pd
import pytest

from hoidata.splits.leaks import PROMISES, find_leaks

FILES = ["raw/a.npz", "raw/b.npz", "mesh/box.ply", "raw/sub/c.npz"]


def row(clip_id: str, **facts) -> dict:
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
    rows = [row("a", **first), row("b", **second)]
    found = leaks(rows, {"a": "train", "b": "test"}, [kind])
    assert found.shared[kind] == (name,)
    assert kind in found.broken
    assert not leaks(rows, {"a": "test", "b": "test"}, [kind]).shared[kind]
    assert not leaks(rows, {"a": None, "b": "test"}, [kind]).shared[kind]


def test_clips_that_share_nothing_break_no_promise():
    found = leaks([row("a", source_files=[0]), row("b", source_files=[1])], {"a": "train", "b": "validation"}, PROMISES)
    assert found.broken == ()
    assert found.promised == PROMISES
    assert found.as_json() == {kind: {"promised": True, "in_two_parts": 0, "first": []} for kind in PROMISES}


def test_a_table_may_stand_in_both_parts():
    rows = [row("a", other_objects=["table"]), row("b", other_objects=["table", "cup"])]
    assert leaks(rows, {"a": "train", "b": "test"}, ["object"]).shared["object"] == ()


def test_a_mesh_may_serve_both_parts_but_a_motion_file_in_a_subfolder_may_not():
    rows = [row("a", source_files=[2, 3]), row("b", source_files=[2, 3])]
    assert leaks(rows, {"a": "train", "b": "test"}, ["file"]).shared["file"] == ("raw/sub/c.npz",)


def test_a_copy_under_another_name_is_a_leak_whatever_was_promised():
    rows = [row("a"), row("b"), row("c")]
    found = leaks(rows, {"a": "train", "b": "test", "c": "test"}, digests={"a": "1", "b": "1", "c": "2"})
    assert found.shared["motion"] == ("a = b",)
    assert found.broken == ("motion",)


def test_copies_within_one_part_are_no_leak():
    found = leaks([row("a"), row("b")], {"a": "train", "b": "train"}, digests={"a": "1", "b": "1"})
    assert found.shared["motion"] == ()


def test_sequences_of_two_subjects_share_no_frames_though_they_have_one_name():
    rows = [row("a", subject="s1", sequence="cup_1"), row("b", subject="s2", sequence="cup_1")]
    assert leaks(rows, {"a": "train", "b": "test"}).shared["frame"] == ()


def test_overlaps_are_seen_across_a_clip_in_between():
    """a lasts over b and reaches c: neighbours alone would miss it."""
    spans = {"a": (0, 100), "b": (10, 20), "c": (90, 120)}
    rows = [
        row(name, subject="s", sequence="x", first_source_frame=first, last_source_frame=last)
        for name, (first, last) in spans.items()
    ]
    found = leaks(rows, {"a": "train", "b": "train", "c": "test"})
    assert found.broken == ("frame",)
    assert found.shared["frame"] == ("a (train) and c (test) overlap",)


def test_what_is_not_promised_is_still_recorded():
    found = leaks([row("a", subject="s1"), row("b", subject="s1")], {"a": "train", "b": "test"}, ["object"])
    assert found.broken == ()
    assert found.as_json()["subject"] == {"promised": False, "in_two_parts": 1, "first": ["s1"]}
