"""Smoke tests on a GPU: every network trains a step there, and a motion is sampled. Skipped without one."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hoidata.hands import load_embedded_hands
from hoidata.metrics.evaluate import evaluate_store
from models.common.predicting import sample_family
from models.common.repeatable import make_repeatable
from models.registry import load_family
from tests.models.toy import FAST, PARAMS, train

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU: torch.cuda.is_available() is False"),
]


@pytest.fixture(scope="module")
def on_gpu(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One short training of each network on the GPU."""
    out = tmp_path_factory.mktemp("gpu")
    for name in PARAMS:
        train(name, annotated_root, out, device="cuda")
    return out


def test_every_network_trains_on_the_gpu_and_its_weights_are_finite(on_gpu: Path) -> None:
    for name in PARAMS:
        weights = load_file(on_gpu / name / "model.safetensors")
        assert weights
        assert all(torch.isfinite(weight).all() for weight in weights.values())


def test_same_seed_same_bytes_on_the_gpu(annotated_root: Path, tmp_path: Path) -> None:
    """With deterministic operations, as in a stage."""
    repeatable = [torch.are_deterministic_algorithms_enabled(), torch.get_num_threads()]
    make_repeatable(threads=1)
    try:
        for out in ("once", "twice"):
            for name in PARAMS:
                train(name, annotated_root, tmp_path / out, device="cuda")
    finally:
        torch.use_deterministic_algorithms(bool(repeatable[0]))
        torch.set_num_threads(repeatable[1])
    for name in PARAMS:
        once, twice = (load_file(tmp_path / out / name / "model.safetensors") for out in ("once", "twice"))
        assert all(torch.equal(weight, twice[key]) for key, weight in once.items()), name


def test_motions_are_sampled_and_measured_on_the_gpu(annotated_root: Path, on_gpu: Path, tmp_path: Path) -> None:
    family, hands = load_family("text2hoi"), load_embedded_hands()
    sample_family(
        family, annotated_root, on_gpu, tmp_path / "motions", {"samples": 2}, hands, settings=FAST, device="cuda"
    )
    metrics = evaluate_store(tmp_path / "motions" / "clips", annotated_root, hands)["figures"]
    assert all(np.isfinite(value) for value in metrics.values())
