"""Provenance and its comparison with the present files, on a graph of two stages in a temporary folder."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from dvc.repo import Repo
from safetensors.numpy import save_file

from hoidata.errors import BadInput
from hoidata.files import canonical_json
from pipelines.lineage.digests import path_digest
from pipelines.lineage.graph import look_up, read_graph, written_graph
from pipelines.lineage.provenance import build_provenance, read_provenance
from pipelines.lineage.targets import find_target
from pipelines.lineage.tree import Node, overall_status, target_tree, tree_as_json
from pipelines.stages.code import write_code
from tests.builders.folders import write_text

GRAPH = """
stages:
  convert:
    matrix: {dataset: "${datasets}"}
    cmd: python convert.py ${item.dataset}
    deps: ["manifests/${item.dataset}.json", "code/convert/${item.dataset}.json"]
    params: [convert]
    outs:
      - data/${item.dataset}:
          persist: true
"""
FAMILY = """
vars: [../../params.yaml]
stages:
  train:
    wdir: ../..
    matrix:
      dataset: ${datasets}
      model: [contact, length]
    cmd: python train.py ${item.dataset} ${item.model}
    deps: ["data/${item.dataset}", "code/train/${item.model}.json"]
    params: ["train.${train.size}.${item.model}"]
    outs: ["checkpoints/${item.dataset}/${item.model}"]
"""
PARAMS = """
datasets: [grab, arctic]
families: []
convert: {fps: 30}
train:
  size: demo
  demo: {contact: {lr: 0.1, steps: 5}, length: {lr: 0.2}}
  paper: {contact: {lr: 0.3}, length: {lr: 0.4}}
"""
TRAIN = "models/text2hoi/dvc.yaml:train@grab-contact"
FACTS = {"model": "contact", "seed": 0, "clips": {"train": ["grab/s1/a", "grab/s1/b"]}, "synthetic": True}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    files = {
        "dvc.yaml": GRAPH,
        "models/text2hoi/dvc.yaml": FAMILY,
        "params.yaml": PARAMS,
        "manifests/grab.json": "{}",
        "hoidata/datasets/registry.py": "",
        "hoidata/datasets/grab/adapter.py": "",
        "models/text2hoi/contact.py": "",
        "pipelines/stages/convert.py": "import hoidata.datasets.registry",
        "pipelines/stages/train.py": "from models.text2hoi import contact",
        "data/grab/clips.npz": "clips",
    }
    write_text(folder, files)
    Repo.init(str(folder), no_scm=True).close()
    write_code(folder)
    return folder


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    return shutil.copytree(written, tmp_path / "project")


@pytest.fixture
def checkpoint(root: Path) -> Path:
    provenance = build_provenance(root, TRAIN, FACTS)
    path = root / "checkpoints/grab/contact/model.safetensors"
    path.parent.mkdir(parents=True)
    metadata = {"hoidata": canonical_json({"provenance": provenance})}
    save_file({"weight": np.zeros(2, np.float32)}, path, metadata)
    return path


def tree_of(root: Path, checkpoint: Path) -> Node:
    return target_tree(root, find_target(root, str(checkpoint)))


def status_of(root: Path, checkpoint: Path) -> dict[str, str]:
    return {f"{node.kind} {node.name}": node.status for node in tree_of(root, checkpoint).walk()}


def test_graph_holds_the_stages_of_all_families_with_their_addresses(root):
    graph = read_graph(root)
    trained = [f"models/text2hoi/dvc.yaml:train@{d}-{m}" for d in ("grab", "arctic") for m in ("contact", "length")]
    assert sorted(graph) == sorted(["convert@grab", "convert@arctic", *trained])
    stage = graph[TRAIN]
    assert (stage.data, stage.params) == (("data/grab",), ("train.demo.contact",))
    assert stage.code == ("code/train/contact.json",)
    assert graph["convert@grab"].outs == ("data/grab",)


@pytest.mark.slow
@pytest.mark.parametrize("project", ["this project", "a small one"])
def test_the_graph_read_without_dvc_equals_the_one_dvc_reads(root, project):
    folder = Path(__file__).parents[3] if project == "this project" else root
    assert written_graph(folder) == read_graph(folder)


def test_provenance_is_built_while_dvc_writes_its_lock_file(root):
    """Stages run in parallel: DVC writes the entry of one while another builds its provenance."""
    before = build_provenance(root, TRAIN, FACTS)
    (root / "dvc.lock").write_text("schema: '2.0'\nstages:\n  convert@grab:\n    cm")
    with pytest.raises(BadInput, match=r"dvc\.lock"):
        read_graph(root)
    assert build_provenance(root, TRAIN, FACTS) == before


def test_a_graph_with_unknown_syntax_is_read_by_dvc(root):
    (root / "dvc.yaml").write_text(
        "stages: {each: {foreach: [a, b], do: {cmd: 'echo ${item}', outs: ['${item}.txt']}}}"
    )
    assert {"each@a", "each@b"} <= written_graph(root).keys()


def test_a_graph_dvc_cannot_read_is_refused(root):
    (root / "dvc.yaml").write_text("stages: {raw: {cmd: [}}")
    with pytest.raises(BadInput, match="stages that DVC can read"):
        read_graph(root)


def test_a_missing_param_is_refused_with_the_existing_keys():
    with pytest.raises(BadInput, match="one of: lr"):
        look_up({"train": {"lr": 1}}, "train.rate")


def test_the_tree_has_all_stages_params_code_and_manifests_behind_a_checkpoint(root, checkpoint):
    statuses = status_of(root, checkpoint)
    assert set(statuses.values()) == {"same"}
    assert {
        f"stage {TRAIN}",
        "param train.demo.contact",
        "code models/text2hoi/contact.py",
        "data data/grab",
        "stage convert@grab",
        "param convert",
        "code hoidata/datasets/grab/adapter.py",
        "manifest manifests/grab.json",
    } <= set(statuses)


@pytest.mark.parametrize(
    ("path", "text", "node"),
    [
        ("manifests/grab.json", "{ }", "manifest manifests/grab.json"),
        ("hoidata/datasets/grab/adapter.py", "1", "code hoidata/datasets/grab/adapter.py"),
        ("models/text2hoi/table.csv", "1", "code models/text2hoi/table.csv"),
        ("data/grab/clips.npz", "others", "data data/grab"),
        ("params.yaml", PARAMS.replace("fps: 30", "fps: 60"), "param convert"),
        ("params.yaml", PARAMS.replace("lr: 0.1", "lr: 0.5"), "param train.demo.contact"),
        ("params.yaml", PARAMS.replace("size: demo", "size: paper"), f"stage {TRAIN}"),
    ],
)
def test_a_change_of_any_input_is_found(root, checkpoint, path, text, node):
    (root / path).write_text(text)
    assert status_of(root, checkpoint)[node] == "changed"
    assert overall_status(tree_of(root, checkpoint)) == "changed"


def test_a_changed_param_shows_both_values(root, checkpoint):
    (root / "params.yaml").write_text(PARAMS.replace("lr: 0.1", "lr: 0.5"))
    nodes = tree_of(root, checkpoint).walk()
    assert next(node.detail for node in nodes if node.name == "train.demo.contact") == "lr: 0.1 -> 0.5"


def test_a_deleted_input_is_missing(root, checkpoint):
    (root / "manifests/grab.json").unlink()
    assert status_of(root, checkpoint)["manifest manifests/grab.json"] == "missing"
    assert overall_status(tree_of(root, checkpoint)) == "missing"


def test_unrelated_changes_are_not_reported(root, checkpoint):
    (root / "params.yaml").write_text(PARAMS.replace("lr: 0.2", "lr: 0.9"))
    (root / "models" / "__pycache__").mkdir()
    (root / "models" / "__pycache__" / "contact.pyc").write_text("compiled")
    (root / "models" / "text2hoi" / "length.py").write_text("nobody imports it")
    assert overall_status(tree_of(root, checkpoint)) == "same"


def test_provenance_depends_on_content_alone(root):
    first = canonical_json(build_provenance(root, TRAIN, FACTS))
    for path in root.rglob("*.py"):
        path.touch()
    assert canonical_json(build_provenance(root, TRAIN, FACTS)) == first


def test_tree_is_plain_json(root, checkpoint):
    tree = tree_of(root, checkpoint)
    assert json.loads(json.dumps(tree_as_json(tree)))["children"][0]["name"] == TRAIN


def test_a_checkpoint_has_the_ids_of_its_training_clips(root, checkpoint):
    assert read_provenance(checkpoint)["clips"] == FACTS["clips"]


@pytest.mark.parametrize("data", [b"", b"\x00" * 7, b"\xff" * 16, (2).to_bytes(8, "little") + b"{}"])
def test_a_malformed_checkpoint_is_refused_with_its_name(tmp_path, data):
    (tmp_path / "model.safetensors").write_bytes(data)
    with pytest.raises(BadInput, match=r"model\.safetensors: expected"):
        read_provenance(tmp_path / "model.safetensors")


def test_folder_digest_depends_on_names_and_bytes(tmp_path):
    (tmp_path / "a").write_text("1")
    before = path_digest(tmp_path)
    (tmp_path / "a").rename(tmp_path / "b")
    assert path_digest(tmp_path) != before
    assert path_digest(tmp_path / "nothing") is None
