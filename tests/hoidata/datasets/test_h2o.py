"""H2O: a tree of text files written here by hand, and what its numbers must mean."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.datasets import Quarantined
from hoidata.datasets.h2o.adapter import ACTIONS, OBJECTS, H2OAdapter
from hoidata.errors import BadInput
from hoidata.hands import track_joints

N_FRAMES = 27
LABELS = [0, 0, 0] + [26] * 22 + [0, 0]  # take out chips in frames 3 to 24
LEFT = {"t": (0.05, -0.02, 0.4), "orient": (0.3, -0.8, 0.5), "betas": (0.6, -0.4, 0, 0, 0.2, 0, 0, 0, 0, 0.1)}
RIGHT = {"t": (-0.04, 0.03, 0.5), "orient": (-0.2, 1.1, 0.1), "betas": (-0.5, 0.3, 0.1, 0, 0, 0, 0, 0, 0, 0)}
INDEX_BEND = (0.0, 0.1, 0.7)


def camera(frame: int) -> np.ndarray:
    """Camera to world: a head that turns and walks."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("zyx", [20 + 3 * frame, 10, -110], degrees=True).as_matrix()
    matrix[:3, 3] = (0.1 + 0.01 * frame, -0.2, 1.5 - 0.005 * frame)
    return matrix


def object_in_camera(frame: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec((0.2, 0.9, 0.02 * frame)).as_matrix()
    matrix[:3, 3] = (0.02, 0.05 + 0.002 * frame, 0.45)
    return matrix


def hand_block(flag: int, hand: dict, fingers=(0.0,) * 45) -> list[float]:
    return [flag, *hand["t"], *hand["orient"], *fingers, *hand["betas"]]


def write_text(path: Path, numbers) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(" ".join(repr(float(number)) for number in np.ravel(numbers)))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """One sequence; the right index bends at its first joint; the left hand is unknown in frame 5."""
    fingers = np.zeros(45)
    fingers[:3] = INDEX_BEND
    folder = tmp_path / "subject2" / "k1" / "3" / "cam4"
    for frame in range(N_FRAMES):
        name = f"{frame:06d}.txt"
        left = [0.0] * 62 if frame == 5 else hand_block(1, LEFT)
        write_text(folder / "cam_pose" / name, camera(frame))
        write_text(folder / "hand_pose_mano" / name, left + hand_block(1, RIGHT, fingers))
        write_text(folder / "obj_pose_rt" / name, [7, *object_in_camera(frame).ravel()])
        write_text(folder / "action_label" / name, [LABELS[frame]])
    mesh = tmp_path / "object" / "chips" / "chips.obj"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.cylinder(0.04, 0.2, sections=8).export(mesh)
    return tmp_path


@pytest.fixture
def clip(root, load_all):
    (clip,) = load_all(H2OAdapter(), root)
    return clip


def test_a_run_of_one_label_becomes_one_clip_with_its_words_and_source_frames(clip):
    assert (clip.clip_id, clip.subject) == ("h2o/subject2/k1/3/000003-000024", "subject2")
    assert (clip.verb, clip.object_words, clip.object.model.name) == ("take out", "chips", "chips")
    assert clip.source_frames.tolist() == list(range(3, 25))
    assert clip.gravity is None


def test_a_flat_hand_stands_in_the_world_where_its_camera_saw_it(clip, hands, formula):
    rest = formula.rest_points(hands.left, LEFT["betas"])
    joints = track_joints(clip.hands["left"], hands.left)
    seen = formula.rigid(rest, LEFT["orient"], LEFT["t"])
    for at, frame in enumerate(clip.source_frames):
        if frame == 5:
            continue
        world = seen @ camera(frame)[:3, :3].T + camera(frame)[:3, 3]
        np.testing.assert_allclose(joints[at], world, atol=1e-6)
        without_offset = world - camera(frame)[:3, :3] @ rest[0]  # transl taken for the wrist
        naive = formula.rigid(rest, LEFT["orient"], camera(frame)[:3, :3] @ LEFT["t"] + camera(frame)[:3, 3])
        inverse = (seen - camera(frame)[:3, 3]) @ camera(frame)[:3, :3]
        for wrong in (without_offset, naive, inverse):
            assert np.linalg.norm(joints[at] - wrong, axis=1).min() > 0.01


def test_a_bent_finger_is_absolute_and_not_relative_to_the_mean_pose(clip, hands, formula):
    fingers = np.zeros(45)
    fingers[:3] = INDEX_BEND
    rest = formula.rest_points(hands.right, RIGHT["betas"])
    seen = formula.chain(rest, RIGHT["orient"], fingers, RIGHT["t"])
    joints = track_joints(clip.hands["right"], hands.right)
    for at, frame in enumerate(clip.source_frames):
        np.testing.assert_allclose(joints[at, :16], seen @ camera(frame)[:3, :3].T + camera(frame)[:3, 3], atol=1e-6)
    relative = formula.chain(rest, RIGHT["orient"], fingers + hands.right.mean_pose, RIGHT["t"])
    assert np.linalg.norm(relative - seen, axis=1).max() > 0.005


def test_the_object_moves_from_its_own_frame_through_the_camera_to_the_world(clip):
    turns = Rotation.from_rotvec(clip.object.rotvec).as_matrix()
    for at, frame in enumerate(clip.source_frames):
        expected = camera(frame) @ object_in_camera(frame)
        np.testing.assert_allclose(turns[at], expected[:3, :3], atol=1e-6)
        np.testing.assert_allclose(clip.object.translation_m[at], expected[:3, 3], atol=1e-6)


def test_the_flag_of_a_frame_decides_whether_the_hand_is_valid(clip):
    assert np.flatnonzero(~clip.hands["left"].valid).tolist() == [2]
    assert clip.hands["right"].valid.all()
    assert len(clip.hands["left"].betas) == 1


def test_source_frames_are_the_numbers_of_the_files_also_when_the_first_are_absent(root, clip, load_all):
    for path in sorted((root / "subject2/k1/3/cam4").glob("*/00000[01].txt")):
        path.unlink()
    (later,) = load_all(H2OAdapter(), root)
    assert later.clip_id == clip.clip_id
    assert later.source_frames.tolist() == list(range(3, 25))
    np.testing.assert_array_equal(later.hands["right"].wrist_m, clip.hands["right"].wrist_m)


def test_a_frame_that_no_folder_has_is_a_gap(root, load_all):
    for path in sorted((root / "subject2/k1/3/cam4").glob("*/000010.txt")):
        path.unlink()
    with pytest.raises(BadInput, match=r"cam_pose/000010\.txt.*each of 27 frames"):
        load_all(H2OAdapter(), root)


def test_the_folder_names_of_the_readme_are_read_too(root, clip, load_all):
    folder = root / "subject2" / "k1" / "3" / "cam4"
    (folder / "hand_pose_mano").rename(folder / "hand_pose_MANO")
    (folder / "obj_pose_rt").rename(folder / "obj_pose_RT")
    (again,) = load_all(H2OAdapter(), root)
    np.testing.assert_array_equal(again.hands["right"].wrist_m, clip.hands["right"].wrist_m)


def test_twenty_frames_of_a_label_are_too_short_and_twenty_one_enough(root, load_all):
    labels = root / "subject2" / "k1" / "3" / "cam4" / "action_label"
    for frame in (3, 4):
        write_text(labels / f"{frame:06d}.txt", [0])
    (short,) = load_all(H2OAdapter(), root)
    assert isinstance(short, Quarantined)
    assert (short.source_key, short.got) == ("h2o/subject2/k1/3/000005-000024", "20 (frames 5 to 24)")
    write_text(labels / "000004.txt", [26])
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.n_frames == 21


def test_a_margin_widens_the_clip_within_the_recording(root, load_all):
    (clip,) = load_all(H2OAdapter(margin_frames=5), root)
    assert clip.source_frames.tolist() == list(range(27))


def test_another_object_class_than_the_label_names_is_left_out_with_its_reason(root, load_all):
    write_text(root / "subject2/k1/3/cam4/obj_pose_rt/000010.txt", [5, *object_in_camera(10).ravel()])
    (item,) = load_all(H2OAdapter(), root)
    assert isinstance(item, Quarantined)
    assert "7 (chips)" in item.expected
    assert "[5, 7]" in item.got


def test_a_run_is_cut_to_the_frames_in_which_its_object_is_tracked(root, load_all):
    write_text(root / "subject2/k1/3/cam4/obj_pose_rt/000003.txt", [0, *np.zeros(16)])
    (clip,) = load_all(H2OAdapter(margin_frames=2), root)
    assert clip.clip_id.endswith("000004-000024")
    assert clip.source_frames[[0, -1]].tolist() == [4, 26]


def test_the_old_name_of_an_object_folder_is_known(root, load_all):
    (root / "object" / "chips" / "chips.obj").rename(root / "object" / "chips" / "pringles.obj")
    (root / "object" / "chips").rename(root / "object" / "pringles")
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.object.model.name == "chips"


README_OBJECTS = "1 book, 2 espresso, 3 lotion, 4 spray, 5 milk, 6 cocoa, 7 chips, 8 cappuccino"
README_ACTIONS = """
1 grab book, 2 grab espresso, 3 grab lotion, 4 grab spray, 5 grab milk, 6 grab cocoa, 7 grab chips, 8 grab cappuccino,
9 place book, 10 place espresso, 11 place lotion, 12 place spray, 13 place milk, 14 place cocoa, 15 place chips,
16 place cappuccino, 17 open lotion, 18 open milk, 19 open chips, 20 close lotion, 21 close milk, 22 close chips,
23 pour milk, 24 take out espresso, 25 take out cocoa, 26 take out chips, 27 take out cappuccino, 28 put in espresso,
29 put in cocoa, 30 put in cappuccino, 31 apply lotion, 32 apply spray, 33 read book, 34 read espresso,
35 spray spray, 36 squeeze lotion
"""


def test_the_tables_of_objects_and_actions_are_those_of_the_readme():
    assert [f"{number} {name}" for number, name in enumerate(OBJECTS)][1:] == README_OBJECTS.split(", ")
    listed = [" ".join(row.split()) for row in README_ACTIONS.split(",")]
    assert [f"{number} {verb} {noun}" for number, (verb, noun) in enumerate(ACTIONS)][1:] == listed


def _remove(path: Path) -> None:
    path.unlink()


def _put(text: str):
    return lambda path: path.write_text(text)


BAD_FILES = {
    "a missing frame": ("hand_pose_mano/000007.txt", _remove, "nothing there"),
    "a truncated frame": ("hand_pose_mano/000007.txt", lambda path: path.write_text(path.read_text()[:300]), "124"),
    "too many columns": ("obj_pose_rt/000007.txt", lambda path: path.write_text(path.read_text() + " 1.0"), "17"),
    "NaN in a pose": ("cam_pose/000007.txt", _put(" ".join(["nan"] * 16)), "finite"),
    "infinity in a pose": ("obj_pose_rt/000007.txt", _put(" ".join(["1e400"] * 17)), "finite"),
    "an empty file": ("obj_pose_rt/000007.txt", _put(""), "17 numbers 0"),
    "an empty first line": (
        "cam_pose/000007.txt",
        lambda path: path.write_text("\n" + path.read_text()),
        "16 numbers 0",
    ),
    "text that is not UTF-8": ("cam_pose/000007.txt", lambda path: path.write_bytes(b"\xff\xfe " * 16), "16 numbers"),
    "a binary file": ("hand_pose_mano/000007.txt", lambda path: path.write_bytes(bytes(range(256))), "124 numbers"),
    "JSON": ("action_label/000007.txt", _put("[26]"), "1 numbers"),
    "a frame too many": ("cam_pose/000027.txt", lambda path: write_text(path, camera(27)), "each of 28 frames"),
    "no numbers": ("action_label/000007.txt", _put("milk"), "1 numbers"),
    "a label that is no whole number": ("action_label/000007.txt", _put("26.5"), "0 to 36"),
    "an unknown object": ("obj_pose_rt/000007.txt", lambda path: write_text(path, [9, *np.eye(4).ravel()]), "0 to 8"),
    "broken intrinsics": ("cam_intrinsics.txt", _put("636.6 636.3"), "6 numbers 2"),
    "an unknown label": ("action_label/000007.txt", _put("37"), "0 to 36"),
    "a matrix that is no rotation": ("cam_pose/000007.txt", _put(" ".join(["0.5"] * 16)), "rotation"),
    "a matrix by columns": ("cam_pose/000007.txt", lambda path: write_text(path, camera(7).T), "row 0 0 0 1"),
    "a mirror": (
        "obj_pose_rt/000007.txt",
        lambda path: write_text(path, [7, *(object_in_camera(7) @ np.diag([1, 1, -1, 1])).ravel()]),
        "a mirror",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_frame_file_is_named_with_what_was_expected(root, load_all, name):
    file, spoil, expected = BAD_FILES[name]
    spoil(root / "subject2/k1/3/cam4" / file)
    with pytest.raises(BadInput) as caught:
        load_all(H2OAdapter(), root)
    assert Path(file).stem in caught.value.where
    assert file.split("/")[0] in caught.value.where or name == "a frame too many"
    assert expected in f"{caught.value.expected} {caught.value.got}"


def test_a_bad_object_pose_is_named_by_its_file_also_behind_frames_without_object(root, load_all):
    folder = root / "subject2/k1/3/cam4/obj_pose_rt"
    for frame in (0, 1):
        write_text(folder / f"{frame:06d}.txt", np.zeros(17))
    write_text(folder / "000007.txt", [7, *np.full(16, 0.5)])
    with pytest.raises(BadInput, match=r"obj_pose_rt/000007\.txt"):
        load_all(H2OAdapter(), root)


@pytest.mark.parametrize("folder", ["cam_pose", "hand_pose_mano", "obj_pose_rt"])
def test_a_folder_that_is_not_there_is_named(root, load_all, folder):
    shutil.rmtree(root / "subject2/k1/3/cam4" / folder)
    with pytest.raises(BadInput, match=rf"cam4/{folder}: expected a folder of NNNNNN\.txt files.*pose archive"):
        load_all(H2OAdapter(), root)


BAD_MESHES = {
    "none": (lambda path: path.unlink(), "the object's mesh", "nothing there"),
    "empty": (_put(""), "vertices", "shape"),
    "without faces": (_put("v 0 0 0\nv 1 0 0\nv 0 1 0\n"), "faces", "no face"),
    "of faces without area": (_put("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), "faces with area", "without"),
    "with a corner that is not there": (_put("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n"), "face corners", "3"),
    "with NaN": (_put("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "finite", "NaN"),
}


@pytest.mark.parametrize("name", BAD_MESHES)
def test_a_bad_mesh_is_named_with_what_was_expected(root, load_all, name):
    spoil, expected, got = BAD_MESHES[name]
    spoil(root / "object/chips/chips.obj")
    with pytest.raises(BadInput) as caught:
        load_all(H2OAdapter(), root)
    assert caught.value.where.endswith("object/chips/chips.obj")
    assert expected in caught.value.expected
    assert got in caught.value.got


def test_a_frame_file_that_links_out_of_the_raw_folder_is_refused(root, load_all, tmp_path_factory):
    path = root / "subject2/k1/3/cam4/action_label/000007.txt"
    outside = tmp_path_factory.mktemp("outside") / "secret.txt"
    path.rename(outside)
    path.symlink_to(outside)
    with pytest.raises(BadInput, match=r"action_label/000007\.txt.*leaves"):
        load_all(H2OAdapter(), root)


def test_the_camera_that_saw_each_frame_comes_with_the_clip(root, load_all):
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.camera.name == "cam4"
    assert clip.camera.images.tolist() == clip.source_frames.tolist() == list(range(3, 25))
    assert clip.camera.intrinsics is None
    turns = Rotation.from_rotvec(clip.camera.rotvec).as_matrix()
    for at, frame in enumerate(range(3, 25)):
        np.testing.assert_allclose(turns[at], camera(frame)[:3, :3], atol=1e-6)
        np.testing.assert_allclose(clip.camera.position_m[at], camera(frame)[:3, 3], atol=1e-6)


def test_intrinsics_are_read_where_they_are(root, load_all):
    (root / "subject2/k1/3/cam4/cam_intrinsics.txt").write_text("636.6593 636.2520 635.2839 366.8740 1280 720\n")
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.camera.intrinsics.tolist() == [636.6593, 636.2520, 635.2839, 366.8740, 1280.0, 720.0]
    assert "subject2/k1/3/cam4/cam_intrinsics.txt" in [source.path for source in clip.sources]


def test_a_frame_file_too_big_to_be_one_is_refused_without_reading_it(root, load_all):
    with open(root / "subject2/k1/3/cam4/cam_pose/000007.txt", "wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(BadInput, match=r"cam_pose/000007\.txt.*at most 1048576 bytes"):
        load_all(H2OAdapter(), root)


@pytest.mark.parametrize(
    "setting", [{"margin_frames": -5}, {"margin_frames": "abc"}, {"shortest_frames": 20.5}, {"hands": "manual"}]
)
def test_a_setting_that_cannot_be_is_refused_before_any_file_is_read(setting):
    with pytest.raises(BadInput, match=f"settings of the adapter h2o: {next(iter(setting))}"):
        H2OAdapter(**setting)
