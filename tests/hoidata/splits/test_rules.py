"""Rules assign clips to parts, by names or in time. Clips that no part lists are excluded."""

import hashlib
from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from hoidata.errors import BadInput
from hoidata.splits.definitions import choose
from hoidata.splits.rules import KINDS, SplitRule, assign_split
from hoidata.store.annotated import load_annotated
from tests.builders.objects import box_model
from tests.builders.stores import write_annotated

COLUMNS = ["clip_id", "subject", "sequence", "first_source_frame", "last_source_frame", "object", "other_objects"]


def table(rows) -> pd.DataFrame:
    """Rows of the first five columns, or of all."""
    full = [(*values, "box", [])[: len(COLUMNS)] if len(values) == 5 else values for values in rows]
    return pd.DataFrame(full, columns=COLUMNS).set_index("clip_id", drop=False).rename_axis(None)


def one_sequence(n_clips: int, name: str = "cyl") -> list[tuple]:
    return [(f"{name}/{i}", "p1", name, 100 * i, 100 * i + 90) for i in range(n_clips)]


def of_objects(*objects: tuple[str, list[str]]) -> pd.DataFrame:
    return table([(f"clip{i}", "p1", f"seq{i}", 0, 9, name, others) for i, (name, others) in enumerate(objects)])


def test_a_rule_by_subject_puts_every_clip_of_a_subject_in_one_part():
    rows = [(f"{subject}/{i}", subject, f"{subject}/x", i, i) for subject in ("s1", "s9", "s10") for i in range(3)]
    split = assign_split(table(rows), SplitRule(train=("s1",), validation=("s9",), test=("s10",)))
    assert split.groupby(split.index.str.split("/").str[0]).unique().map(list).to_dict() == {
        "s1": ["train"],
        "s9": ["validation"],
        "s10": ["test"],
    }


@pytest.mark.parametrize(("train", "part"), [(("s1",), None), ("rest", "train")])
def test_a_clip_that_no_part_names_is_left_out_unless_the_rest_trains(train, part):
    rows = table([("a", "s1", "x", 0, 9), ("b", "s4", "y", 0, 9)])
    split = assign_split(rows, SplitRule(train=train, test=("s10",)))
    assert split.to_dict() == {"a": "train", "b": part}


MUG_TESTS = SplitRule("object", train="rest", test=("mug",))


@pytest.mark.parametrize(
    ("rule", "objects", "expected"),
    [
        (replace(MUG_TESTS, validation=("box",)), [("cup", []), ("box", []), ("mug", [])],
         ["train", "validation", "test"]),
        (MUG_TESTS, [("cup", ["mug"]), ("cup", ["pot"]), ("mug", ["cup"])], [None, "train", None]),
        (MUG_TESTS, [("mug", ["table"]), ("apple", ["table"]), ("mug", ["table", "apple"])], ["test", "train", None]),
        (MUG_TESTS, [("mug#1a2b3c4d", ["table#00000000"]), ("apple", []), ("mug#5e6f7a8b", [])],
         ["test", "train", "test"]),
    ],
    ids=["the moved object", "another object is visible", "a table is in every clip", "two meshes of one name"],
)  # fmt: skip
def test_a_rule_by_object_excludes_clips_that_show_objects_of_two_parts(rule, objects, expected):
    assert assign_split(of_objects(*objects), rule).tolist() == expected


def test_a_rule_by_sequence_wants_the_whole_name_and_one_by_prefix_its_beginning():
    rows = table([("a", "s3", "s3/k1/0", 0, 9), ("b", "s3", "s3/k2/0", 0, 9), ("c", "s3", "s3/k2/01", 0, 9)])
    by_name = SplitRule("sequence", train=("s3/k1/0",), test=("s3/k2/0",))
    assert assign_split(rows, by_name).tolist() == ["train", "test", None]
    by_prefix = SplitRule("prefix", train=("s3/k1/",), test=("s3/k2/",))
    assert assign_split(rows, by_prefix).tolist() == ["train", "test", "test"]


def test_a_rule_by_time_tests_on_the_end_of_every_sequence():
    rows = one_sequence(20) + one_sequence(4, "mug")
    split = assign_split(table(rows), SplitRule(by="time"))
    assert split.tolist()[:20] == ["train"] * 14 + ["validation"] * 3 + ["test"] * 3
    assert split.tolist()[20:] == ["train", "train", "validation", "test"]


def test_shares_are_rounded_and_small_sequences_have_one_clip_of_each():
    shares = {n: assign_split(table(one_sequence(n)), SplitRule(by="time")).tolist() for n in (2, 3, 12, 17)}
    counts = {n: tuple(map(parts.count, ("train", "validation", "test"))) for n, parts in shares.items()}
    assert counts == {2: (2, 0, 0), 3: (1, 1, 1), 12: (8, 2, 2), 17: (11, 3, 3)}  # 0.15 x 12 = 1.8, x 17 = 2.55


def test_a_rule_by_rounds_spreads_the_held_out_clips_over_every_sequence():
    rows = one_sequence(11) + one_sequence(3, "mug")
    split = assign_split(table(rows), SplitRule(by="rounds"))
    assert [i for i, part in enumerate(split[:11]) if part == "test"] == [4, 9]
    assert [i for i, part in enumerate(split[:11]) if part == "validation"] == [3, 8]
    assert split.tolist()[11:] == ["train"] * 3


@pytest.mark.parametrize("rule", [SplitRule("time"), SplitRule("rounds"), SplitRule("object", "rest", (), ("mug",))])
def test_the_split_does_not_depend_on_the_order_of_the_rows(rule):
    rows = table(one_sequence(20) + one_sequence(9, "mug"))
    shuffled = rows.sample(frac=1, random_state=np.random.RandomState(3))
    assert assign_split(shuffled, rule).sort_index().to_dict() == assign_split(rows, rule).sort_index().to_dict()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 60), st.floats(0, 0.95), st.floats(0, 0.95))
@example(3, 0.9, 0.05)
def test_parts_follow_each_other_in_time(n_clips, validation, test):
    assume(validation + test < 1)
    rule = SplitRule(by="time", validation_share=validation, test_share=test)
    order = [("train", "validation", "test").index(part) for part in assign_split(table(one_sequence(n_clips)), rule)]
    assert order == sorted(order)
    assert len(order) == n_clips


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ({"train": ("s2",), "validation": ("s1",), "test": ("s1", "s2")}, "no subject in two parts, got s2"),
        ({"train": ("s1",), "validation": ("s9",), "test": ("s9",)}, "no subject in two parts, got s9"),
        ({"by": "prefix", "train": ("s1/",), "test": ("s1/k2/",)}, "no prefix in two parts"),
        ({"by": "time", "validation_share": 0.6, "test_share": 0.5}, "less than 1"),
        ({"validation": ("s9",), "test": ("s10",)}, "`rest` for all others"),
        ({"by": "colour", "train": "rest"}, "subject, object, sequence, prefix, time, rounds"),
        ({"train": "s1"}, "a list of names"),
        ({"train": "rest", "test": "rest"}, "a list of names"),
        ({"train": "rest", "test": (10,)}, "a list of names"),
    ],
)
def test_a_rule_that_contradicts_itself_is_refused(rule, message):
    with pytest.raises(BadInput, match=message):
        SplitRule(**rule)


@pytest.mark.parametrize("by", KINDS)
def test_an_empty_table_has_an_empty_split(by):
    assert assign_split(table([]), SplitRule(by, "rest")).tolist() == []


def test_drawn_sequences_keep_together_and_few_change_parts_when_others_come():
    names = [f"day{number % 3}/{number:03d}" for number in range(40)]

    def drawn(sequences) -> dict[str, str]:
        rows = [{"clip_id": f"{name}/{cut}", "sequence": name} for name in sequences for cut in (0, 1)]
        parts = assign_split(pd.DataFrame(rows).set_index("clip_id", drop=False), SplitRule(by="drawn"))
        assert all(parts[f"{name}/0"] == parts[f"{name}/1"] for name in sequences)
        return {name: parts[f"{name}/0"] for name in sequences}

    assigned = drawn(names)
    assert Counter(assigned.values()) == {"train": 28, "validation": 6, "test": 6}
    assert assigned == drawn(names[::-1])
    more = drawn([*names, "day4/new"])
    assert sum(more[name] != assigned[name] for name in names) <= 2
    assert set(drawn(names[:3]).values()) == {"train", "validation", "test"}


def test_each_object_has_its_share_of_test_sequences_and_at_least_one():
    counts = {"box": 20, "mug": 7, "pen": 2, "cup": 1}
    names = {
        f"s{number % 3}/{object_name}_{number:02d}": object_name
        for object_name, count in counts.items()
        for number in range(count)
    }
    rows = [
        (f"{name}/{cut}", "s1", name, cut, cut, object_name, [])
        for name, object_name in names.items()
        for cut in (0, 9)
    ]
    split = assign_split(table(rows), SplitRule("drawn-per-object", validation_share=0.1, test_share=44 / 301))
    assert all(split[f"{name}/0"] == split[f"{name}/9"] for name in names)
    part_counts = Counter((object_name, split[f"{name}/0"]) for name, object_name in names.items())
    assert part_counts == {
        **{("box", "train"): 15, ("box", "validation"): 2, ("box", "test"): 3},
        **{("mug", "train"): 5, ("mug", "validation"): 1, ("mug", "test"): 1},
        **{("pen", "train"): 1, ("pen", "test"): 1, ("cup", "test"): 1},
    }
    in_order = sorted((name for name, object_name in names.items() if object_name == "box"), key=digest)
    assert [split[f"{name}/0"] for name in in_order] == ["train"] * 15 + ["validation"] * 2 + ["test"] * 3


def digest(name: str) -> str:
    return hashlib.sha256(name.encode()).hexdigest()


VERBS, OBJECTS, HANDS = (
    ("lift", "pour", "pass", "shake"),
    ("cup", "jug", "box", "pan", "mug"),
    ("left", "right", "both"),
)
CROSSED = list(product(VERBS, OBJECTS, HANDS)) * 2  # 60 compositions of two clips each
BY = SplitRule("composition", validation_share=0.1, test_share=0.2)


def clips_of(compositions, overlapping: bool = False) -> pd.DataFrame:
    """A sequence per clip; or one sequence, of which every two clips share frames."""
    rows = []
    for number, (verb, name, hand) in enumerate(compositions):
        first = 200 * (number // 2) + 50 * (number % 2) if overlapping else 0
        source = {"sequence": "s1/all" if overlapping else f"s1/{number}", "subject": "s1"}
        words = {"verb": verb, "object": name, "hand_type": hand, "other_objects": []}
        span = {"first_source_frame": first, "last_source_frame": first + 99}
        rows.append({"clip_id": f"clip{number:03d}", **source, **words, **span})
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
    rows = clips_of(CROSSED)
    parts = assign_split(rows, BY)
    check(rows, parts)
    assert Counter(parts) == {"train": 84, "validation": 12, "test": 24}


def test_no_verb_object_or_hand_is_held_out_much_more_than_others():
    rows = clips_of(CROSSED)
    held_out = assign_split(rows, BY) != "train"
    for column in ("verb", "object", "hand_type"):
        shares = held_out.groupby(rows[column]).mean()
        assert 0.15 <= shares.min() <= shares.max() <= 0.45, column


def test_the_order_of_the_clips_changes_nothing():
    rows = clips_of(CROSSED)
    for rule in (BY, replace(BY, by="drawn-object")):
        shuffled = rows.sample(frac=1, random_state=np.random.RandomState(5))
        assert assign_split(shuffled, rule).sort_index().to_dict() == assign_split(rows, rule).to_dict()


def test_a_verb_of_one_object_alone_and_an_object_of_one_verb_stay_in_training():
    rows = clips_of([*CROSSED, ("staple", "stapler", "left"), ("fly", "cup", "left"), ("lift", "kite", "right")])
    parts = assign_split(rows, BY)
    check(rows, parts)
    assert set(parts[-3:]) == {"train"}


@pytest.mark.parametrize("by", ["composition", "drawn-object"])
def test_a_corpus_without_crossings_is_refused(by):
    """A verb per object, as many a recorded set has: nothing can be held out that training has in another way."""
    rows = clips_of([(f"verb {name}", name, "right") for name in OBJECTS] * 6)
    with pytest.raises(
        BadInput, match=rf"split by {by}: expected 3 clips or more .* for test, got 0 of 30.*combined more often"
    ):
        assign_split(rows, SplitRule(by))


def test_fewer_clips_than_the_least_are_refused():
    rows = clips_of(CROSSED)
    assert (assign_split(rows, replace(BY, least_clips=24)) == "test").sum() == 24
    with pytest.raises(BadInput, match=r"25 clips or more that can be held out for test, got 24 of 120"):
        assign_split(rows, replace(BY, least_clips=25))
    with pytest.raises(BadInput, match="1 clips or more"):
        replace(BY, least_clips=0)


def test_a_clip_that_shares_frames_with_a_held_out_one_is_excluded():
    rows = clips_of(CROSSED, overlapping=True)
    free, parts = assign_split(clips_of(CROSSED), BY).tolist(), assign_split(rows, BY).tolist()
    rank = {"test": 0, "validation": 1, "train": 2}
    for number, (alone, part) in enumerate(zip(free, parts, strict=True)):
        other = parts[number + 1 - 2 * (number % 2)]
        above = other is not None and rank[other] < rank[alone]
        assert part == (None if above else alone)
    assert None in parts


def test_drawn_objects_are_in_one_part_and_their_verbs_and_hands_in_training_too():
    rows = clips_of([*CROSSED, *[("staple", "stapler", "left")] * 9])
    rows.at["clip000", "other_objects"] = ["jug", "table"]
    parts = assign_split(rows, SplitRule("drawn-object", validation_share=0.15, test_share=0.2))
    of = {name: set(parts[rows["object"] == name].dropna()) for name in (*OBJECTS, "stapler")}
    assert all(len(object_parts) == 1 for object_parts in of.values())
    assert of["stapler"] == {"train"}
    assert Counter(part for object_parts in of.values() for part in object_parts) == {
        "train": 4,
        "validation": 1,
        "test": 1,
    }
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
    assigned = pd.DataFrame({"part": store.splits, "words": dict(zip(store.ids(), words * 2, strict=True))})
    assert {len(set(parts)) for _, parts in assigned.groupby("words")["part"]} == {1}
    assert Counter(assigned["part"]) == {"train": 16, "validation": 4, "test": 4}
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
