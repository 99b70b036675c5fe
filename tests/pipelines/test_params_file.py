"""params.yaml means to every stage and command what it means to DVC, and an error names the key that is in the file."""

from pathlib import Path

import pytest
import yaml
from dvc.utils.serialize import parse_yaml

from hoidata.contact.settings import ContactSettings
from hoidata.errors import BadInput
from hoidata.settings import build_config
from models.common.training import TrainingConfig
from pipelines.commands.adapters import read_settings
from pipelines.lineage.locks import parse_locks
from pipelines.params import load_yaml, read_file
from pipelines.stages.base import load_settings
from pipelines.stages.train import TrainParams

PROJECT = Path(__file__).parents[2]
SCALARS = (
    *("1e-05", "4e-4", "+1E3", "1e3", "1.e5", ".5", "5.", "12e03", "-.inf"),
    *("010", "0o10", "0x1f", "0b11", "1_000", "089", "1:30"),
    *("yes", "on", "off", "No", "y", "true", "False", "null", "~", "", "2026-01-02", "'1e-05'"),
)


@pytest.mark.parametrize("text", SCALARS)
def test_a_value_is_what_dvc_reads_it_as(text):
    ours, theirs = load_yaml(f"key: {text}\n".encode())["key"], parse_yaml(f"key: {text}\n", "params.yaml")["key"]
    assert (ours, type(ours)) == (theirs, type(theirs))


def test_the_exponent_that_dvc_writes_is_a_number():
    values = load_yaml(b"{learning_rate: 1e-05, steps: 1e3, weight_decay: '4e-4', clip_norm: +1E3}")
    config = build_config(TrainingConfig, values, "training")
    assert (config.learning_rate, config.weight_decay, config.clip_norm) == (0.00001, 0.0004, 1000.0)
    assert (config.steps, type(config.steps)) == (1000, int)


@pytest.mark.parametrize("value", [1e-5, "1e-05 ", "0.5.1", "nan", "Infinity", "1e999", ""])
def test_what_is_no_whole_number_is_refused_where_one_is_needed(value):
    with pytest.raises(BadInput, match=r"training\.steps: expected int, got"):
        build_config(TrainingConfig, {"steps": value}, "training")


def test_numbers_in_a_list_are_read_by_the_same_rule():
    from models.text2hoi.contact import ContactConfig

    config = build_config(ContactConfig, {"decoder_widths": [1e2, "64", 32]}, "network")
    assert config.decoder_widths == (100, 64, 32)
    with pytest.raises(BadInput, match=r"network\.decoder_widths: expected int, got 'wide'"):
        build_config(ContactConfig, {"decoder_widths": ["wide"]}, "network")


def test_a_key_that_is_given_twice_is_refused_as_dvc_refuses_it(tmp_path):
    (tmp_path / "params.yaml").write_text("contact: {points: 8}\ncontact: {points: 9}\n")
    with pytest.raises(BadInput, match="duplicate key"):
        read_file(tmp_path / "params.yaml")


@pytest.mark.parametrize(
    "text", ["a: !!bool z", "a: !!int ''", "a: !!python/object:os.system x", "a: =", "a: -_", "[a"]
)
def test_text_that_is_no_yaml_is_refused_in_words(tmp_path, text):
    (tmp_path / "params.yaml").write_text(text)
    with pytest.raises(BadInput, match="expected YAML text"):
        read_file(tmp_path / "params.yaml")


def test_a_lock_file_gives_the_numbers_dvc_noted():
    text = b"stages: {train@a: {params: {params.yaml: {train.small: {learning_rate: 1e-05}}}}}"
    assert parse_locks({"dvc.lock": text})["train@a"].params == {"train.small": {"learning_rate": 0.00001}}


def test_a_setting_on_the_command_line_is_read_as_in_the_file():
    assert read_settings(["margin_frames=1e1", "clips=on"]) == {"margin_frames": 10.0, "clips": "on"}
    with pytest.raises(BadInput, match=r"--setting clips: expected a value as in params.yaml"):
        read_settings(["clips=[1"])


def planned(params: Path, network: str) -> None:
    from models.common.training import Plan
    from models.registry import load_network

    Plan.of(load_network(network), load_settings(TrainParams, "train", params).of(network))


@pytest.mark.parametrize(
    ("keys", "value", "key", "words"),
    [
        ("train.small.length.training.learning_rate", "fast", None, "expected float, got 'fast'"),
        ("train.ours.length.network.noise", "loud", None, "expected int, got 'loud'"),
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
