"""H2O: a tree of text files written by hand, and what becomes of it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.datasets import Quarantined
from hoidata.datasets.h2o.adapter import H2OAdapter
from tests.builders.h2o import camera, object_in_camera, write_root, write_text


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_root(tmp_path)


@pytest.fixture
def clip(root, load_all):
    (clip,) = load_all(H2OAdapter(), root)
    return clip


def test_a_run_of_one_label_becomes_one_clip_with_its_words_and_source_frames(clip):
    assert (clip.clip_id, clip.subject) == ("h2o/subject2/k1/3/000003-000024", "subject2")
    assert (clip.verb, clip.object_words, clip.object.model.name) == ("take out", "chips", "chips")
    assert clip.source_frames.tolist() == list(range(3, 25))
    assert clip.gravity is None
    assert len(clip.hands["left"].betas) == 1  # equal in every frame


def test_source_frames_are_the_numbers_of_the_files_also_when_the_first_are_absent(root, clip, load_all):
    for path in sorted((root / "subject2/k1/3/cam4").glob("*/00000[01].txt")):
        path.unlink()
    (later,) = load_all(H2OAdapter(), root)
    assert later.clip_id == clip.clip_id
    assert later.source_frames.tolist() == list(range(3, 25))
    np.testing.assert_array_equal(later.hands["right"].wrist_m, clip.hands["right"].wrist_m)


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


def test_three_frames_without_the_object_are_bridged_and_marked_and_four_are_named_as_missing_poses(root, load_all):
    for frame in (8, 9, 10, 15):
        write_text(root / f"subject2/k1/3/cam4/obj_pose_rt/{frame:06d}.txt", [0, *np.zeros(16)])
    (clip,) = load_all(H2OAdapter(), root)
    made = [8, 9, 10, 15]
    assert clip.camera.images.tolist() == list(range(3, 25))
    assert (np.flatnonzero(~clip.recorded) + 3).tolist() == made
    assert clip.source_frames.tolist() == [7 if at in (8, 9, 10) else 14 if at == 15 else at for at in range(3, 25)]
    for frame in made:
        truth = camera(frame) @ object_in_camera(frame)
        assert np.abs(clip.object.translation_m[frame - 3] - truth[:3, 3]).max() < 1e-3
        turn = Rotation.from_rotvec(clip.object.rotvec[frame - 3]) * Rotation.from_matrix(truth[:3, :3]).inv()
        assert np.rad2deg(turn.magnitude()) < 0.2
    write_text(root / "subject2/k1/3/cam4/obj_pose_rt/000011.txt", [0, *np.zeros(16)])
    found = load_all(H2OAdapter(shortest_frames=4), root)
    assert [clip.source_frames[[0, -1]].tolist() for clip in found[:2]] == [[3, 7], [12, 24]]
    assert isinstance(found[2], Quarantined)
    assert "poses of chips without a gap of more than 3 frames" in found[2].expected
    assert found[2].got == "none in source frames 8 to 11"


def test_the_old_name_of_an_object_folder_is_known(root, load_all):
    (root / "object" / "chips" / "chips.obj").rename(root / "object" / "chips" / "pringles.obj")
    (root / "object" / "chips").rename(root / "object" / "pringles")
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.object.model.name == "chips"


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
