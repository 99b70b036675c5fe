"""The graph as DVC and as this package read it, the provenance of a checkpoint, and digests of folders."""

from pathlib import Path

import pytest

from hoidata.errors import BadInput
from hoidata.files import canonical_json
from pipelines.lineage.digests import path_digest
from pipelines.lineage.graph import look_up, read_graph, written_graph
from pipelines.lineage.provenance import build_provenance, read_provenance

FAMILY = "models/text2hoi/dvc.yaml:"
TRAIN = f"{FAMILY}train@embedded-grab-contact"
FACTS = {"model": "contact", "seed": 0, "clips": {"train": ["grab/s1/a", "grab/s1/b"]}, "synthetic": True}


def test_graph_holds_the_stages_of_all_families_with_their_addresses(ran):
    graph = read_graph(ran.root)
    data = [f"{name}@embedded-grab" for name in ("convert", "evaluate", "raw", "split")]
    assert sorted(graph) == sorted(["code", *data, f"{FAMILY}sample", TRAIN, f"{FAMILY}train@embedded-grab-length"])
    stage = graph[TRAIN]
    assert stage.data == ("data/embedded/grab/clips", "data/embedded/grab/splits")
    assert stage.params == ("train.seed", "train.demo.contact")
    assert stage.code == ("code/train/contact.json",)
    assert graph["convert@embedded-grab"].outs == ("data/embedded/grab/clips",)


@pytest.mark.slow
@pytest.mark.parametrize("project", ["this project", "a small one"])
def test_the_graph_read_without_dvc_equals_the_one_dvc_reads(ran, project):
    folder = Path(__file__).parents[3] if project == "this project" else ran.root
    assert written_graph(folder) == read_graph(folder)


def test_provenance_is_built_while_dvc_writes_its_lock_file(ran):
    """Stages run in parallel: DVC writes the entry of one while another builds its provenance."""
    before = build_provenance(ran.root, TRAIN, FACTS)
    (ran.root / "dvc.lock").write_text("schema: '2.0'\nstages:\n  convert@grab:\n    cm")
    with pytest.raises(BadInput, match=r"dvc\.lock"):
        read_graph(ran.root)
    for path in ran.root.rglob("*.py"):
        path.touch()
    assert canonical_json(build_provenance(ran.root, TRAIN, FACTS)) == canonical_json(before)


def test_a_graph_with_unknown_syntax_is_read_by_dvc_and_one_dvc_cannot_read_is_refused(ran):
    ran.write({"dvc.yaml": "stages: {each: {foreach: [a, b], do: {cmd: 'echo ${item}', outs: ['${item}.txt']}}}"})
    assert {"each@a", "each@b"} <= written_graph(ran.root).keys()
    ran.write({"dvc.yaml": "stages: {raw: {cmd: [}}"})
    with pytest.raises(BadInput, match="stages that DVC can read"):
        read_graph(ran.root)


def test_a_missing_param_is_refused_with_the_existing_keys():
    with pytest.raises(BadInput, match="one of: lr"):
        look_up({"train": {"lr": 1}}, "train.rate")


@pytest.mark.parametrize("data", [b"", b"\x00" * 7, b"\xff" * 16, (2).to_bytes(8, "little") + b"{}"])
def test_a_malformed_checkpoint_is_refused_with_its_name(tmp_path, data):
    (tmp_path / "model.safetensors").write_bytes(data)
    with pytest.raises(BadInput, match=r"model\.safetensors: expected"):
        read_provenance(tmp_path / "model.safetensors")


def test_folder_digest_depends_on_names_and_bytes_and_not_on_compiled_code(tmp_path):
    (tmp_path / "a").write_text("1")
    before = path_digest(tmp_path)
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / "contact.pyc").write_text("compiled")
    assert path_digest(tmp_path) == before
    (tmp_path / "a").rename(tmp_path / "b")
    assert path_digest(tmp_path) != before
    assert path_digest(tmp_path / "nothing") is None
