"""What a GPU would run waits for no value and mixes no devices; known without one (see ``fake_device``).

The device is asked for in one word; what is not there is said, never silently replaced.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from hoidata.errors import BadInput, MissingResource
from models.common.repeatable import chosen_device

NAMES = [
    *(
        f"train {name} {preset}"
        for preset in ("paper", "ours")
        for name in ("contact", "length", "diffusion", "refiner")
    ),
    *(f"sample and refine by {kind}, guidance {scale}" for kind in ("ddim", "ddpm", "dpm++") for scale in (1, 2)),
    "generate rows of ours",
    "sample lengths",
]


@pytest.fixture(scope="module")
def said(annotated_root: Path, trained: Path) -> dict[str, str]:
    """What each path raised, "" where it ran through."""
    command = [sys.executable, "-m", "tests.models.fake_device", str(annotated_root), str(trained)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    return dict(map(json.loads, done.stdout.splitlines()))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_path_runs_on_a_device_without_data(said: dict[str, str], name: str) -> None:
    assert said[name] == ""


@pytest.mark.slow
def test_waiting_for_a_value_and_mixing_devices_would_be_noticed(said: dict[str, str]) -> None:
    assert said["a value that is waited for"].startswith("DataDependentOutputException")
    assert said["tensors of two devices"].startswith("FakeTensorDeviceMismatchError")
    assert said["a copy that is waited for"].startswith("RuntimeError: a copy that is waited for")
    noticed = {"a value that is waited for", "a copy that is waited for", "tensors of two devices"}
    assert set(said) == {*NAMES, *noticed}


@pytest.mark.parametrize("present", [True, False])
def test_auto_takes_a_gpu_where_there_is_one(monkeypatch, present: bool):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: present)
    assert chosen_device("auto") == ("cuda" if present else "cpu")
    assert chosen_device("cpu") == "cpu"


def test_cuda_is_refused_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert chosen_device("cuda") == "cuda"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingResource, match="set it to auto or cpu"):
        chosen_device("cuda")


def test_another_word_is_refused():
    with pytest.raises(BadInput, match="auto or cpu or cuda"):
        chosen_device("gpu")
