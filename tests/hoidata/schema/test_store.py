import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair, load_embedded_hands, track_joints
from hoidata.schema import SIDES, BodyTrack, CameraTrack, SourceContact, SourceFile
from hoidata.schema.info import generated_info
from hoidata.schema.quarantine import Quarantined
from hoidata.schema.store import open_store, write_store

LEFT_OUT = Quarantined("test/s9/bad_1", "bad_1.npz", "7 columns", "6", "download it again")


INFO = generated_info("test")


@pytest.fixture
def clips(make_clip):
    """Rigid and articulated, invalid frames, betas per frame, a personal template, a second object, no label.

    Camera, body and contact labels in some; some frames without, an empty list of contacts, no expression.
    """
    plain = replace(
        make_clip(seed=1, clip_id="test/s1/a", gravity=None),
        gravity_note="estimated from nothing",
        hands_from="keypoints",
        fit_error_m=0.0042,
        source_contact=contact(0, 30),
    )
    hinged = make_clip(40, "both", articulated=True, seed=2, clip_id="test/s2/b", verb=None)
    left = hinged.hands["left"]
    rng = np.random.default_rng(5)
    valid = left.valid.copy()
    valid[3:6] = False
    odd_left = replace(left, valid=valid, betas=rng.normal(size=(40, 10)).astype(np.float32))
    template = load_embedded_hands().right.template_m.astype(np.float32) * np.float32(1.1)
    odd_right = replace(hinged.hands["right"], template_m=template)
    odd = replace(
        hinged,
        hands={"left": odd_left, "right": odd_right},
        other_objects=(plain.cut(0, 30).object, hinged.object),
        labelled_hand="left",
        source_frames=np.arange(7, 167, 4, dtype=np.int32),
        source_from_world=np.diag([10.0, -10.0, 10.0, 1.0]),
        sources=(SourceFile("s2/b.npz", 12, "ab" * 32), SourceFile("mesh.obj", 3, "cd" * 32)),
        source_fps=120.0,
    )
    moved = replace(hinged.object, translation_m=hinged.object.translation_m + np.float32(0.5))
    longer = replace(odd, other_objects=(hinged.object, moved))
    longer = replace(
        longer,
        camera=camera(40, np.array([600.0, 600, 320, 240, 640, 480])),
        body=body(40, True),
        gravity_note="fitted",
    )
    last = make_clip(20, "left", seed=3, clip_id="test/s1/c")
    return [plain, longer, replace(last, camera=camera(20), body=body(20, False), source_contact=contact(57, 20))]


def camera(n_frames: int, intrinsics: np.ndarray | None = None) -> CameraTrack:
    rng = np.random.default_rng(n_frames)
    rotvec, position = rng.normal(size=(2, n_frames, 3)).astype(np.float32)
    return CameraTrack("cam4", rotvec, position, np.arange(n_frames, dtype=np.int32) * 2, intrinsics)


def body(n_frames: int, expression: bool) -> BodyTrack:
    rng = np.random.default_rng(n_frames)
    arrays = [rng.normal(size=(n_frames, columns)).astype(np.float32) for columns in (3, 3, 63, 9, 10)]
    return BodyTrack(*arrays[:4], expression=arrays[4] if expression else None)


def contact(count: int, n_frames: int) -> SourceContact:
    rng = np.random.default_rng(count)
    rows = np.unique(np.stack((rng.integers(0, n_frames, count), rng.integers(0, 8, count)), axis=1), axis=0)
    frame, vertex = rows.T.astype(np.int32)
    return SourceContact(frame, vertex, rng.integers(21, 56, len(rows)).astype(np.uint8))


@pytest.fixture
def folder(tmp_path: Path, clips) -> Path:
    write_store(tmp_path / "clips", [clips[0], LEFT_OUT, *clips[1:]], INFO)
    return tmp_path / "clips"


def assert_equal_values(one, two) -> None:
    assert type(one) is type(two)
    if hasattr(one, "__dataclass_fields__"):
        for name in one.__dataclass_fields__:
            assert_equal_values(getattr(one, name), getattr(two, name))
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, two)
    elif isinstance(one, dict):
        assert list(one) == list(two)
        for key in one:
            assert_equal_values(one[key], two[key])
    elif isinstance(one, tuple):
        assert len(one) == len(two)
        for first, second in zip(one, two, strict=True):
            assert_equal_values(first, second)
    else:
        assert one == two


def test_a_clip_comes_back_as_it_was_written(folder, clips):
    store = open_store(folder)
    assert store.ids == [clip.clip_id for clip in clips]
    for clip in clips:
        as_trimesh_gave_it = clip.object.model.vertices_m
        assert type(store.clip(clip.clip_id).object.model.vertices_m) is np.ndarray
        assert_equal_values(store.clip(clip.clip_id), plain_arrays(clip))
        np.testing.assert_array_equal(store.clip(clip.clip_id).object.model.vertices_m, as_trimesh_gave_it)


def plain_arrays(clip):
    """The clip with trimesh's tracked arrays replaced by NumPy ones."""

    def plain(track):
        model = replace(track.model, vertices_m=np.array(track.model.vertices_m), faces=np.array(track.model.faces))
        return replace(track, model=model)

    return replace(clip, object=plain(clip.object), other_objects=tuple(map(plain, clip.other_objects)))


def test_joints_are_those_of_the_clip(folder, clips):
    store = open_store(folder)
    for clip in clips:
        for side in SIDES:
            expected = track_joints(clip.hands[side], load_embedded_hands()[side])
            np.testing.assert_array_equal(store.joints(clip.clip_id, side), expected)


def test_the_same_clips_give_the_same_bytes(folder, clips, tmp_path):
    write_store(tmp_path / "again", [clips[0], LEFT_OUT, *clips[1:]], INFO)
    for path in sorted(folder.rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "again" / path.relative_to(folder)).read_bytes(), path.name


def test_what_is_read_from_a_store_writes_the_same_store(folder, tmp_path):
    store = open_store(folder)
    again = [store.clip(clip_id) for clip_id in store.ids]
    write_store(tmp_path / "again", [again[0], LEFT_OUT, *again[1:]], INFO)
    for path in sorted(folder.rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "again" / path.relative_to(folder)).read_bytes(), path.name


def test_plain_numpy_and_pandas_can_read_it(folder, clips):
    row = pd.read_parquet(folder / "meta" / "sequences.parquet").set_index("clip_id").loc[clips[2].clip_id]
    with np.load(folder / "arrays" / f"frames-{row.shard:05d}.npz", allow_pickle=False) as arrays:
        wrist = arrays["left_wrist_m"][row.first_row : row.first_row + row.n_frames]
    np.testing.assert_array_equal(wrist, clips[2].hands["left"].wrist_m)


def test_many_clips_go_to_several_shards(tmp_path, make_clip, monkeypatch):
    monkeypatch.setattr("hoidata.schema.shards.FRAMES_PER_SHARD", 50)
    clips = [make_clip(30, seed=number, clip_id=f"test/s1/{number}") for number in range(5)]
    write_store(tmp_path / "clips", clips, INFO)
    store = open_store(tmp_path / "clips")
    assert store.sequences["shard"].tolist() == [0, 0, 1, 1, 2]
    for clip in clips:
        np.testing.assert_array_equal(store.clip(clip.clip_id).object.rotvec, clip.object.rotvec)


def test_the_tables_say_what_was_left_out_and_what_was_read(folder):
    store = open_store(folder)
    assert store.quarantine.to_dict("records") == [vars(LEFT_OUT)]
    assert store.files["path"].tolist() == ["s2/b.npz", "mesh.obj"]
    assert store.objects["object"].tolist() == ["box", "hinged_box"]
    assert store.info["counts"] == {"clips": 3, "frames": 90, "objects": 2, "files": 2, "quarantined": 1}


def test_an_empty_store_opens_and_has_all_columns(tmp_path, folder):
    write_store(tmp_path / "empty", [], INFO)
    store = open_store(tmp_path / "empty")
    assert store.ids == []
    assert list(store.sequences.columns) == list(open_store(folder).sequences.columns)


def test_a_newer_major_version_is_refused(folder):
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps({**info, "schema_version": "1.7.0"}))
    assert len(open_store(folder)) == 3
    path.write_text(json.dumps({**info, "schema_version": "2.0.0"}))
    with pytest.raises(BadInput, match=r"expected schema version 1\.1\.0, got 2\.0\.0; upgrade .* hoidata migrate /"):
        open_store(folder)
    path.write_text(json.dumps({**info, "schema_version": "0.9.0"}))
    with pytest.raises(BadInput, match=r"got 0\.9\.0; run: hoidata migrate /"):
        open_store(folder)


def test_other_hands_than_those_of_the_conversion_are_refused(folder):
    embedded = load_embedded_hands()
    wider = replace(embedded.right, template_m=embedded.right.template_m * 1.01)
    with pytest.raises(BadInput, match="hand model"):
        open_store(folder, HandPair(left=embedded.left, right=wider))
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps({**info, "hand_model": {"name": "mano", "digest": "ff" * 32}}))
    with pytest.raises(MissingResource, match="mano"):
        open_store(folder).joints("test/s1/a", "left")


def test_a_folder_that_is_no_store_is_named(tmp_path):
    with pytest.raises(MissingResource, match=r"meta/info\.json is missing"):
        open_store(tmp_path)


def test_a_truncated_array_file_is_named(folder):
    path = folder / "arrays" / "frames-00000.npz"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(BadInput, match="frames-00000"):
        open_store(folder).clip("test/s1/a")


def test_a_clip_that_breaks_the_rules_is_refused(tmp_path, clips):
    millimetres = replace(clips[0].object, translation_m=clips[0].object.translation_m * 1000)
    with pytest.raises(BadInput, match="unit"):
        write_store(tmp_path / "clips", [replace(clips[0], object=millimetres)], INFO)
    assert not (tmp_path / "clips").exists()


def test_the_second_clip_of_one_id_is_left_out_and_listed(tmp_path, clips, folder):
    second = replace(clips[2], clip_id=clips[0].clip_id)
    counts = write_store(tmp_path / "twice", [clips[0], second, *clips[1:]], INFO)
    assert counts["clips"] == 3
    store = open_store(tmp_path / "twice")
    np.testing.assert_array_equal(store.clip("test/s1/a").object.rotvec, clips[0].object.rotvec)
    (row,) = store.quarantine.to_dict("records")
    assert row["source_key"] == "test/s1/a"
    assert "a second one, frames 0 to 19 of s1/c" in row["got"]
    frames = "arrays/frames-00000.npz"
    assert (tmp_path / "twice" / frames).read_bytes() == (folder / frames).read_bytes()


def test_a_store_survives_pickling_without_carrying_its_arrays(folder):
    import pickle

    store = open_store(folder)
    store.clip("test/s1/a")
    data = pickle.dumps(store)
    assert len(data) < 50_000
    again = pickle.loads(data)
    np.testing.assert_array_equal(again.clip("test/s1/a").source_frames, store.clip("test/s1/a").source_frames)
