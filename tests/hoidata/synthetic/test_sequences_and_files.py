"""One action of each format, made and written; the whole small corpora are in test_corpora.py."""

import io
import json
import zipfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.naive import READERS, NaiveHands
from hoidata.clips import SIDES
from hoidata.errors import HoidataError
from hoidata.files import sha256_file
from hoidata.files.restricted_pickle import ARRAYS, restricted_load
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.objects.mesh import load_mesh
from hoidata.synthetic.check import check_sequences, sequence_metrics
from hoidata.synthetic.corpus import write_corpus, write_raw_sequence, write_shared_files
from hoidata.synthetic.generate import make_action, place_in_raw_sequences, tasks_of
from hoidata.synthetic.grasps import closes_force
from hoidata.synthetic.sequences import Person, idle_hand
from hoidata.synthetic.soundness import measure
from hoidata.synthetic.truth import TruthSequence

pytestmark = pytest.mark.slow
ONE_ACTION = {"h2o": 0, "grab": 1, "arctic": 1}


def _one(dataset: str) -> TruthSequence:
    task = next(task for task in tasks_of(dataset, 3, "small") if task.action == ONE_ACTION[dataset])
    return place_in_raw_sequences(dataset, make_action(task._replace(entries=task.entries[:1])))[0]


@pytest.fixture(scope="module")
def truths() -> dict[str, TruthSequence]:
    return {dataset: _one(dataset) for dataset in ONE_ACTION}


@pytest.fixture(scope="module")
def root(truths, tmp_path_factory):
    folder = tmp_path_factory.mktemp("raw")
    for dataset, truth in truths.items():
        write_shared_files(dataset, folder / dataset, [truth])
        write_raw_sequence(dataset, folder / dataset, [truth])
    return folder


def test_a_cage_of_contacts_closes_force_and_a_pinch_does_not():
    faces = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    assert closes_force(0.05 * faces, faces, np.zeros(3))
    assert not closes_force(0.05 * faces[:2], faces[:2], np.zeros(3))
    pinch = np.array([[1.0, 0, 0], [-1, 0, 0], [1.0, 0, 0]])
    assert not closes_force(0.05 * pinch, pinch, np.zeros(3))


@pytest.mark.parametrize("dataset", ONE_ACTION)
def test_every_held_frame_is_sound(truths, dataset):
    sound = measure(truths[dataset], load_embedded_hands())
    assert len(sound.residual) > 15
    assert sound.residual.max() < 0.01
    assert sound.distance_m.max() < 0.02
    assert sound.penetration_m.max() < 0.01
    assert sound.idle_m > 0.2
    assert sound.is_sound


@pytest.mark.parametrize("dataset", ONE_ACTION)
def test_hands_that_are_shifted_or_missing_do_not_explain_the_motion(truths, dataset):
    figures = sequence_metrics(truths[dataset])
    assert figures.feasible == figures.lifted
    assert figures.feasible_without_contact <= 0.02 * figures.lifted
    far = measure(truths[dataset], load_embedded_hands(), np.array([0.0, 0.0, 0.3]))
    assert not far.is_sound
    assert (far.residual > 0.01).all()


@pytest.mark.parametrize("dataset", ONE_ACTION)
def test_while_held_the_hand_does_not_move_against_the_object(truths, dataset):
    truth = truths[dataset]
    frames = np.arange(*truth.contact)
    track = truth.object
    rotation = Rotation.from_rotvec(track.rotvec[frames])
    for side in truth.active_sides:
        local = rotation.inv().apply(truth.hands[side].wrist_m[frames] - track.translation_m[frames])
        assert np.abs(local - local[0]).max() < 1e-9


@pytest.mark.parametrize("dataset", ONE_ACTION)
def test_contact_lasts_from_the_frame_in_which_the_hand_is_closed_to_the_last_before_it_opens(truths, dataset):
    truth = truths[dataset]
    for side in truth.active_sides:
        pose = truth.hands[side].hand_pose
        closed = np.abs(pose - pose[sum(truth.contact) // 2]).max(axis=1) < 1e-12
        np.testing.assert_array_equal(np.flatnonzero(closed), np.arange(*truth.contact))


def test_an_idle_left_hand_is_the_mirror_image_of_a_right_one():
    person, pair = Person("s1", np.zeros(10), None), load_embedded_hands()
    left, right = (
        track_joints(idle_hand(side, person, 3, np.random.default_rng(0), True), pair[side]) for side in SIDES
    )
    np.testing.assert_allclose(left, right * (-1.0, 1.0, 1.0), atol=1e-6)


@pytest.mark.parametrize("dataset", ONE_ACTION)
def test_equal_seeds_give_equal_sequences_and_other_seeds_others(truths, dataset):
    again = _one(dataset)
    np.testing.assert_array_equal(again.object.translation_m, truths[dataset].object.translation_m)
    side = again.active_sides[0]
    np.testing.assert_array_equal(again.hands[side].hand_pose, truths[dataset].hands[side].hand_pose)


@pytest.mark.parametrize("dataset", ONE_ACTION)
def test_raw_files_read_frame_by_frame_as_the_field_reads_them_give_the_hands_and_the_object_that_were_made(
    truths, root, dataset
):
    """With the formulas of the datasets, not the adapters': a mirrored hand, a swapped side or another unit shows."""
    truth, pair = truths[dataset], load_embedded_hands()
    sampled_frames = np.linspace(*truth.contact, 3, endpoint=False).astype(int)
    read_back = READERS[dataset](root / dataset, truth.source_key, sampled_frames + truth.raw_start, NaiveHands(pair))
    sides = [number for number, side in enumerate(SIDES) if truth.hands[side].valid.all()]
    assert {SIDES[number] for number in sides} >= set(truth.active_sides)
    for number in sides:
        expected = truth.joints(pair)[SIDES[number]][sampled_frames]
        np.testing.assert_allclose(read_back.joints_m[:, number], expected, atol=4e-3 if dataset == "grab" else 2e-6)
        np.testing.assert_allclose(read_back.joints_m[:, number, 0], expected[:, 0], atol=2e-6)
    pose = read_back.object_pose
    np.testing.assert_allclose(pose[:, :3, 3], truth.object.translation_m[sampled_frames], atol=2e-6)
    turns = Rotation.from_rotvec(truth.object.rotvec[sampled_frames]).as_matrix()
    np.testing.assert_allclose(pose[:, :3, :3], turns, atol=2e-6)


def _npz_member(path, name):
    with zipfile.ZipFile(path) as archive:
        return archive.read(f"{name}.npy")


def _unboxed(npy: bytes):
    stream = io.BytesIO(npy)
    assert np.lib.format.read_magic(stream) == (1, 0)
    shape, _, kind = np.lib.format.read_array_header_1_0(stream)
    assert shape == ()
    assert kind == np.dtype(object)
    return restricted_load(stream, ARRAYS).item()


def test_grab_members_are_0d_and_pickled_as_numpy_1_did(truths, root):
    truth = truths["grab"]
    path = root / "grab" / "grab" / f"{truth.source_key}.npz"
    with np.load(path, allow_pickle=False) as archive:
        assert set(archive.files) == {
            "gender", "sbj_id", "obj_name", "motion_intent", "framerate", "n_frames", "n_comps", "body", "lhand",
            "rhand", "object", "table", "contact",
        }  # fmt: skip
        assert archive["framerate"].shape == ()
        assert archive["motion_intent"].item() == truth.intent
        assert archive["n_frames"].item() == truth.n_frames
    for name in ("body", "lhand", "rhand", "object", "table", "contact"):
        assert b"numpy._core" not in _npz_member(path, name)
        _unboxed(_npz_member(path, name))
    contact = _unboxed(_npz_member(path, "contact"))["object"]
    assert contact.shape == (truth.n_frames, len(truth.object.model.vertices_m))
    touched = np.flatnonzero((contact > 0).any(1))
    np.testing.assert_array_equal(touched, np.arange(*truth.contact))
    left_ids = {0, 21, *range(26, 41)}
    assert set(np.unique(contact)) <= left_ids  # "eat apple" is done with the left hand


def _row(folder, kind: str, frame: int) -> np.ndarray:
    return np.array((folder / kind / f"{frame:06d}.txt").read_text().split(), dtype=np.float64)


def test_h2o_lines_have_the_right_counts_and_numbering(truths, root):
    truth = truths["h2o"]
    folder = root / "h2o" / truth.source_key / "cam4"
    frame = truth.raw_start + truth.clip[0]
    counts = {"cam_pose": 16, "hand_pose": 128, "hand_pose_mano": 124, "obj_pose": 64, "obj_pose_rt": 17,
              "action_label": 1, "verb_label": 1}  # fmt: skip
    assert {kind: len(_row(folder, kind, frame)) for kind in counts} == counts
    labels = [int(_row(folder, "action_label", n)[0]) for n in range(len(list((folder / "action_label").iterdir())))]
    labelled = np.flatnonzero(labels)
    np.testing.assert_array_equal(labelled, np.arange(*truth.clip) + truth.raw_start)
    assert set(np.array(labels)[labelled]) == {2}  # grab espresso


def test_arctic_parts_and_meshes_belong_together(truths, root):
    truth = truths["arctic"]
    folder = root / "arctic" / "meta" / "object_vtemplates" / truth.object_name
    mesh = load_mesh(folder / "mesh.obj")
    parts = np.array(json.loads((folder / "parts.json").read_text()))
    assert len(parts) == len(mesh.vertices)
    top = np.array(json.loads((folder / "top_keypoints_300.json").read_text())["keypoints"])
    nearest = np.linalg.norm(mesh.vertices[:, None] - top, axis=2).argmin(0)
    assert (parts[nearest] == 0).all()
    np.testing.assert_allclose(mesh.vertices / 1000, truth.object.model.vertices_m, atol=1e-9)


def test_arctic_descriptions_name_range_verb_and_hand_in_four_tokens(truths, root):
    truth = truths["arctic"]
    line = (root / "arctic" / "description" / truth.source_key / "description.txt").read_text().splitlines()[0]
    span, verb, hand, last = line.split(" ")
    start, stop = map(int, span.split("-"))
    assert (start - 1, stop) == (truth.raw_start + truth.clip[0], truth.raw_start + truth.clip[1])
    assert (verb, hand, last) == ("shake,", "right", "hand")
    assert list(truth.source_frames) == list(range(start - 1, stop))


def test_grab_clips_are_every_fourth_frame_of_the_contact(truths):
    truth = truths["grab"]
    frames = truth.source_frames
    assert (frames % 4 == 0).all()
    assert (np.diff(frames) == 4).all()
    assert truth.contact[0] <= frames[0] < truth.contact[0] + 4
    assert truth.contact[1] - 4 <= frames[-1] < truth.contact[1]
    assert truth.take(truth.clip_frames).n_frames == len(frames)


def _digests(root) -> dict[str, str]:
    return {str(path.relative_to(root)): sha256_file(path) for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.long
def test_a_corpus_is_the_same_bytes_for_any_number_of_jobs(small_corpus, tmp_path):
    write_corpus("grab", tmp_path / "together", seed=0, size="small", jobs=2)
    assert _digests(tmp_path / "together") == _digests(small_corpus("grab").raw)


@pytest.mark.parametrize("dataset", ["h2o", "grab", "arctic"])
def test_a_corpus_is_sound(dataset, small_corpus):
    figures = check_sequences(small_corpus(dataset).truths).iloc[0]
    assert figures["sequences"] == 8
    assert figures["pass %"] >= 98
    assert figures["largest hand-object distance mm"] < 20
    assert figures["largest penetration mm"] < 10
    assert figures["pass % shifted 10 mm"] < 0.8 * figures["pass %"]
    assert figures["pass % without contact"] < 1


def test_an_unknown_corpus_is_refused_with_the_known_names(tmp_path):
    with pytest.raises(HoidataError, match="h2o, grab, arctic"):
        write_corpus("mimic", tmp_path / "x")
