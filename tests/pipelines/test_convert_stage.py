"""The settings of conversion in params.yaml."""

from pathlib import Path

import pytest

from hoidata.clips.clip import SourceFile
from hoidata.datasets import RawTree, get_adapter
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.errors import BadInput, MissingResource
from pipelines.lineage.closure import SourceTree
from pipelines.lineage.manifests import Manifest, read_manifest, scan_files, write_manifest
from pipelines.params import read_file
from pipelines.stages.adapters import ConvertSettings, ensure_manifests, raw_files
from pipelines.stages.base import StagePaths, load_settings
from pipelines.stages.code import closures, own_settings
from tests.builders import hoi4d

PROJECT = Path(__file__).parents[2]


def params_of(folder: Path, text: str) -> ConvertSettings:
    path = folder / "params.yaml"
    path.write_text(text)
    return load_settings(ConvertSettings, "convert", path)


def test_the_committed_settings_are_every_adapters_defaults():
    params = load_settings(ConvertSettings, "convert", PROJECT / "params.yaml")
    assert params.adapter("grab") == GrabAdapter()


def test_a_dataset_may_have_a_margin_of_its_own(tmp_path):
    params = params_of(tmp_path, "convert: {margin_frames: 5, adapters: {arctic: {margin_frames: 2}, h2o: null}}")
    margins = {name: getattr(params.adapter(name), "margin_frames", None) for name in ("grab", "arctic", "h2o")}
    assert margins == {"grab": 5, "arctic": 2, "h2o": 5}


def test_a_variant_has_the_adapter_and_raw_files_of_its_source_and_settings_of_its_own(tmp_path, monkeypatch):
    params = params_of(tmp_path, "convert: {adapters: {arctic-whole: {clips: whole}}}")
    assert (params.adapter("arctic").clips, params.adapter("arctic-whole").clips) == ("described", "whole")
    with pytest.raises(MissingResource, match="no adapter 'kitchen'"):
        params.adapter("kitchen-whole")
    monkeypatch.chdir(tmp_path)
    scanned = Manifest("arctic", True, "files", "some", files=(SourceFile("raw_seqs/s01/box.mano.npy", 9, "ab" * 32),))
    write_manifest(StagePaths("own", "arctic").manifest, scanned)
    ensure_manifests("own", ["arctic", "arctic-whole"])
    assert read_manifest(StagePaths("own", "arctic-whole").manifest) == scanned
    (tmp_path / "files").mkdir()
    monkeypatch.setenv("HOIDATA_ARCTIC", str(tmp_path / "files"))
    assert raw_files(StagePaths("own", "arctic-whole")) == raw_files(StagePaths("own", "arctic")) == tmp_path / "files"
    # A generated corpus is each variant's own: its manifest may hold another recipe.
    with pytest.raises(MissingResource, match=r"\.hoidata/raw/embedded/arctic-whole"):
        raw_files(StagePaths("embedded", "arctic-whole"))


def test_a_folder_with_a_file_per_frame_is_one_entry_of_a_manifest(tmp_path):
    """HOI4D has 2,971 recordings of 900 such files."""
    adapter, root = get_adapter("hoi4d"), hoi4d.write_two(tmp_path)
    listed = {entry.path: entry for entry in scan_files(root, adapter.parts)}
    assert f"HOI4D_annotations/{hoi4d.SAFE}/objpose" in listed
    assert len(listed) < 30
    assert adapter.load(RawTree(root, listed), hoi4d.key_of(hoi4d.SAFE), hoi4d.HANDS)
    (root / f"HOI4D_annotations/{hoi4d.SAFE}/objpose/7.json").write_text("{}")
    with pytest.raises(BadInput, match="SHA-256"):
        adapter.load(RawTree(root, listed), hoi4d.key_of(hoi4d.SAFE), hoi4d.HANDS)


def test_the_code_of_a_variant_is_that_of_its_source_and_its_settings_concern_it_alone():
    plain = read_file(PROJECT / "params.yaml")
    params = plain | {
        "datasets": ["arctic", "arctic-whole"],
        "convert": {"adapters": {"arctic-whole": {"clips": "whole"}}},
    }
    starts = closures(params, SourceTree(PROJECT))
    for stage in ("raw", "convert", "split"):
        assert starts[f"{stage}/arctic"] == starts[f"{stage}/arctic-whole"]
    assert own_settings(params, "convert/arctic") == {"params.yaml convert.adapters.arctic": "null"}
    assert "whole" in own_settings(params, "convert/arctic-whole")["params.yaml convert.adapters.arctic-whole"]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("convert: {margin: 5}", "keys among: margin_frames, adapters, got margin"),
        ("convert: {margin_frames: -1}", "margin_frames"),
        ("convert: {adapters: {grab: {margin: 1}}}", "settings of the adapter grab.*margin_frames.*got margin"),
    ],
)
def test_a_wrong_setting_is_named_with_the_known_ones(tmp_path, text, problem):
    with pytest.raises(BadInput, match=problem):
        params_of(tmp_path, text).adapter("grab")
