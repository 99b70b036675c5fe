"""What a corpus can tell, on a handful of clips whose every figure is counted by hand."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hoidata.metrics.corpus_facts import (
    COLUMNS,
    FIGURES,
    CorpusClip,
    corpus_facts,
    fingers_turned_deg,
    read_clips,
    regions,
)
from hoidata.store.annotated import load_annotated
from pipelines.cli import app
from tests.builders.annotated import write_annotated_dataset
from tests.builders.clips import with_hand

NAMED = {figure.name: figure for figure in FIGURES}


def clip(part: str | None, verb: str, thing: str, hand: str = "right", touched: str = "1100", **facts) -> CorpusClip:
    usual = {"subject": f"of {part}", "hinged": thing == "lid", "text": np.eye(4)[0], "free": (True, False)}
    usual |= {"fingers_deg": 30.0, "idle_m": np.inf, "near_hand_differs": None}
    points = np.array([point == "1" for point in touched])
    return CorpusClip("", part, verb=verb, object=thing, hand=hand, touched=points, **(usual | facts))


def value(name: str, clips: list[CorpusClip], part: str = "test") -> float | None:
    chosen = [item for item in clips if part in (item.part, "all")]
    return NAMED[name].value(part, chosen, clips)


TRAIN = [
    clip("train", "lift", "cup", "left"),
    clip("train", "lift", "cup", "left"),
    clip("train", "pour", "cup", "right"),
    clip("train", "pour", "jug", "right"),
    clip("train", "pour", "jug", "right"),
    clip("train", "pour", "jug", "right"),
    clip("train", "open", "lid", "both"),
]


def test_the_majority_verb_is_that_of_training_under_what_is_given():
    tests = [clip("test", "pour", "cup", "right"), clip("test", "lift", "cup", "left"), clip("test", "fly", "cup")]
    shares = {
        name: value(f"majority_{name}_top1", TRAIN + tests) for name in ("nothing", "object", "hand", "object_hand")
    }
    assert shares == pytest.approx({"nothing": 1 / 3, "object": 1 / 3, "hand": 2 / 3, "object_hand": 2 / 3})
    assert value("majority_nothing_top3", TRAIN + tests) == pytest.approx(2 / 3)  # nobody guesses a verb never seen


def test_what_training_has_not_seen_together_falls_back_to_the_object_and_then_to_all():
    unseen = [clip("test", "lift", "cup", "both"), clip("test", "pour", "kite", "both")]
    assert value("majority_object_hand_top1", TRAIN + unseen) == 1
    assert value("majority_object_hand_top1", [*TRAIN, clip("test", "pour", "cup", "both")]) == 0


def test_the_lookup_takes_the_same_prompt_else_the_nearest_sentence_of_the_object_else_nothing():
    train = [
        clip("train", "lift", "cup", touched="1100"),
        clip("train", "lift", "cup", touched="0110"),
        clip("train", "pour", "cup", touched="0011", text=np.eye(4)[1]),
    ]

    def looked_up(test: CorpusClip) -> tuple[float | None, float | None]:
        clips = [*train, test]
        return value("lookup_contact_f1", clips), value("lookup_contact_f1_pooled", clips)

    assert looked_up(clip("test", "lift", "cup", touched="1100")) == pytest.approx((0.75, 0.8))  # pooled: 1110
    near_pour = {"text": np.array([0.1, 0.9, 0.0, 0.0]), "touched": "0111"}
    assert looked_up(clip("test", "shake", "cup", **near_pour)) == pytest.approx((0.8, 0.8))
    assert looked_up(clip("test", "lift", "jug", touched="1100")) == (0, 0)
    assert value("same_prompt", [*train, clip("test", "lift", "cup"), clip("test", "lift", "jug")]) == 0.5


def test_regions_are_chains_of_similar_maps():
    maps = np.array([[int(point) for point in row] for row in ("111000", "011100", "000111", "000010")], bool)
    assert regions(maps[[0, 2]]) == 2
    assert regions(maps[:2]) == 1  # 2 of 4 points in common
    assert regions(maps[:3]) == 2  # 1 of 5
    assert regions(maps) == 2  # the last one is a third of the one before
    assert regions(np.zeros((2, 6), bool)) == 1


def test_crossings_are_counted_over_objects_pairs_and_prompts():
    clips = [
        *(clip("train", verb, "cup", hand) for verb in ("lift", "pour", "pass") for hand in ("left", "right")),
        clip("test", "lift", "cup", "left", touched="0011"),
        *(clip("train", verb, "jug") for verb in ("lift", "lift", "pour")),
        clip(None, "open", "lid", "both", subject="of test"),
    ]
    found = {name: value(name, clips, "all") for name in NAMED}
    assert [found[name] for name in ("clips", "verbs", "objects", "hinged_objects")] == [11, 4, 3, 1]
    assert (found["subjects"], found["shared_subjects"]) == (2, 0)
    assert value("shared_subjects", [*clips, clip("test", "lift", "cup", subject="of train")]) == 1
    assert found["verbs_per_object"] == 2
    assert found["objects_many_verbs"] == pytest.approx(1 / 3)
    assert found["object_hands_many_verbs"] == pytest.approx(2 / 4)
    assert (found["prompts_of_two_clips"], found["prompts_two_regions"]) == (2, 0.5)


def test_shares_of_clips_are_over_those_of_which_it_can_be_said():
    clips = [
        clip("test", "lift", "cup", fingers_deg=10, idle_m=0.05, free=(True, True), near_hand_differs=True),
        clip("test", "lift", "cup", fingers_deg=20, idle_m=0.2, near_hand_differs=False),
        clip("test", "lift", "cup", fingers_deg=60, hand="both", free=(False, False)),
    ]
    names = ("free_first", "free_last", "free_both", "fingers_median_deg", "fingers_moved", "idle_near")
    assert [value(name, clips) for name in names] == pytest.approx([2 / 3, 1 / 3, 1 / 3, 20, 2 / 3, 1 / 3])
    assert value("annotated_hand_differs", clips) == 0.5


def test_nothing_is_said_of_an_empty_part_and_training_is_not_looked_up_in_itself():
    empty = {name for name in NAMED if value(name, [], "test") is None}
    assert {"lookup_contact_f1", "free_both", "majority_hand_top3", "fingers_median_deg"} <= empty
    assert value("lookup_contact_f1", TRAIN, "train") is None


def test_fingers_turn_by_the_largest_angle_between_any_two_valid_frames(make_clip):
    clip = make_clip(6, "right")
    pose = np.zeros((6, 15, 3))
    pose[:, 4] = np.deg2rad([0, -25, 0, 15, 0, 90])[:, None] * np.array([0.6, 0.0, 0.8])
    pose[:, 9] = [0.0, 0.3, 0.0]
    clip = with_hand(clip, hand_pose=pose.reshape(6, 45).astype(np.float32), valid=np.arange(6) < 5)
    assert fingers_turned_deg(clip, ["right"]) == pytest.approx(40, abs=1e-3)
    assert fingers_turned_deg(clip, []) == 0


def test_a_stored_clip_is_read_as_it_is(make_clip, tmp_path):
    """The builder's hands hold on from the first frame to the last, without moving a finger."""
    root, _ = write_annotated_dataset(tmp_path, make_clip)
    left, both = (
        item
        for item in read_clips(load_annotated(root), 7)
        if item.part in ("validation", "test") and item.hand != "right"
    )
    assert (left.hand, left.part, left.verb, left.object, left.subject) == (
        "left",
        "validation",
        "lift",
        (7, "box"),
        (7, "s2"),
    )
    assert (left.free, left.near_hand_differs, left.hinged) == ((False, False), None, False)
    assert left.fingers_deg == pytest.approx(0, abs=0.1)
    assert 0.1 < left.idle_m < 1
    assert both.idle_m == np.inf
    annotated = load_annotated(root)
    np.testing.assert_array_equal(left.touched, annotated.contact_of(left.clip_id, "left").astype(bool))
    np.testing.assert_array_equal(both.touched, annotated.contact(both.clip_id).astype(bool))


def test_several_datasets_are_pooled_and_their_objects_are_not_one(make_clip, tmp_path):
    roots = [write_annotated_dataset(tmp_path / name, make_clip)[0] for name in "ab"]
    one, two = corpus_facts(roots[:1])["figures"], corpus_facts(roots)["figures"]
    assert (one["clips"]["all"], two["clips"]["all"]) == (4, 8)
    assert (one["objects"]["all"], two["objects"]["all"]) == (1, 2)
    assert two["lookup_contact_f1"]["test"] == one["lookup_contact_f1"]["test"]


def test_the_command_prints_every_figure_in_words_or_as_json(make_clip, tmp_path):
    root, _ = write_annotated_dataset(tmp_path, make_clip)
    said = CliRunner().invoke(app, ["corpus", str(root)])
    assert said.exit_code == 0
    lines = " ".join(said.output.split())
    assert "-: the figure compares with training clips" in lines  # what the dashes mean
    assert "of them in more than one part │ 0 │ 0 │ 0 │ 0" in lines
    assert "no hand touches the object in the first frame │ 0.00 │ 0.00 │ 0.00 │ 0.00" in lines
    found = json.loads(CliRunner().invoke(app, ["corpus", str(root), "--json"]).output)
    assert found == corpus_facts([root])
    assert {name for figure in found["figures"].values() for name in figure} == {"words", *COLUMNS}
