"""The stage split as dvc.yaml runs it: its parameters, datasets without clips, and its place in the lineage."""

import json
from dataclasses import replace

import pandas as pd
import pytest
import yaml

from hoidata.annotation.stage import annotate_store
from hoidata.errors import BadInput
from hoidata.splits.definitions import choose
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.lineage.graph import producers, read_graph
from pipelines.stages import split
from pipelines.stages.base import StagePaths

GRAB = StagePaths("embedded", "grab")


@pytest.fixture
def folder(make_clip, tmp_path, monkeypatch):
    """A project folder with four annotated clips of GRAB, one per subject; the current folder."""
    monkeypatch.chdir(tmp_path)
    names = ("s1", "s2", "s9", "s10")
    clips = [
        replace(make_clip(seed=seed, clip_id=f"grab/{name}/box_lift_1", subject=name), sequence=f"{name}/box_lift_1")
        for seed, name in enumerate(names)
    ]
    write_store(GRAB.clips, clips, generated_info("grab"))
    annotate_store(GRAB.clips, GRAB.annotation, encoder="hash")
    return tmp_path


def choose_split(folder, value) -> None:
    (folder / "params.yaml").write_text(yaml.safe_dump({"split": {"grab": value}}))


def test_a_name_or_a_rule_of_the_users_own_decides(folder):
    choose_split(folder, "text2hoi")
    split.run(GRAB)
    assert pd.read_parquet(GRAB.splits / "splits.parquet")["split"].tolist() == ["train", "train", "validation", "test"]
    (folder / "params.yaml").write_text("split: {}")  # then the dataset's own: text2hoi
    split.run(GRAB)
    assert json.loads((GRAB.splits / "info.json").read_text())["chosen"]["name"] == "text2hoi"
    choose_split(folder, {"by": "subject", "train": ["s2"], "validation": ["s1"], "test": ["s9"]})
    split.run(GRAB)
    parts = pd.read_parquet(GRAB.splits / "splits.parquet")["split"]
    assert parts.tolist()[:3] == ["validation", "train", "test"]
    assert pd.isna(parts[3])
    assert json.loads((GRAB.splits / "info.json").read_text())["chosen"]["name"] == "params.yaml"


def test_parts_without_clips_are_said_with_the_setting(folder, capsys):
    choose_split(folder, {"by": "subject", "train": "rest", "validation": ["s7"], "test": ["s10"]})
    split.run(GRAB)
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith("embedded-grab: no validation clips: ")
    assert "split.grab of params.yaml" in said[0]


def test_a_name_that_is_not_there_lists_those_that_are(folder):
    choose_split(folder, "text2hio")
    with pytest.raises(BadInput, match=r"params.yaml: split.grab: expected one of: composition, .*official, text2hoi"):
        split.run(GRAB)
    assert not GRAB.splits.exists()


def test_a_dataset_without_clips_passes_its_reason_on(folder):
    choose_split(folder, "text2hoi")
    empty = StagePaths("embedded", "h2o")
    empty.annotation.mkdir(parents=True)
    (empty.annotation / "empty.json").write_text('{"reason": "h2o is not present"}')
    split.run(empty)
    assert json.loads((empty.splits / "empty.json").read_text()) == {"reason": "h2o is not present"}


def test_whatever_opens_the_annotated_store_depends_on_its_split(pytestconfig):
    graph = read_graph(pytestconfig.rootpath)
    made = producers(graph)
    for name in ("h2o", "grab", "arctic", "manipnet"):
        out = f"data/embedded/{name}/splits"
        assert made[out].name == f"split@embedded-{name}"
        readers = {stage.name.rpartition(":")[2].split("@")[0] for stage in graph.values() if out in stage.deps}
        assert readers == {"train", "train-diffusion", "train-refiner", "sample", "evaluate", "evaluator", "controls"}


def test_the_project_chooses_a_split_each_dataset_has(pytestconfig):
    params = yaml.safe_load((pytestconfig.rootpath / "params.yaml").read_text())
    for dataset in params["datasets"]:
        assert choose(dataset, params["split"][dataset]).rule
