"""Described ranges that overlap in time, each for another hand, as in Text2HOI's files: every line is a clip."""

import pytest

from hoidata.datasets.arctic.adapter import ArcticAdapter
from hoidata.errors import BadInput
from hoidata.splits.leaks import find_leaks
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store_check.check import check_store
from tests.builders import arctic as recording
from tests.builders.stores import write_annotated

LINES = """1-40 grasp, left hand
21-60 open, right hand
21-60 lift, left hand
"""
HELD, OPENED, LIFTED = (f"arctic/s04/box_use_01/{name}" for name in ("0001-0040", "0021-0060-right", "0021-0060-left"))
NEAR_M = 0.4  # both hands of the recording are nearer to its box in every range


@pytest.fixture
def annotated(tmp_path, load_clips):
    """The annotated store of a recording with those lines, by a rule for the hand."""
    recording.write_template(tmp_path / "raw", "box")
    recording.write_sequence(tmp_path / "raw", "box_use_01", LINES)
    clips = load_clips(ArcticAdapter(), tmp_path / "raw")

    def by_rule(hand: str) -> AnnotatedStore:
        rule = {"by": "subject", "train": "rest"}
        root = write_annotated(tmp_path / hand, clips, "arctic", rule, threshold_m=NEAR_M, points=64, hand=hand)
        assert not check_store(root / "clips")
        return load_annotated(root)

    return by_rule


def test_each_line_is_a_clip_of_its_own_range_with_its_own_hand_and_sentence(annotated):
    store = annotated("annotated-else-proximity")
    assert {key: store.sentences(key)[0] for key in store.ids()} == {
        HELD: "Grasp a box with the left hand.",
        OPENED: "Open a box with the right hand.",
        LIFTED: "Lift a box with the left hand.",
    }
    frames = {key: store.clip(key).source_frames for key in store.ids()}
    assert {key: (int(found[0]), int(found[-1])) for key, found in frames.items()} == {
        HELD: (0, 39),
        OPENED: (20, 59),
        LIFTED: (20, 59),
    }


def test_by_distance_both_hands_of_such_a_clip_are_active_and_the_annotators_is_kept_beside(annotated):
    store = annotated("proximity")
    assert set(store.hand_types["hand_type"]) == {"both"}
    assert store.hand_types["labelled_hand"].to_dict() == {HELD: "left", OPENED: "right", LIFTED: "left"}
    assert not store.hand_types["agreement"].any()
    assert store.sentences(OPENED)[0] == "Open a box with both hands."


def test_clips_that_share_frames_never_stand_in_two_parts_unnoticed(annotated):
    rows = annotated("proximity").store.sequences
    for parts in ({HELD: "train", OPENED: "test"}, {OPENED: "train", LIFTED: "test"}):
        assert find_leaks(rows, parts, ()).broken == ("frame",)


def test_one_hand_with_two_words_for_one_range_is_refused(annotated, tmp_path, load_clips):
    recording.write_sequence(tmp_path / "raw", "box_use_01", LINES + "21-60 place, left hand\n")
    with pytest.raises(BadInput, match="one line per range and hand"):
        load_clips(ArcticAdapter(), tmp_path / "raw")
