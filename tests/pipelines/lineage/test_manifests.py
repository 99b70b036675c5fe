from pathlib import Path
from types import SimpleNamespace

import pytest

from hoidata.clips.clip import SourceFile
from hoidata.datasets import DatasetPart, get_adapter
from hoidata.errors import BadInput
from hoidata.files import sha256_bytes
from pipelines.lineage.manifests import (
    Manifest,
    absent_manifest,
    missing_parts,
    part_of,
    read_manifest,
    scan_files,
    verify_files,
    write_manifest,
)
from tests.builders.folders import write_text


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """A raw folder with two files, a folder of per-frame files, and files that no adapter reads."""
    files = {
        "s1/mug.npz": "abc",
        "tools/table.json": "{}",
        "cam4/hand_pose/000000.txt": "1 2",
        "cam4/hand_pose/000001.txt": "3 4",
        "cam4/rgb/000000.png": "pixels",
        "s1.tar.gz": "archive",
        ".cache/state": "x",
    }
    return write_text(tmp_path / "raw", files)


def manifest_of(root: Path) -> Manifest:
    return Manifest("grab", True, "files", "research only", files=scan_files(root))


def test_scan_lists_data_files_and_one_entry_per_frame_folder(raw):
    assert [entry.path for entry in scan_files(raw)] == ["cam4/hand_pose", "s1/mug.npz", "tools/table.json"]


def test_digest_of_a_frame_folder_is_that_of_its_lines(raw):
    lines = f"{sha256_bytes(b'1 2')}  000000.txt\n{sha256_bytes(b'3 4')}  000001.txt\n"
    entry = scan_files(raw)[0]
    assert (entry.size, entry.sha256) == (6, sha256_bytes(lines.encode()))


def test_manifest_comes_back_as_written(raw, tmp_path):
    manifest = manifest_of(raw)
    write_manifest(tmp_path / "grab.json", manifest)
    assert read_manifest(tmp_path / "grab.json") == manifest


def test_a_manifest_without_files_is_read_as_written(tmp_path):
    manifest = Manifest("grab", True, "generated", "CC0-1.0", recipe={"seed": 0, "size": "full"})
    write_manifest(tmp_path / "grab.json", manifest)
    assert read_manifest(tmp_path / "grab.json") == manifest
    assert manifest.synthetic


def test_committed_manifests_have_the_format_of_write_manifest(tmp_path):
    for path in (Path(__file__).parents[3] / "manifests").glob("*/*.json"):
        write_manifest(tmp_path / "again.json", read_manifest(path))
        assert (tmp_path / "again.json").read_text() == path.read_text(), path


def test_verify_lists_missing_changed_and_unlisted_files(raw):
    manifest = manifest_of(raw)
    assert verify_files(raw, manifest) == []
    (raw / "s1/mug.npz").unlink()
    (raw / "cam4/hand_pose/000001.txt").write_text("3 5")
    (raw / "s1/new.npz").write_text("n")
    problems = [(item.path, item.problem) for item in verify_files(raw, manifest)]
    assert problems == [("cam4/hand_pose", "changed"), ("s1/mug.npz", "missing"), ("s1/new.npz", "unlisted")]


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"schema": "hoidata.manifest/1", "colour": "red"}', '{"schema": "hoidata.manifest/9"}']
)
def test_a_malformed_manifest_is_refused_with_its_name(tmp_path, text):
    (tmp_path / "grab.json").write_text(text)
    with pytest.raises(BadInput, match=r"grab\.json: expected"):
        read_manifest(tmp_path / "grab.json")


def test_a_file_of_a_manifest_needs_path_size_and_digest(tmp_path):
    write_manifest(tmp_path / "a.json", Manifest("a", True, "files", "x", files=(SourceFile("f", 1, "0"),)))
    text = (tmp_path / "a.json").read_text()
    (tmp_path / "a.json").write_text(text.replace('"size": 1, ', ""))
    with pytest.raises(BadInput, match="size"):
        read_manifest(tmp_path / "a.json")


PARTS = (
    DatasetPart("poses", ("cam4/*/*.txt",), "pose.zip"),
    DatasetPart("sequences", ("s*/*.npz", "GRAB/s*/*.npz"), "s1.zip"),
    DatasetPart("tables", ("tables/*.ply",), "tables.zip", optional=True),
    DatasetPart("meshes", ("meshes/*.ply",), "meshes.zip"),
)


def test_a_scan_by_parts_lists_only_files_an_adapter_reads(raw):
    assert [entry.path for entry in scan_files(raw, PARTS)] == ["cam4/hand_pose", "s1/mug.npz"]
    (raw / "GRAB" / "s1").mkdir(parents=True)
    (raw / "GRAB" / "s1" / "cup.npz").write_text("x")
    assert next(entry.path for entry in scan_files(raw, PARTS)) == "GRAB/s1/cup.npz"


def test_a_link_to_a_parent_folder_does_not_make_a_scan_endless(raw):
    (raw / "s1" / "again").symlink_to(raw)
    assert [entry.path for entry in scan_files(raw)] == ["cam4/hand_pose", "s1/mug.npz", "tools/table.json"]


def test_missing_parts_are_listed_required_ones_first(raw):
    adapter = SimpleNamespace(parts=PARTS)
    assert [part.contents for part in missing_parts(adapter, raw)] == ["meshes", "tables"]
    assert part_of(adapter, "s3/cup.npz") is PARTS[1]
    assert part_of(adapter, "cam4/obj_pose_rt") is PARTS[0]
    assert part_of(adapter, "s3/deep/cup.npz") is None


@pytest.mark.parametrize("name", ["h2o", "grab", "arctic", "manipnet"])
def test_the_manifest_of_an_absent_dataset_states_its_terms(name):
    manifest = absent_manifest(get_adapter(name))
    assert not manifest.present
    assert manifest.may_be_shared == (name == "manipnet")
