"""One action of each format, made and written; the whole small corpora are in test_corpora.py."""

import io
import json
import zipfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.naive import READERS, NaiveHands
from hoidata.clips import SIDES
from hoidata.clips.clip import ObjectTrack
from hoidata.errors import HoidataError
from hoidata.files import sha256_file
from hoidata.files.restricted_pickle import ARRAYS, restricted_load
from hoidata.hands import load_embedded_hands, track_joints, track_vertices
from hoidata.metrics.corpus_statistics import LOST_FRAMES
from hoidata.objects.distance import closest_points
from hoidata.objects.mesh import load_mesh
from hoidata.objects.model import articulate
from hoidata.synthetic.catalogue import object_model
from hoidata.synthetic.corpus import write_corpus, write_raw_sequence, write_shared_files
from hoidata.synthetic.generate import make_action, place_in_raw_sequences, tasks_of
from hoidata.synthetic.grasps import Grip, closes_force
from hoidata.synthetic.sequences import (
    REGRASP_FRAMES,
    Person,
    Release,
    grasping_hand,
    grasps_of,
    idle_hand,
    released_frames,
)
from hoidata.synthetic.truth import TruthSequence
from tests.builders.study import check_soundness

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
def test_in_contact_hands_touch_and_slide_and_fingers_move_and_before_and_after_they_are_away(truths, dataset):
    truth, pair = truths[dataset].at_30_fps(), load_embedded_hands()
    in_object = Rotation.from_rotvec(truth.object.rotvec).inv()
    for side in truth.active_sides:
        touching, hand = truth.in_contact(side), truth.hands[side]
        vertices = track_vertices(hand, pair[side]).astype(np.float64)
        model, away = truth.object.model, []
        for frame in np.flatnonzero(touching | (np.arange(truth.n_frames) % 5 == 0)):
            local = in_object[frame].apply(vertices[frame] - truth.object.translation_m[frame])
            angle = None if truth.object.hinge_rad is None else truth.object.hinge_rad[frame : frame + 1]
            points_m = articulate(model.vertices_m, model.part, model.hinge, angle)[0]
            away.append((frame, closest_points(points_m, model.faces, local).distance_m.min()))
        assert max(distance for frame, distance in away if touching[frame]) < 0.004
        assert min(away[0][1], away[-1][1]) > 0.02
        wrist_m = in_object.apply(hand.wrist_m - truth.object.translation_m)
        step_cm_s = 3000 * np.linalg.norm(np.diff(wrist_m, axis=0), axis=1)[touching[1:] & touching[:-1]]
        assert 0.5 < step_cm_s.mean() < 12
        joints = Rotation.from_rotvec(hand.hand_pose.reshape(-1, 3))
        before, after = (np.arange(len(joints)).reshape(-1, 15)[part].ravel() for part in (np.s_[:-1], np.s_[1:]))
        deg_s = 30 * np.rad2deg((joints[before].inv() * joints[after]).magnitude()).reshape(-1, 15).mean(axis=1)
        assert 30 < deg_s[touching[1:] & touching[:-1]].mean() < 120


def test_a_hand_that_regrasps_lets_go_for_long_enough_to_count_and_comes_back():
    times, person = np.arange(100.0), Person("s1", np.zeros(10), None)
    model = object_model("grab", "cubelarge")
    still = ObjectTrack(model, np.zeros((100, 3)), np.zeros((100, 3)))
    grip = Grip(side="right", wrist_m=np.array([0.1, 0, 0]), rotmat=np.eye(3), hand_pose=np.full(45, 0.3),
                open_pose=np.zeros(45), part=0)  # fmt: skip
    release = Release("right", 26.0, 20.0 + REGRASP_FRAMES)
    grasps = grasps_of((20.0, 80.0), "right", release)
    assert grasps_of((20.0, 80.0), "left", release) == ((20.0, 80.0),)
    hand = grasping_hand(grip, person, still, np.tile(np.eye(3), (100, 1, 1)), times, grasps, np.zeros((100, 51)))
    away_m = np.linalg.norm(hand.wrist_m - grip.wrist_m, axis=1)
    closed = np.all(np.isclose(hand.hand_pose, grip.hand_pose), axis=1)
    expected = [*range(20, 27), *range(20 + REGRASP_FRAMES, 81)]
    assert np.flatnonzero(closed & (away_m < 1e-9)).tolist() == expected
    first, last = released_frames(release, 1)["right"]
    assert np.setdiff1d(np.arange(20, 81), expected).tolist() == list(range(first, last))
    assert np.sum(away_m[first:last] > 0.03) > LOST_FRAMES
    assert hand.hand_pose[first:last].min() == pytest.approx(0.0)


def test_an_idle_left_hand_is_the_mirror_image_of_a_right_one():
    person, pair = Person("s1", np.zeros(10), None), load_embedded_hands()
    left, right = (
        track_joints(idle_hand(side, person, 3, np.random.default_rng(0), True), pair[side]) for side in SIDES
    )
    np.testing.assert_allclose(left, right * (-1.0, 1.0, 1.0), atol=1e-6)


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


@pytest.mark.long
@pytest.mark.parametrize("dataset", ONE_ACTION)
def test_a_corpus_is_sound_and_shifted_hands_are_not(dataset, small_corpus):
    truths = small_corpus(dataset).truths
    assert len(truths) == 8
    check_soundness(truths)


def test_an_unknown_corpus_is_refused_with_the_known_names(tmp_path):
    with pytest.raises(HoidataError, match="h2o, grab, arctic"):
        write_corpus("mimic", tmp_path / "x")
