"""A training with a non-finite number stops immediately, reports it, and saves the last good weights."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor

from hoidata.batches.dataset import HoiDataset
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import load_checkpoint, save_checkpoint
from models.common.family import Network, Setup
from models.common.predicting import PredictionConfig, requests_for
from models.common.training import train_network
from models.evaluator.inputs import Examples
from models.evaluator.settings import EvaluatorSettings
from models.evaluator.stage import train_evaluators
from models.registry import load_network
from models.text2hoi.sampler import SamplingConfig, Text2Hoi
from pipelines.stages.train import full_key
from tests.models.test_progress import SETTINGS

LAST_GOOD = Path("progress", "last_good", "model.safetensors")


def changed(network: Network, change: Callable[[int, Tensor, Setup], Tensor], validation: bool = False) -> Network:
    """The network with its total loss, or its validation loss, replaced by ``change(call, value, setup)``."""

    def objective(setup: Setup):
        inner, normaliser = network.objective(setup)
        losses, validation_loss, calls = inner.losses, inner.validation, iter(range(1, 10_000))

        def changed_losses(batch, generator):
            terms = losses(batch, generator)
            return {**terms, "total": change(next(calls), terms["total"], setup)}

        replaced = lambda network_now: change(next(calls), validation_loss(network_now), setup)  # noqa: E731
        setattr(inner, *(("validation", replaced) if validation else ("losses", changed_losses)))
        return inner, normaliser

    return replace(network, objective=objective)


def train(network: Network, root: Path, out: Path, **training) -> None:
    params = {**SETTINGS[network.name], "training": {**SETTINGS[network.name]["training"], **training}}
    needed = {load_network(other): out / "needed" / other for other in network.needs}
    name_key = lambda key: f"train.small.{network.name}.{key}"  # noqa: E731
    train_network(network, root, out / "made", params, needed=needed, progress=out / "progress", full_key=name_key)


def nan_at(step: int) -> Callable[[int, Tensor, Setup], Tensor]:
    return lambda call, value, setup: value * (math.nan if call == step else 1)


def step_of(path: Path) -> int:
    with safe_open(path, framework="pt") as stored:
        return json.loads(stored.metadata()["hoidata"])["step"]


@pytest.fixture
def out(trained: Path, tmp_path: Path) -> Path:
    (tmp_path / "needed").symlink_to(trained)
    return tmp_path


@pytest.mark.parametrize("name", [pytest.param("contact", marks=pytest.mark.slow), "length"])
def test_a_training_stops_at_the_first_non_finite_loss_and_saves_the_best_weights(
    annotated_root: Path, out: Path, name: str
) -> None:
    """At a constant learning rate, a training of n steps has the weights of the n-th validation."""
    settings = {"validate_every": 1, "keep_best": True, "learning_rate": 0.25, "save_every": 3}
    calls = []

    def counted(call: int, value: Tensor, setup: Setup) -> Tensor:
        calls.append(call)
        return nan_at(6)(call, value, setup)

    message = (
        rf"training of {name}: expected finite losses and weights, got a loss of nan at step 6 of 50; "
        rf"lower train\.small\.{name}\.training\.learning_rate \(0\.25\) or set "
        rf"train\.small\.{name}\.training\.clip_norm"
        r".*the last good weights, of step (\d+), are kept in .*last_good/model\.safetensors"
    )
    with pytest.raises(BadInput, match=message):
        train(changed(load_network(name), counted), annotated_root, out, steps=50, **settings)
    assert calls == [1, 2, 3, 4, 5, 6]
    assert not (out / "made").exists()
    last_good = load_checkpoint(out / LAST_GOOD, load_network(name))
    (out / "plain").mkdir()
    (out / "plain" / "needed").symlink_to(out / "needed")
    train(load_network(name), annotated_root, out / "plain", steps=5, **settings)
    expected = load_checkpoint(out / "plain" / "made", load_network(name))
    weights = expected.network.state_dict()
    assert all(torch.equal(value, weights[key]) for key, value in last_good.network.state_dict().items())
    best = np.genfromtxt(out / "progress" / "log.csv", delimiter=",", names=True)
    assert last_good.facts["steps"] == best["step"][best["validation"].argmin()]
    assert last_good.info["results"]["validation_loss"] == pytest.approx(best["validation"].min(), rel=1e-5)


def test_non_finite_weights_are_never_saved_and_the_next_run_resumes_from_finite_ones(
    annotated_root: Path, out: Path, capfd: pytest.CaptureFixture
) -> None:
    """A finite loss with an infinite gradient: the square root of zero times a weight."""

    def without_gradient(call: int, value: Tensor, setup: Setup) -> Tensor:
        return value + (value - value.detach()).abs().sqrt() if call == 4 else value

    network = changed(load_network("length"), without_gradient)
    settings = {"steps": 50, "save_every": 1, "validate_every": 50}
    for at_call, message in ((4, ""), (1, "resumes after step 3")):
        network = network if at_call == 4 else changed(load_network("length"), nan_at(1))
        with pytest.raises(BadInput, match=r"at step 4 of 50; lower.*the last good weights, of step 3"):
            train(network, annotated_root, out, **settings)
        assert message in capfd.readouterr().err
        state = load_file(out / "progress" / "state.safetensors")
        assert step_of(out / "progress" / "state.safetensors") == 3
        assert all(bool(value.isfinite().all()) for value in state.values())
    last_good = load_file(out / LAST_GOOD)
    assert all(torch.equal(value, state[f"kept/{key.removeprefix('weights.')}"]) for key, value in last_good.items())


def test_a_non_finite_validation_loss_ends_the_training(annotated_root: Path, out: Path) -> None:
    network = changed(load_network("length"), nan_at(2), validation=True)
    with pytest.raises(BadInput, match="a validation loss of nan at step 2 of 50"):
        train(network, annotated_root, out, steps=50, validate_every=1)


def test_at_the_first_step_the_error_points_to_the_clips(annotated_root: Path, out: Path) -> None:
    network = changed(load_network("length"), nan_at(1))
    with pytest.raises(BadInput, match=r"step 1 of 50; look for clips.*no weights are saved"):
        train(network, annotated_root, out, steps=50)


def test_a_learning_rate_that_is_far_too_high_is_detected(annotated_root: Path, out: Path) -> None:
    with pytest.raises(BadInput, match=r"not finite|loss of (nan|inf).*learning_rate \(1e\+30\)"):
        train(load_network("length"), annotated_root, out, steps=50, learning_rate=1e30)


def test_the_error_states_the_key_that_takes_effect(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    train_section = (
        "{preset: ours, size: small, seed: 0, paper: {}, "
        "ours: {length: {training: {clip_norm: 1.0}}}, small: {length: {training: {learning_rate: 0.1}}}, full: {}}"
    )
    path.write_text(f"profile: study\nprofiles: {{study: {{}}}}\ntrain: {train_section}\n")
    assert full_key("length", "training.learning_rate", path) == "train.small.length.training.learning_rate"
    assert full_key("length", "training.clip_norm", path) == "train.ours.length.training.clip_norm"
    assert full_key("contact", "training.learning_rate", path) == "train.small.contact.training.learning_rate"
    overlay = "{train: {ours: {length: {training: {clip_norm: 2.0}}}}}"
    path.write_text(f"profile: study\nprofiles: {{study: {overlay}}}\ntrain: {train_section}\n")
    assert full_key("length", "training.clip_norm", path) == "profiles.study.train.ours.length.training.clip_norm"


@pytest.mark.parametrize("subset", ["train", "validation"])
def test_the_evaluator_stops_at_clips_with_numbers_that_are_not_finite(
    annotated_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, subset: str
) -> None:
    """Otherwise it would run all epochs and return its initial weights."""
    of = Examples.of

    def corrupted(annotated: AnnotatedStore, split: str, joints_only: bool) -> Examples:
        examples = of(annotated, split, joints_only)
        steps = [np.full_like(array, np.nan) if split == subset else array for array in examples.steps]
        return replace(examples, steps=steps)

    monkeypatch.setattr(Examples, "of", corrupted)
    kind = "training loss at step 1" if subset == "train" else "validation loss after step 1"
    with pytest.raises(BadInput, match=f"evaluator: expected finite losses, got a {kind} of nan"):
        train_evaluators(annotated_root, tmp_path / "out", EvaluatorSettings(("corrected",)))
    assert not (tmp_path / "out").exists()


def test_a_checkpoint_with_weights_that_are_not_finite_is_refused(trained: Path, tmp_path: Path) -> None:
    loaded = load_checkpoint(trained / "length", load_network("length"))
    next(loaded.network.parameters()).data[0] = math.inf
    info = {key: value for key, value in loaded.info.items() if key not in ("format", "model", "config")}
    save_checkpoint(tmp_path, "length", loaded.network, None, info)
    with pytest.raises(BadInput, match="expected finite weights, got NaN or infinity in 1 tensors"):
        load_checkpoint(tmp_path, load_network("length"))


def test_a_sampled_motion_that_is_not_finite_is_an_error_that_names_the_request(
    annotated: AnnotatedStore, trained: Path
) -> None:
    model = Text2Hoi.load(trained, load_embedded_hands(), SamplingConfig())
    for weight in model.trained["diffusion"].network.parameters():
        weight.data.fill_(1e30)
    sample = HoiDataset(annotated, "test", crop="start")[0]
    requests = requests_for(sample, PredictionConfig(samples=1))
    with pytest.raises(BadInput, match=rf"motion {sample.clip_id}~0 \(.*\): expected finite numbers, got NaN or inf"):
        model.sample(requests)
