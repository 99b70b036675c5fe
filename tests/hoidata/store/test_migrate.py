"""A store written by the code of schema 1.0.0 (commit f4768a6: boxes, random poses) is read and brought up to date."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from hoidata.errors import BadInput, MissingResource
from hoidata.store.migrate import migrate_store
from hoidata.store.store import SCHEMA_VERSION, open_store
from hoidata.store_check.check import check_store
from pipelines.cli import app

OLD = Path(__file__).parent / "stores" / "1.0.0"
IDS = ["arctic/s01/box_grab_01/0000-0006", "arctic/s02/hinged_box_use_01/0010-0018"]


@pytest.fixture
def old(tmp_path: Path) -> Path:
    shutil.copytree(OLD, tmp_path / "clips")
    return tmp_path / "clips"


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_old_store_is_sound_by_the_rules_of_its_version(old):
    assert json.loads((OLD / "meta" / "info.json").read_text())["schema_version"] == "1.0.0"
    assert check_store(old) == []


def test_a_fault_of_an_old_store_is_found_too(old):
    path = old / "meta" / "objects.parquet"
    pq.write_table(pq.read_table(path).append_column("mood", pa.array(["", ""])), path)
    assert [problem.where for problem in check_store(old)] == ["meta/objects.parquet: mood"]


def test_what_1_1_added_is_filled_in_on_reading(old):
    before = contents(old)
    store = open_store(old)
    assert store.ids == IDS
    box, hinged = (store.clip(clip_id) for clip_id in IDS)
    for clip in (box, hinged):
        assert (clip.camera, clip.body, clip.source_contact, clip.fit_error_m) == (None, None, None, None)
        assert clip.hands_from == "parameters"
    assert (box.gravity_note, hinged.gravity) == ("", None)
    assert hinged.gravity_note == "not recorded: converted with schema 1.0"
    assert store.info["frame"]["handedness"] == "right"
    assert store.info["hand_convention"]["left_shape"] == "unknown"
    assert store.info["hand_convention"]["note"].startswith("MANO: axis-angles relative to the mean pose")
    assert store.info["licence"] == "ARCTIC licence (MPI): non-commercial research, no redistribution"
    assert contents(old) == before


def test_arrays_of_the_old_store_are_those_plain_numpy_reads(old):
    rows = pd.read_parquet(old / "meta" / "sequences.parquet").set_index("clip_id")
    row = rows.loc[IDS[1]]
    clip = open_store(old).clip(IDS[1])
    with np.load(old / "arrays" / "frames-00000.npz") as arrays:
        frames = slice(row["first_row"], row["first_row"] + row["n_frames"])
        np.testing.assert_array_equal(clip.hands["left"].hand_pose, arrays["left_hand_pose"][frames])
        np.testing.assert_array_equal(clip.object.hinge_rad, arrays["object_hinge_rad"][frames])
        others = slice(row["other_row"], row["other_row"] + row["n_frames"])
        np.testing.assert_array_equal(clip.other_objects[0].translation_m, arrays["other_translation_m"][others])
    assert [len(clip.hands[side].betas) for side in ("left", "right")] == [8, 1]
    assert not clip.hands["left"].valid[3:5].any()
    assert clip.hands["left"].template_m is None
    assert clip.hands["right"].template_m.shape == (778, 3)
    assert clip.source_frames.tolist() == [10, 14, 18, 22, 26, 30, 34, 38]


def test_migrating_keeps_ids_and_arrays_and_gives_a_sound_store_of_today(old):
    assert migrate_store(old) == "1.0.0"
    assert json.loads((old / "meta" / "info.json").read_text())["schema_version"] == SCHEMA_VERSION
    assert check_store(old) == []
    store, before = open_store(old), open_store(OLD)
    assert store.ids == IDS
    assert store.info["frame"] == before.info["frame"]
    pd.testing.assert_frame_equal(store.quarantine, before.quarantine)
    pd.testing.assert_frame_equal(store.files, before.files)
    pd.testing.assert_frame_equal(store.objects, before.objects)
    pd.testing.assert_frame_equal(store.sequences[before.sequences.columns[:29]], before.sequences.iloc[:, :29])
    with np.load(OLD / "arrays" / "frames-00000.npz") as was, np.load(old / "arrays" / "frames-00000.npz") as now:
        for name in was.files:
            np.testing.assert_array_equal(now[name], was[name])
    for name in ("objects.npz", "templates.npz"):
        assert (old / "arrays" / name).read_bytes() == (OLD / "arrays" / name).read_bytes()


def test_migrating_twice_changes_nothing_more(old):
    migrate_store(old)
    after = contents(old)
    assert migrate_store(old) == SCHEMA_VERSION
    assert contents(old) == after


def test_a_migration_that_fails_leaves_the_old_store(old, monkeypatch):
    before = contents(old)

    def full(*_) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("hoidata.store.writing.write_table", full)
    with pytest.raises(OSError, match="no space"):
        migrate_store(old)
    assert contents(old) == before
    assert [path.name for path in old.parent.iterdir()] == ["clips"]


def test_versions_that_cannot_be_migrated_say_what_helps(old, tmp_path):
    path = old / "meta" / "info.json"
    info = json.loads(path.read_text())
    cases = (
        ("0.4.0", "convers"),
        ("3.0.0", f"upgrade hoidata.*then run: hoidata migrate {old}"),
        ("one", "conversion"),
    )
    for version, remedy in cases:
        path.write_text(json.dumps({**info, "schema_version": version}))
        with pytest.raises(BadInput, match=remedy):
            migrate_store(old)
    with pytest.raises(MissingResource, match="no store"):
        migrate_store(tmp_path)


def test_the_command_migrates_and_says_so(old):
    runner = CliRunner()
    first = runner.invoke(app, ["migrate", str(old)])
    assert (first.exit_code, first.output) == (0, f"{old}: schema 1.0.0, rewritten as {SCHEMA_VERSION}\n")
    again = runner.invoke(app, ["migrate", str(old)])
    assert again.output == f"{old}: schema {SCHEMA_VERSION}, nothing to do\n"
    assert runner.invoke(app, ["validate", str(old)]).exit_code == 0
