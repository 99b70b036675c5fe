"""The evaluator stage: off, on with its metrics for every family, and killed trainings."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.stages import evaluate, evaluator, train
from pipelines.stages.base import StagePaths, empty_reason
from pipelines.stages.code import write_code
from tests.builders.stores import write_two_verbs

PROJECT = Path(__file__).parents[2]
PATHS = StagePaths("embedded", "grab", family="text2hoi")
IMPORTED = """
import sys
from pipelines.stages import evaluator
from pipelines.stages.base import StagePaths
evaluator.run(StagePaths("embedded", "grab"))
print("torch" in sys.modules)
"""


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    """A project of one dataset with two verbs, in which no stage has an entry but those of dvc.yaml."""
    monkeypatch.chdir(tmp_path)
    for name in ("dvc.yaml", "params.yaml"):
        (tmp_path / name).write_text((PROJECT / name).read_text())
    (tmp_path / "manifests").symlink_to(PROJECT / "manifests")
    return tmp_path


def choose(project: Path, **settings) -> None:
    params = yaml.safe_load((project / "params.yaml").read_text())
    params["profiles"]["embedded"]["evaluator"] = settings
    (project / "params.yaml").write_text(yaml.safe_dump({**params, "families": ["text2hoi"]}))


def test_off_it_writes_the_reason_without_loading_torch(project):
    choose(project, networks=[])
    command = [sys.executable, "-c", IMPORTED]
    done = subprocess.run(command, env={"PYTHONPATH": str(PROJECT)}, check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "False"
    assert empty_reason(PATHS.evaluators) == "off: params.yaml names no networks under evaluator"


@pytest.mark.long
def test_on_its_metrics_and_digests_are_in_the_metrics_of_a_family(project):
    clips = write_two_verbs(PATHS.data)
    subprocess.run(["git", "init", "-q"], check=True)
    subprocess.run([sys.executable, "-m", "dvc", "init", "-q"], check=True)
    choose(project, networks=["corrected", "text-motion"], most_steps=2)
    write_code(Path())
    evaluator.run(PATHS)
    predicted = [replace(clip, clip_id=f"{clip.clip_id}~0") for clip in clips[3:]]
    write_store(PATHS.samples / "clips", predicted, generated_info("ours"))
    (PATHS.samples / "diagnostics.json").write_text("{}")
    evaluate.run(PATHS)
    evaluation = json.loads((PATHS.metrics / "text2hoi.json").read_text())
    info = json.loads((PATHS.evaluators / "info.json").read_text())
    assert evaluation["evaluators"].pop("path")
    assert {name: evaluator_info["digest"] for name, evaluator_info in evaluation["evaluators"].items()} == {
        name: evaluator_info["digest"] for name, evaluator_info in info["evaluators"].items()
    }
    assert (
        evaluation["figures"]["accuracy_top1_corrected"] == info["evaluators"]["corrected"]["accuracy"]["test"]["top1"]
    )
    assert evaluation["notes"]["fid_frechet_corrected"] == "N too small"


def end(*_: object, **__: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def stopped_project(project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project whose trainings are killed as soon as they have begun."""
    for name in ("models", "pipelines"):
        (project / name).symlink_to(PROJECT / name)
    monkeypatch.setattr("models.common.training.train_network", end)
    monkeypatch.setattr("models.evaluator.stage.train_evaluators", end)
    return project


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize(
    ("run", "paths", "out"),
    [
        (train.run, StagePaths("embedded", "grab", "length"), "checkpoints"),
        (evaluator.run, StagePaths("embedded", "grab"), "evaluators"),
    ],
    ids=["train", "evaluator"],
)
def test_a_killed_training_leaves_no_other_files(
    stopped_project: Path, run: Callable[[StagePaths], None], paths: StagePaths, out: str
) -> None:
    process = multiprocessing.get_context("fork").Process(target=run, args=(paths,))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert [path for path in (stopped_project / out).rglob("*") if path.is_file() or path.name.startswith(".")] == []
