"""GRAB's adapter on one handwritten NPZ and its meshes: motion, table, body and contact labels."""

from pathlib import Path

import numpy as np
import pytest

from hoidata.datasets.grab import adapter as grab_words
from hoidata.datasets.grab.adapter import GrabAdapter, object_words, read_contact
from hoidata.errors import BadInput
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


def test_the_table_is_a_further_object_where_there_is_one(root, load_all):
    recording.write_sequence(root, recording.with_table())
    recording.write_table(root)
    (clip,) = load_all(GrabAdapter(margin_frames=1), root)
    (table,) = clip.other_objects
    assert (table.model.name, table.n_frames, table.hinge_rad) == ("table", clip.n_frames, None)
    assert clip.object.model.name == "cubelarge"
    assert "tools/object_meshes/contact_meshes/table.ply" in {source.path for source in clip.sources}


@pytest.mark.parametrize("data", [recording.sequence(), recording.with_table()])
def test_without_a_table_or_its_mesh_there_is_none_and_nothing_is_wrong(root, load_all, data):
    recording.write_sequence(root, data)
    (clip,) = load_all(GrabAdapter(), root)
    assert clip.other_objects == ()


def test_the_body_is_included_on_request_only(root, load_all):
    recording.write_sequence(root, recording.with_body())
    assert load_all(GrabAdapter(), root)[0].body is None
    (clip,) = load_all(GrabAdapter(body=True), root)
    frames = clip.source_frames
    body, params = clip.body, recording.with_body()["body"]["params"]
    np.testing.assert_array_equal(body.transl_m, params["transl"][frames])
    np.testing.assert_array_equal(body.global_orient, params["global_orient"][frames])
    np.testing.assert_array_equal(body.body_pose, params["body_pose"][frames])
    face = np.concatenate([params[name][frames] for name in ("jaw_pose", "leye_pose", "reye_pose")], axis=1)
    np.testing.assert_array_equal(body.face_pose, face)
    np.testing.assert_array_equal(body.expression, params["expression"][frames])


def test_a_file_without_a_body_converts_when_none_is_asked_for_and_is_named_when_it_is(root, load_all):
    assert load_all(GrabAdapter(), root)[0].body is None
    with pytest.raises(BadInput) as caught:
        load_all(GrabAdapter(body=True), root)
    assert "body" in caught.value.got
    data = recording.with_body()
    del data["body"]["params"]["expression"]
    recording.write_sequence(root, data)
    with pytest.raises(BadInput) as caught:
        load_all(GrabAdapter(body=True), root)
    assert "expression" in caught.value.expected


def labelled(dtype=np.int8, order: str = "C") -> dict:
    data = recording.sequence()
    contact = data["contact"]["object"]
    contact[30, 5], contact[32, 7], contact[32, 1], contact[33, 2] = 55, 21, 40, 22
    data["contact"]["object"] = np.array(contact, dtype=dtype, order=order)
    return data


# Frames 12 to 44 hold label 22 on vertex 3; frame 30 is skipped by the stride, 32 is the clip's fifth and has three
# labels.
ENTRIES = sorted([*((frame, 3, 22) for frame in range(9)), (5, 7, 21), (5, 1, 40)])


def entries(contact) -> list[tuple[int, int, int]]:
    return list(zip(contact.frame.tolist(), contact.vertex.tolist(), contact.label.tolist(), strict=True))


@pytest.mark.parametrize("dtype", ["int8", "uint8", "<i4", "<i8", ">i2", "<f4", "<f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_contact_labels_are_kept_whatever_their_type_and_order(root, load_all, dtype, order):
    recording.write_sequence(root, labelled(dtype, order))
    (clip,) = load_all(GrabAdapter(), root)
    assert entries(clip.source_contact) == ENTRIES


def test_contact_labels_count_frames_of_the_clip_with_its_margin(root, load_all):
    recording.write_sequence(root, labelled())
    (clip,) = load_all(GrabAdapter(margin_frames=2), root)
    assert entries(clip.source_contact) == [(frame + 2, vertex, label) for frame, vertex, label in ENTRIES]
    (clip,) = load_all(GrabAdapter(margin_frames=50), root)
    assert clip.source_frames[[0, -1]].tolist() == [0, 60]
    assert entries(clip.source_contact)[0] == (3, 3, 22)


def test_contact_labels_can_be_excluded(root, load_all):
    (clip,) = load_all(GrabAdapter(contact=False), root)
    assert clip.source_contact is None
    assert clip.source_frames[[0, -1]].tolist() == [12, 44]


def test_labels_below_zero_mean_no_contact(root, load_all):
    data = recording.sequence()
    contact = data["contact"]["object"]
    contact[contact == 0] = -1
    recording.write_sequence(root, data)
    (clip,) = load_all(GrabAdapter(), root)
    assert set(clip.source_contact.label) == {22}
    assert clip.n_frames == 9


def test_labels_longer_than_one_piece_are_those_read_at_once(root):
    """1,201 frames of 8,800 vertices take 85 MB as 64-bit numbers, read in pieces of 59 frames: within a step of 4."""
    rng = np.random.default_rng(0)
    contact = np.zeros((1201, 8800), np.int64)
    frame, vertex = rng.integers(0, 1201, 5000), rng.integers(0, 8800, 5000)
    contact[frame, vertex] = rng.integers(1, 56, 5000)
    path = recording.write_sequence(root, {"contact": {"object": contact}})
    labels = read_contact(path, "here", 1201, 8800, 4, with_labels=True)
    strided = contact[::4]
    np.testing.assert_array_equal(labels.touched, strided.any(axis=1))
    expected_frame, expected_vertex = np.nonzero(strided)
    np.testing.assert_array_equal(labels.labels.frame, expected_frame)
    np.testing.assert_array_equal(labels.labels.vertex, expected_vertex)
    np.testing.assert_array_equal(labels.labels.label, strided[expected_frame, expected_vertex])
    part = labels.cut(100, 200)
    assert (part.frame.min(), part.frame.max()) == (0, 99)
    assert len(part.frame) == ((expected_frame >= 100) & (expected_frame < 200)).sum()
