"""GRAB: one NPZ and its meshes written by hand, and what their numbers must mean."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.datasets.grab import words as grab_words
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.datasets.grab.words import object_words
from hoidata.hands import track_joints


def load_recording() -> ModuleType:
    spec = importlib.util.spec_from_file_location("grab_recording", Path(__file__).with_name("grab_recording.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


recording = load_recording()


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


def test_a_flat_hand_has_the_shape_and_the_wrist_of_its_personal_mesh(clip, hands, formula):
    rest = formula.rest_points(hands.left, template_m=recording.personal_mesh("left").astype(np.float32))
    joints = track_joints(clip.hands["left"], hands.left)
    for at, frame in enumerate(clip.source_frames):
        orient, transl = recording.LEFT["global_orient"][frame], recording.LEFT["transl"][frame]
        np.testing.assert_allclose(joints[at], formula.rigid(rest, orient, transl), atol=2e-6)
        without_mesh = formula.rigid(formula.rest_points(hands.left), orient, transl)
        wrist_at_transl = formula.rigid(rest, orient, transl - rest[0])
        assert np.linalg.norm(joints[at] - without_mesh, axis=1).max() > 0.004
        assert np.linalg.norm(joints[at] - wrist_at_transl, axis=1).min() > 0.05


def test_fullpose_is_absolute(clip, hands, formula):
    fingers = np.zeros(45)
    fingers[9:12] = recording.MIDDLE_BEND
    rest = formula.rest_points(hands.right, template_m=recording.personal_mesh("right").astype(np.float32))
    joints = track_joints(clip.hands["right"], hands.right)[:, :16]
    for at, frame in enumerate(clip.source_frames):
        orient, transl = recording.RIGHT["global_orient"][frame], recording.RIGHT["transl"][frame]
        np.testing.assert_allclose(joints[at], formula.chain(rest, orient, fingers, transl), atol=2e-6)
    relative = formula.chain(rest, orient, fingers + hands.right.mean_pose, transl)
    assert np.linalg.norm(joints[-1] - relative, axis=1).max() > 0.005


def test_without_fullpose_the_24_components_give_the_fingers(root, load_all, hands):
    data = recording.sequence()
    coefficients = np.tile(np.linspace(-1, 1, 24), (recording.N_FRAMES, 1))
    del data["rhand"]["params"]["fullpose"]
    data["rhand"]["params"]["hand_pose"] = coefficients
    recording.write_sequence(root, data)
    (clip,) = load_all(GrabAdapter(), root)
    expected = coefficients[0] @ hands.right.components[:24]
    np.testing.assert_allclose(clip.hands["right"].hand_pose[0], expected, atol=1e-6)


def test_the_object_pose_is_the_transpose_of_the_stored_rotation(clip):
    mesh = clip.object.model.vertices_m
    for at, frame in enumerate(clip.source_frames):
        stored = Rotation.from_rotvec(recording.OBJECT["global_orient"][frame]).as_matrix()
        row_vectors = mesh @ stored + recording.OBJECT["transl"][frame]
        ours = Rotation.from_rotvec(clip.object.rotvec[at]).as_matrix()
        np.testing.assert_allclose(mesh @ ours.T + clip.object.translation_m[at], row_vectors, atol=1e-6)
        assert np.abs(mesh @ stored.T + recording.OBJECT["transl"][frame] - row_vectors).max() > 0.02


def test_the_object_mesh_keeps_every_vertex_in_its_place(clip):
    np.testing.assert_allclose(
        clip.object.model.vertices_m, trimesh.creation.box((0.1, 0.12, 0.14)).vertices, atol=1e-7
    )


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


INTENTS = {
    "offhand": "hand over", "browse": "browse", "brush": "brush", "call": "call", "chop": "chop", "clean": "clean",
    "cook": "cook", "drink": "drink", "eat": "eat", "fly": "fly", "inspect": "inspect", "lift": "lift", "open": "open",
    "pass": "pass", "peel": "peel", "play": "play", "pour": "pour", "screw": "screw", "see": "see", "set": "set",
    "shake": "shake", "squeeze": "squeeze", "stamp": "stamp", "staple": "staple", "switchON": "switch on",
    "takepicture": "take a picture with", "toast": "toast", "use": "use", "wear": "wear",
}  # fmt: skip
OBJECTS = [
    "airplane", "alarmclock", "apple", "banana", "binoculars", "bowl", "camera", "cubelarge", "cubemedium",
    "cubesmall", "cup", "cylinderlarge", "cylindermedium", "cylindersmall", "doorknob", "duck", "elephant",
    "eyeglasses", "flashlight", "flute", "fryingpan", "gamecontroller", "hammer", "hand", "headphones", "knife",
    "lightbulb", "mouse", "mug", "phone", "piggybank", "pyramidlarge", "pyramidmedium", "pyramidsmall", "scissors",
    "spherelarge", "spheremedium", "spheresmall", "stamp", "stanfordbunny", "stapler", "teapot", "toothbrush",
    "toothpaste", "toruslarge", "torusmedium", "torussmall", "train", "watch", "waterbottle", "wineglass",
]  # fmt: skip


def test_all_29_intents_of_grab_have_their_verb():
    assert len(grab_words.INTENTS) == 29
    assert grab_words.INTENTS == INTENTS


def test_all_51_objects_of_grab_have_their_words_and_no_two_the_same():
    assert sorted(grab_words.OBJECTS) == OBJECTS
    assert len(OBJECTS) == 51
    assert len({object_words(name) for name in OBJECTS}) == 51
    assert len({*grab_words.OBJECTS, *grab_words.OTHER_MESHES, "body"}) == 57  # the meshes of GRAB's folder


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
