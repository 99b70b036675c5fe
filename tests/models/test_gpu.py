"""Smoke tests on a GPU: every network trains a step there, and a motion is sampled. Skipped by name without one."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from hoidata.annotation import load_encoder
from hoidata.hands import load_embedded_hands
from models.common.training import train_model
from models.text2hoi.generation import generate
from tests.models.test_training import PARAMS

NEEDS = {"contact": (), "length": (), "diffusion": ("contact",), "refiner": ("diffusion",)}
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU: torch.cuda.is_available() is False"),
]


@pytest.fixture(scope="module")
def trained(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One short training of each network on the GPU."""
    out = tmp_path_factory.mktemp("gpu")
    for name, needs in NEEDS.items():
        upstream = {other: out / other for other in needs}
        train_model(name, annotated_root, out / name, PARAMS[name], upstream=upstream, device="cuda")
    return out


def test_every_network_trains_on_the_gpu_and_its_weights_are_finite(trained: Path):
    for name in NEEDS:
        weights = load_file(trained / name / "model.safetensors")
        assert weights
        assert all(torch.isfinite(weight).all() for weight in weights.values())


def test_a_motion_is_sampled_from_what_was_trained_on_the_gpu(trained: Path, annotated):
    model = annotated.object_model(annotated.object_key(annotated.ids()[0]))
    motion = generate("Lift a box with the right hand.", model, trained, load_embedded_hands(), load_encoder("hash"), 0)
    assert motion.clip.n_frames > 0
