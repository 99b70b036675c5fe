"""Data derived from licensed data is not pushed unless the user chooses to share it."""

import shutil
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

PROJECT = Path(__file__).parents[2]
MAY_LEAVE = ("raw.json", "metrics/", "code")  # digests and metrics


def outputs(project: Path) -> dict[str, dict]:
    """All cached outputs of the graph with their flags."""
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
def test_sharing_needs_a_remote(project, project_tools):
    refused = project_tools.run(project, "hoidata", "share", "--on")
    assert refused.returncode == 1
    assert "dvc remote add" in refused.stderr


@pytest.fixture
def built(project, project_tools, tmp_path) -> SimpleNamespace:
    """A project with clips, its remote, and functions that run the commands of this module."""
    remote = tmp_path / "remote"

    def run(*command: str, folder: Path = project) -> str:
        done = project_tools.run(folder, *command)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def commit() -> None:
        run("git", "add", "-A")
        run("git", "-c", "user.name=a", "-c", "user.email=b", "commit", "-qm", "built")

    def push(*options: str) -> set[str]:
        """The names of the files on the remote after ``dvc push``, which are their digests."""
        run("dvc", "push", *options)
        files = [path.relative_to(remote) for path in remote.rglob("*") if path.is_file()]
        return {"".join(path.parts[-2:]) for path in files if "runs" not in path.parts}

    run("dvc", "repro", "convert@embedded-manipnet")
    run("dvc", "remote", "add", "-d", "there", str(remote))
    commit()
    stages = yaml.safe_load((project / "dvc.lock").read_text())["stages"]
    outs = [(stage.partition("@")[0], out["md5"]) for stage, body in stages.items() for out in body["outs"]]
    return SimpleNamespace(
        project=project, remote=remote, run=run, push=push,
        may_leave={digest for stage, digest in outs if stage == "raw"},
        clips={digest for stage, digest in outs if stage == "convert"},
    )  # fmt: skip


@pytest.mark.long
def test_with_sharing_off_no_derived_data_is_sent_whatever_was_pushed_before(built):
    every_way = ((), ("--all-commits",), ("--run-cache",), ("-r", "there"))
    for options in every_way:
        assert built.push(*options) == built.may_leave, options
    built.run("hoidata", "share", "--on")
    assert built.push() > built.may_leave | built.clips
    assert built.run("git", "status", "--porcelain") == ""
    built.run("hoidata", "share", "--off")
    shutil.rmtree(built.remote)
    for options in every_way:
        assert built.push(*options) == built.may_leave, options
    built.run("hoidata", "share", "--on")
    assert built.push() > built.may_leave | built.clips


@pytest.mark.long
def test_a_clone_pulls_shared_data_also_after_a_failed_pull(built, project_tools, tmp_path):
    assert built.push() == built.push() == built.may_leave
    built.run("hoidata", "share", "--on")
    assert built.push() > built.clips
    clone, clips = tmp_path / "clone", "data/embedded/manipnet/clips"
    built.run("git", "clone", "-q", str(built.project), str(clone))
    assert project_tools.run(clone, "dvc", "pull", clips).returncode != 0
    built.run("hoidata", "share", "--on", folder=clone)
    built.run("dvc", "pull", clips, folder=clone)
    assert built.run("hoidata", "validate", clips, folder=clone)
    assert (clone / clips / "meta/info.json").read_bytes() == (built.project / clips / "meta/info.json").read_bytes()


@pytest.mark.parametrize("address", ["s3://bucket/team", "s3://bucket/team/", "ssh://host/a"])
def test_derived_and_other_outputs_have_different_addresses(project, monkeypatch, address):
    """DVC keeps its index of an address between pushes, even if outputs move to another remote."""
    from dvc.config import Config

    from pipelines.commands.share import share

    monkeypatch.chdir(project)
    with Config.from_cwd().edit() as config:
        config["core"]["remote"] = "team"
        config["remote"]["team"] = {"url": address}
    share(on=True)
    shared, plain = (Config.from_cwd()["remote"][name]["url"].rstrip("/") for name in ("derived", "team"))
    assert shared == f"{address.rstrip('/')}/derived" != plain
    share(on=False)
    assert Path(Config.from_cwd()["remote"]["derived"]["url"]).resolve() == (project / ".dvc/cache").resolve()


def test_dvc_and_prefect_in_this_folder_send_no_analytics(monkeypatch):
    from dvc.analytics import is_enabled
    from dvc.config import Config

    for name in ("DVC_NO_ANALYTICS", "DO_NOT_TRACK", "DVC_TEST"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(PROJECT)
    assert not is_enabled()
    assert not Config.from_cwd()["core"]["check_update"]
    assert tomllib.loads((PROJECT / "prefect.toml").read_text())["server"]["analytics_enabled"] is False
