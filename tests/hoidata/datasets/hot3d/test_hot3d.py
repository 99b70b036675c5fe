"""HOT3D's adapter on recordings of a ground truth: intervals, the authors' check, UmeTrack's hands, licences."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hoidata.annotation.sentences import english_sentences
from hoidata.clips.clip import SIDES, Clip
from hoidata.clips.validation import check_clip
from hoidata.conformance.check import check_adapter
from hoidata.conversion.convert import convert_dataset
from hoidata.dataset_folders import BUILT_IN, facts_of_adapter
from hoidata.datasets import Quarantined, RawTree, SequenceKey
from hoidata.datasets.hot3d.adapter import Hot3dAdapter
from hoidata.datasets.hot3d.files import NOUNS, object_words
from hoidata.errors import BadInput
from hoidata.hands import track_joints
from hoidata.store.store import open_store
from pipelines.exports.describe import dataset_card
from pipelines.exports.licences import licences_of
from pipelines.exports.motion import Format
from tests.builders import hot3d
from tests.builders.corruption import replaced
from tests.builders.formulas import chain, rest_points
from tests.builders.hot3d import ARIA, HANDS, KEYBOARD, MUG, N_FRAMES, QUEST, UMETRACK

MASK = f"{ARIA}/masks/mask_qa_pass.csv"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return hot3d.write_two(tmp_path / "raw")


def load(root: Path, name: str = ARIA, **settings) -> list[Clip | Quarantined]:
    return Hot3dAdapter(**settings).load(RawTree(root), hot3d.key_of(name), HANDS)


def only_clip(root: Path, name: str = ARIA, **settings) -> Clip:
    (clip,) = load(root, name, **settings)
    assert isinstance(clip, Clip)
    return check_clip(clip)


def edit_rows(root: Path, change: Callable[[int, list[str]], list[str] | None], uid: str = MUG) -> None:
    """Change the cells of an object's rows, or drop them; frames count from 0."""
    path = root / ARIA / "dynamic_objects.csv"
    head, *lines = path.read_text().splitlines()
    frame_of = {str(time): frame for frame, times in enumerate(hot3d.times("Aria")) for time in times}
    cells = [line.split(",") for line in lines]
    edited_cells = [
        change(frame_of[row_cells[1]], row_cells) if row_cells[0] == uid else row_cells for row_cells in cells
    ]
    path.write_text("\n".join([head, *(",".join(row_cells) for row_cells in edited_cells if row_cells)]))


def away(cells: list[str]) -> list[str]:
    return [*cells[:2], "7.0", *cells[3:]]


@pytest.mark.parametrize(("name", "headset", "seed"), [(ARIA, "Aria", 0), (QUEST, "Quest3", 1)])
def test_a_recording_comes_back_to_its_truth(root: Path, name: str, headset: str, seed: int) -> None:
    """Joints and object of every frame, within 0.1 mm of the ground truth, for the world of either headset."""
    clip, truth = only_clip(root, name), hot3d.truth(headset, "mano", seed)
    for side in SIDES:
        numbers, rotation, position_m = truth.hands[side]
        rest = rest_points(HANDS[side], numbers["betas"])
        bends = HANDS[side].mean_pose + np.array(numbers["pose"]) @ HANDS[side].components[:15]
        planted = [chain(rest, rotation[frame].as_rotvec(), bends, position_m[frame]) for frame in range(N_FRAMES)]
        assert np.abs(track_joints(clip.hands[side], HANDS[side])[:, :16] - planted).max() < 1e-4
    box = hot3d.box(hot3d.HALF_BOX_M)
    planted = [
        rotation.apply(box) + position_m for rotation, position_m in zip(truth.rotation, truth.position_m, strict=True)
    ]
    order = [int(np.linalg.norm(clip.object.model.vertices_m - corner, axis=1).argmin()) for corner in box]
    assert np.abs((clip.object.world_from_object @ clip.object.model.vertices_m)[:, order] - planted).max() < 1e-4


def test_a_clip_has_words_of_its_object_and_no_verb(root: Path) -> None:
    clip = only_clip(root)
    assert clip.clip_id == f"hot3d/{ARIA}/00000-00035-mug_white"
    assert (clip.verb, clip.object_words, clip.subject) == (None, "white mug", "P0001")
    assert english_sentences(clip.verb, clip.object_words, "both")[0] == "Move a white mug with both hands."
    assert [track.model.name for track in clip.other_objects] == ["keyboard"]
    assert [str(key) for key in Hot3dAdapter().sequences(root)] == [f"hot3d/{ARIA}", f"hot3d/{QUEST}"]


def test_every_object_of_the_makers_has_words() -> None:
    assert object_words("coffee_pot") == "coffee pot"
    assert all(words == object_words(name) and not any(map(str.isdigit, words)) for name, words in NOUNS.items())


def test_a_clip_names_its_source_files(root: Path) -> None:
    recording_files = [f"{ARIA}/{name}" for name in ("dynamic_objects.csv", hot3d.MANO_FILE, "metadata.json")]
    shared = ["assets/instance.json", *(f"assets/{uid}.glb" for uid in (MUG, KEYBOARD))]
    assert [source.path for source in only_clip(root).sources] == sorted([*recording_files, *shared, MASK])


def test_an_interval_begins_and_ends_with_the_touch_and_a_margin_widens_it(root: Path) -> None:
    edit_rows(root, lambda frame, cells: cells if 2 <= frame < 34 else away(cells))
    assert only_clip(root).source_frames.tolist() == list(range(2, 34))
    assert only_clip(root, margin_frames=1).source_frames.tolist() == list(range(1, 35))
    assert only_clip(root, margin_frames=99).n_frames == N_FRAMES


def test_a_gap_of_ten_frames_without_touch_is_part_of_it_and_one_of_eleven_is_not(root: Path) -> None:
    edit_rows(root, lambda frame, cells: away(cells) if 12 <= frame < 22 else cells)
    assert only_clip(root).n_frames == N_FRAMES
    edit_rows(root, lambda frame, cells: away(cells) if 12 <= frame < 23 else cells)
    clips = load(root, shortest_frames=12)
    assert [clip.source_frames[[0, -1]].tolist() for clip in clips if isinstance(clip, Clip)] == [[0, 11], [23, 35]]


def test_long_intervals_are_divided_evenly(root: Path) -> None:
    clips = load(root, longest_frames=15)
    assert [clip.n_frames for clip in clips if isinstance(clip, Clip)] == [12, 12, 12]


def test_frames_that_failed_the_authors_check_are_excluded_and_counted(root: Path) -> None:
    (root / MASK).write_text(hot3d.mask_table(hot3d.truth("Aria", "mano", 0), "Aria", {2: "1201-2", 3: "214-1"}))
    failed, short, clip = load(root)
    assert isinstance(clip, Clip)
    assert clip.source_frames.tolist() == list(range(4, N_FRAMES))
    assert isinstance(failed, Quarantined)
    assert (failed.source_key, failed.got) == (f"hot3d/{ARIA}/failed", "1 others, 2 frames, the first frame 2")
    assert isinstance(short, Quarantined)
    assert short.source_key == f"hot3d/{ARIA}/mug_white/short"
    (root / MASK).unlink()
    assert only_clip(root).n_frames == N_FRAMES


def without_times(root: Path, frames: range) -> None:
    """Remove these frames from all files."""
    hands = root / ARIA / hot3d.MANO_FILE
    lines = hands.read_text().splitlines(keepends=True)
    hands.write_text("".join([*lines[: 2 * frames.start], *lines[2 * frames.stop :]]))
    for uid in (MUG, KEYBOARD):
        edit_rows(root, lambda frame, cells: None if frame in frames else cells, uid)


def test_frames_without_the_object_and_times_that_are_missing_end_an_interval(root: Path) -> None:
    edit_rows(root, lambda frame, cells: None if 32 <= frame < 36 else cells)
    assert [clip.n_frames for clip in load(root) if isinstance(clip, Clip)] == [32]
    without_times(root, range(28, 32))
    assert [clip.n_frames for clip in load(root, shortest_frames=20) if isinstance(clip, Clip)] == [28]


def close_to_truth(clip: Clip, interpolated: list[int]) -> None:
    """Interpolated frames are marked and close to the ground truth, which moves evenly."""
    truth = hot3d.truth("Aria", "mano", 0)
    assert np.flatnonzero(~clip.recorded).tolist() == interpolated
    assert np.abs(clip.object.translation_m[interpolated] - truth.position_m[interpolated]).max() < 1e-4
    rotated = np.linalg.norm(
        (np.array([t.as_rotvec() for t in truth.rotation]) - clip.object.rotvec)[interpolated], axis=1
    )
    assert np.rad2deg(rotated.max()) < 1


def test_short_gaps_in_the_objects_poses_are_bridged_and_marked(root: Path) -> None:
    gaps = {9, 19, 20, 29, 30, 31}
    edit_rows(root, lambda frame, cells: None if frame in gaps else cells)
    clip = only_clip(root)
    close_to_truth(clip, sorted(gaps))
    assert clip.n_frames == N_FRAMES
    assert clip.source_frames[[8, 9, 10, 18, 19, 20, 21]].tolist() == [8, 8, 10, 18, 18, 18, 21]
    assert all(track.valid.all() for track in clip.hands.values())


def test_frames_that_no_file_has_are_added_where_three_or_fewer_are_lost(root: Path) -> None:
    without_times(root, range(12, 15))
    clip = only_clip(root)
    close_to_truth(clip, [12, 13, 14])
    assert np.flatnonzero(~clip.hands["left"].valid).tolist() == [12, 13, 14]


def test_a_long_gap_is_reported_as_missing_poses_and_not_as_short_touches(root: Path) -> None:
    edit_rows(root, lambda frame, cells: None if 12 <= frame < 20 else cells)
    missing, cut = load(root)
    assert isinstance(missing, Quarantined)
    assert missing.source_key == f"hot3d/{ARIA}/mug_white/missing"
    assert (missing.expected, missing.got) == (
        "poses of mug_white without a gap of more than 3 frames at 30 per second",
        "none in source frames 12 to 19",
    )
    assert isinstance(cut, Quarantined)
    assert "between missing poses of the object or a hand" in cut.expected
    assert cut.got == "2 others, 28 frames, the first frame 0"


def test_a_hand_that_is_lost_during_contact_is_reported_too(root: Path) -> None:
    lines = (root / ARIA / hot3d.MANO_FILE).read_text().splitlines()
    lost = [json.dumps({**json.loads(line), "hand_poses": {}}) for line in lines[24:48]]
    (root / ARIA / hot3d.MANO_FILE).write_text("\n".join([*lines[:24], *lost, *lines[48:]]))
    (cut,) = load(root)
    assert isinstance(cut, Quarantined)
    assert cut.source_key == f"hot3d/{ARIA}/mug_white/cut"


def test_a_clip_begins_and_ends_with_a_recorded_frame(root: Path) -> None:
    edit_rows(root, lambda frame, cells: None if frame in (17, 18) else cells)
    clips = [clip for clip in load(root, longest_frames=18) if isinstance(clip, Clip)]
    assert [clip.source_frames[[0, -1]].tolist() for clip in clips] == [[0, 16], [19, 35]]


def test_a_clip_has_another_object_only_if_it_is_tracked_throughout(root: Path) -> None:
    edit_rows(root, lambda frame, cells: None if frame == 9 else cells, KEYBOARD)
    clip = only_clip(root)
    assert np.flatnonzero(~clip.recorded).tolist() == [9]
    assert len(clip.other_objects) == 1
    edit_rows(root, lambda frame, cells: None if 9 <= frame < 13 else cells, KEYBOARD)
    assert next(item for item in load(root) if isinstance(item, Clip)).other_objects == ()


def test_an_object_that_is_touched_and_does_not_move_gives_no_clip(root: Path) -> None:
    still = (root / ARIA / "dynamic_objects.csv").read_text().splitlines()[1].split(",")[2:]
    edit_rows(root, lambda frame, cells: [*cells[:2], *still])
    hands = [json.loads(line) for line in (root / ARIA / hot3d.MANO_FILE).read_text().splitlines()]
    still_hands = [json.dumps({**line, "hand_poses": hands[0]["hand_poses"]}) for line in hands]
    (root / ARIA / hot3d.MANO_FILE).write_text("\n".join(still_hands))
    (item,) = load(root)
    assert isinstance(item, Quarantined)
    assert (item.source_key, item.expected) == (f"hot3d/{ARIA}/mug_white/still", "an object that moves 2 cm")


PACKED = SequenceKey("hot3d", "clips", "train_quest3/clip-001849")


def load_packed(root: Path, **settings) -> list[Clip | Quarantined]:
    return Hot3dAdapter(**settings).load(RawTree(root), PACKED, HANDS)


def test_a_clip_of_hot3d_clips_equals_its_recording(root: Path, tmp_path: Path) -> None:
    """The same truth packed into a tar: the same motion, of the participant of the recording."""
    hot3d.write_clip(tmp_path / "clips", "Quest3", 1849, QUEST, hot3d.truth("Quest3", "mano", 1))
    assert Hot3dAdapter().sequences(tmp_path / "clips") == [PACKED]
    (clip,) = load_packed(tmp_path / "clips")
    assert isinstance(clip, Clip)
    whole = only_clip(root, QUEST)
    assert check_clip(clip).clip_id == f"{PACKED}/00000-00035-mug_white"
    assert (clip.sequence, clip.subject, clip.object_words) == (PACKED.name, "P0002", "white mug")
    assert np.flatnonzero(~clip.hands["left"].valid).tolist() == [5]
    for side in SIDES:
        joints_m = [track_joints(item.hands[side], HANDS[side])[clip.hands[side].valid] for item in (clip, whole)]
        assert np.abs(joints_m[0] - joints_m[1]).max() < 1e-5
    np.testing.assert_allclose(clip.object.translation_m, whole.object.translation_m, atol=1e-6)
    np.testing.assert_allclose(clip.object.rotvec, whole.object.rotvec, atol=1e-5)
    np.testing.assert_array_equal(clip.source_from_world, whole.source_from_world)
    assert [source.path for source in clip.sources] == [
        "clip_definitions.json",
        "object_models_eval/obj_000009.glb",
        "train_quest3/clip-001849.tar",
    ]


@pytest.mark.slow
def test_clips_of_hot3d_clips_keep_every_rule_of_the_conformance_check(packed_root: Path) -> None:
    hot3d.write_clip(packed_root, "Quest3", 1850, QUEST, hot3d.truth("Quest3", "mano", 3))
    table = {str(number): {"sequence_id": QUEST, "device": "Quest3"} for number in (1849, 1850)}
    (packed_root / "clip_definitions.json").write_text(json.dumps(table))
    findings = check_adapter(Hot3dAdapter(), packed_root, HANDS, worker=False)
    assert [item for item in findings if item.outcome == "fail"] == []


@pytest.mark.long
def test_a_clip_of_hot3d_clips_without_manos_numbers_gets_fitted_hands(tmp_path: Path) -> None:
    hot3d.write_clip(tmp_path, "Quest3", 1849, QUEST, hot3d.truth("Quest3", "mano", 1), without="mano")
    assert all(item.hands_from == "keypoints" for item in load_packed(tmp_path) if isinstance(item, Clip))
    assert load_packed(tmp_path)


@pytest.mark.parametrize(
    ("path", "change", "message"),
    [
        (f"{PACKED.name}.tar", lambda data: data[:300], "a whole .tar archive"),
        (f"{PACKED.name}.tar", lambda data: b"", "a whole .tar archive"),
        (f"{PACKED.name}.tar", lambda data: data[:0] + bytes(10240), "of test clips they are withheld"),
        (f"{PACKED.name}.tar", replaced(b'"wrist_xform": [', b'"wrist_xform": {'), "JSON text"),
        (f"{PACKED.name}.tar", replaced(b'"thetas": [', b'"thetaz": ['), "the entry 'thetas'"),
        (f"{PACKED.name}.tar", replaced(b'"object_name": "mug', b'"object_name": "MUG'), "lower-case words"),
        (f"{PACKED.name}.tar", replaced(b'{"9": [', b'{"x": ['), "a number, and one object"),
        (f"{PACKED.name}.tar", replaced(b'{"mano": ', b'{"nano": '), "the entry 'mano'"),
        ("clip_definitions.json", lambda data: b"{}", "the entry '1849'"),
        ("clip_definitions.json", replaced(b"P0002_", b"../02_"), "a recording such as"),
        ("clip_definitions.json", replaced(b"Quest3", b"Quest4"), "Aria or Quest3"),
        ("object_models_eval/obj_000009.glb", lambda data: b"", "a readable mesh"),
    ],
)
def test_a_corrupted_clip_of_hot3d_clips_is_named(tmp_path: Path, packed_root: Path, path, change, message) -> None:
    root = shutil.copytree(packed_root, tmp_path / "clips")
    (root / path).write_bytes(change((root / path).read_bytes()))
    with pytest.raises(BadInput, match=message) as caught:
        load_packed(root)
    assert path in caught.value.where


@pytest.fixture(scope="module")
def packed_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("packed")
    hot3d.write_clip(root, "Quest3", 1849, QUEST, hot3d.truth("Quest3", "mano", 1))
    return root


@pytest.fixture(scope="module")
def umetrack_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("umetrack")
    hot3d.write_assets(root)
    hot3d.write_recording(root, UMETRACK, "Aria", "umetrack", 2, MUG)
    return root


@pytest.mark.slow
def test_a_recording_with_umetracks_hands_alone_gets_hands_fitted_to_their_joints(umetrack_root: Path) -> None:
    """The person has the embedded hand, so the fit can reach the joints."""
    clip, truth = only_clip(umetrack_root, UMETRACK), hot3d.truth("Aria", "umetrack", 2)
    assert clip.hands_from == "keypoints"
    assert clip.fit_error_m is not None
    assert clip.fit_error_m < 5e-4
    for side in SIDES:
        _, rotation, position_m = truth.hands[side]
        planted = np.stack(
            [rotation[i].apply(hot3d.umetrack_joints(side, hot3d.ANGLES)) + position_m[i] for i in range(N_FRAMES)]
        )
        off = np.linalg.norm(track_joints(clip.hands[side], HANDS[side]) - planted, axis=2)
        assert np.nanmax(off) < 2e-3
        assert np.isnan(off).sum(axis=1).tolist() == [1] * N_FRAMES
    assert f"{UMETRACK}/umetrack_hand_user_profile.json" in [source.path for source in clip.sources]


@pytest.mark.slow
def test_fitted_hands_that_miss_the_joints_are_rejected_with_the_distance(umetrack_root: Path) -> None:
    (item,) = load(umetrack_root, UMETRACK, most_fit_error_mm=0)
    assert isinstance(item, Quarantined)
    assert item.where == UMETRACK
    assert "by 0 mm or less" in item.expected
    assert item.got.endswith(" mm")


@pytest.mark.slow
def test_mano_takes_precedence_if_a_recording_has_both_unless_umetrack_is_requested(
    root: Path, umetrack_root: Path
) -> None:
    with pytest.raises(BadInput, match="poses of a hand, got none"):
        load(root, hands="umetrack")
    (root / ARIA / hot3d.UMETRACK_FILE).write_text((umetrack_root / UMETRACK / hot3d.UMETRACK_FILE).read_text())
    assert only_clip(root).hands_from == "parameters"
    adapter = Hot3dAdapter(hands="umetrack")
    assert (adapter.needs_mano, adapter.hand_convention.shape) == (False, "fitted")
    assert only_clip(umetrack_root, UMETRACK, hands="umetrack").hands_from == "keypoints"


def test_each_kind_of_array_has_the_licence_of_its_files(root: Path, tmp_path: Path) -> None:
    convert_dataset(Hot3dAdapter(), root, HANDS, tmp_path / "clips", progress=False)
    store = open_store(tmp_path / "clips")
    rows = {row.kind.name: row for row in licences_of(store.info)}
    assert {name: row.spdx for name, row in rows.items() if name in ("hands", "object motion", "words")} == {
        "hands": "LicenseRef-hot3d-hands",
        "object motion": "LicenseRef-hot3d-object-motion",
        "words": "LicenseRef-hot3d",
    }
    assert [name for name, row in rows.items() if row.may_be_shared and name != "hand surface"] == ["object motion"]
    assert "CC BY-NC-SA" in rows["hands"].licence
    card = dataset_card(store.folder, store, Format("the store"), for_own_use=True)
    assert "- LicenseRef-hot3d-object-meshes: CC BY-SA, changed so that no object or model may be sold" in card
    with pytest.raises(BadInput, match=r"licences of hot3d: expected some of hands, .*got feet"):
        licences_of(store.info | {"licences": {"feet": {"licence": "x", "may_be_shared": True}}})
    generated = convert_dataset(Hot3dAdapter(), root, HANDS, tmp_path / "made", progress=False, synthetic=True)
    assert generated.clips == 2
    assert all(row.may_be_shared for row in licences_of(open_store(tmp_path / "made").info))


def test_incomplete_licences_of_arrays_are_refused(tmp_path: Path) -> None:
    facts = (BUILT_IN / "hot3d/facts.toml").read_text()
    (tmp_path / "facts.toml").write_text(facts.replace("may_be_shared = true", 'may_be_shared = "yes"'))
    with pytest.raises(BadInput, match=r"licences.object motion: expected a licence and may_be_shared"):
        facts_of_adapter(str(tmp_path / "adapter.py"))
