"""GRAB: one NPZ and its meshes written here by hand, and what their numbers must mean."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.adapters.grab import GrabAdapter, object_words
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_joints

N_FRAMES = 61  # at 120 Hz: frames 0, 4, ..., 60 are kept
TOUCHED = (9, 47)  # the object is touched in frames 9 to 47: strided frames 12 to 44
TIME = np.arange(N_FRAMES)
LEFT = {
    "global_orient": np.stack([0.1 + 0.01 * TIME, -0.4 + 0 * TIME, 0.9 - 0.005 * TIME], axis=1),
    "transl": np.stack([0.3 + 0.002 * TIME, 0.1 + 0 * TIME, 0.8 + 0.001 * TIME], axis=1),
}
RIGHT = {
    "global_orient": np.stack([1.2 - 0.01 * TIME, 0.3 + 0 * TIME, -0.2 + 0 * TIME], axis=1),
    "transl": np.stack([0.1 + 0 * TIME, -0.2 + 0.003 * TIME, 0.9 + 0 * TIME], axis=1),
}
OBJECT = {
    "global_orient": np.stack([0.4 + 0 * TIME, 0.02 * TIME, -0.7 + 0 * TIME], axis=1),
    "transl": np.stack([0.2 + 0 * TIME, 0.001 * TIME, 0.75 + 0 * TIME], axis=1),
}
MIDDLE_BEND = (0.1, -0.05, 0.6)
N_VERTICES = 8


def personal_mesh(side: str) -> np.ndarray:
    """A hand 8 % larger than the model's, and shifted: J0 must come from this mesh."""
    return load_embedded_hands()[side].template_m * 1.08 + np.array([0.004, -0.003, 0.002])


def sequence() -> dict:
    fullpose = np.zeros((N_FRAMES, 45))
    fullpose[:, 9:12] = MIDDLE_BEND
    contact = np.zeros((N_FRAMES, N_VERTICES), dtype=np.int8)
    contact[TOUCHED[0] : TOUCHED[1] + 1, 3] = 22
    numbers = {name: {key: value.astype(np.float32) for key, value in block.items()} for name, block in BLOCKS.items()}
    numbers["lhand"]["fullpose"] = np.zeros((N_FRAMES, 45), np.float32)
    numbers["rhand"]["fullpose"] = fullpose.astype(np.float32)
    return {
        "gender": "male",
        "sbj_id": "s3",
        "obj_name": "cubelarge",
        "motion_intent": "offhand",
        "framerate": 120.0,
        "n_frames": N_FRAMES,
        "n_comps": 24,
        "lhand": {"params": numbers["lhand"], "vtemp": "tools/subject_meshes/male/s3_lhand.ply"},
        "rhand": {"params": numbers["rhand"], "vtemp": "tools/subject_meshes/male/s3_rhand.ply"},
        "object": {"params": numbers["object"], "object_mesh": "tools/object_meshes/contact_meshes/cubelarge.ply"},
        "contact": {"object": contact, "body": np.zeros((N_FRAMES, 5), np.int8)},
    }


BLOCKS = {"lhand": LEFT, "rhand": RIGHT, "object": OBJECT}


def write_sequence(root: Path, data: dict) -> Path:
    path = root / "grab" / "s3" / "cubelarge_offhand_1.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path, **{key: np.array(value, dtype=object if isinstance(value, dict) else None) for key, value in data.items()}
    )
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_sequence(tmp_path, sequence())
    meshes = tmp_path / "tools" / "object_meshes" / "contact_meshes"
    meshes.mkdir(parents=True)
    trimesh.creation.box((0.1, 0.12, 0.14)).export(meshes / "cubelarge.ply")
    people = tmp_path / "tools" / "subject_meshes" / "male"
    people.mkdir(parents=True)
    for side, letter in (("left", "l"), ("right", "r")):
        mesh = trimesh.Trimesh(personal_mesh(side), load_embedded_hands()[side].faces, process=False)
        mesh.export(people / f"s3_{letter}hand.ply")
    return tmp_path


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
    data = sequence()
    data["contact"]["object"][48] = 31
    write_sequence(root, data)
    (clip,) = load_all(GrabAdapter(), root)
    assert clip.source_frames[-1] == 48


def test_words_come_from_intent_and_object_name_with_the_size_kept(clip):
    assert (clip.verb, clip.object_words) == ("hand over", "large cube")
    assert object_words("torussmall") == "small torus"
    assert object_words("wineglass") == "wine glass"
    assert object_words("mug") == "mug"


@pytest.mark.parametrize(
    ("intent", "verb"),
    [("switchON", "switch on"), ("takepicture", "take picture"), ("pass", "pass"), ("drink", "drink")],
)
def test_joined_intents_become_words_and_others_stay(root, load_all, intent, verb):
    write_sequence(root, sequence() | {"motion_intent": intent})
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
    rest = formula.rest_points(hands.left, template_m=personal_mesh("left").astype(np.float32))
    joints = track_joints(clip.hands["left"], hands.left)
    for at, frame in enumerate(clip.source_frames):
        orient, transl = LEFT["global_orient"][frame], LEFT["transl"][frame]
        np.testing.assert_allclose(joints[at], formula.rigid(rest, orient, transl), atol=2e-6)
        without_mesh = formula.rigid(formula.rest_points(hands.left), orient, transl)
        wrist_at_transl = formula.rigid(rest, orient, transl - rest[0])
        assert np.linalg.norm(joints[at] - without_mesh, axis=1).max() > 0.004
        assert np.linalg.norm(joints[at] - wrist_at_transl, axis=1).min() > 0.05


def test_fullpose_is_absolute(clip, hands, formula):
    fingers = np.zeros(45)
    fingers[9:12] = MIDDLE_BEND
    rest = formula.rest_points(hands.right, template_m=personal_mesh("right").astype(np.float32))
    joints = track_joints(clip.hands["right"], hands.right)[:, :16]
    for at, frame in enumerate(clip.source_frames):
        orient, transl = RIGHT["global_orient"][frame], RIGHT["transl"][frame]
        np.testing.assert_allclose(joints[at], formula.chain(rest, orient, fingers, transl), atol=2e-6)
    relative = formula.chain(rest, orient, fingers + hands.right.mean_pose, transl)
    assert np.linalg.norm(joints[-1] - relative, axis=1).max() > 0.005


def test_without_fullpose_the_24_components_give_the_fingers(root, load_all, hands):
    data = sequence()
    coefficients = np.tile(np.linspace(-1, 1, 24), (N_FRAMES, 1))
    del data["rhand"]["params"]["fullpose"]
    data["rhand"]["params"]["hand_pose"] = coefficients
    write_sequence(root, data)
    (clip,) = load_all(GrabAdapter(), root)
    expected = coefficients[0] @ hands.right.components[:24]
    np.testing.assert_allclose(clip.hands["right"].hand_pose[0], expected, atol=1e-6)


def test_the_object_pose_is_the_transpose_of_the_stored_rotation(clip):
    mesh = clip.object.model.vertices_m
    for at, frame in enumerate(clip.source_frames):
        stored = Rotation.from_rotvec(OBJECT["global_orient"][frame]).as_matrix()
        row_vectors = mesh @ stored + OBJECT["transl"][frame]
        ours = Rotation.from_rotvec(clip.object.rotvec[at]).as_matrix()
        np.testing.assert_allclose(mesh @ ours.T + clip.object.translation_m[at], row_vectors, atol=1e-6)
        assert np.abs(mesh @ stored.T + OBJECT["transl"][frame] - row_vectors).max() > 0.02


def test_the_object_mesh_keeps_every_vertex_in_its_place(clip):
    np.testing.assert_allclose(
        clip.object.model.vertices_m, trimesh.creation.box((0.1, 0.12, 0.14)).vertices, atol=1e-7
    )


def test_a_download_unpacked_twice_gives_each_sequence_once(root, load_all):
    write_sequence(root / "GRAB", sequence())
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


def _edit(change):
    def spoil(root: Path) -> None:
        data = sequence()
        change(data)
        write_sequence(root, data)

    return spoil


def _truncate(root: Path) -> None:
    path = root / "grab" / "s3" / "cubelarge_offhand_1.npz"
    path.write_bytes(path.read_bytes()[:2000])


def _set(block: str, key: str, value):
    return _edit(lambda data: data[block]["params"].__setitem__(key, value))


def _nan(data: dict) -> None:
    data["rhand"]["params"]["transl"][20, 1] = np.nan


BAD_FILES = {
    "a truncated file": (_truncate, "cubelarge_offhand_1.npz", ".npz"),
    "NaN in a pose": (_edit(_nan), "rhand.transl", "finite"),
    "a pose of 44 columns": (_set("lhand", "fullpose", np.zeros((N_FRAMES, 44))), "lhand.fullpose", "45 columns"),
    "text for numbers": (_set("object", "transl", np.full((N_FRAMES, 3), "x")), "object.transl", "numbers"),
    "a frame too few": (_set("object", "transl", np.zeros((60, 3))), "object.transl", "61 frames"),
    "no rotation": (_edit(lambda data: data["object"]["params"].pop("global_orient")), "object", "global_orient"),
    "no contact at all": (
        _edit(lambda data: data["contact"].__setitem__("object", np.zeros((N_FRAMES, N_VERTICES), np.int8))),
        "contact.object",
        "contact in at least one frame",
    ),
    "contact of another mesh": (
        _edit(lambda data: data["contact"].__setitem__("object", np.ones((N_FRAMES, 9), np.int8))),
        "contact.object",
        "(61, 8)",
    ),
    "a frame rate of 100": (_edit(lambda data: data.__setitem__("framerate", 100.0)), "framerate", "multiple of 30"),
    "a frame rate without end": (
        _edit(lambda data: data.__setitem__("framerate", np.inf)),
        "framerate",
        "whole number",
    ),
    "a path that leaves the folder": (
        _edit(lambda data: data["object"].__setitem__("object_mesh", "../../etc/passwd.ply")),
        "passwd",
        "file",
    ),
    "an unreadable mesh": (
        lambda root: (root / "tools/object_meshes/contact_meshes/cubelarge.ply").write_bytes(b"ply\nnothing"),
        "cubelarge.ply",
        "mesh",
    ),
    "a missing hand mesh": (
        lambda root: (root / "tools/subject_meshes/male/s3_rhand.ply").unlink(),
        "s3_rhand.ply",
        "a file",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_named_with_what_was_expected(root, load_all, name):
    spoil, where, expected = BAD_FILES[name]
    spoil(root)
    with pytest.raises(BadInput) as caught:
        load_all(GrabAdapter(), root)
    assert where in caught.value.where
    assert expected in caught.value.expected
