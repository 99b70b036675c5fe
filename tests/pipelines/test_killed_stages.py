"""What a killed training leaves: nothing beside the checkpoints and the evaluators, whenever it was killed."""

import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.stages import evaluator, train
from pipelines.stages.base import StagePaths

PROJECT = Path(__file__).parents[2]
pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


def end(*_: object, **__: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project whose trainings are killed as soon as they have begun."""
    monkeypatch.chdir(tmp_path)
    for name in ("dvc.yaml", "params.yaml"):
        text = (PROJECT / name).read_text()
        (tmp_path / name).write_text(text.replace("evaluator: {}", "evaluator: {networks: [paper]}"))
    for name in ("models", "pipelines", "manifests"):
        (tmp_path / name).symlink_to(PROJECT / name)
    monkeypatch.setattr("models.common.training.train_network", end)
    monkeypatch.setattr("models.evaluator.stage.train_evaluators", end)
    return tmp_path


def killed(run: Callable[[StagePaths], None], paths: StagePaths) -> None:
    process = multiprocessing.get_context("fork").Process(target=run, args=(paths,))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL


@pytest.mark.parametrize(
    ("run", "paths", "out"),
    [
        (train.run, StagePaths("embedded", "grab", "length"), "checkpoints"),
        (evaluator.run, StagePaths("embedded", "grab"), "evaluators"),
    ],
    ids=["train", "evaluator"],
)
def test_a_killed_training_leaves_nothing_beside_its_output(
    project: Path, monkeypatch: pytest.MonkeyPatch, run: Callable[[StagePaths], None], paths: StagePaths, out: str
) -> None:
    monkeypatch.setattr("pipelines.stages.train.producers", lambda graph: _AnyStage())
    monkeypatch.setattr("pipelines.stages.evaluator.producers", lambda graph: _AnyStage())
    killed(run, paths)
    assert [path for path in (project / out).rglob("*") if path.is_file() or path.name.startswith(".")] == []


class _AnyStage(dict):
    def __missing__(self, path: str) -> "_AnyStage":
        return self

    name = "train"
