"""A copy of the project in a temporary folder, with small corpora and a few training steps."""

import atexit
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from pipelines.warm import WarmProcess

PROJECT = Path(__file__).parents[2]
PARTS = (
    "hoidata",
    "models",
    "pipelines",
    "manifests",
    "dvc.yaml",
    "params.yaml",
    ".dvcignore",
    ".gitignore",
    "prefect.toml",
    ".dvc/config",
    ".dvc/.gitignore",
)
BUDGET = {"steps": 2, "batch": 4, "validate_every": 1}
TRANSFORMER = {"width": 32, "layers": 1, "heads": 2, "feed_forward": 64, "frames_per_token": 5}
POINT_NET = {"widths": [16, 32, 64], "heads": [32, 16], "align": False}
TINY = {
    "contact": {"network": {"point_net": POINT_NET, "decoder_widths": [32, 16, 8], "latent": 4}, "training": BUDGET},
    "length": {"network": {"width": 16}, "training": BUDGET},
    "diffusion": {"network": {"transformer": TRANSFORMER}, "training": BUDGET},
    "refiner": {
        "network": {"transformer": TRANSFORMER},
        "training": BUDGET,
    },
}
TINY_SAMPLE = {"samples": 2, "text2hoi": {"sampler": {"steps": 2}}}


def copy_project(folder: Path) -> Path:
    """Copy the project's code and settings into ``folder`` as a new git repository without data and lock files."""
    for part in PARTS:
        source, target = PROJECT / part, folder / part
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            # The copy includes compiled code, which numba uses if the source has the same modification time.
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("*.tmp.*", "*.pyc.*", "dvc.lock"))
        else:
            shutil.copy(source, target)
    subprocess.run(["git", "init", "--quiet", str(folder)], check=True)
    make_small(folder)
    return folder


def make_small(folder: Path) -> None:
    """Set small corpora, the hash encoder, and a few training steps per network."""
    for path in (folder / "manifests" / "embedded").glob("*.json"):
        path.write_text(path.read_text().replace('"size": "full"', '"size": "small"'))
    params = yaml.safe_load((folder / "params.yaml").read_text())
    params["annotate"]["encoder"] = "hash"
    params["train"]["small"] |= TINY
    params["sample"] |= TINY_SAMPLE
    params["profiles"]["embedded"]["evaluator"]["most_steps"] = 2
    write_params(folder, params)


def write_params(folder: Path, params: dict) -> None:
    (folder / "params.yaml").write_text(yaml.safe_dump(params, sort_keys=False))


def make_narrow(folder: Path, datasets: list[str], families: list[str]) -> None:
    """Restrict the graph to some datasets and families."""
    params = yaml.safe_load((folder / "params.yaml").read_text())
    write_params(folder, {**params, "datasets": datasets, "families": families})
    for path in folder.glob("models/*/dvc.yaml"):
        stages = yaml.safe_load(path.read_text())["stages"]
        for stage in stages.values():
            if "family" in stage["matrix"]:
                stage["matrix"]["family"] = [name for name in stage["matrix"]["family"] if name in families]
        remaining = {name: stage for name, stage in stages.items() if stage["matrix"].get("family") != []}
        if remaining:
            path.write_text(yaml.safe_dump({"vars": ["../../params.yaml"], "stages": remaining}, sort_keys=False))
        else:
            path.unlink()


def set_present(folder: Path, present: set[str]) -> None:
    """Mark only the named embedded corpora as present."""
    for name in ("h2o", "grab", "arctic"):
        path = folder / "manifests" / "embedded" / f"{name}.json"
        text = path.read_text().replace('"present": true', '"present": false')
        path.write_text(text.replace('"present": false', '"present": true') if name in present else text)


def environment(**more: str) -> dict[str, str]:
    """The environment variables without the user's raw folders, and with this Python first on the path."""
    variables = {key: value for key, value in os.environ.items() if not key.startswith(("HOIDATA_", "PREFECT_"))}
    path = f"{Path(sys.executable).parent}{os.pathsep}{variables.get('PATH', '')}"
    return {**variables, "PATH": path, "OMP_NUM_THREADS": "1", "DVC_NO_ANALYTICS": "1", "DO_NOT_TRACK": "1", **more}


@cache
def warm_process() -> WarmProcess:
    """A warm process for all tests of a worker, so that stages do not import torch again."""
    process = WarmProcess()
    process.start()
    atexit.register(process.close)
    return process


def run(folder: Path, *command: str, **more: str) -> subprocess.CompletedProcess:
    """Run a command in the project folder."""
    warm = warm_process().environment if command[:2] == ("dvc", "repro") else {}
    return subprocess.run(command, cwd=folder, env=environment(**warm, **more), capture_output=True, text=True)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return copy_project(tmp_path / "project")


@pytest.fixture
def stage_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict]:
    """A function that writes manifests and params.yaml with some settings to the current folder."""
    shutil.copytree(PROJECT / "manifests" / "embedded", tmp_path / "manifests" / "embedded")
    monkeypatch.chdir(tmp_path)
    delivered = yaml.safe_load((PROJECT / "params.yaml").read_text())
    delivered["annotate"]["encoder"] = "hash"

    def write(**settings: object) -> dict:
        write_params(Path(), {**delivered, **settings})
        return delivered

    write()
    return write


@pytest.fixture(scope="session")
def built_once(made_once) -> Path:
    """A project after ``dvc repro``, with GRAB present and ARCTIC absent."""

    def build(folder: Path) -> None:
        copy_project(folder)
        make_narrow(folder, ["grab", "arctic"], ["text2hoi", "ground-truth"])
        set_present(folder, {"grab"})
        result = run(folder, "dvc", "repro")
        assert result.returncode == 0, result.stdout + result.stderr

    return made_once("built", build)


@pytest.fixture(scope="module")
def built(built_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of ``built_once`` for the tests of one module."""
    return shutil.copytree(built_once, tmp_path_factory.mktemp("built") / "project")


@pytest.fixture(scope="session")
def project_tools() -> SimpleNamespace:
    """The functions above, for test modules, which cannot import a conftest."""
    tools = (copy_project, make_narrow, set_present, write_params, environment, run)
    return SimpleNamespace(**{tool.__name__: tool for tool in tools})
