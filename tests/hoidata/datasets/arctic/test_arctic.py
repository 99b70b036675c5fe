"""ARCTIC: parameter files, templates and descriptions written by hand, and what their numbers must mean."""

import json
from pathlib import Path

import pytest

from hoidata.datasets import Quarantined
from hoidata.datasets.arctic.adapter import ArcticAdapter
from hoidata.datasets.arctic.files import parse_description
from tests.builders import arctic as recording


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return recording.write_root(tmp_path)


@pytest.fixture
def clips(root, load_clips):
    return {clip.clip_id: clip for clip in load_clips(ArcticAdapter(), root)}


@pytest.fixture
def lift(clips):
    return clips["arctic/s04/box_grab_01/0015-0044-both"]


def test_words_and_hand_come_from_the_description(clips):
    words = {(clip.verb, clip.labelled_hand, clip.object_words) for clip in clips.values()}
    assert words == {
        ("grab", "left", "box"),
        ("lift", "both", "box"),
        ("close", "right", "box"),
        ("open", "right", "box"),
    }


def test_parts_may_be_json_booleans(root, load_all, lift):
    parts = root / "meta" / "object_vtemplates" / "box" / "parts.json"
    parts.write_text(json.dumps([True] * 4 + [False] * 4))
    again = load_all(ArcticAdapter(), root)[0]
    assert again.object.model.part.tolist() == lift.object.model.part.tolist()


@pytest.mark.parametrize(
    ("verb", "noun"), [("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")]
)
def test_the_verb_object_pairs_that_text2hoi_left_out_give_no_clip(root, load_clips, verb, noun):
    lines = f"1-40 {verb}, right hand\n20-60 open, left hand\n"
    recording.write_sequence(root, f"{noun}_use_02", lines)
    recording.write_template(root, noun)
    assert [clip.verb for clip in load_clips(ArcticAdapter(), root) if noun in clip.clip_id] == ["open"]
    recording.write_sequence(root, "box_use_02", lines)
    assert [clip.verb for clip in load_clips(ArcticAdapter(), root) if "box_use" in clip.clip_id] == [verb, "open"]


def test_a_pair_text2hoi_leaves_out_is_listed_with_its_reason_and_kept_when_asked_for(root, load_all, load_clips):
    recording.write_sequence(root, "notebook_use_02", "1-40 write, right hand\n")
    recording.write_template(root, "notebook")
    (item,) = [item for item in load_all(ArcticAdapter(), root) if "notebook" in str(item)]
    assert (item.source_key, item.got) == ("arctic/s04/notebook_use_02/0001-0040", "write notebook")
    assert "all_pairs" in item.remedy
    kept = [clip.verb for clip in load_clips(ArcticAdapter(all_pairs=True), root) if "notebook" in clip.clip_id]
    assert kept == ["write"]


def test_a_range_of_19_frames_is_listed_with_its_reason(root, load_all):
    recording.write_sequence(root, "box_use_02", "1-19 open, left hand\n1-20 close, left hand\n")
    short, long = [item for item in load_all(ArcticAdapter(), root) if "box_use_02" in str(item)]
    assert (short.source_key, short.expected, short.got) == (
        "arctic/s04/box_use_02/0001-0019",
        "20 frames or more",
        "19",
    )
    assert long.n_frames == 20


def test_a_range_that_ends_one_frame_after_the_motion_is_left_out_and_not_cut_short(root, load_all):
    recording.write_sequence(root, "box_use_02", "21-70 open, left hand\n31-71 close, left hand\n")
    whole, beyond = [item for item in load_all(ArcticAdapter(), root) if "box_use_02" in str(item)]
    assert whole.source_frames.tolist() == list(range(20, 70))
    assert (beyond.source_key, beyond.expected, beyond.got) == (
        "arctic/s04/box_use_02/0031-0071",
        "frames 1 to 70",
        "31-71",
    )


def test_trailing_digits_of_an_object_name_are_not_part_of_it(root, load_clips):
    recording.write_sequence(root, "box2_use_01", "1-40 open, left hand\n")
    (clip,) = [clip for clip in load_clips(ArcticAdapter(), root) if "box2" in clip.clip_id]
    assert (clip.object.model.name, clip.object_words) == ("box", "box")


@pytest.mark.parametrize(
    ("noun", "words"), [("capsulemachine", "capsule machine"), ("waffleiron", "waffle iron"), ("laptop", "laptop")]
)
def test_joined_object_names_become_words(root, load_clips, noun, words):
    recording.write_sequence(root, f"{noun}_use_01", "1-40 open, left hand\n")
    recording.write_template(root, noun)
    assert {clip.object_words for clip in load_clips(ArcticAdapter(), root) if noun in clip.clip_id} == {words}


def test_a_bad_line_is_listed_and_the_others_convert(root, load_all):
    recording.write_sequence(
        root, lines="1-30 lift, both hands\n31-60 open the box\n50-90 close, left hand\n40-20 grab, left hand\n"
    )
    results = load_all(ArcticAdapter(), root)
    left_out = [item for item in results if isinstance(item, Quarantined)]
    assert [item.where.rsplit(":", 1)[-1] for item in left_out[:2]] == ["2", "4"]
    assert "1 to 70" in left_out[2].expected
    assert len(results) - len(left_out) == 1


def test_a_description_line_has_four_words():
    assert parse_description("12-100 grab, right hand").stop == 100
    for line in ("12-100 grab, right", "12-100 grab, up hand", "a-b grab, left hand", "0-10 grab, left hand"):
        with pytest.raises(ValueError, match=r"words|range|hand"):
            parse_description(line)
