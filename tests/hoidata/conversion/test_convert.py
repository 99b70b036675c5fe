"""Conversion of a whole dataset: order, workers, bad sequences, manifests, absent data."""

import hashlib
import os
import pickle
import re
import shutil
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import RawTree, SequenceKey, adapter_names, get_adapter
from hoidata.datasets.base import Adapter
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.errors import BadInput, MissingResource
from hoidata.store.store import open_store
from pipelines.lineage.manifests import scan_files
from tests.hoidata.conversion.killable import write_meshes, write_sequence


@pytest.fixture
def root(tmp_path, hands) -> Path:
    """Three sequences of two subjects; every file valid."""
    write_meshes(tmp_path / "raw", hands)
    for seed, name in enumerate(("s1/mug_drink_1", "s1/mug_lift", "s2/mug_pass_1")):
        write_sequence(tmp_path / "raw", name, seed, first_touched=0)
    return tmp_path / "raw"


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_every_sequence_becomes_a_clip_and_the_store_states_its_origin(root, hands, tmp_path, capsys):
    summary = convert_dataset(GrabAdapter(), root, hands, tmp_path / "clips", synthetic=True)
    assert (summary.sequences, summary.clips, summary.frames, summary.quarantined) == (3, 3, 30, ())
    assert "grab: 3 clips, 30 frames from 3 sequences; 0 quarantined" in capsys.readouterr().out
    store = open_store(tmp_path / "clips")
    assert store.ids == ["grab/s1/mug_drink_1", "grab/s1/mug_lift", "grab/s2/mug_pass_1"]
    assert store.info["synthetic"]
    assert store.clip(store.ids[0]).synthetic
    assert store.info["licence"] == "CC0-1.0 (generated in the files of grab)"
    assert store.info["frame"] == {"handedness": "right", **asdict(GrabAdapter().frame)}
    assert store.info["hand_convention"]["translation"] == "transl"


@pytest.mark.long
def test_the_number_of_workers_and_the_location_of_the_raw_folder_change_no_byte(root, hands, tmp_path):
    (root / "grab" / "s1" / "mug_lift.npz").write_bytes(b"broken")
    convert_dataset(GrabAdapter(), root, hands, tmp_path / "one", jobs=1, progress=False)
    shutil.move(root, tmp_path / "elsewhere")
    convert_dataset(GrabAdapter(), tmp_path / "elsewhere", hands, tmp_path / "two", jobs=2, progress=False)
    assert digests(tmp_path / "one") == digests(tmp_path / "two")


def test_a_bad_sequence_is_quarantined_with_its_reason_and_the_others_convert(root, hands, tmp_path, capsys):
    path = root / "grab" / "s1" / "mug_lift.npz"
    path.write_bytes(path.read_bytes()[:500])
    summary = convert_dataset(GrabAdapter(), root, hands, tmp_path / "clips")
    assert (summary.clips, len(summary.quarantined)) == (2, 1)
    assert "1 quarantined:\n  grab/s1/mug_lift: grab/s1/mug_lift.npz: expected" in capsys.readouterr().out
    (quarantine_row,) = open_store(tmp_path / "clips").quarantine.to_dict("records")
    assert (quarantine_row["source_key"], quarantine_row["where"]) == ("grab/s1/mug_lift", "grab/s1/mug_lift.npz")


def values_of(value) -> object:
    """Every number of a clip as bytes with type and shape, through nested dataclasses."""
    if is_dataclass(value):
        return [(item.name, values_of(getattr(value, item.name))) for item in fields(value)]
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return [(key, values_of(item)) for key, item in value.items()]
    return [values_of(item) for item in value] if isinstance(value, tuple) else value


# Positions of a clip in the arrays, and numbers of its files, depend on the other clips of the store.
POSITION_COLUMNS = re.compile(r"shard|.*_row|source_files|.*_first|.*_start|.*_template")


def rows_of(store) -> dict[str, str]:
    columns = [name for name in store.sequences.columns if not POSITION_COLUMNS.fullmatch(name)]
    assert {"n_frames", "object", "verb", "gravity", "source_fps"} <= set(columns)
    rows = store.sequences[columns].to_dict("records")
    return {clip_row["clip_id"]: repr([np.asarray(value).tolist() for value in clip_row.values()]) for clip_row in rows}


def test_a_clip_does_not_depend_on_other_sequences(root, hands, tmp_path):
    convert_dataset(GrabAdapter(), root, hands, tmp_path / "all", progress=False)
    (root / "grab" / "s1" / "mug_drink_1.npz").unlink()
    (root / "grab" / "s1" / "note.txt").write_text("not a sequence")
    convert_dataset(GrabAdapter(), root, hands, tmp_path / "part", progress=False)
    whole, part = open_store(tmp_path / "all"), open_store(tmp_path / "part")
    assert part.ids == ["grab/s1/mug_lift", "grab/s2/mug_pass_1"]
    assert rows_of(part) == {clip_id: clip_row for clip_id, clip_row in rows_of(whole).items() if clip_id in part.ids}
    for clip_id in part.ids:
        assert values_of(part.clip(clip_id)) == values_of(whole.clip(clip_id))
        for side in ("left", "right"):
            np.testing.assert_array_equal(part.joints(clip_id, side), whole.joints(clip_id, side))


def test_the_order_in_which_the_system_lists_files_changes_no_byte(root, hands, tmp_path, monkeypatch):
    convert_dataset(GrabAdapter(), root, hands, tmp_path / "one", progress=False)
    listdir, scandir = os.listdir, os.scandir
    listed = []

    class Shuffled:
        def __init__(self, path) -> None:
            with scandir(path) as items:
                self.items = sorted(items, key=lambda item: hashlib.sha256(item.name.encode()).digest())
            listed.append(path)

        def __enter__(self):
            return iter(self.items)

        def __exit__(self, *_) -> None:
            pass

        def __iter__(self):
            return iter(self.items)

    monkeypatch.setattr(os, "scandir", Shuffled)
    monkeypatch.setattr(os, "listdir", lambda path=".": sorted(listdir(path), reverse=True))
    convert_dataset(GrabAdapter(), root, hands, tmp_path / "two", progress=False)
    monkeypatch.undo()
    assert listed
    assert digests(tmp_path / "one") == digests(tmp_path / "two")


@dataclass(frozen=True)
class CrashingAdapter(GrabAdapter):
    """An adapter with a defect in one sequence."""

    def load(self, raw, key, hands):
        if key.name == "s1/mug_lift":
            raise IndexError("index 7 is out of bounds")
        return super().load(raw, key, hands)


def test_a_defect_of_an_adapter_is_reported_as_such_and_other_sequences_convert(root, hands, tmp_path):
    summary = convert_dataset(CrashingAdapter(), root, hands, tmp_path / "clips", progress=False)
    assert summary.clips == 2
    assert "index 7 is out of bounds" in summary.quarantined[0].got
    assert "report" in summary.quarantined[0].remedy


@dataclass(frozen=True)
class SloppyAdapter(GrabAdapter):
    """An adapter whose clips of one sequence break a rule of Clip."""

    def load(self, raw, key, hands):
        clips = super().load(raw, key, hands)
        return [replace(clip, gravity=np.array([0.0, 0.0, -9.81])) for clip in clips] if "lift" in key.name else clips


def test_a_clip_that_breaks_a_rule_quarantines_its_sequence_only(root, hands, tmp_path):
    summary = convert_dataset(SloppyAdapter(), root, hands, tmp_path / "clips", progress=False)
    assert summary.clips == 2
    (item,) = summary.quarantined
    assert item.source_key == "grab/s1/mug_lift"
    assert "gravity" in item.where


def test_an_absent_dataset_gives_an_empty_store_with_the_reason(hands, tmp_path):
    for number, root in enumerate((None, tmp_path / "nowhere", tmp_path)):
        summary = convert_dataset(GrabAdapter(), root, hands, tmp_path / f"clips{number}", progress=False)
        assert summary.clips == 0
        store = open_store(tmp_path / f"clips{number}")
        assert len(store) == 0
        assert "grab.is.tue.mpg.de" in store.info["empty_reason"]


def test_a_file_that_differs_from_the_manifest_or_is_not_in_it_is_quarantined(root, hands, tmp_path):
    manifest = [item for item in scan_files(root) if item.path != "grab/s2/mug_pass_1.npz"]
    assert convert_dataset(GrabAdapter(), root, hands, tmp_path / "a", manifest=manifest, progress=False).clips == 2
    path = root / "grab" / "s1" / "mug_lift.npz"
    path.write_bytes(path.read_bytes() + b" ")
    summary = convert_dataset(GrabAdapter(), root, hands, tmp_path / "b", manifest=manifest, progress=False)
    assert [(item.source_key, item.expected.split()[0]) for item in summary.quarantined] == [
        ("grab/s1/mug_lift", "SHA-256"),
        ("grab/s2/mug_pass_1", "a"),
    ]


def test_a_link_out_of_the_raw_folder_is_refused(root, tmp_path):
    secret = tmp_path / "secret.npz"
    secret.write_bytes(b"secret")
    (root / "grab" / "s1" / "link.npz").symlink_to(secret)
    with pytest.raises(BadInput, match="leaves"):
        RawTree(root).file("grab/s1/link.npz")
    with pytest.raises(BadInput, match="inside"):
        RawTree(root).read("../secret.npz")


def test_a_folder_of_small_files_is_one_source_whose_digest_depends_on_each(tmp_path):
    for name, text in (("000000.txt", "1"), ("000001.txt", "2")):
        (tmp_path / name).write_text(text)
    tree = RawTree(tmp_path.parent)
    assert tree.read_folder(tmp_path.name, ["000000.txt", "000001.txt"]) == [b"1", b"2"]
    lines = "".join(
        f"{hashlib.sha256(text).hexdigest()}  {name}\n" for text, name in ((b"1", "000000.txt"), (b"2", "000001.txt"))
    )
    assert tree.sources[0].sha256 == hashlib.sha256(lines.encode()).hexdigest()


@pytest.mark.parametrize("name", adapter_names())
def test_a_registered_adapter_declares_its_facts(name, tmp_path):
    adapter = get_adapter(name)
    assert isinstance(adapter, Adapter)
    assert adapter.name == name
    assert adapter.needs_mano == (name in ("h2o", "grab", "arctic", "taco", "hoi4d", "hot3d", "oakink2"))
    assert adapter.licence
    assert adapter.where_to_register
    assert adapter.frame.note
    assert adapter.hand_convention.note
    assert adapter.parts
    assert not any(part.is_in(tmp_path) for part in adapter.parts)
    assert adapter.source_fps >= 15
    assert pickle.loads(pickle.dumps(adapter)) == adapter
    assert adapter.sequences(tmp_path) == []


def test_the_error_for_an_unknown_adapter_lists_the_known_ones():
    assert adapter_names()[:8] == ["arctic", "grab", "h2o", "hoi4d", "hot3d", "manipnet", "oakink2", "taco"]
    with pytest.raises(MissingResource, match="arctic, grab, h2o, hoi4d, hot3d, manipnet, oakink2, taco"):
        get_adapter("tacos")


def test_the_text_of_a_key_is_dataset_and_name():
    assert str(SequenceKey("grab", "s1", "s1/mug_lift")) == "grab/s1/mug_lift"


def test_a_frame_file_that_is_a_link_out_of_the_raw_folder_is_refused(tmp_path):
    (tmp_path / "secret.txt").write_text("1")
    folder = tmp_path / "raw" / "frames"
    folder.mkdir(parents=True)
    (folder / "000000.txt").symlink_to(tmp_path / "secret.txt")
    with pytest.raises(BadInput, match="leaves"):
        RawTree(tmp_path / "raw").read_folder("frames", ["000000.txt"])
    (tmp_path / "raw" / "linked").symlink_to(tmp_path)
    with pytest.raises(BadInput, match="leaves"):
        RawTree(tmp_path / "raw").read_folder("linked", ["secret.txt"])
    with pytest.raises(BadInput, match="nothing there"):
        RawTree(tmp_path / "raw").read_folder("frames", ["000001.txt"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["h2o", "grab", "arctic"])
def test_a_manifest_scanned_by_parts_lists_every_file_a_conversion_reads(name, hands, small_corpus, tmp_path):
    shutil.copytree(small_corpus(name).raw, tmp_path / "raw")
    adapter = get_adapter(name)
    (tmp_path / "raw" / "notes.json").write_text("{}")
    listed = scan_files(tmp_path / "raw", adapter.parts)
    assert "notes.json" not in {item.path for item in listed}
    summary = convert_dataset(adapter, tmp_path / "raw", hands, tmp_path / "a", manifest=listed, progress=False)
    free = convert_dataset(adapter, tmp_path / "raw", hands, tmp_path / "b", progress=False)
    assert summary == free
    assert summary.clips > 0


def test_a_generated_store_does_not_state_the_licence_of_the_dataset(root, hands, tmp_path):
    convert_dataset(GrabAdapter(), root, hands, tmp_path / "generated", progress=False, synthetic=True)
    convert_dataset(GrabAdapter(), root, hands, tmp_path / "real", progress=False)
    generated, recorded = open_store(tmp_path / "generated").info, open_store(tmp_path / "real").info
    assert generated["licence"].startswith("CC0-1.0")
    assert (generated["may_be_shared"], recorded["may_be_shared"]) == (True, False)
    assert "no redistribution" in recorded["licence"]
