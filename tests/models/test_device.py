"""Training and sampling read no GPU value on the host and mix no devices, checked without a GPU (``fake_device``).

The setting ``device`` is one word; a missing device is an error.
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
    *(f"sample and refine by {kind}" for kind in ("ddim", "ddpm", "dpm++")),
    "decode control points of ours",
    "sample lengths",
]


@pytest.fixture(scope="module")
def errors(annotated_root: Path, trained: Path) -> dict[str, str]:
    """The error of each path, or ""."""
    command = [sys.executable, "-m", "tests.models.fake_device", str(annotated_root), str(trained)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    return dict(map(json.loads, done.stdout.splitlines()))


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_a_path_runs_on_a_device_without_data(errors: dict[str, str], name: str) -> None:
    assert errors[name] == ""


@pytest.mark.long
def test_reading_a_value_and_mixing_devices_are_detected(errors: dict[str, str]) -> None:
    assert errors["a value read on the host"].startswith("DataDependentOutputException")
    assert errors["tensors of two devices"].startswith("FakeTensorDeviceMismatchError")
    assert errors["a blocking copy"].startswith("RuntimeError: a blocking copy")
    noticed = {"a value read on the host", "a blocking copy", "tensors of two devices"}
    assert set(errors) == {*NAMES, *noticed}


@pytest.mark.parametrize("present", [True, False])
def test_auto_is_a_gpu_if_there_is_one(monkeypatch, present: bool):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: present)
    assert chosen_device("auto") == ("cuda" if present else "cpu")
    assert chosen_device("cpu") == "cpu"


def test_cuda_is_refused_without_a_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert chosen_device("cuda") == "cuda"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingResource, match="set it to auto or cpu"):
        chosen_device("cuda")


def test_another_word_is_refused():
    with pytest.raises(BadInput, match="auto or cpu or cuda"):
        chosen_device("gpu")
