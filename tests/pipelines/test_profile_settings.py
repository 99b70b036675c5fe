"""What params.yaml says under ``profiles`` counts for that profile alone, and makes its stages run again."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from hoidata.annotation.settings import AnnotationSettings
from hoidata.errors import BadInput
from pipelines.lineage.graph import look_up, read_graph
from pipelines.params import chosen_params, read_file, read_params
from pipelines.stages.base import load_settings, read_section
from pipelines.stages.code import SECTIONS_OF_DATASETS, own_settings, profile_settings

PROJECT = Path(__file__).parents[2]
OVERLAY: dict[str, Any] = {
    "annotate": {"encoder": "hash"},
    "split": {"grab": {"by": "subject", "test": ["s2"]}},
    "train": {"small": {"refiner": {"training": {"steps": 3}}}},
    "sample": {"samples": 20},
}


@pytest.fixture
def plain() -> dict[str, Any]:
    return {**read_file(PROJECT / "params.yaml"), "profiles": {"study": OVERLAY}}


def test_an_overlay_changes_what_it_names_in_its_profile_and_nothing_else(plain):
    before = copy.deepcopy(plain)
    study, embedded = chosen_params({**plain, "profile": "study"}), chosen_params(plain)
    assert embedded == {name: value for name, value in plain.items() if name != "profiles"}
    expected: dict[str, Any] = copy.deepcopy(embedded) | {"profile": "study"}
    expected["annotate"]["encoder"] = "hash"
    expected["split"]["grab"] = OVERLAY["split"]["grab"]  # a mapping in the place of a name
    expected["train"]["small"]["refiner"]["training"]["steps"] = 3
    expected["sample"]["samples"] = 20
    assert study == expected
    assert plain == before


def test_every_reader_of_the_params_sees_the_overlay(plain, tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text(yaml.safe_dump({**plain, "profile": "study"}))
    assert load_settings(AnnotationSettings, "annotate", path).encoder == "hash"
    assert read_section("sample", path) == read_params(tmp_path)["sample"] == {**plain["sample"], "samples": 20}


def test_an_empty_section_of_an_overlay_says_nothing(plain):
    for overlay in (None, {}, {"annotate": None}):
        assert (
            chosen_params({**plain, "profile": "study", "profiles": {"study": overlay}})["annotate"]["encoder"] == "use"
        )


@pytest.mark.parametrize(
    ("profiles", "message"),
    [
        ({"studdy": {}}, "profiles: expected keys among: embedded, study, own, got studdy"),
        ({"study": {"anotate": {}}}, "profiles.study: expected keys among: .*annotate.*, got anotate"),
        ({"study": {"annotate": "hash"}}, "profiles.study.annotate: expected keys with values, got 'hash'"),
        ({"study": ["annotate"]}, "profiles.study: expected keys with values"),
        ({"study": {"datasets": ["grab"]}}, "profiles.study.datasets: .*at the top of params.yaml"),
        ({"study": {"families": []}}, "profiles.study.families: "),
        ({"study": {"family_datasets": {}}}, "profiles.study.family_datasets: "),
        ({"study": {"profile": "own"}}, "profiles.study.profile: "),
        ({"study": {"train": {"size": "full"}}}, "profiles.study.train.size: "),
    ],
)
def test_what_cannot_be_laid_over_is_refused_in_whatever_profile_one_is(plain, profiles, message):
    with pytest.raises(BadInput, match=message):
        chosen_params({**plain, "profiles": profiles})


@pytest.mark.parametrize("text", ["[" * 30000, "{a: " * 30000, "- " * 30000])
def test_params_nested_beyond_reason_are_refused_and_end_no_process(tmp_path, text):
    (tmp_path / "params.yaml").write_text(text)
    with pytest.raises(BadInput, match="YAML text"):
        read_file(tmp_path / "params.yaml")


def test_a_stage_runs_again_when_a_setting_it_reads_is_laid_over_and_no_other_does(plain):
    """Every parameter of every stage of dvc.yaml, changed in the overlay alone, changes that stage's file in code/."""
    stages = read_graph(PROJECT).values()
    keys = {(file, key) for stage in stages for file in stage.code for key in stage.params}
    keys |= {(file, f"{'.'.join(SECTIONS_OF_DATASETS[name])}.grab") for name in SECTIONS_OF_DATASETS
             for file in [f"code/{name}/grab.json"]}  # fmt: skip
    checked = {(file, key) for file, key in keys if key not in ("datasets", "families", "family_datasets")}
    files = {file for stage in stages for file in stage.code}
    for key in sorted({key for _, key in checked}):
        assert changed_by_overlay(plain, key, files) == {file for file, other in checked if other == key}, key


def changed_by_overlay(plain: dict[str, Any], key: str, files: set[str]) -> set[str]:
    """The files of ``code/`` that an overlay of ``key`` gives other settings."""
    overlay: Any = {"steps": 1} if isinstance(look_up(plain, key), dict) else 7
    for name in reversed(key.split(".")):
        overlay = {name: overlay}
    base = {**plain, "profile": "study", "profiles": {}}
    with_overlay = {**base, "profiles": {"study": overlay}}

    def written(values: dict[str, Any], file: str) -> dict[str, str]:
        name = file.removeprefix("code/").removesuffix(".json")
        return own_settings(chosen_params(values), name) | profile_settings(values, chosen_params(values), name)

    return {file for file in files if written(base, file) != written(with_overlay, file)}


def test_what_is_written_is_what_the_stage_reads_so_that_equal_settings_are_equal_text(plain):
    study = chosen_params({**plain, "profile": "study"})
    found = profile_settings(plain, study, "train/refiner")
    (value,) = found.values()
    assert json.loads(value) == [0, study["train"]["ours"]["refiner"], study["train"]["small"]["refiner"]]
    assert profile_settings(plain, study, "train/contact") == {}
    assert profile_settings(plain, chosen_params(plain), "train/refiner") == {}


def test_a_stage_of_a_profile_that_is_not_chosen_is_refused_as_its_settings_are_not_there(tmp_path, project_tools):
    folder = project_tools.copy_project(tmp_path / "project")
    done = project_tools.run(
        folder, "python", "-m", "pipelines.stages", "split", "--profile", "own", "--dataset", "grab"
    )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "--profile: expected embedded, which params.yaml chooses, got own" in done.stderr
