"""Held-out objects and compositions: everything they are made of is seen in training, only never together."""

from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest

from hoidata.errors import BadInput
from hoidata.splits.definitions import choose
from hoidata.splits.rules import SplitRule, assign_split
from hoidata.store.annotated import load_annotated
from tests.builders.objects import box_model
from tests.builders.stores import write_annotated

VERBS, OBJECTS, HANDS = (
    ("lift", "pour", "pass", "shake"),
    ("cup", "jug", "box", "pan", "mug"),
    ("left", "right", "both"),
)
CROSSED = list(product(VERBS, OBJECTS, HANDS)) * 2  # 60 compositions of two clips each
BY = SplitRule("composition", validation_share=0.1, test_share=0.2)


def table(compositions, overlapping: bool = False) -> pd.DataFrame:
    """A sequence per clip; or one sequence, of which every two clips share frames."""
    rows = []
    for number, (verb, name, hand) in enumerate(compositions):
        first = 200 * (number // 2) + 50 * (number % 2) if overlapping else 0
        place = {"sequence": "s1/all" if overlapping else f"s1/{number}", "subject": "s1"}
        words = {"verb": verb, "object": name, "hand_type": hand, "other_objects": []}
        span = {"first_source_frame": first, "last_source_frame": first + 99}
        rows.append({"clip_id": f"clip{number:03d}", **place, **words, **span})
    return pd.DataFrame(rows).set_index("clip_id", drop=False).rename_axis(None)


def seen(rows: pd.DataFrame, parts: pd.Series, part: str, *columns: str) -> set:
    return set(rows.loc[parts == part, list(columns)].itertuples(index=False, name=None))


def check(rows: pd.DataFrame, parts: pd.Series) -> None:
    trained = {column: seen(rows, parts, "train", column) for column in ("verb", "object", "hand_type")}
    whole = {part: seen(rows, parts, part, *trained) for part in ("train", "validation", "test")}
    for part in ("validation", "test"):
        assert whole[part]
        assert all(seen(rows, parts, part, column) <= trained[column] for column in trained)
    assert not whole["train"] & (whole["test"] | whole["validation"])
    assert not whole["test"] & whole["validation"]


def test_what_is_held_out_is_seen_in_training_but_never_together_and_as_much_as_asked_for():
    rows = table(CROSSED)
    parts = assign_split(rows, BY)
    check(rows, parts)
    assert Counter(parts) == {"train": 84, "validation": 12, "test": 24}


def test_no_verb_object_or_hand_is_held_out_much_more_than_others():
    rows = table(CROSSED)
    held = assign_split(rows, BY) != "train"
    for column in ("verb", "object", "hand_type"):
        shares = held.groupby(rows[column]).mean()
        assert 0.15 <= shares.min() <= shares.max() <= 0.45, column


def test_the_order_of_the_clips_changes_nothing():
    rows = table(CROSSED)
    for rule in (BY, replace(BY, by="drawn-object")):
        shuffled = rows.sample(frac=1, random_state=np.random.RandomState(5))
        assert assign_split(shuffled, rule).sort_index().to_dict() == assign_split(rows, rule).to_dict()


def test_a_verb_of_one_object_alone_and_an_object_of_one_verb_stay_in_training():
    rows = table([*CROSSED, ("staple", "stapler", "left"), ("fly", "cup", "left"), ("lift", "kite", "right")])
    parts = assign_split(rows, BY)
    check(rows, parts)
    assert set(parts[-3:]) == {"train"}


@pytest.mark.parametrize("by", ["composition", "drawn-object"])
def test_a_corpus_without_crossings_is_refused(by):
    """A verb per object, as many a recorded set has: nothing can be held out that training has in another way."""
    rows = table([(f"verb {name}", name, "right") for name in OBJECTS] * 6)
    with pytest.raises(
        BadInput, match=rf"split by {by}: expected 3 clips or more .* for test, got 0 of 30.*cross more"
    ):
        assign_split(rows, SplitRule(by))


def test_fewer_clips_than_the_least_are_refused():
    rows = table(CROSSED)
    assert (assign_split(rows, replace(BY, least_clips=24)) == "test").sum() == 24
    with pytest.raises(BadInput, match=r"25 clips or more that can be held out for test, got 24 of 120"):
        assign_split(rows, replace(BY, least_clips=25))
    with pytest.raises(BadInput, match="1 clips or more"):
        replace(BY, least_clips=0)


def test_a_clip_that_shares_frames_with_a_held_out_one_is_left_out():
    rows = table(CROSSED, overlapping=True)
    free, parts = assign_split(table(CROSSED), BY).tolist(), assign_split(rows, BY).tolist()
    rank = {"test": 0, "validation": 1, "train": 2}
    for number, (alone, part) in enumerate(zip(free, parts, strict=True)):
        other = parts[number + 1 - 2 * (number % 2)]
        above = other is not None and rank[other] < rank[alone]
        assert part == (None if above else alone)
    assert None in parts


def test_drawn_objects_are_in_one_part_and_their_verbs_and_hands_in_training_too():
    rows = table([*CROSSED, *[("staple", "stapler", "left")] * 9])
    rows.at["clip000", "other_objects"] = ["jug", "table"]
    parts = assign_split(rows, SplitRule("drawn-object", validation_share=0.15, test_share=0.2))
    of = {name: set(parts[rows["object"] == name].dropna()) for name in (*OBJECTS, "stapler")}
    assert all(len(found) == 1 for found in of.values())
    assert of["stapler"] == {"train"}
    assert Counter(part for found in of.values() for part in found) == {"train": 4, "validation": 1, "test": 1}
    assert (parts["clip000"] is None) == (of["cup"] != of["jug"])


def test_the_stage_splits_by_composition_and_the_leak_check_looks_at_compositions(make_clip, tmp_path):
    rule = {"by": "composition", "validation_share": 0.2, "test_share": 0.2}
    words = list(product(("lift", "turn", "pass"), ("box", "cup"), ("left", "right")))
    clips = []
    for number, (verb, name, hand) in enumerate(words * 2):
        clip = make_clip(12, hand, seed=number, clip_id=f"toy/s1/{number}", verb=verb)
        track = replace(clip.object, model=replace(box_model(), name=name))
        clips.append(replace(clip, object=track, sequence=f"s1/{number}"))
    store = load_annotated(write_annotated(tmp_path / "toy", clips, rule=rule, points=64))
    found = pd.DataFrame({"part": store.splits, "words": dict(zip(store.ids(), words * 2, strict=True))})
    assert {len(set(parts)) for _, parts in found.groupby("words")["part"]} == {1}
    assert Counter(found["part"]) == {"train": 16, "validation": 4, "test": 4}
    record = store.split_info["chosen"]
    assert record["rule"] == {**rule, "least_clips": 1}
    assert record["leaks"]["composition"] == {"promised": True, "in_two_parts": 0, "first": []}
    other = {"by": "drawn", "promises": ["composition"]}
    with pytest.raises(BadInput, match=r"no composition in two parts, as it promises, got .*\| box \|"):
        write_annotated(tmp_path / "drawn", clips, rule=other, points=64)


def test_any_dataset_can_be_split_by_composition_and_by_drawn_objects_by_name():
    for name in ("composition", "drawn-object"):
        for dataset in ("grab", "mydata"):
            definition = choose(dataset, name)
            assert (definition.rule.by, definition.rule.least_clips) == (name, 64)
            assert (definition.rule.as_json() | {"by": name, "least_clips": 64}) == definition.rule.as_json()
