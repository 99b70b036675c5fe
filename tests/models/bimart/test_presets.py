"""BimArt's presets in params.yaml: both networks of a pair have the same features, and their preset is recognised."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from hoidata.errors import BadInput
from hoidata.settings import build_config
from models.bimart.network import DenoiserConfig
from models.bimart.sampler import SamplingConfig, preset_of
from models.bimart.scene import FeatureConfig
from models.bimart.training import LossConfig
from models.common.training import TrainingSpec
from models.registry import load_network
from pipelines.stages.train import TrainParams

SECTION: dict[str, Any] = yaml.safe_load((Path(__file__).parents[3] / "params.yaml").read_text())["train"]
NETWORKS = ("bimart-contact", "bimart-motion")


def training_plan(preset: str, size: str, name: str) -> TrainingSpec:
    params = build_config(TrainParams, {**SECTION, "preset": preset, "size": size}, "params.yaml: train")
    return TrainingSpec.of(load_network(name), params.of(name))


def differences(first: Any, second: Any, name: str = "") -> set[str]:
    if not isinstance(first, dict):
        return set() if first == second else {name}
    return {
        difference for key in first for difference in differences(first[key], second[key], f"{name}.{key}".strip("."))
    }


@pytest.mark.parametrize("preset", ["paper", "ours"])
@pytest.mark.parametrize("size", ["small", "full"])
def test_the_preset_of_a_network_is_recognised(preset: str, size: str) -> None:
    assert preset_of(training_plan(preset, size, "bimart-motion").network) == preset


@pytest.mark.parametrize("preset", ["paper", "ours"])
@pytest.mark.parametrize("size", ["small", "full"])
def test_both_networks_of_a_preset_have_the_same_features_but_for_the_state(preset: str, size: str) -> None:
    contact, motion = (asdict(training_plan(preset, size, name).network.features) for name in NETWORKS)
    assert differences(contact, motion) <= {"state"}


@pytest.mark.parametrize(
    ("config", "old", "new"),
    [
        (FeatureConfig, "most_m", "max_distance_m"),
        (DenoiserConfig, "floor", "min_std_fraction"),
        (LossConfig, "windows", "windows_per_clip"),
        (SamplingConfig, "guide", "contact_guidance"),
    ],
)
def test_a_renamed_key_is_refused_with_its_new_name(config: type, old: str, new: str) -> None:
    with pytest.raises(BadInput, match=f"{old} is now {new}"):
        build_config(config, {old: 1}, "params.yaml: train")
