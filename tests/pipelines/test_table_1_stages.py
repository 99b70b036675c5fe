"""The baselines of Text2HOI's Table 1 as stages: one key per family, then training, sampling and metrics."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from pipelines.lineage.graph import read_graph
from pipelines.stages import evaluate, sample, train
from pipelines.stages.base import StagePaths
from pipelines.stages.code import write_code
from pipelines.stages.families import OPTIONAL_FAMILIES
from tests.builders.stores import write_two_verbs
from tests.models.test_table_1 import NETWORKS, TINY
from tests.models.toy import BUDGET

PROJECT = Path(__file__).parents[2]
PATHS = StagePaths("embedded", "grab")
FOLDERS = ("mdm", "imos", "t2m")
FAMILIES = tuple(family for folder in FOLDERS for family in OPTIONAL_FAMILIES[folder])


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project of one annotated dataset with the baselines turned on, tiny networks and two training steps."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "manifests").symlink_to(PROJECT / "manifests")
    for path in (PROJECT / "dvc.yaml", *PROJECT.glob("models/*/dvc.yaml")):
        copy = tmp_path / path.relative_to(PROJECT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(path.read_text())
    params = yaml.safe_load((PROJECT / "params.yaml").read_text())
    params |= {"datasets": ["grab"], "families": ["ground-truth"]}
    params["family_datasets"] |= {folder: ["grab"] for folder in FOLDERS}
    params["train"]["small"] |= {name: {"network": TINY[name], "training": BUDGET} for name in NETWORKS}
    params["sample"] |= {"samples": 2, "mdm": {"sampler": {"steps": 2}}}
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(params))
    subprocess.run(["git", "init", "-q"], check=True)
    subprocess.run([sys.executable, "-m", "dvc", "init", "-q"], check=True)
    write_two_verbs(PATHS.data)
    return tmp_path


@pytest.mark.long
def test_one_key_per_family_leads_to_metrics_of_all_methods(project: Path) -> None:
    stages = {name.partition("@")[0] for name in read_graph(project) if name.startswith("models/")}
    expected = {f"models/{folder}/dvc.yaml:{stage}" for folder in FOLDERS for stage in ("train", "sample")}
    assert expected | {"models/t2m/dvc.yaml:train-generator"} <= stages
    write_code(project)
    for network in NETWORKS:
        train.run(replace(PATHS, model=network))
    for family in (*FAMILIES, "ground-truth"):
        sample.run(replace(PATHS, family=family))
    evaluate.run(PATHS)
    results = {name: json.loads((PATHS.metrics / f"{name}.json").read_text()) for name in FAMILIES}
    for name, result in results.items():
        assert result["motions"] == 2 * result["held_out_clips"] == 4, name
        estimated = name == "t2m"
        assert ("length_error_frames" in result["figures"], "joint_error_mm" in result["figures"]) == (
            estimated,
            not estimated,
        )
