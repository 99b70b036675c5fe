import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hoidata.errors import BadInput
from hoidata.schema.splits import SplitRule, assign_split, check_no_leak


def table(rows) -> pd.DataFrame:
    columns = ["clip_id", "subject", "sequence", "first_source_frame", "last_source_frame"]
    return pd.DataFrame(rows, columns=columns).set_index("clip_id", drop=False).rename_axis(None)


def one_sequence(n_clips: int, name: str = "cyl") -> list[tuple]:
    return [(f"{name}/{i}", "p1", name, 100 * i, 100 * i + 90) for i in range(n_clips)]


def test_a_rule_by_subject_puts_every_clip_of_a_subject_in_one_part():
    rows = [(f"{subject}/{i}", subject, f"{subject}/x", i, i) for subject in ("s1", "s9", "s10") for i in range(3)]
    split = assign_split(table(rows), SplitRule(validation=("s9",), test=("s10",)))
    assert split.groupby(split.index.str.split("/").str[0]).first().to_dict() == {
        "s1": "train",
        "s9": "validation",
        "s10": "test",
    }


def test_a_rule_by_time_tests_on_the_end_of_every_sequence():
    rows = one_sequence(20) + one_sequence(4, "mug")
    split = assign_split(table(rows), SplitRule(by="time"))
    assert split.tolist()[:20] == ["train"] * 14 + ["validation"] * 3 + ["test"] * 3
    assert split.tolist()[20:] == ["train", "train", "validation", "test"]


def test_a_rule_by_rounds_spreads_the_held_out_clips_over_every_sequence():
    rows = one_sequence(11) + one_sequence(3, "mug")
    split = assign_split(table(rows), SplitRule(by="rounds"))
    assert [i for i, part in enumerate(split[:11]) if part == "test"] == [4, 9]
    assert [i for i, part in enumerate(split[:11]) if part == "validation"] == [3, 8]
    assert split.tolist()[11:] == ["train"] * 3


def test_the_split_does_not_depend_on_the_order_of_the_rows():
    rows = table(one_sequence(20) + one_sequence(9, "mug"))
    shuffled = rows.sample(frac=1, random_state=np.random.RandomState(3))
    rule = SplitRule(by="time")
    assert assign_split(shuffled, rule).sort_index().to_dict() == assign_split(rows, rule).sort_index().to_dict()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 60), st.floats(0, 0.45), st.floats(0, 0.45))
def test_parts_follow_each_other_in_time(n_clips, validation, test):
    rule = SplitRule(by="time", validation_share=validation, test_share=test)
    order = [("train", "validation", "test").index(part) for part in assign_split(table(one_sequence(n_clips)), rule)]
    assert order == sorted(order)
    assert len(order) == n_clips


def test_overlapping_clips_in_two_parts_are_a_leak():
    rows = [(f"a/{i}", "p1", "a", 10 * i, 10 * i + 15) for i in range(10)]
    with pytest.raises(BadInput, match="no frame in two parts"):
        assign_split(table(rows), SplitRule(by="time"))


def test_a_subject_in_two_parts_is_a_leak():
    rows = table([("a", "s1", "x", 0, 9), ("b", "s1", "y", 0, 9)])
    with pytest.raises(BadInput, match="s1"):
        check_no_leak(rows, pd.Series(["train", "test"], index=rows.index), SplitRule())


def test_a_rule_that_contradicts_itself_is_refused():
    with pytest.raises(BadInput, match="s1"):
        SplitRule(validation=("s1",), test=("s1", "s2"))
    with pytest.raises(BadInput, match="less than 1"):
        SplitRule(by="time", validation_share=0.6, test_share=0.5)


def test_an_empty_table_has_an_empty_split():
    assert assign_split(table([]), SplitRule()).tolist() == []
