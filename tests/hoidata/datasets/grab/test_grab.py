"""GRAB: one NPZ and its meshes written by hand, and what their numbers must mean."""

from pathlib import Path

import pytest

from hoidata.datasets.grab import words as grab_words
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.datasets.grab.words import object_words
from tests.builders import grab as recording


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return recording.write_root(tmp_path)


@pytest.fixture
def clip(root, load_all):
    (clip,) = load_all(GrabAdapter(), root)
    return clip


def test_a_file_becomes_one_clip_from_first_to_last_contact_at_30_frames_per_second(clip):
    assert clip.source_frames.tolist() == [12, 16, 20, 24, 28, 32, 36, 40, 44]
    assert clip.source_fps == 120
    assert (clip.clip_id, clip.subject) == ("grab/s3/cubelarge_offhand_1", "s3")
    assert clip.gravity.tolist() == [0, 0, -1]


def test_the_last_contact_frame_is_kept_when_it_is_a_strided_one(root, load_all):
    data = recording.sequence()
    data["contact"]["object"][48] = 31
    recording.write_sequence(root, data)
    (clip,) = load_all(GrabAdapter(), root)
    assert clip.source_frames[-1] == 48


def test_words_come_from_intent_and_object_name_with_the_size_kept(clip):
    assert (clip.verb, clip.object_words) == ("hand over", "large cube")
    assert object_words("torussmall") == "small torus"
    assert object_words("wineglass") == "wine glass"
    assert object_words("mug") == "mug"


@pytest.mark.parametrize(
    ("intent", "verb"),
    [("switchON", "switch on"), ("takepicture", "take a picture with"), ("pass", "pass"), ("drink", "drink")],
)
def test_joined_intents_become_words_and_others_stay(root, load_all, intent, verb):
    recording.write_sequence(root, recording.sequence() | {"motion_intent": intent})
    (clip,) = load_all(GrabAdapter(), root)
    assert clip.verb == verb


def test_every_joined_object_name_of_grab_becomes_words():
    joined = {
        "alarmclock": "alarm clock", "fryingpan": "frying pan", "gamecontroller": "game controller",
        "lightbulb": "light bulb", "piggybank": "piggy bank", "stanfordbunny": "Stanford bunny",
        "waterbottle": "water bottle", "wineglass": "wine glass",
    }  # fmt: skip
    assert {name: object_words(name) for name in joined} == joined
    for shape in ("cube", "cylinder", "pyramid", "sphere", "torus"):
        for size in ("small", "medium", "large"):
            assert object_words(shape + size) == f"{size} {shape}"
    for name in ("airplane", "eyeglasses", "headphones", "toothbrush", "toothpaste", "flashlight", "doorknob"):
        assert object_words(name) == name


def test_a_download_unpacked_twice_gives_each_sequence_once(root, load_all):
    recording.write_sequence(root / "GRAB", recording.sequence())
    assert [str(key) for key in GrabAdapter().sequences(root)] == ["grab/s3/cubelarge_offhand_1"]
    assert len(load_all(GrabAdapter(), root)) == 1


def test_a_margin_counts_frames_of_the_clip(root, load_all):
    (clip,) = load_all(GrabAdapter(margin_frames=2), root)
    assert clip.source_frames[[0, -1]].tolist() == [4, 52]


def test_every_file_that_was_read_is_listed_with_its_digest(clip, root):
    assert [source.path for source in clip.sources] == [
        "grab/s3/cubelarge_offhand_1.npz",
        "tools/object_meshes/contact_meshes/cubelarge.ply",
        "tools/subject_meshes/male/s3_lhand.ply",
        "tools/subject_meshes/male/s3_rhand.ply",
    ]
    assert clip.sources[0].size == (root / clip.sources[0].path).stat().st_size


@pytest.mark.parametrize(
    ("intent", "verb"),
    [
        ("juggle", "juggle"),
        ("switchOFF", "switch off"),
        ("pick_all", "pick all"),
        ("turn over", "turn over"),
        ("", None),
    ],
)
def test_an_intent_grab_does_not_have_is_taken_at_its_word(root, load_all, intent, verb):
    recording.write_sequence(root, recording.sequence() | {"motion_intent": intent})
    (clip,) = load_all(GrabAdapter(), root)
    assert clip.verb == verb


def test_29_intents_and_51_objects_have_words_and_no_two_objects_the_same():
    renamed = {intent: verb for intent, verb in grab_words.INTENTS.items() if intent != verb}
    assert renamed == {"offhand": "hand over", "switchON": "switch on", "takepicture": "take a picture with"}
    assert (len(grab_words.INTENTS), len(grab_words.OBJECTS)) == (29, 51)
    assert len({object_words(name) for name in grab_words.OBJECTS}) == 51
    assert len({*grab_words.OBJECTS, *grab_words.OTHER_MESHES, "body"}) == 57  # the meshes of GRAB's folder
