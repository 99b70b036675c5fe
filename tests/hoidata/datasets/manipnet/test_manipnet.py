"""ManipNet's adapter on a handwritten raw tree: left-handed, decimetres, 120 Hz, 17-joint hands.

Expected joints are computed link by link in the files' left-handed world and then mirrored.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from hoidata.annotation.stage import annotate_store
from hoidata.clips.clip import SIDES, Clip
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import Quarantined, RawTree
from hoidata.datasets.manipnet.adapter import (
    HAND_JOINTS,
    ManipNetAdapter,
    object_words,
    read_hand_recording,
    read_recording,
    thirty_fps_frames,
)
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.store.store import Store, open_store
from hoidata.store_check.check import check_store
from tests.builders.manipnet import KEY, MIRROR, POSE, lift_rows, write_skin, write_tree

HANDS = load_embedded_hands()


def load(raw: RawTree) -> tuple[list[Clip], list[Quarantined]]:
    results = ManipNetAdapter().load(raw, KEY, HANDS)
    return [x for x in results if isinstance(x, Clip)], [x for x in results if isinstance(x, Quarantined)]


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> tuple[RawTree, Clip]:
    """The raw tree of one lift and the single clip it gives."""
    raw = write_tree(tmp_path_factory.mktemp("carried"), *lift_rows())
    (clip,), left_out = load(raw)
    assert not left_out
    return raw, clip


def test_a_carried_object_becomes_one_clip_that_says_what_was_seen(carried: tuple[RawTree, Clip]) -> None:
    _, clip = carried
    assert (clip.verb, clip.object_words, clip.labelled_hand) == ("lift", "large tetrahedron", None)
    assert clip.clip_id == "manipnet/tetra_large7/000000-000596"
    assert np.array_equal(clip.source_frames, np.arange(0, 600, 4))
    np.testing.assert_array_equal(clip.gravity, [0, -1, 0])
    assert clip.source_fps == pytest.approx(120, abs=0.01)
    assert {source.path for source in clip.sources} == {
        "hand/hand_reference.json",
        "objects/Primitive/tetra_large.obj.gz",
        *(f"sequences/tetra_large7/{name}.bvh.gz" for name in ("leftHand", "rightHand", "tetra_large")),
    }


def test_the_fitted_hands_follow_the_recorded_joints(carried: tuple[RawTree, Clip]) -> None:
    raw, clip = carried
    recording = read_recording(raw, KEY.name)
    for side, keypoints_m in recording.keypoints_m.items():
        error_m = np.linalg.norm(track_joints(clip.hands[side], HANDS[side]) - keypoints_m, axis=-1)
        assert error_m.mean() < 0.010
        assert error_m[:, 16:].mean() < 0.005
        assert clip.hands[side].valid.all()


def test_source_from_world_recovers_the_numbers_of_the_file(carried: tuple[RawTree, Clip]) -> None:
    _, clip = carried
    world = np.append(clip.object.translation_m[-1], 1.0)
    sway = 0.002 * np.sin(596 / 9)
    np.testing.assert_allclose((clip.source_from_world @ world)[:3], [-0.9 + sway, 4.0, -0.4], atol=1e-5)
    corner = (clip.object.world_from_object @ clip.object.model.vertices_m)[-1, 0]
    np.testing.assert_allclose(corner * 10 * MIRROR, [-0.9 + sway - 0.5, 4.0, -0.4], atol=1e-5)


@pytest.mark.long
def test_frozen_and_jumping_intervals_are_cut_and_listed(tmp_path: Path) -> None:
    left, right, object_rows = lift_rows(1200)
    for rows in (left, right, object_rows):
        rows[800:900] = [rows[800]] * 100
    for frame in range(400, 1200):
        object_rows[frame] = [object_rows[frame][0] - 0.15, *object_rows[frame][1:]]
    clips, left_out = load(write_tree(tmp_path, left, right, object_rows))
    reasons = {item.source_key: item.got for item in left_out}
    assert reasons["manipnet/tetra_large7/000800-000899"] == "100 exactly equal frames"
    assert reasons["manipnet/tetra_large7/000398-000401"].startswith("object jumps 1.5 cm")
    for clip in clips:
        assert not np.isin(clip.source_frames, [*range(398, 402), *range(800, 900)]).any()
        assert np.array_equal(np.diff(clip.source_frames), np.full(clip.n_frames - 1, 4))
    assert len(clips) >= 3


@pytest.mark.slow
def test_a_touch_that_is_short_because_tracking_failed_says_so(tmp_path: Path) -> None:
    left, right, object_rows = lift_rows(280)
    for frame in range(140, len(object_rows)):  # the object jumps 1.5 cm: touches of 34 frames on both sides
        object_rows[frame][1] += 0.15
    _, left_out = load(write_tree(tmp_path, left, right, object_rows))
    short = [item.got for item in left_out if item.expected == "45 frames or more"]
    assert len(short) == 2
    assert all(got.endswith(", next to frames that are left out") for got in short)


@pytest.mark.slow
def test_a_wrist_far_from_the_object_is_cut_out(tmp_path: Path) -> None:
    left, right, object_rows = lift_rows()
    for frame in range(500, 600):
        left[frame][0] = -6.0 - (frame - 499) * 0.08
    _, left_out = load(write_tree(tmp_path, left, right, object_rows))
    assert [(item.expected, item.got) for item in left_out] == [
        ("both wrists within 1 m of the object", "a wrist 1.33 m away")
    ]


def test_times_not_frame_numbers_decide_at_other_rates() -> None:
    np.testing.assert_array_equal(thirty_fps_frames(8000, 0.008333334), np.arange(0, 8000, 4))
    frames = thirty_fps_frames(8000, 0.00862069)
    np.testing.assert_allclose(frames * 0.00862069, np.arange(len(frames)) / 30, atol=0.5 * 0.00862069)
    assert 0 <= (7999 - frames[-1]) * 0.00862069 < 1 / 30


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cyl_med", "medium cylinder"),
        ("cube_med", "medium cube"),
        ("tri_prism_large", "large triangular prism"),
        ("mug1", "mug"),
        ("bottle4_body", "bottle"),
        ("teapot2", "teapot"),
        ("wineglass3", "wine glass"),
        ("sphere", "sphere"),
    ],
)
def test_file_names_become_words(name: str, words: str) -> None:
    assert object_words(name) == words


@pytest.mark.long
def test_a_margin_keeps_usable_frames_around_the_interaction_under_the_same_id_and_verb(tmp_path: Path) -> None:
    """The hand comes down on the object until frame 100, which is lifted from frame 150; frames 8 to 11 are a jump."""
    left, right, object_rows = lift_rows()
    for frame in range(600):
        height = 1.0 + 3.0 * np.clip((frame - 150) / 240, 0, 1)
        object_rows[frame][:2] = [object_rows[frame][0] + (0.5 if frame < 10 else 0.0), height]
        right[frame][1] = height + max(0.0, (100 - frame) / 40)
    raw = write_tree(tmp_path, left, right, object_rows)
    (without,) = (item for item in ManipNetAdapter().load(raw, KEY, HANDS) if isinstance(item, Clip))
    (with_margin,) = (item for item in ManipNetAdapter(margin_frames=5).load(raw, KEY, HANDS) if isinstance(item, Clip))
    (with_all_frames,) = (
        item for item in ManipNetAdapter(margin_frames=99).load(raw, KEY, HANDS) if isinstance(item, Clip)
    )
    first = int(without.source_frames[0])
    assert 40 < first < 120
    np.testing.assert_array_equal(with_margin.source_frames, np.arange(first - 20, 600, 4))
    np.testing.assert_array_equal(with_all_frames.source_frames, np.arange(12, 600, 4))
    assert {(clip.clip_id, clip.verb) for clip in (without, with_margin, with_all_frames)} == {
        (without.clip_id, "lift")
    }


def test_clips_say_that_their_hands_were_fitted_to_keypoints_and_how_well(carried: tuple[RawTree, Clip]) -> None:
    raw, clip = carried
    recording = read_recording(raw, KEY.name)
    error_m = [
        np.linalg.norm(track_joints(clip.hands[side], HANDS[side]) - points, axis=-1)
        for side, points in recording.keypoints_m.items()
    ]
    assert clip.hands_from == "keypoints"
    assert clip.fit_error_m == pytest.approx(np.mean(error_m), abs=1e-6)


ANGLES = [0.0, 0.0, 0.0, *POSE[6:]]  # the grasping wrist does not rotate


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    left, right, object_rows = lift_rows(300)
    write_tree(
        folder, *([[*frame_numbers[:3], *ANGLES] for frame_numbers in rows] for rows in (left, right)), object_rows
    )
    write_skin(folder)
    return folder


@pytest.fixture(scope="module")
def stored(root, tmp_path_factory) -> Store:
    out = tmp_path_factory.mktemp("stored") / "clips"
    convert_dataset(ManipNetAdapter(), root, load_embedded_hands(), out, progress=False)
    return open_store(out)


def left_handed(root: Path, side: str) -> np.ndarray:
    """(17, 4, 4) poses of the joints in frame 7, decimetres: link by link, as the files have them."""
    arm = {"left": 1.0, "right": -1.0}[side]
    offsets = [(0.2, 0.12, -0.05), (0.18, 0.16, -0.1), (0.28, 0.2, -0.06), (0.3, 0.22, -0.04)]
    offsets += [(1.05, 0.25, 0.01), (0.41, 0.02, 0.0), (0.26, 0.01, 0.0), (1.04, 0.02, 0.03), (0.46, 0.0, 0.02)]
    offsets += [(0.3, 0.0, 0.0), (0.97, -0.19, 0.0), (0.42, -0.01, 0.02), (0.28, -0.02, 0.0)]
    offsets += [(0.86, -0.38, -0.07), (0.33, -0.02, 0.01), (0.22, -0.03, 0.0)]
    parents = [-1, 0, 1, 2, 3, 0, 5, 6, 0, 8, 9, 0, 11, 12, 0, 14, 15]
    turns = Rotation.from_euler("YXZ", np.reshape(ANGLES, (17, 3)), degrees=True).as_matrix()
    poses = np.tile(np.eye(4), (17, 1, 1))
    poses[:, :3, :3] = turns
    poses[0, :3, 3] = lift_rows(300)[SIDES.index(side)][7][:3]
    poses[1:, :3, 3] = np.array(offsets) * [arm, 1, 1]
    for joint, parent in enumerate(parents[1:], start=1):
        poses[joint] = poses[parent] @ poses[joint]
    return poses


def test_joints_tips_capsules_and_sensors_of_the_stored_recording_lie_where_the_files_put_them(root, stored):
    recording, skin = stored.recording(KEY.name), dict(np.load(root / "hand/right_hand_skin.npz"))
    reference = json.loads((root / "hand/hand_reference.json").read_text())
    assert (recording.n_frames, recording.hand.joint_names) == (300, HAND_JOINTS)
    for side in SIDES:
        poses, seven = left_handed(root, side), np.array([7])
        result = recording.state(side, seven).placed(recording.world_from_wrist(side)[seven])
        np.testing.assert_allclose(result.joint_m[0], poses[:, :3, 3] * MIRROR / 10, atol=1e-6)
        arm = np.ones(3) if side == "right" else MIRROR
        ends = [
            poses[HAND_JOINTS.index(capsule["joint"])] @ [*(arm * capsule["end_local"]), 1]
            for capsule in reference["capsules"]
        ]
        np.testing.assert_allclose(result.capsule_end_m[0], np.array(ends)[:, :3] * MIRROR / 10, atol=1e-6)
        np.testing.assert_allclose(result.tip_m[0], result.capsule_end_m[0][[6, 9, 12, 15, 18]], atol=1e-9)
        mirror = np.diag([*arm, 1.0])
        bones = [0, 0, *range(2, 17)]
        skinned = poses[bones] @ mirror @ skin["bind_poses"] @ mirror
        for sensor, vertex in enumerate(reference["proximity_vertices"]):
            bone, weight = skin["bone_indices"][vertex], skin["bone_weights"][vertex]
            rest, normal = arm * skin["vertices"][vertex], arm * skin["normals"][vertex]
            position_m = np.einsum("k,kij,j->i", weight, skinned[bone], [*rest, 1])[:3]
            normal_direction = np.einsum("k,kij,j->i", weight, skinned[bone][:, :3, :3], normal)
            np.testing.assert_allclose(result.sensor_m[0, sensor], position_m * MIRROR / 10, atol=1e-6)
            np.testing.assert_allclose(
                result.sensor_normal[0, sensor], normal_direction / np.linalg.norm(normal_direction) * MIRROR, atol=1e-5
            )


def test_the_store_gives_back_the_recording_it_was_given_and_is_sound(root, stored):
    recording, expected = stored.recording(KEY.name), read_hand_recording(RawTree(root), KEY)
    assert stored.recordings == [KEY.name]
    for side in SIDES:
        np.testing.assert_array_equal(recording.hands[side].rotvec, expected.hands[side].rotvec)
        np.testing.assert_array_equal(recording.hands[side].wrist_m, expected.hands[side].wrist_m)
    for name in ("rotvec", "translation_m"):
        np.testing.assert_array_equal(getattr(recording.object, name), getattr(expected.object, name))
    np.testing.assert_array_equal(recording.usable, expected.usable)
    np.testing.assert_array_equal(recording.state("left").sensor_m, expected.state("left").sensor_m)
    np.testing.assert_array_equal(recording.hand.limit_rad, expected.hand.limit_rad)
    assert {source.path for source in recording.sources} == {source.path for source in expected.sources}
    assert check_store(stored.folder) == []


def test_every_second_frame_of_a_recording_is_a_recording(stored):
    recording = stored.recording(KEY.name)
    few = recording.take(slice(None, None, 2))
    np.testing.assert_array_equal(few.usable, recording.usable[::2])
    np.testing.assert_array_equal(few.object.translation_m, recording.object.translation_m[::2])
    np.testing.assert_array_equal(few.state("left").tip_m, recording.state("left").tip_m[::2])
    for side in SIDES:
        np.testing.assert_array_equal(few.hands[side].wrist_m, recording.hands[side].wrist_m[::2])


def test_without_the_skin_file_there_are_clips_and_no_recordings(root, tmp_path):
    shutil.copytree(root, tmp_path / "raw")
    (tmp_path / "raw/hand/right_hand_skin.npz").unlink()
    convert_dataset(ManipNetAdapter(), tmp_path / "raw", load_embedded_hands(), tmp_path / "clips", progress=False)
    store = open_store(tmp_path / "clips")
    assert (len(store), store.recordings) == (1, [])
    assert "recordings" not in store.info
    assert not (tmp_path / "clips/arrays/recordings.npz").exists()
    with pytest.raises(KeyError, match="there are: "):
        store.recording(KEY.name)


@pytest.mark.parametrize(
    ("array_path", "change"),
    [
        ("arrays/recordings.npz", lambda arrays: {name: array[:-1] for name, array in arrays.items()}),
        ("arrays/recordings.npz", lambda arrays: dict(list(arrays.items())[1:])),
        ("arrays/source_hands.npz", lambda arrays: {name: array.astype(np.float32) for name, array in arrays.items()}),
        ("arrays/source_hands.npz", lambda arrays: {name: array * np.nan for name, array in arrays.items()}),
    ],
)
def test_a_damaged_recording_is_found_and_named(stored, tmp_path, array_path, change):
    shutil.copytree(stored.folder, tmp_path / "clips")
    with np.load(tmp_path / "clips" / array_path) as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "clips" / array_path, **change(arrays))
    problems = check_store(tmp_path / "clips")
    assert problems
    assert all(problem.where.startswith(array_path) for problem in problems)


@pytest.mark.parametrize(("key", "value"), [("hand", "none"), ("object", "cup"), ("source_files", [99]), ("fps", ...)])
def test_wrong_facts_of_a_recording_are_found(stored, tmp_path, key, value):
    shutil.copytree(stored.folder, tmp_path / "clips")
    path = tmp_path / "clips/meta/info.json"
    info = json.loads(path.read_text())
    facts = info["recordings"][KEY.name]
    facts.pop(key) if value is ... else facts.update({key: value})
    path.write_text(json.dumps(info))
    assert any(KEY.name in problem.where for problem in check_store(tmp_path / "clips"))


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays: arrays | {"vertices": arrays["vertices"][:-1]},
        lambda arrays: arrays | {"normals": arrays["normals"] * np.nan},
        lambda arrays: arrays | {"bone_weights": arrays["bone_weights"] * 2},
        lambda arrays: arrays | {"bone_indices": arrays["bone_indices"] + 1},
        lambda arrays: {name: array for name, array in arrays.items() if name != "bind_poses"},
    ],
)
def test_a_skin_that_is_not_the_released_one_is_refused_by_name(root, tmp_path, change):
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "hand/right_hand_skin.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **change(arrays))
    with pytest.raises(BadInput, match=r"right_hand_skin\.npz"):
        read_hand_recording(RawTree(tmp_path), KEY)


@pytest.mark.parametrize("sensors", [[0] * 103, [788] * 104, [-1] * 104, "many", None])
def test_a_reference_without_104_vertices_of_the_skin_is_refused(root, tmp_path, sensors):
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "hand/hand_reference.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"proximity_vertices": sensors}))
    with pytest.raises(BadInput, match=r"hand_reference\.json"):
        read_hand_recording(RawTree(tmp_path), KEY)


@pytest.mark.parametrize(
    "wrong", [None, {"radius": -1.0}, {"radius": float("nan")}, {"joint": "ELBOW"}, {"start_local": [0, 0]}]
)
def test_a_reference_without_19_sound_capsules_is_refused(root, tmp_path, wrong):
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "hand/hand_reference.json"
    reference = json.loads(path.read_text())
    first, *others = reference["capsules"]
    capsules = others if wrong is None else [first | wrong, *others]
    path.write_text(json.dumps(reference | {"capsules": capsules}))
    with pytest.raises(BadInput, match=r"hand_reference\.json"):
        read_hand_recording(RawTree(tmp_path), KEY)


def test_capsule_radii_are_metres(root, stored):
    capsules = json.loads((root / "hand/hand_reference.json").read_text())["capsules"]
    radius_m = [capsule["radius"] / 10 for capsule in capsules]
    np.testing.assert_allclose(stored.recording(KEY.name).hand.capsules.radius_m, radius_m)


def test_verbs_from_the_motion_are_not_called_labels(stored, tmp_path):
    counts = annotate_store(stored.folder, tmp_path / "annotation", encoder="hash")
    verbs = pd.read_parquet(tmp_path / "annotation/hand_type.parquet")
    assert verbs[["verb", "verb_source"]].to_numpy().tolist() == [["lift", "derived"]]
    assert counts["derived_verbs"] == 1
