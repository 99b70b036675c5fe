"""What is derived from licensed data stays here unless the user says otherwise."""

import shutil
import tomllib
from pathlib import Path

import pytest
import yaml

PROJECT = Path(__file__).parents[2]
MAY_LEAVE = ("raw.json", "metrics/", "code")  # digests and figures


def outputs(project: Path) -> dict[str, dict]:
    """Every cached output of the graph with its flags."""
    stages = yaml.safe_load((project / "dvc.yaml").read_text())["stages"].values()
    outs = [out for stage in stages for out in stage.get("outs", []) + stage.get("metrics", [])]
    return {path: flags for out in outs for path, flags in (out if isinstance(out, dict) else {out: {}}).items()}


def kept_here(project: Path) -> set[str]:
    return {path for path, flags in outputs(project).items() if flags.get("remote") == "derived"}


def test_no_derived_data_is_pushed_as_delivered():
    derived = {path for path in outputs(PROJECT) if not any(part in path for part in MAY_LEAVE)}
    assert len(derived) >= 6
    assert kept_here(PROJECT) == derived


@pytest.mark.slow
def test_sharing_needs_a_remote_to_share_with(project, project_tools):
    refused = project_tools.run(project, "hoidata", "share", "--on")
    assert refused.returncode == 1
    assert "dvc remote add" in refused.stderr


@pytest.mark.slow
def test_dvc_push_sends_nothing_derived_until_it_is_shared(project, project_tools, tmp_path):
    built = project_tools.run(project, "dvc", "repro", "convert@embedded-manipnet")
    assert built.returncode == 0, built.stderr
    for words in (("git", "add", "-A"), ("git", "-c", "user.name=a", "-c", "user.email=b", "commit", "-qm", "built")):
        project_tools.run(project, *words)
    project_tools.run(project, "dvc", "remote", "add", "--local", "-d", "there", str(tmp_path / "remote"))

    def pushed() -> int:
        assert project_tools.run(project, "dvc", "push").returncode == 0
        return sum(path.is_file() for path in (tmp_path / "remote").rglob("*"))

    kept = pushed()
    assert project_tools.run(project, "hoidata", "share", "--on").returncode == 0
    shared = pushed()
    assert shared > kept
    assert project_tools.run(project, "git", "status", "--porcelain").stdout == ""
    assert project_tools.run(project, "hoidata", "share", "--off").returncode == 0
    shutil.rmtree(tmp_path / "remote")
    assert pushed() == kept


def test_plain_dvc_and_prefect_typed_in_this_folder_send_nothing_home(monkeypatch):
    from dvc.analytics import is_enabled
    from dvc.config import Config

    for name in ("DVC_NO_ANALYTICS", "DO_NOT_TRACK", "DVC_TEST"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(PROJECT)
    assert not is_enabled()
    assert not Config.from_cwd()["core"]["check_update"]
    assert tomllib.loads((PROJECT / "prefect.toml").read_text())["server"]["analytics_enabled"] is False
