"""Promises of BimArt's presets in params.yaml: networks of a pair see alike and say which preset they are of."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from hoidata.settings import build_config
from models.bimart.sampler import preset_of
from models.common.training import Plan
from models.registry import load_network
from pipelines.stages.train import TrainParams

SECTION: dict[str, Any] = yaml.safe_load((Path(__file__).parents[3] / "params.yaml").read_text())["train"]
NETWORKS = ("bimart-contact", "bimart-motion")


def plan(preset: str, size: str, name: str) -> Plan:
    params = build_config(TrainParams, {**SECTION, "preset": preset, "size": size}, "params.yaml: train")
    return Plan.of(load_network(name), params.of(name))


def differences(first: Any, second: Any, name: str = "") -> set[str]:
    if not isinstance(first, dict):
        return set() if first == second else {name}
    return {found for key in first for found in differences(first[key], second[key], f"{name}.{key}".strip("."))}


@pytest.mark.parametrize("preset", ["paper", "ours"])
@pytest.mark.parametrize("size", ["small", "full"])
def test_networks_say_which_preset_they_are_of(preset: str, size: str) -> None:
    assert preset_of(plan(preset, size, "bimart-motion").network) == preset


@pytest.mark.parametrize("preset", ["paper", "ours"])
@pytest.mark.parametrize("size", ["small", "full"])
def test_both_networks_of_a_preset_see_alike_but_for_the_state(preset: str, size: str) -> None:
    contact, motion = (asdict(plan(preset, size, name).network.features) for name in NETWORKS)
    assert differences(contact, motion) <= {"state"}
