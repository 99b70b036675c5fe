"""The profile ``own``: the user's files are registered, or refused with instructions, and never replaced."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from hoidata.datasets import get_adapter
from hoidata.errors import BadInput, MissingResource
from hoidata.store.store import open_store
from pipelines.cli import app
from pipelines.lineage.manifests import ABSENT_HAND, write_manifest
from pipelines.stages.adapters import manifest_of
from pipelines.stages.base import StagePaths, load_hands, raw_root
from pipelines.stages.raw import write_generated

PROJECT = Path(__file__).parents[2]


def is_present(folder: Path, name: str) -> bool:
    path = folder / "manifests/own" / f"{name}.json"
    return path.is_file() and json.loads(path.read_text())["present"]


def make_present(folder: Path, name: str) -> None:
    """Write a manifest that says that the dataset is present."""
    manifest = manifest_of(StagePaths("own", name))
    write_manifest(folder / "manifests/own" / f"{name}.json", replace(manifest, present=True))


def commit(folder: Path, tools) -> None:
    for words in (("add", "-A"), ("-c", "user.name=a", "-c", "user.email=b", "commit", "-qm", "as delivered")):
        assert tools.run(folder, "git", *words).returncode == 0


def changed_files(folder: Path, tools) -> set[str]:
    """Changed and new files as in ``git status --short``."""
    return set(tools.run(folder, "git", "status", "--porcelain", "--untracked-files=all").stdout.splitlines())


@pytest.mark.slow
def test_repro_refuses_before_dvc_starts(project, project_tools, monkeypatch):
    monkeypatch.chdir(project)
    make_present(project, "grab")
    (project / "params.yaml").write_text(
        (project / "params.yaml").read_text().replace("profile: embedded", "profile: own")
    )
    result = project_tools.run(project, "hoidata", "repro")
    assert result.returncode == 1
    assert "no MANO files are registered" in result.stderr
    assert "Running stage" not in result.stdout


@pytest.mark.long
def test_mano_files_are_registered_with_digest_and_folder(project, tmp_path, project_tools):
    mano = tmp_path / "mano"
    mano.mkdir()
    missing = project_tools.run(project, "hoidata", "raw", "scan", "mano", "--root", str(mano))
    assert missing.returncode == 1
    assert "no MANO_RIGHT.pkl, MANO_LEFT.pkl" in missing.stderr
    for name in ("MANO_RIGHT.pkl", "MANO_LEFT.pkl"):
        (mano / name).write_bytes(name.encode())
    commit(project, project_tools)
    assert project_tools.run(project, "hoidata", "raw", "scan", "mano", "--root", str(mano)).returncode == 0
    assert is_present(project, "hand")
    assert str(mano) in (project / "hoidata.toml").read_text()
    assert "profile: embedded" in (project / "params.yaml").read_text()
    names = ("hand", *yaml.safe_load((project / "params.yaml").read_text())["datasets"])
    assert changed_files(project, project_tools) == {f"?? manifests/own/{name}.json" for name in names}


@pytest.mark.long
def test_git_shows_the_chosen_profile_and_new_manifests_and_dvc_builds_the_profile_own(
    project, small_corpus, project_tools
):
    make_plain_params(project)
    commit(project, project_tools)
    write_manifest(project / "manifests/own/hand.json", replace(ABSENT_HAND, present=True))
    raw = small_corpus("grab").raw
    scanned = project_tools.run(project, "hoidata", "raw", "scan", "grab", "--root", str(raw))
    assert scanned.returncode == 0, scanned.stderr
    params = yaml.safe_load((project / "params.yaml").read_text())
    assert params["profile"] == "own"
    manifests = {f"?? manifests/own/{name}.json" for name in ("hand", *params["datasets"])}
    assert changed_files(project, project_tools) == {" M params.yaml", *manifests}
    built = project_tools.run(project, "dvc", "repro", "raw@own-grab", "raw@own-h2o")
    assert built.returncode == 0, built.stderr
    assert len(json.loads((project / "data/own/grab/raw.json").read_text())["files"]) > 5
    assert not json.loads((project / "data/own/h2o/raw.json").read_text())["present"]


def test_choosing_a_profile_changes_one_line_of_params(here, project_tools):
    make_plain_params(here)
    commit(here, project_tools)
    assert hoidata("profile", "own").stdout == "own\n"
    diff = project_tools.run(here, "git", "diff", "-U0", "params.yaml").stdout
    changed = [line for line in diff.splitlines() if line[0] in "+-" and line[:3] not in ("+++", "---")]
    assert changed == ["-profile: embedded  # embedded, study or own", "+profile: own  # embedded, study or own"]
    params = here / "params.yaml"
    commit(here, project_tools)
    params.write_text(params.read_text().replace("seed: 0", "seed: 5"))
    project_tools.run(here, "git", "checkout", "--quiet", "params.yaml")
    assert hoidata("profile").stdout == "own\n"
    assert "seed: 0" in params.read_text()
    assert hoidata("profile", "embedded").stdout == hoidata("profile").stdout == "embedded\n"
    assert isinstance(hoidata("profile", "mine").exception, BadInput)


def test_a_profile_that_cannot_be_set_is_refused(here):
    params = here / "params.yaml"
    params.write_text(params.read_text().replace("profile: embedded", '"profile": embedded'))
    assert isinstance(hoidata("profile", "own").exception, BadInput)


def make_plain_params(folder: Path) -> None:
    """params.yaml as delivered, including comments."""
    shutil.copy(PROJECT / "params.yaml", folder)


def hoidata(*words: str) -> Result:
    """Run a command in this process and the current folder."""
    return CliRunner().invoke(app, words)


@pytest.fixture
def here(project, monkeypatch) -> Path:
    for name in [name for name in os.environ if name.startswith("HOIDATA_")]:
        monkeypatch.delenv(name)
    monkeypatch.chdir(project)
    return project


def set_own(folder: Path, present: str = "") -> None:
    """Choose the profile own, with one scanned dataset."""
    params = folder / "params.yaml"
    params.write_text(params.read_text().replace("profile: embedded", "profile: own"))
    if present:
        make_present(folder, present)


@pytest.mark.parametrize("name", ["grab", "taco"])  # taco: not even named in params.yaml
def test_verifying_an_absent_dataset_fails_with_its_parts_and_download_pages(here, name):
    set_own(here)
    result = hoidata("raw", "verify", name)
    adapter = get_adapter(name)
    for words in (f"{name}: not present", adapter.licence, adapter.where_to_register, f"raw scan {name} --root"):
        assert words in result.stdout
    for part in adapter.parts:
        assert f"missing: {part.contents}" in result.stdout
        assert part.archive in result.stdout
    assert result.exit_code == 1


def test_verifying_all_present_datasets_ignores_absent_ones(here):
    set_own(here)
    result = hoidata("raw", "verify")
    assert result.exit_code == 0
    assert "grab: not present" in result.stdout


def test_verifying_files_of_a_deleted_folder_fails_with_download_pages(here):
    set_own(here, present="grab")
    for words in (["raw", "verify", "grab"], ["raw", "verify"]):
        result = hoidata(*words)
        assert result.exit_code == 1
        for part in ("HOIDATA_GRAB", "object_meshes.zip", "https://grab.is.tue.mpg.de"):
            assert part in result.stdout


def test_a_scan_reports_missing_dataset_files_before_missing_mano_files(here, tmp_path):
    params = yaml.safe_load((here / "params.yaml").read_text())
    params["datasets"].append("taco")
    (here / "params.yaml").write_text(yaml.safe_dump(params))
    root = tmp_path / "taco"
    root.mkdir()
    for name in ("manipnet", "taco"):
        empty = hoidata("raw", "scan", name, "--root", str(root)).exception
        assert isinstance(empty, BadInput)
        assert not is_present(here, name)
    text = str(empty)
    assert 0 < text.index("Hand_Poses.zip") < text.index("mano.is.tue.mpg.de")
    for path in (
        "Hand_Poses/(a, b, c)/1_1/left_hand.pkl",
        "Object_Poses/(a, b, c)/1_1/x.npy",
        "Object_Models/1_cm.obj",
    ):
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_bytes(b"")
    complete = hoidata("raw", "scan", "taco", "--root", str(root)).exception
    assert isinstance(complete, MissingResource)
    assert str(complete).startswith("taco has MANO parameters and no MANO files are registered")
    for part in ("mano.is.tue.mpg.de", "MANO_RIGHT.pkl", "hoidata raw scan mano", "HOIDATA_MANO"):
        assert part in str(complete)
    assert not is_present(here, "taco")


def test_any_profile_whose_manifests_are_recipes_has_generated_files_and_the_embedded_hand(project, monkeypatch):
    monkeypatch.chdir(project)
    shutil.copytree(project / "manifests" / "embedded", project / "manifests" / "mine", dirs_exist_ok=True)
    assert load_hands("mine").name == "embedded"
    with pytest.raises(MissingResource, match="hoidata synth write grab --profile mine"):
        raw_root(StagePaths("mine", "grab"))


@pytest.mark.slow
def test_convert_takes_a_generated_corpus_with_the_embedded_hand(tmp_path, stage_folder, monkeypatch, small_corpus):
    written = small_corpus("grab").raw  # in place of minutes of generation
    monkeypatch.setattr("hoidata.synthetic.corpus.write_corpus", lambda _, root, *__: shutil.copytree(written, root))
    paths = StagePaths("embedded", "grab")
    write_generated(paths, manifest_of(paths), tmp_path / "grab")
    words = ("convert", "grab", "--root", tmp_path / "grab", "--out", tmp_path / "store", "--jobs", 1)
    result = CliRunner().invoke(app, [*map(str, words)])
    assert result.exit_code == 0, result.output
    store = open_store(tmp_path / "store")
    assert store.clip(store.ids[0]).synthetic


def test_commands_outside_of_a_project_are_refused(tmp_path, project_tools):
    result = project_tools.run(tmp_path, "hoidata", "doctor")
    assert result.returncode == 1
    assert "no hoidata project" in result.stderr


@pytest.mark.slow
def test_doctor_lists_all_parts(project, project_tools):
    result = project_tools.run(project, "hoidata", "doctor", COLUMNS="200")
    assert result.returncode == 0, result.stdout
    for part in ("torch", "prefect server", "gpu", "hand (embedded)", "text encoder", "raw grab (own)", "CLIP"):
        assert part in result.stdout


@pytest.mark.long
@pytest.mark.skipif("HOIDATA_MANIPNET" not in os.environ, reason="HOIDATA_MANIPNET is not set")
def test_real_motion_capture_is_scanned_checked_and_converted(project, project_tools):
    root = os.environ["HOIDATA_MANIPNET"]
    scanned = project_tools.run(project, "hoidata", "raw", "scan", "manipnet", "--root", root)
    assert scanned.returncode == 0, scanned.stderr
    assert "profile: own" in (project / "params.yaml").read_text()
    assert project_tools.run(project, "hoidata", "raw", "verify", "manipnet").returncode == 0
    built = project_tools.run(project, "dvc", "repro", "raw@own-manipnet", "annotate@own-grab", HOIDATA_MANIPNET=root)
    assert built.returncode == 0, built.stdout + built.stderr
    assert (project / "data/own/grab/annotation/empty.json").is_file()
    assert len(json.loads((project / "data/own/manipnet/raw.json").read_text())["files"]) > 50
