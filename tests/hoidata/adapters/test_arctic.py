"""ARCTIC: parameter files, templates and descriptions written here by hand, and what their numbers must mean."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.adapters import Quarantined
from hoidata.adapters.arctic import ArcticAdapter
from hoidata.adapters.arctic_files import parse_description
from hoidata.errors import BadInput
from hoidata.hands import track_joints
from hoidata.objects import articulate, place

N_FRAMES = 70
TIME = np.arange(N_FRAMES)
ANGLE = 0.02 * TIME + 3.5  # unwrapped: beyond pi
ORIENT = np.stack([0.3 + 0 * TIME, 0.01 * TIME, -0.6 + 0 * TIME], axis=1)
TRANSLATION_MM = np.stack([100.0 + TIME, -50.0 + 0 * TIME, 900.0 - 2.0 * TIME], axis=1)
BOTTOM_MM = [(0.0, 0.0, 0.0), (200.0, 0.0, 0.0), (200.0, 150.0, 0.0), (0.0, 150.0, -40.0)]
TOP_MM = [(10.0, 5.0, 20.0), (190.0, 5.0, 20.0), (190.0, 140.0, 25.0), (10.0, 140.0, 25.0)]
FACES = "f 1 2 3\nf 1 3 4\nf 5 6 7\nf 5 7 8\n"
SHAPE = {"left": np.linspace(-0.6, 0.6, 10), "right": np.linspace(0.5, -0.5, 10)}
HAND_TRANSL = {"left": (0.2, -0.1, 0.8), "right": (-0.1, 0.1, 0.9)}
HAND_ORIENT = {"left": (0.4, -1.0, 0.3), "right": (-0.7, 0.2, 1.9)}
STORED = np.zeros(45)
STORED[0:3] = (0.1, 0.0, 0.5)  # relative to the mean pose
STORED[21:24] = (0.0, 0.0, 6.4)  # beyond 2 pi, as it occurs in the real files
LINES = """1-20 grab, left hand

15-44 lift, both hands
45-63 open, right hand
41-70 close right hand
15-44 open, right hand
"""


def hand_params(side: str) -> dict:
    return {
        "rot": np.tile(HAND_ORIENT[side], (N_FRAMES, 1)).astype(np.float32),
        "pose": np.tile(STORED, (N_FRAMES, 1)).astype(np.float32),
        "trans": np.tile(HAND_TRANSL[side], (N_FRAMES, 1)).astype(np.float32),
        "shape": SHAPE[side].astype(np.float32),
        "fitting_err": np.zeros(N_FRAMES, np.float32),
    }


def write_sequence(root: Path, name: str = "box_grab_01", lines: str = LINES) -> None:
    folder = root / "raw_seqs" / "s04"
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / f"{name}.mano.npy", np.array({side: hand_params(side) for side in SHAPE}, dtype=object))
    np.save(folder / f"{name}.object.npy", np.column_stack((ANGLE, ORIENT, TRANSLATION_MM)))
    text = root / "description" / "s04" / name / "description.txt"
    text.parent.mkdir(parents=True, exist_ok=True)
    text.write_text(lines)


def write_template(root: Path, name: str) -> None:
    folder = root / "meta" / "object_vtemplates" / name
    folder.mkdir(parents=True)
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in BOTTOM_MM + TOP_MM)
    (folder / "mesh.obj").write_text(f"# a box\n{vertices}vt 0 0\nvn 0 0 1\n{FACES}")
    (folder / "parts.json").write_text(json.dumps([1, 1, 1, 1, 0, 0, 0, 0]))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_sequence(tmp_path)
    write_template(tmp_path, "box")
    return tmp_path


@pytest.fixture
def clips(root, load_all):
    return {clip.clip_id: clip for clip in load_all(ArcticAdapter(), root)}


@pytest.fixture
def lift(clips):
    return clips["arctic/s04/box_grab_01/0015-0044-both"]


def test_described_ranges_count_from_one_and_include_both_ends(clips):
    frames = {clip_id.rsplit("/", 1)[1]: clip.source_frames[[0, -1]].tolist() for clip_id, clip in clips.items()}
    assert frames == {
        "0001-0020": [0, 19],
        "0015-0044-both": [14, 43],
        "0041-0070": [40, 69],
        "0015-0044-right": [14, 43],
    }


def test_words_and_hand_come_from_the_description(clips):
    words = {(clip.verb, clip.labelled_hand, clip.object_words) for clip in clips.values()}
    assert words == {
        ("grab", "left", "box"),
        ("lift", "both", "box"),
        ("close", "right", "box"),
        ("open", "right", "box"),
    }


def test_fingers_are_relative_to_the_mean_pose_and_stay_unwrapped(lift, hands, formula):
    for side in ("left", "right"):
        rest = formula.rest_points(hands[side], SHAPE[side].astype(np.float32))
        absolute = STORED + hands[side].mean_pose
        joints = track_joints(lift.hands[side], hands[side])[0, :16]
        expected = formula.chain(rest, HAND_ORIENT[side], absolute, HAND_TRANSL[side])
        np.testing.assert_allclose(joints, expected, atol=2e-6)
        as_stored = formula.chain(rest, HAND_ORIENT[side], STORED, HAND_TRANSL[side])
        assert np.linalg.norm(joints - as_stored, axis=1).max() > 0.005
        np.testing.assert_allclose(lift.hands[side].hand_pose[0], absolute, atol=1e-6)
        assert lift.hands[side].hand_pose.max() > 6


def test_the_wrist_stands_at_the_shaped_rest_wrist_plus_trans(lift, hands, formula):
    for side in ("left", "right"):
        rest = formula.rest_points(hands[side], SHAPE[side])
        np.testing.assert_allclose(lift.hands[side].wrist_m[3], rest[0] + HAND_TRANSL[side], atol=1e-6)
        assert np.linalg.norm(rest[0]) > 0.05


def test_things_fall_along_minus_z_of_the_vicon_world(lift):
    assert lift.gravity.tolist() == [0, 0, -1]
    assert lift.source_fps == 30


def test_millimetres_become_metres_in_mesh_and_translation(lift):
    np.testing.assert_allclose(lift.object.model.vertices_m, np.array(BOTTOM_MM + TOP_MM) / 1000, atol=1e-9)
    np.testing.assert_allclose(lift.object.translation_m, TRANSLATION_MM[14:44] / 1000, atol=1e-6)


def test_the_top_turns_about_minus_z_and_the_bottom_does_not(lift):
    model = lift.object.model
    assert model.part.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    points = place(
        articulate(model.vertices_m, model.part, model.hinge, lift.object.hinge_rad),
        lift.object.rotvec,
        lift.object.translation_m,
    )
    for at, frame in enumerate(range(14, 44)):
        turn = Rotation.from_euler("z", -ANGLE[frame]).as_matrix()
        pose = Rotation.from_rotvec(ORIENT[frame]).as_matrix()
        canonical = np.vstack((BOTTOM_MM, np.array(TOP_MM) @ turn.T))
        expected = (canonical @ pose.T + TRANSLATION_MM[frame]) / 1000
        np.testing.assert_allclose(points[at], expected, atol=1e-6)
        other_way = (np.array(TOP_MM) @ turn @ pose.T + TRANSLATION_MM[frame]) / 1000
        assert np.abs(points[at, 4:] - other_way).max() > 0.01


def test_the_hinge_angle_is_kept_beyond_pi(lift):
    np.testing.assert_allclose(lift.object.hinge_rad, ANGLE[14:44], atol=1e-6)
    assert lift.object.hinge_rad[-1] > np.pi


def test_parts_may_be_json_booleans(root, load_all, lift):
    parts = root / "meta" / "object_vtemplates" / "box" / "parts.json"
    parts.write_text(json.dumps([True] * 4 + [False] * 4))
    again = load_all(ArcticAdapter(), root)[0]
    assert again.object.model.part.tolist() == lift.object.model.part.tolist()


@pytest.mark.parametrize(
    ("verb", "noun"), [("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")]
)
def test_the_verb_object_pairs_that_text2hoi_left_out_give_no_clip(root, load_all, verb, noun):
    lines = f"1-40 {verb}, right hand\n20-60 open, left hand\n"
    write_sequence(root, f"{noun}_use_02", lines)
    write_template(root, noun)
    assert [clip.verb for clip in load_all(ArcticAdapter(), root) if noun in clip.clip_id] == ["open"]
    write_sequence(root, "box_use_02", lines)
    assert [clip.verb for clip in load_all(ArcticAdapter(), root) if "box_use" in clip.clip_id] == [verb, "open"]


def test_trailing_digits_of_an_object_name_are_not_part_of_it(root, load_all):
    write_sequence(root, "box2_use_01", "1-40 open, left hand\n")
    (clip,) = [clip for clip in load_all(ArcticAdapter(), root) if "box2" in clip.clip_id]
    assert (clip.object.model.name, clip.object_words) == ("box", "box")


@pytest.mark.parametrize(
    ("noun", "words"), [("capsulemachine", "capsule machine"), ("waffleiron", "waffle iron"), ("laptop", "laptop")]
)
def test_joined_object_names_become_words(root, load_all, noun, words):
    write_sequence(root, f"{noun}_use_01", "1-40 open, left hand\n")
    write_template(root, noun)
    assert {clip.object_words for clip in load_all(ArcticAdapter(), root) if noun in clip.clip_id} == {words}


def test_a_bad_line_is_listed_and_the_others_convert(root, load_all):
    write_sequence(
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


def _edit_hand(change):
    def spoil(root: Path) -> None:
        params = {side: hand_params(side) for side in SHAPE}
        change(params)
        np.save(root / "raw_seqs" / "s04" / "box_grab_01.mano.npy", np.array(params, dtype=object))

    return spoil


def _set_object(array):
    return lambda root: np.save(root / "raw_seqs" / "s04" / "box_grab_01.object.npy", array)


def _nan_object() -> np.ndarray:
    array = np.column_stack((ANGLE, ORIENT, TRANSLATION_MM))
    array[33, 2] = np.nan
    return array


def _truncate(root: Path) -> None:
    path = root / "raw_seqs" / "s04" / "box_grab_01.mano.npy"
    path.write_bytes(path.read_bytes()[:900])


BAD_FILES = {
    "a truncated file": (_truncate, "mano.npy", ""),
    "a missing object file": (
        lambda root: (root / "raw_seqs/s04/box_grab_01.object.npy").unlink(),
        "object.npy",
        "a file",
    ),
    "a missing hand": (_edit_hand(lambda params: params.pop("left")), "mano.npy", "left"),
    "a frame too many": (_set_object(np.zeros((71, 7))), "mano.npy", "71 frames"),
    "six columns": (_set_object(np.zeros((70, 6))), "object.npy", "7 columns"),
    "NaN in a pose": (_set_object(_nan_object()), "object.npy", "finite"),
    "text for numbers": (_set_object(np.full((70, 7), "a")), "object.npy", "numbers"),
    "nine betas": (_edit_hand(lambda params: params["right"].update(shape=np.zeros(9))), "right.shape", "10 columns"),
    "no description": (lambda root: (root / "description/s04/box_grab_01/description.txt").unlink(), "description", ""),
    "parts of another mesh": (
        lambda root: (root / "meta/object_vtemplates/box/parts.json").write_text("[0, 1]"),
        "parts.json",
        "8 zeros and ones",
    ),
    "a mesh without faces": (
        lambda root: (root / "meta/object_vtemplates/box/mesh.obj").write_text("v 0 0 0\n"),
        "mesh.obj",
        "faces",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_named_with_what_was_expected(root, load_all, name):
    spoil, where, expected = BAD_FILES[name]
    spoil(root)
    with pytest.raises(BadInput) as caught:
        load_all(ArcticAdapter(), root)
    assert where in caught.value.where
    assert expected in caught.value.expected
