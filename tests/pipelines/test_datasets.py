"""A new dataset is a folder and a name: stages run with one from outside of the repository, and DVC with TACO."""

import difflib
import json
import tomllib
from pathlib import Path

import pandas as pd
import pytest
import yaml
from typer.testing import CliRunner

from hoidata.clips import SIDES
from hoidata.hands import load_embedded_hands
from pipelines.cli import app
from pipelines.commands.project import remember_root
from pipelines.stages import annotate, contact, convert, quality, raw, split
from pipelines.stages.base import StagePaths, empty_reason
from tests.builders import kitchen, taco
from tests.builders.mano import write_mano_pickle

TYPED_FILES = ("hoidata.toml", "params.yaml")


@pytest.fixture
def here(project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project without manifests of the dataset, as the current folder."""
    monkeypatch.chdir(project)
    return project


def texts() -> dict[str, list[str]]:
    return {name: Path(name).read_text().splitlines() if Path(name).is_file() else [] for name in TYPED_FILES}


def name_in_params(name: str) -> None:
    params = yaml.safe_load(Path("params.yaml").read_text())
    params["datasets"].append(name)
    Path("params.yaml").write_text(yaml.safe_dump(params, sort_keys=False))


def hoidata(*words: str) -> str:
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output + str(result.exception)
    return result.output


def split_of(paths: StagePaths) -> dict[str, int]:
    """The number of clips of each subset."""
    chosen = json.loads((paths.splits / "info.json").read_text())["chosen"]
    assert chosen["name"] == "drawn"
    assert chosen["keeps_its_promises"]
    assert len(pd.read_parquet(paths.annotation / "text.parquet")) >= 3
    return chosen["clips"]


@pytest.mark.slow
def test_a_dataset_from_a_folder_outside_the_repository_takes_three_lines(here: Path, tmp_path: Path) -> None:
    root = kitchen.write_kitchen(tmp_path / "raw", load_embedded_hands())
    facts = kitchen.write_dataset(tmp_path / "mine") / "facts.toml"
    facts.write_text(facts.read_text().replace("needs_mano = true", "needs_mano = false"))
    before = texts()
    Path("hoidata.toml").write_text('[datasets]\npaths = ["../mine/kitchen"]\n')
    name_in_params("kitchen")
    typed = [
        line
        for name, lines in texts().items()
        for line in difflib.ndiff(before[name], lines)
        if line.startswith(("+", "-"))
    ]
    print(f"{len(typed)} lines typed outside the folder:", *typed, sep="\n")
    assert len(typed) <= 3
    assert "CC BY 4.0" in hoidata("raw", "scan", "kitchen", "--root", str(root))
    assert 'paths = ["../mine/kitchen"]' in Path("hoidata.toml").read_text()
    for stage in (raw, convert, quality, contact, annotate, split):
        stage.run(StagePaths("own", "kitchen"))
    assert split_of(StagePaths("own", "kitchen")) == {"train": 1, "validation": 1, "test": 1, "left_out": 0}
    raw.run(StagePaths("embedded", "kitchen"))
    convert.run(StagePaths("embedded", "kitchen"))
    assert empty_reason(StagePaths("embedded", "kitchen").clips) == "kitchen is not present in the profile embedded"


@pytest.mark.long
def test_taco_runs_in_dvc_repro_after_adding_its_name(here: Path, tmp_path: Path, project_tools) -> None:
    mano, root = tmp_path / "mano", taco.write_taco(tmp_path / "taco")
    mano.mkdir()
    for side in SIDES:
        write_mano_pickle(load_embedded_hands()[side], mano / f"MANO_{side.upper()}.pkl")
    name_in_params("taco")
    assert not Path("manifests/own/taco.json").exists()
    assert "no raw files were scanned" in CliRunner().invoke(app, ["raw", "verify", "taco"]).output
    hoidata("raw", "scan", "mano", "--root", str(mano))
    hoidata("raw", "scan", "taco", "--root", str(root))
    built = project_tools.run(here, "dvc", "repro", "split@own-taco")
    assert built.returncode == 0, built.stdout + built.stderr
    assert split_of(StagePaths("own", "taco")) == {"train": 1, "validation": 1, "test": 1, "left_out": 0}


def test_a_scan_keeps_the_other_sections_of_hoidata_toml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("hoidata.toml").write_text('[roots]\nold = "/a"\n\n[datasets]\npaths = ["../kitchen"]\n')
    remember_root("new", Path("/b"))
    first = Path("hoidata.toml").read_text()
    remember_root("new", Path("/b"))
    assert Path("hoidata.toml").read_text() == first
    for line in ('old = "/a"', 'new = "/b"', 'paths = ["../kitchen"]'):
        assert first.count(line) == 1
    assert first.count("[roots]") == 1


def test_a_raw_folder_may_have_brackets_in_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("hoidata.toml").write_text('[datasets]\npaths = ["../kitchen"]\n')
    for name, folder in (("mano", "/mano [v1.2]"), ("grab", "[/grab"), ("mano", "/mano [v1.2]")):
        remember_root(name, Path(folder))
    settings = tomllib.loads(Path("hoidata.toml").read_text())
    assert settings == {"roots": {"mano": "/mano [v1.2]", "grab": "[/grab"}, "datasets": {"paths": ["../kitchen"]}}
