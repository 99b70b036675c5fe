"""Stages read the same values from params.yaml as DVC, and an overlay affects only its profile."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from dvc.utils.serialize import parse_yaml

from hoidata.annotation.settings import AnnotationSettings
from hoidata.contact.settings import ContactSettings
from hoidata.errors import BadInput
from hoidata.settings import build_config
from models.common.training import TrainingConfig
from pipelines.commands.adapters import read_settings
from pipelines.lineage.graph import look_up, read_graph
from pipelines.lineage.locks import parse_locks
from pipelines.params import chosen_params, load_yaml, read_file, read_params
from pipelines.stages.base import load_settings, read_section
from pipelines.stages.code import SECTIONS_OF_DATASETS, dataset_settings, profile_settings
from pipelines.stages.train import TrainParams

PROJECT = Path(__file__).parents[2]
SCALARS = (
    *("1e-05", "4e-4", "+1E3", "1e3", "1.e5", ".5", "5.", "12e03", "-.inf"),
    *("010", "0o10", "0x1f", "0b11", "1_000", "089", "1:30"),
    *("yes", "on", "off", "No", "y", "true", "False", "null", "~", "", "2026-01-02", "'1e-05'"),
)


@pytest.mark.parametrize("text", SCALARS)
def test_values_are_parsed_as_dvc_parses_them(text):
    ours, theirs = load_yaml(f"key: {text}\n".encode())["key"], parse_yaml(f"key: {text}\n", "params.yaml")["key"]
    assert (ours, type(ours)) == (theirs, type(theirs))


def test_the_exponent_that_dvc_writes_is_a_number():
    values = load_yaml(b"{learning_rate: 1e-05, steps: 1e3, weight_decay: '4e-4', clip_norm: +1E3}")
    config = build_config(TrainingConfig, values, "training")
    assert (config.learning_rate, config.weight_decay, config.clip_norm) == (0.00001, 0.0004, 1000.0)
    assert (config.steps, type(config.steps)) == (1000, int)


@pytest.mark.parametrize("value", [1e-5, "1e-05 ", "0.5.1", "nan", "Infinity", "1e999", ""])
def test_other_values_than_integers_are_refused_for_integer_settings(value):
    with pytest.raises(BadInput, match=r"training\.steps: expected int, got"):
        build_config(TrainingConfig, {"steps": value}, "training")


def test_numbers_in_a_list_are_parsed_in_the_same_way():
    from models.text2hoi.contact import ContactConfig

    config = build_config(ContactConfig, {"decoder_widths": [1e2, "64", 32]}, "network")
    assert config.decoder_widths == (100, 64, 32)
    with pytest.raises(BadInput, match=r"network\.decoder_widths: expected int, got 'wide'"):
        build_config(ContactConfig, {"decoder_widths": ["wide"]}, "network")


def test_a_duplicate_key_is_refused_as_in_dvc(tmp_path):
    (tmp_path / "params.yaml").write_text("contact: {points: 8}\ncontact: {points: 9}\n")
    with pytest.raises(BadInput, match="duplicate key"):
        read_file(tmp_path / "params.yaml")


@pytest.mark.parametrize(
    "text", ["a: !!bool z", "a: !!int ''", "a: !!python/object:os.system x", "a: =", "a: -_", "[a"]
)
def test_malformed_yaml_is_refused_with_a_message(tmp_path, text):
    (tmp_path / "params.yaml").write_text(text)
    with pytest.raises(BadInput, match="expected YAML text"):
        read_file(tmp_path / "params.yaml")


def test_numbers_in_a_lock_file_are_parsed_as_dvc_wrote_them():
    text = b"stages: {train@a: {params: {params.yaml: {train.small: {learning_rate: 1e-05}}}}}"
    assert parse_locks({"dvc.lock": text})["train@a"].params == {"train.small": {"learning_rate": 0.00001}}


def test_a_setting_on_the_command_line_is_parsed_as_in_the_file():
    assert read_settings(["margin_frames=1e1", "clips=on"]) == {"margin_frames": 10.0, "clips": "on"}
    with pytest.raises(BadInput, match=r"--setting clips: expected a value as in params.yaml"):
        read_settings(["clips=[1"])


def planned(params: Path, network: str) -> None:
    from models.common.training import TrainingSpec
    from models.registry import load_network

    TrainingSpec.of(load_network(network), load_settings(TrainParams, "train", params).of(network))


@pytest.mark.parametrize(
    ("keys", "value", "key", "words"),
    [
        ("train.small.length.training.learning_rate", "fast", None, "expected float, got 'fast'"),
        ("train.ours.length.network.verb_input", "loud", None, "expected bool, got 'loud'"),
        ("profiles.embedded.train.small.length.training.batch", 1.5, None, "expected int, got 1.5"),
        ("train.small.length.training.steps", 0, None, "expected 1 or more, got 0"),
        ("train.small.length.training.stepps", 3, "train.small.length.training", "expected keys among: .*got stepps"),
        ("train.small.length.trainin", {}, "train.small.length", "expected keys among: .*got trainin"),
        ("train.small.length.network", 4, None, "expected keys with values, got 4"),
    ],
)
def test_an_error_of_a_training_names_the_key_that_is_in_the_file(tmp_path, keys, value, key, words):
    params = read_file(PROJECT / "params.yaml")
    *sections, last = keys.split(".")
    section = params
    for name in sections:
        section = section.setdefault(name, {})
    section[last] = value
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(params))
    with pytest.raises(BadInput, match=f"^params.yaml: {key or keys}: {words}"):
        planned(tmp_path / "params.yaml", "length")


def test_an_error_of_any_section_names_the_profile_that_sets_the_value(tmp_path):
    params = read_file(PROJECT / "params.yaml")
    params["profiles"]["embedded"]["contact"] = {"threshold_m": "near"}
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(params))
    with pytest.raises(BadInput, match=r"^params.yaml: profiles.embedded.contact.threshold_m: expected float"):
        load_settings(ContactSettings, "contact", tmp_path / "params.yaml")


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
    expected["split"]["grab"] = OVERLAY["split"]["grab"]  # a mapping instead of a name
    expected["train"]["small"]["refiner"]["training"]["steps"] = 3
    expected["sample"]["samples"] = 20
    assert study == expected
    assert plain == before


def test_all_readers_of_params_apply_the_overlay(plain, tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text(yaml.safe_dump({**plain, "profile": "study"}))
    assert load_settings(AnnotationSettings, "annotate", path).encoder == "hash"
    assert read_section("sample", path) == read_params(tmp_path)["sample"] == {**plain["sample"], "samples": 20}


def test_an_empty_section_of_an_overlay_changes_nothing(plain):
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
def test_keys_that_a_profile_cannot_override_are_refused_in_all_profiles(plain, profiles, message):
    with pytest.raises(BadInput, match=message):
        chosen_params({**plain, "profiles": profiles})


@pytest.mark.parametrize("text", ["[" * 30000, "{a: " * 30000, "- " * 30000])
def test_too_deeply_nested_params_are_refused_and_do_not_crash(tmp_path, text):
    (tmp_path / "params.yaml").write_text(text)
    with pytest.raises(BadInput, match="YAML text"):
        read_file(tmp_path / "params.yaml")


def test_an_overlay_runs_exactly_the_stages_again_that_read_its_settings(plain):
    """A change of any stage parameter in the overlay alone changes that stage's file in code/."""
    stages = read_graph(PROJECT).values()
    keys = {(file, key) for stage in stages for file in stage.code for key in stage.params}
    keys |= {(file, f"{'.'.join(SECTIONS_OF_DATASETS[name])}.grab") for name in SECTIONS_OF_DATASETS
             for file in [f"code/{name}/grab.json"]}  # fmt: skip
    checked = {(file, key) for file, key in keys if key not in ("datasets", "families", "family_datasets")}
    files = {file for stage in stages for file in stage.code}
    for key in sorted({key for _, key in checked}):
        assert changed_by_overlay(plain, key, files) == {file for file, other in checked if other == key}, key


def changed_by_overlay(plain: dict[str, Any], key: str, files: set[str]) -> set[str]:
    """The files of ``code/`` that change with an overlay of ``key``."""
    overlay: Any = {"steps": 1} if isinstance(look_up(plain, key), dict) else 7
    for name in reversed(key.split(".")):
        overlay = {name: overlay}
    base = {**plain, "profile": "study", "profiles": {}}
    with_overlay = {**base, "profiles": {"study": overlay}}

    def written(values: dict[str, Any], file: str) -> dict[str, str]:
        name = file.removeprefix("code/").removesuffix(".json")
        return dataset_settings(chosen_params(values), name) | profile_settings(values, chosen_params(values), name)

    return {file for file in files if written(base, file) != written(with_overlay, file)}


def test_the_file_of_a_stage_has_exactly_the_settings_that_it_reads(plain):
    study = chosen_params({**plain, "profile": "study"})
    settings = profile_settings(plain, study, "train/refiner")
    (value,) = settings.values()
    assert json.loads(value) == [0, study["train"]["ours"]["refiner"], study["train"]["small"]["refiner"]]
    assert profile_settings(plain, study, "train/contact") == {}
    assert profile_settings(plain, chosen_params(plain), "train/refiner") == {}


def test_a_stage_of_another_profile_than_the_chosen_one_is_refused(tmp_path, project_tools):
    folder = project_tools.copy_project(tmp_path / "project")
    done = project_tools.run(
        folder, "python", "-m", "pipelines.stages", "split", "--profile", "own", "--dataset", "grab"
    )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "--profile: expected embedded, which params.yaml chooses, got own" in done.stderr
