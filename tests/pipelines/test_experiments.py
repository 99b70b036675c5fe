"""DVC experiments, in the project folder or a temporary copy, use the chosen profile and the user's files."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from hoidata.dataset_folders import outside_folders
from hoidata.errors import MissingResource
from hoidata.machine_folder import machine_folder
from pipelines.stages.adapters import ensure_manifests, manifest_of
from pipelines.stages.base import StagePaths, raw_root, registered_root

CLIPS, TARGET = "data/own/h2o/clips", "convert@own-h2o"


@pytest.fixture
def scanned(project: Path, small_corpus, project_tools) -> Path:
    """A project with a scanned and converted dataset; dvc.lock is committed, profile and manifests are not."""
    root = small_corpus("h2o").raw
    params = yaml.safe_load((project / "params.yaml").read_text())
    params["convert"]["adapters"]["h2o"] = {"hands": "keypoints"}  # which need no MANO files
    project_tools.write_params(project, params)
    project_tools.make_narrow(project, ["h2o"], ["ground-truth"])
    git = ("git", "-c", "user.name=a", "-c", "user.email=b@c.d")
    for command in (
        ("git", "config", "user.name", "a"),
        ("git", "config", "user.email", "b@c.d"),
        ("git", "add", "-A"),
        (*git, "commit", "-qm", "as delivered"),
        ("hoidata", "raw", "scan", "h2o", "--root", str(root)),
        ("dvc", "repro", TARGET),
        ("git", "add", "dvc.lock", "pipelines/dvc.lock"),
        (*git, "commit", "-qm", "converted"),
    ):
        done = project_tools.run(project, *command)
        assert done.returncode == 0, done.stdout + done.stderr
    return project


def of_experiment(project: Path, name: str, file: str, tools: SimpleNamespace) -> dict:
    """A YAML file in the commit of an experiment."""
    refs = tools.run(project, "git", "for-each-ref", "--format=%(refname)", "refs/exps").stdout.split()
    (ref,) = (ref for ref in refs if ref.endswith(f"/{name}"))
    return yaml.safe_load(tools.run(project, "git", "show", f"{ref}:{file}").stdout)


def listed_files(project: Path, lock: dict) -> set[str]:
    """The files of the clips in a dvc.lock."""
    digest = next(out["md5"] for out in lock["stages"][TARGET]["outs"] if out["path"] == CLIPS)
    listing = json.loads((project / ".dvc/cache/files/md5" / digest[:2] / digest[2:]).read_text())
    return {item["relpath"] for item in listing}


@pytest.mark.long
def test_experiments_in_temporary_copies_use_the_users_files_of_the_chosen_profile(scanned, project_tools):
    run = ("dvc", "exp", "run", "-n")
    converted = project_tools.run(scanned, *run, "copied", "--temp", "-S", "convert.margin_frames=4", TARGET)
    assert converted.returncode == 0, converted.stdout + converted.stderr
    project_tools.run(scanned, *run, "queued", "--queue", "-S", "train.seed=7", TARGET)
    done = project_tools.run(scanned, "dvc", "exp", "run", "--run-all", "-j", "1")
    assert "Success" in project_tools.run(scanned, "dvc", "queue", "status").stdout, done.stdout + done.stderr
    for name, margin, seed in (("copied", 4, 0), ("queued", None, 7)):
        params = of_experiment(scanned, name, "params.yaml", project_tools)
        assert (params["profile"], params["convert"]["margin_frames"], params["train"]["seed"]) == ("own", margin, seed)
        files = listed_files(scanned, of_experiment(scanned, name, "dvc.lock", project_tools))
        assert "empty.json" not in files
        assert any(file.startswith("arrays/") for file in files)


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage_folder: Callable[..., dict]) -> Path:
    """A project, and as the current folder a temporary copy without untracked files, as DVC makes it."""
    project, copy = tmp_path / "original", tmp_path / "original/.dvc/tmp/exps/tmp1"
    (copy / "manifests").mkdir(parents=True)
    (copy / "params.yaml").write_bytes(Path("params.yaml").read_bytes())
    monkeypatch.chdir(copy)
    monkeypatch.setenv("DVC_ROOT", str(project))
    for name in ("HOIDATA_MANO", "HOIDATA_GRAB", "HOIDATA_MANIPNET", "HOIDATA_DATASETS"):
        monkeypatch.delenv(name, raising=False)
    return project


def test_a_temporary_copy_finds_the_registered_folders_of_this_machine(copied):
    (copied / "hoidata.toml").write_text(
        '[roots]\nmanipnet = "/data/m"\nhand = "/data/h"\n[datasets]\npaths = ["kitchen"]\n'
    )
    (copied / "kitchen").mkdir()
    (copied / "kitchen/adapter.py").touch()
    (copied / ".hoidata/raw/embedded/grab").mkdir(parents=True)
    assert (registered_root("manipnet"), registered_root("hand")) == (Path("/data/m"), Path("/data/h"))
    assert raw_root(StagePaths("embedded", "grab")).samefile(copied / ".hoidata/raw/embedded/grab")
    assert outside_folders()["kitchen"].samefile(copied / "kitchen")


def test_a_temporary_copy_reads_uncommitted_manifests_of_scanned_datasets(copied, tmp_path):
    from dataclasses import replace

    from pipelines.lineage.manifests import ABSENT_HAND, read_manifest, write_manifest

    scanned = {name: replace(manifest_of(StagePaths("own", name)), present=True) for name in ("grab", "manipnet")}
    for name, manifest in (*scanned.items(), ("hand", replace(ABSENT_HAND, present=True))):
        write_manifest(copied / f"manifests/own/{name}.json", manifest)
    ensure_manifests("own", ["grab", "manipnet", "h2o"])
    present = {path.stem: read_manifest(path).present for path in Path("manifests/own").iterdir()}
    assert present == {"grab": True, "manipnet": True, "hand": True, "h2o": False}


def test_another_project_that_runs_in_a_dvc_stage_does_not_count_as_an_experiment(tmp_path, monkeypatch):
    (tmp_path / "theirs/ours").mkdir(parents=True)
    (tmp_path / "theirs/hoidata.toml").write_text('[roots]\ngrab = "/theirs"\n')
    monkeypatch.chdir(tmp_path / "theirs/ours")
    monkeypatch.setenv("DVC_ROOT", str(tmp_path / "theirs"))
    monkeypatch.delenv("HOIDATA_GRAB", raising=False)
    assert machine_folder() == Path()
    with pytest.raises(MissingResource, match="the raw files of grab"):
        raw_root(StagePaths("own", "grab"))
