"""Each adapter gives back, for every clip, the truth the embedded corpus was written from, and leaves bad files out."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.contact.hands import acting_hands
from hoidata.contact.proximity import ProximityIndex
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import get_adapter
from hoidata.files import load_npy, load_npz_objects
from hoidata.hands import load_embedded_hands
from hoidata.objects.sampling import sample_points
from hoidata.store.store import open_store

TOLERANCE = 1e-4  # metres, radians


@pytest.fixture(scope="module", params=["h2o", "grab", "arctic"])
def corpus(request, small_corpus):
    """(truths by sequence and first source frame, store) of one dataset's small corpus."""
    made = small_corpus(request.param)
    truths = {(truth.source_key, int(truth.source_frames[0])): truth for truth in made.truths}
    return truths, open_store(made.clips)


@pytest.fixture
def pairs(corpus):
    truths, store = corpus
    clips = [store.clip(clip_id) for clip_id in store.ids]
    assert {(clip.sequence, int(clip.source_frames[0])) for clip in clips} == set(truths)
    found = [truths[clip.sequence, int(clip.source_frames[0])] for clip in clips]
    return [(clip, truth.take(truth.clip_frames)) for clip, truth in zip(clips, found, strict=True)]


@pytest.mark.slow
def test_frames_words_and_hand_are_those_of_the_truth(corpus, pairs):
    truths, store = corpus
    assert len(pairs) == len(truths) >= 8
    for clip, truth in pairs:
        whole = truths[clip.sequence, int(clip.source_frames[0])]
        assert clip.source_frames.tolist() == whole.source_frames.tolist()
        assert (clip.verb, clip.object_words, clip.subject) == (truth.verb, truth.object_words, truth.subject)
        index = ProximityIndex(sample_points(clip.object.model))
        joints = {side: store.joints(clip.clip_id, side) for side in ("left", "right")}
        assert acting_hands(clip, joints, index).hand_type == truth.hand_type
        assert clip.labelled_hand in (None, truth.hand_type)


@pytest.mark.slow
def test_joints_are_those_of_the_truth(corpus, pairs):
    _, store = corpus
    for clip, truth in pairs:
        expected = truth.joints(load_embedded_hands())
        for side in ("left", "right"):
            np.testing.assert_array_equal(clip.hands[side].valid, truth.hands[side].valid)
            valid = clip.hands[side].valid
            np.testing.assert_allclose(
                store.joints(clip.clip_id, side)[valid], expected[side][valid], atol=TOLERANCE, rtol=0
            )


@pytest.mark.slow
def test_object_pose_and_hinge_are_those_of_the_truth(pairs):
    for clip, truth in pairs:
        close = partial(np.testing.assert_allclose, atol=TOLERANCE, rtol=0)
        close(clip.object.translation_m, truth.object.translation_m)
        between = Rotation.from_rotvec(clip.object.rotvec) * Rotation.from_rotvec(truth.object.rotvec).inv()
        assert between.magnitude().max() < TOLERANCE
        assert clip.object.is_articulated == truth.object.is_articulated
        if truth.object.hinge_rad is not None:
            close(clip.object.hinge_rad, truth.object.hinge_rad)


@pytest.mark.slow
def test_meshes_parts_and_hinges_are_those_of_the_truth(pairs):
    for clip, truth in pairs:
        found, expected = clip.object.model, truth.object.model
        assert found.name == truth.object_name
        np.testing.assert_allclose(found.vertices_m, expected.vertices_m, atol=1e-6, rtol=0)
        np.testing.assert_array_equal(found.faces, expected.faces)
        np.testing.assert_array_equal(found.part, expected.part)
        if expected.hinge is not None:
            assert found.hinge is not None
            np.testing.assert_allclose(found.hinge.axis, expected.hinge.axis, atol=1e-9)
            np.testing.assert_allclose(found.hinge.origin_m, expected.hinge.origin_m, atol=1e-9)


def _shorten(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _cut_last_column(path: Path) -> None:
    if path.suffix == ".txt":
        path.write_text(path.read_text().rsplit(maxsplit=1)[0])
    elif path.suffix == ".npy":
        np.save(path, load_npy(path)[:, :-1])
    else:
        _edit_npz(path, lambda values: values[:, :-1])


def _put_nan(path: Path) -> None:
    if path.suffix == ".txt":
        first, rest = path.read_text().split(maxsplit=1)
        path.write_text(f"{first} nan {rest.split(maxsplit=1)[1]}")
    elif path.suffix == ".npy":
        np.save(path, np.where(np.arange(7) == 4, np.nan, load_npy(path)))
    else:
        _edit_npz(path, lambda values: np.where(np.arange(3) == 1, np.nan, values))


def _edit_npz(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    data = load_npz_objects(path)
    data["object"]["params"]["transl"] = change(data["object"]["params"]["transl"])
    np.savez(
        path, **{key: np.array(value, object) if isinstance(value, dict) else value for key, value in data.items()}
    )


MOTION_FILE = {
    "h2o": "subject1/h1/0/cam4/hand_pose_mano/000030.txt",
    "grab": "grab/s2/apple_eat_1.npz",
    "arctic": "raw_seqs/s01/laptop_use_01.object.npy",
}
MESH_FILE = {
    "h2o": "object/*/*.obj",
    "grab": "tools/object_meshes/contact_meshes/apple.ply",
    "arctic": "meta/object_vtemplates/laptop/mesh.obj",
}
SPOIL = {
    "truncated": (MOTION_FILE, _shorten, ""),
    "missing": (MOTION_FILE, Path.unlink, "nothing there"),
    "with a column too few": (MOTION_FILE, _cut_last_column, ""),
    "holding NaN": (MOTION_FILE, _put_nan, "NaN"),
    "an unreadable mesh": (MESH_FILE, lambda path: path.write_bytes(b"no mesh"), ""),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SPOIL)
def test_a_sequence_with_a_file_that_is_bad_is_left_out_and_the_others_stay_the_same(corpus, tmp_path, name):
    _, store = corpus
    dataset = store.info["dataset"]
    files, spoil, got = SPOIL[name]
    shutil.copytree(store.folder.parent / "raw", tmp_path / "raw")
    for bad in sorted((tmp_path / "raw").glob(files[dataset])):
        spoil(bad)
    hands = load_embedded_hands()
    summary = convert_dataset(get_adapter(dataset), tmp_path / "raw", hands, tmp_path / "clips", progress=False)
    left_out = open_store(tmp_path / "clips").quarantine.to_dict("records")
    if name == "missing" and dataset == "grab":
        assert left_out == []  # a file that is not there is no sequence
    else:
        assert len(left_out) == len(summary.left_out) >= 1
    for row in left_out:
        assert not row["where"].startswith("/")
        assert got in row["got"]
        assert Path(bad).name.split(".")[0] in row["where"] or dataset == "h2o"
    bad_keys = tuple(row["source_key"] for row in left_out) or ("grab/s2/apple_eat_1",)
    again = open_store(tmp_path / "clips")
    assert again.ids == [clip_id for clip_id in store.ids if not clip_id.startswith(bad_keys)]
    for clip_id in again.ids:
        np.testing.assert_array_equal(again.joints(clip_id, "right"), store.joints(clip_id, "right"))
