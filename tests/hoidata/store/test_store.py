"""Stores: written, read and mapped; the field table, which files hold and README.md says; and empty outputs."""

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

import hoidata.store.fields as fields
from hoidata.clips import SIDES
from hoidata.clips.quarantine import Quarantined
from hoidata.contact.settings import read_contact_settings
from hoidata.errors import BadInput, MissingResource
from hoidata.files.arrays import write_npz
from hoidata.hands import HandPair, load_embedded_hands, track_joints
from hoidata.quality.thresholds import exclusion_reasons
from hoidata.store.annotated import load_annotated
from hoidata.store.distances import DistanceEntries
from hoidata.store.info import generated_info
from hoidata.store.mapped import map_npz
from hoidata.store.store import open_store, write_store
from hoidata.store_check.check import check_store
from hoidata.store_check.describe import readme
from pipelines.cli import app
from pipelines.commands.store_facts import fact_rows, group_rows, quarantine_rows
from tests.builders.stores import write_clips


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
        assert_equal_values(store.clip(clip.clip_id), clip)


def test_the_motion_alone_is_the_clip_without_what_else_the_source_had(folder, clips):
    store = open_store(folder)
    for clip in clips:
        bare = replace(clip, camera=None, body=None, source_contact=None)
        assert_equal_values(store.clip(clip.clip_id, motion_only=True), bare)
    assert any(clip.camera and clip.body and clip.source_contact for clip in clips)


def test_a_clip_may_be_changed_without_the_next_one_knowing(folder, clips):
    store = open_store(folder)
    for clip in clips:
        taken = store.clip(clip.clip_id)
        tracks = (*taken.hands.values(), taken.object, *taken.other_objects, taken.camera, taken.body)
        tracks = (taken, *tracks, taken.source_contact)
        arrays = [value for track in tracks if track for value in vars(track).values() if isinstance(value, np.ndarray)]
        assert len(arrays) >= 14
        for array in arrays:
            array[...] = 1
        assert_equal_values(store.clip(clip.clip_id), clip)


def test_joints_are_those_of_the_clip(folder, clips):
    store = open_store(folder)
    for clip in clips:
        for side in SIDES:
            expected = track_joints(clip.hands[side], load_embedded_hands()[side])
            np.testing.assert_array_equal(store.joints(clip.clip_id, side), expected)


def test_the_same_clips_give_the_same_bytes(folder, clips, left_out, tmp_path):
    write_store(tmp_path / "again", [clips[0], left_out, *clips[1:]], generated_info("test"))
    for path in sorted(folder.rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "again" / path.relative_to(folder)).read_bytes(), path.name


def test_plain_numpy_and_pandas_can_read_it(folder, clips):
    row = pd.read_parquet(folder / "meta" / "sequences.parquet").set_index("clip_id").loc[clips[2].clip_id]
    with np.load(folder / "arrays" / f"frames-{row.shard:05d}.npz", allow_pickle=False) as arrays:
        wrist = arrays["left_wrist_m"][row.first_row : row.first_row + row.n_frames]
    np.testing.assert_array_equal(wrist, clips[2].hands["left"].wrist_m)


def test_many_clips_go_to_several_shards(tmp_path, make_clip, monkeypatch):
    monkeypatch.setattr("hoidata.store.writing.FRAMES_PER_SHARD", 50)
    clips = [make_clip(30, seed=number, clip_id=f"test/s1/{number}") for number in range(5)]
    write_clips(tmp_path / "clips", clips)
    store = open_store(tmp_path / "clips")
    assert store.sequences["shard"].tolist() == [0, 0, 1, 1, 2]
    for clip in clips:
        np.testing.assert_array_equal(store.clip(clip.clip_id).object.rotvec, clip.object.rotvec)


def test_the_tables_say_what_was_left_out_and_what_was_read(folder, left_out):
    store = open_store(folder)
    assert store.quarantine.to_dict("records") == [vars(left_out)]
    assert store.files["path"].tolist() == ["s2/b.npz", "mesh.obj"]
    assert store.objects["object"].tolist() == ["box", "hinged_box"]
    assert store.info["counts"] == {"clips": 3, "frames": 90, "objects": 2, "files": 2, "quarantined": 1}


def test_an_empty_store_opens_and_has_all_columns(tmp_path, folder):
    write_clips(tmp_path / "empty", [])
    store = open_store(tmp_path / "empty")
    assert store.ids == []
    assert list(store.sequences.columns) == list(open_store(folder).sequences.columns)
    assert dict(fact_rows(store))["gravity of the clips"] == "no clips"


@pytest.mark.parametrize("version", ["1.0.0", "1.7.0", "2.0.0", "0.9.0"])
def test_a_store_of_another_version_is_refused(folder, version):
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "schema_version": version}))
    with pytest.raises(BadInput, match=rf"expected schema version 1\.1\.0, got {version}; run the conversion again"):
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


def test_a_clip_that_breaks_the_rules_is_refused(tmp_path, clips):
    millimetres = replace(clips[0].object, translation_m=clips[0].object.translation_m * 1000)
    with pytest.raises(BadInput, match="unit"):
        write_store(tmp_path / "clips", [replace(clips[0], object=millimetres)], generated_info("test"))
    assert not (tmp_path / "clips").exists()


def test_the_second_clip_of_one_id_is_left_out_and_listed(tmp_path, clips, folder):
    second = replace(clips[2], clip_id=clips[0].clip_id)
    counts = write_store(tmp_path / "twice", [clips[0], second, *clips[1:]], generated_info("test"))
    assert counts["clips"] == 3
    store = open_store(tmp_path / "twice")
    np.testing.assert_array_equal(store.clip("test/s1/a").object.rotvec, clips[0].object.rotvec)
    (row,) = store.quarantine.to_dict("records")
    assert row["source_key"] == "test/s1/a"
    assert "a second one, frames 0 to 19 of s1/c" in row["got"]
    frames = "arrays/frames-00000.npz"
    assert (tmp_path / "twice" / frames).read_bytes() == (folder / frames).read_bytes()


def with_mesh(clip, clip_id, scale):
    model = replace(clip.object.model, vertices_m=np.array(clip.object.model.vertices_m) * scale)
    return replace(clip, clip_id=clip_id, object=replace(clip.object, model=model))


def test_different_meshes_of_one_name_are_kept_apart_whatever_their_order(tmp_path, clips):
    small, large = with_mesh(clips[2], "test/s1/small", 1.0), with_mesh(clips[2], "test/s1/large", 1.5)
    other = clips[1]
    write_clips(tmp_path / "one", [small, large, other])
    write_clips(tmp_path / "two", [other, large, small])
    one, two = open_store(tmp_path / "one"), open_store(tmp_path / "two")
    assert check_store(tmp_path / "one") == []
    pd.testing.assert_frame_equal(one.objects, two.objects)
    names = set(one.objects["object"])
    assert "hinged_box" in names
    assert {name.split("#")[0] for name in names - {"hinged_box"}} == {"box"}
    for store in (one, two):
        for clip in (small, large):
            found = store.clip(clip.clip_id).object.model
            assert found.name == f"box#{store.objects.set_index('object').at[found.name, 'digest'][:8]}"
            np.testing.assert_array_equal(found.vertices_m, clip.object.model.vertices_m)
    again = [one.clip(clip_id) for clip_id in one.ids]
    write_clips(tmp_path / "again", again)
    assert open_store(tmp_path / "again").objects["object"].tolist() == one.objects["object"].tolist()


@pytest.mark.parametrize(
    "key", ["dataset_version", "frame", "hand_convention", "licence", "may_be_shared", "source_fps", "hand_model"]
)
def test_a_store_without_a_required_fact_is_refused_before_anything_is_written(tmp_path, clips, key):
    info = generated_info("test")
    with pytest.raises(BadInput, match=f"info.json: {key}"):
        write_store(tmp_path / "clips", clips, {name: info[name] for name in info if name != key})
    assert not list(tmp_path.iterdir())


def test_facts_of_the_wrong_kind_are_refused(tmp_path):
    frame = generated_info("test")["frame"]
    for further in ({"frame": frame | {"handedness": "left"}}, {"may_be_shared": "yes"}, {"source_fps": True}):
        with pytest.raises(BadInput, match=f"info.json: {next(iter(further))}"):
            write_store(tmp_path / "clips", [], generated_info("test", **further))


def test_many_contact_labels_fill_a_shard(tmp_path, clips, monkeypatch):
    monkeypatch.setattr("hoidata.store.writing.CONTACTS_PER_SHARD", 40)
    touched = [replace(clips[2], clip_id=f"test/s1/{number}") for number in range(3)]
    assert len(touched[0].source_contact.frame) >= 40
    write_clips(tmp_path / "clips", touched)
    store = open_store(tmp_path / "clips")
    assert store.sequences["shard"].tolist() == [0, 1, 2]
    for clip in touched:
        assert_equal_values(store.clip(clip.clip_id).source_contact, clip.source_contact)


def test_a_store_survives_pickling_without_carrying_its_arrays(folder):
    import pickle

    store = open_store(folder)
    store.clip("test/s1/a")
    data = pickle.dumps(store)
    assert len(data) < 50_000
    again = pickle.loads(data)
    np.testing.assert_array_equal(again.clip("test/s1/a").source_frames, store.clip("test/s1/a").source_frames)


def entries(frame: list[int]) -> DistanceEntries:
    """One entry per frame named; their points are 0, 1, 2 and so on, i + 1 mm away."""
    numbers, zeros = np.arange(len(frame)), np.zeros(len(frame), np.int64)
    return DistanceEntries(
        side=zeros, frame=np.array(frame), joint=zeros, point=numbers, distance_m=np.float32(0.001 * (numbers + 1))
    )


@pytest.mark.parametrize("cut", [DistanceEntries.window, DistanceEntries.interval])
def test_entries_of_an_interval_count_its_frames_from_its_start_and_end_before_its_stop(cut) -> None:
    found = cut(entries([0, 2, 2, 3, 5, 5, 6]), 2, 5)
    assert found.frame.tolist() == [0, 0, 1]
    assert found.point.tolist() == [1, 2, 3]
    assert found.distance_m.tolist() == pytest.approx([0.002, 0.003, 0.004])
    assert len(cut(entries([0, 1, 8]), 2, 5).frame) == 0


def test_a_window_keeps_the_order_of_entries_that_follow_hand_by_hand() -> None:
    found = entries([3, 4, 9, 0, 3]).window(3, 5)
    assert found.frame.tolist() == [0, 1, 0]
    assert found.point.tolist() == [0, 1, 4]


def test_the_facts_are_those_of_the_store(folder):
    facts = dict(fact_rows(open_store(folder)))
    assert facts["dataset"] == "test, version generated, SYNTHETIC, generated by code"
    assert facts["licence"] == "none: generated; derived data may be shared"
    assert facts["clips"] == "3; subjects: 1"
    assert facts["frames"] == "90 at 30 per second, 0.1 minutes; source 30, 120 per second"
    assert facts["objects"] == "2, 1 with a hinge"
    assert facts["gravity of the clips"] == "stated in 1, estimated in 1, not known in 1"
    assert facts["valid frames"] == "left 96.7 %, right 100.0 %"
    assert facts["world frame"] == "right-handed, up +z; z up, metres"
    assert (
        "cameras in 2 clips; body parameters in 2 clips; contact labels of the source in 2 clips"
        in facts["optional data"]
    )
    assert "hands fitted to keypoints in 1 clips" in facts["optional data"]


def test_clips_are_counted_by_object_and_verb(folder):
    store = open_store(folder)
    assert group_rows(store, "object") == [("box", "2", "50"), ("hinged_box", "1", "40")]
    assert group_rows(store, "verb") == [("lift", "2", "50"), ("(no label)", "1", "40")]
    assert quarantine_rows(store) == [("test/s9/bad_1", "bad_1.npz", "7 columns", "6")]


def test_the_command_prints_them_and_all_on_request(tmp_path, clips, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    left_out = [
        Quarantined(source_key=f"test/s9/[bad]_{number}", where="x.npz", expected="7 columns", got="6", remedy="-")
        for number in range(15)
    ]
    write_store(tmp_path / "clips", [*left_out, *clips], generated_info("test"))
    short = CliRunner().invoke(app, ["info", str(tmp_path / "clips")])
    assert short.exit_code == 0
    assert "stated in 1, estimated in 1, not known in 1" in short.output
    assert "test/s9/[bad]_11" in short.output
    assert "test/s9/[bad]_12" not in short.output
    assert "and 3 more (--all lists them)" in short.output
    assert "test/s9/[bad]_14" in CliRunner().invoke(app, ["info", "--all", str(tmp_path / "clips")]).output


README = Path(fields.__file__).with_name("README.md")


def test_the_readme_is_the_one_the_table_gives():
    assert README.read_text() == readme(), "run: python -m hoidata.store_check.describe > hoidata/store/README.md"


def test_places_and_angles_have_a_unit_and_a_frame():
    for file in (fields.FRAMES, fields.BODY, fields.OBJECT_ARRAYS, fields.TEMPLATES):
        for field in file.fields:
            coordinates = field.shape[-1] in (3, 9, 45, 63) and field.dtype.startswith("float")
            assert bool(field.frame and field.unit) == (coordinates or field.name.endswith("hinge_rad")), field.name
    for file in fields.STORE_FILES:
        for field in file.fields:
            if field.name.endswith("_m"):
                assert field.unit == "metre", field.name


def test_written_files_hold_what_the_table_says(folder):
    for file in (fields.FRAMES, fields.BODY, fields.SOURCE_CONTACT):
        with np.load(folder / file.path.replace("*", "00000")) as archive:
            assert archive.files == [field.name for field in file.fields]
            for field in file.fields:
                assert archive[field.name].dtype == field.dtype
                assert archive[field.name].shape[1:] == field.row_shape
    for file in fields.TABLES.values():
        assert pq.read_schema(folder / file.path).names == [field.name for field in file.fields]
    info = json.loads((folder / "meta" / "info.json").read_text())
    for field in fields.INFO.fields:
        fields.value_at(info, field.name)
    assert info["axes"]["<side>_hand_pose"] == ["frame", "joint x axis-angle"]


REASON = "grab is not present in the profile own"


def empty(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "empty.json").write_text(json.dumps({"reason": REASON}))
    return folder


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """The folders of a dataset that is not there: a store without clips, and notes instead of all else."""
    write_store(tmp_path / "clips", [], generated_info("grab"))
    for name in ("clips", "annotation", "contact", "splits", "quality"):
        empty(tmp_path / name)
    return tmp_path


READERS: list[Callable[[Path], object]] = [
    load_annotated,
    lambda root: exclusion_reasons(root / "quality"),
    lambda root: read_contact_settings(root / "contact"),
]


@pytest.mark.parametrize("read", READERS)
def test_the_reason_is_told(dataset, read):
    with pytest.raises(MissingResource, match=f"is empty: {REASON}"):
        read(dataset)


@pytest.mark.parametrize("name", ["annotation", "contact", "splits"])
def test_the_reason_of_a_later_stage_is_told_too(dataset, name):
    (dataset / "clips/empty.json").unlink()
    for other in {"annotation", "contact", "splits"} - {name}:
        (dataset / other / "empty.json").unlink()
        (dataset / other / "info.json").write_text("{}")
    with pytest.raises(MissingResource, match=f"{name} is empty: {REASON}"):
        load_annotated(dataset)


def test_a_family_without_motions_tells_why_where_its_clips_would_be(tmp_path):
    with pytest.raises(MissingResource, match=f"text2hoi is empty: {REASON}"):
        open_store(empty(tmp_path / "text2hoi") / "clips")


def test_a_stage_that_has_not_run_is_named(tmp_path):
    write_store(tmp_path / "clips", [], generated_info("grab"))
    with pytest.raises(MissingResource, match="annotation is not there: run the stage 'annotate'"):
        load_annotated(tmp_path)


ARRAYS = {
    "a/points": np.arange(12.0, dtype=np.float32).reshape(4, 3),
    "flags": np.array([True, False, True]),
    "empty": np.zeros((0, 45), np.float32),
    "scalar": np.array(7),
    "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
}


def test_mapped_arrays_equal_those_numpy_loads(tmp_path: Path):
    write_npz(tmp_path / "a.npz", ARRAYS)
    np.savez(tmp_path / "b.npz", **ARRAYS)
    for path in (tmp_path / "a.npz", tmp_path / "b.npz"):
        mapped = map_npz(path)
        with np.load(path) as loaded:
            assert sorted(mapped) == sorted(loaded.files)
            for name in loaded.files:
                np.testing.assert_array_equal(mapped[name], loaded[name])
                assert mapped[name].dtype == loaded[name].dtype


def test_mapped_arrays_cannot_be_changed(tmp_path: Path):
    write_npz(tmp_path / "a.npz", ARRAYS)
    with pytest.raises(ValueError, match="read-only"):
        map_npz(tmp_path / "a.npz")["a/points"][0] = 1


def test_files_that_cannot_be_mapped_are_named(tmp_path: Path):
    np.savez_compressed(tmp_path / "small.npz", a=np.zeros(100))
    np.savez(tmp_path / "objects.npz", a=np.array([{}], dtype=object))
    (tmp_path / "text.npz").write_text("hello")
    for name, got in (("small", "compressed"), ("objects", "Python objects"), ("text", "zip"), ("none", "nothing")):
        with pytest.raises(BadInput, match=got):
            map_npz(tmp_path / f"{name}.npz")


def test_a_header_that_promises_more_than_the_member_holds_is_refused(tmp_path: Path):
    """Otherwise the rows of the next member would be read as this one's."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in (("a", np.zeros((4, 3), np.float32)), ("b", np.ones((400, 3), np.float32))):
            stream = io.BytesIO()
            np.save(stream, array)
            archive.writestr(f"{name}.npy", stream.getvalue().replace(b"'shape': (4, 3)", b"'shape': (9, 3)"))
    with pytest.raises(BadInput, match="shorter than its shape"):
        map_npz(path)


def test_one_changed_byte_anywhere_in_an_array_is_told(tmp_path: Path):
    write_npz(tmp_path / "a.npz", {name: array for name, array in ARRAYS.items() if array.size})
    whole = (tmp_path / "a.npz").read_bytes()
    expected = {name: array.copy() for name, array in map_npz(tmp_path / "a.npz").items()}
    refused = 0
    for offset in range(0, len(whole), 7):
        changed = bytearray(whole)
        changed[offset] ^= 1 << offset % 8
        (tmp_path / f"{offset}.npz").write_bytes(changed)
        try:
            arrays = map_npz(tmp_path / f"{offset}.npz")
        except BadInput:
            refused += 1
            continue
        # Bytes of the archive's own that nobody reads: times, versions, the lengths' second copies.
        assert {name: array.tolist() for name, array in arrays.items()} == {
            name: array.tolist() for name, array in expected.items()
        } or set(arrays) != set(expected)
    assert refused > 0.6 * len(whole) / 7


def test_a_file_cut_anywhere_gives_the_named_error_only(tmp_path: Path):
    write_npz(tmp_path / "a.npz", ARRAYS)
    whole = (tmp_path / "a.npz").read_bytes()
    for length in range(0, len(whole), 37):
        (tmp_path / "cut.npz").write_bytes(whole[:length])
        with pytest.raises(BadInput, match=r"cut\.npz"):
            map_npz(tmp_path / "cut.npz")
