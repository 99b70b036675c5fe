"""A training that was killed, distributed or observed gives the same result as an undisturbed one."""

import json
import multiprocessing
import os
import signal
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from hoidata.batches.dataset import HoiDataset
from hoidata.errors import BadInput
from hoidata.store.annotated import AnnotatedStore
from models.common.corpus import BatchSpec, batches
from models.common.family import Network, Setup
from models.common.progress import Line, Progress, State
from models.common.team import Team, run_team
from models.common.training import _add_gradients, train_network
from models.registry import load_network
from tests.models.toy import BIMART, BUDGET, PARAMS

STEPS, SAVED_EVERY = 8, 2
# The toy's networks, ManipNet's, and one of BimArt's.
SETTINGS = PARAMS | {
    "manipnet": {"network": {"encoder": 8}, "training": BUDGET, "loss": {"steps_per_clip": 4}},
    "bimart-motion": BIMART,
}


def train(name: str, root: Path, out: Path, *, progress: Path | None = None, die_at: int = 0, **training) -> None:
    """A short training of one network with these settings over the toy's; killed at the start of step ``die_at``."""
    params = {**SETTINGS[name], "training": {**SETTINGS[name]["training"], **training}}
    network = load_network(name)
    needed = {load_network(other): out.parent / "needed" / other for other in network.needs}
    network = mortal(network, die_at) if die_at else network
    train_network(network, root, out, params, needed=needed, progress=progress)


def mortal(network: Network, die_at: int) -> Network:
    """The network with an objective that kills the process in its ``die_at``-th step."""

    def objective(setup: Setup):
        inner, normaliser = network.objective(setup)
        count, losses = iter(range(1, die_at + 1)), inner.losses

        def counted(batch, generator):
            if next(count) == die_at:
                os.kill(os.getpid(), signal.SIGKILL)
            return losses(batch, generator)

        setattr(inner, "losses", counted)  # noqa: B010 (pyright knows losses as a method)
        return inner, normaliser

    return replace(network, objective=objective)


def killed(*arguments, **options) -> None:
    process = multiprocessing.get_context("fork").Process(target=train, args=arguments, kwargs=options)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL


@pytest.fixture
def out(trained: Path, tmp_path: Path) -> Path:
    (tmp_path / "needed").symlink_to(trained)
    return tmp_path


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("name", SETTINGS)
def test_a_training_killed_three_times_writes_the_bytes_of_an_undisturbed_one(
    annotated_root: Path, out: Path, name: str, capfd: pytest.CaptureFixture
) -> None:
    settings = {"steps": STEPS, "save_every": SAVED_EVERY, "validate_every": 3, "keep_best": True, "ema_decay": 0.9}
    train(name, annotated_root, out / "whole", **settings)
    done, random = 0, np.random.default_rng([*name.encode()])
    for die_at in sorted(random.choice(np.arange(2, STEPS + 1), 3, replace=False).tolist()):
        killed(name, annotated_root, out / "broken", progress=out / "progress", die_at=die_at - done, **settings)
        assert not (out / "broken").exists()
        done = (die_at - 1) // SAVED_EVERY * SAVED_EVERY
    train(name, annotated_root, out / "broken", progress=out / "progress", **settings)
    for file in ("model.safetensors", "log.csv"):
        assert (out / "broken" / file).read_bytes() == (out / "whole" / file).read_bytes(), file
    assert not (out / "progress").exists()
    assert ("resumes after step" in capfd.readouterr().err) == (done > 0)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("name", [pytest.param("contact", marks=pytest.mark.slow), "length"])
def test_a_short_training_is_saved_by_time_and_resumes_with_the_same_bytes(
    annotated_root: Path, out: Path, name: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    """Its steps are fewer than save_every, but each step takes longer than the time between two saves."""
    monkeypatch.setattr("models.common.progress.SAVE_AFTER_S", 0.0)
    monkeypatch.setattr("models.common.progress.SAVE_INTERVAL_FACTOR", 0)
    settings = {"steps": STEPS, "validate_every": 3, "keep_best": True, "ema_decay": 0.9}
    train(name, annotated_root, out / "whole", **settings)
    killed(name, annotated_root, out / "broken", progress=out / "progress", die_at=6, **settings)
    train(name, annotated_root, out / "broken", progress=out / "progress", **settings)
    assert "resumes after step 5" in capfd.readouterr().err
    for file in ("model.safetensors", "log.csv"):
        assert (out / "broken" / file).read_bytes() == (out / "whole" / file).read_bytes(), file


def test_saving_takes_a_fiftieth_of_the_time_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps of one second; a save takes three: the first one after ten seconds, then one each 150 seconds."""
    now, saved = [0.0], []
    monkeypatch.setattr("models.common.progress.time.monotonic", lambda: now[0])
    network = torch.nn.Linear(1, 1)
    state = State(network, network, torch.optim.AdamW(network.parameters()))
    progress = Progress(tmp_path, "")

    def save(state: State) -> None:
        saved.append(now[0])
        now[0] += 3

    monkeypatch.setattr(progress, "save", save)
    for step in range(1, 401):
        now[0], state.step = now[0] + 1, step
        progress.save_if_due(state, 1000)
    assert saved == [10, 163, 316]


def test_a_line_has_step_loss_and_time_left_and_lines_become_rarer(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    """One second per step of a training resumed after step 100: lines after 5 s, later after a fiftieth of the time."""
    clock = SimpleNamespace(monotonic=lambda: clock.now, now=0.0)
    monkeypatch.setattr("models.common.progress.time", clock)
    line = Line(100, 3700)
    for step in range(101, 3701):
        clock.now += 1.0
        line.print_if_due(step, torch.tensor(0.5))
    lines = capfd.readouterr().err.splitlines()
    assert lines[0] == "step 105 of 3,700, loss 0.5, 0:59:55 left"
    steps = [int(text.split()[1].replace(",", "")) for text in lines]
    assert np.diff(steps)[:10].tolist() == [5] * 10
    assert np.diff(steps)[-1] in (70, 71, 72)


def test_logged_losses_are_those_of_the_whole_team(annotated: AnnotatedStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """With two processes that compute the same, sums are doubled, also between two validations when one saves."""

    def twice(team: Team, tensors: Iterable[torch.Tensor]) -> None:
        for tensor in tensors:
            tensor *= 2

    monkeypatch.setattr(Team, "sum_over_team", twice)
    network = torch.nn.Linear(1, 1)
    objective = SimpleNamespace(losses=lambda batch, generator: {"total": network.weight.sum() * 0 + 3.0})
    state = State(network, network, torch.optim.AdamW(network.parameters()))
    batch = next(batches(HoiDataset(annotated, "train"), 2, 0))
    device = torch.device("cpu")
    losses = [_add_gradients(state, objective, batch, (0, step, 1), device, Team()) for step in (1, 2)]  # type: ignore[arg-type]
    assert [float(loss) for loss in losses] == [6, 6]
    assert float(state.running["total"]) == 12


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_losses_are_readable_during_training_and_an_unusable_state_is_reported(
    annotated_root: Path, out: Path, capfd: pytest.CaptureFixture
) -> None:
    settings = {"steps": STEPS, "save_every": SAVED_EVERY, "validate_every": 1}
    killed("length", annotated_root, out / "new", progress=out / "progress", die_at=4, **settings)
    header, *rows = (out / "progress" / "log.csv").read_text().splitlines()
    assert header.startswith("step,validation,train_total")
    assert [row.split(",")[0] for row in rows] == ["1", "2", "3"]
    with safe_open(out / "progress" / "state.safetensors", framework="pt") as stored:
        assert json.loads(stored.metadata()["hoidata"])["step"] == 2
    other = {**settings, "learning_rate": 0.5}
    for broken_state, message in ((None, "other settings, data or code"), (b"no state", "cannot be read")):
        if broken_state:
            killed("length", annotated_root, out / "new", progress=out / "progress", die_at=4, **settings)
            (out / "progress" / "state.safetensors").write_bytes(broken_state)
        train("length", annotated_root, out / "found", progress=out / "progress", **other)
        train("length", annotated_root, out / "expected", **other)
        assert message in capfd.readouterr().err
        assert (out / "found" / "log.csv").read_bytes() == (out / "expected" / "log.csv").read_bytes()


def test_training_restores_the_state_of_the_process(annotated_root: Path, tmp_path: Path) -> None:
    def settings() -> tuple:
        algorithms = torch.are_deterministic_algorithms_enabled()
        return torch.get_num_threads(), torch.get_float32_matmul_precision(), algorithms, torch.initial_seed()

    before, random_state = settings(), torch.get_rng_state()
    train("length", annotated_root, tmp_path / "out")
    assert settings() == before
    assert torch.equal(torch.get_rng_state(), random_state)


@pytest.mark.long
def test_two_processes_give_the_weights_of_one_and_write_one_file(annotated_root: Path, out: Path) -> None:
    names = ("contact", "diffusion")
    run_team(train_all, 2, out / "meeting", names, annotated_root, out / "two")
    train_all(names, annotated_root, out / "one")
    for name in names:
        assert [path.name for path in sorted((out / "two" / name).iterdir())] == ["log.csv", "model.safetensors"]
        one, two = (load_file(out / folder / name / "model.safetensors") for folder in ("one", "two"))
        assert one.keys() == two.keys()
        assert max(float((one[key].double() - two[key].double()).abs().max()) for key in one) <= 1e-5
    assert (out / "two" / "written").read_text() == "0"


def train_all(names: tuple[str, ...], root: Path, out: Path) -> None:
    """20 steps of each network with two micro-batches; each process that writes notes its rank."""
    torch.set_num_threads(1)
    for name in names:
        network = load_network(name)
        needed = {load_network(other): out.parent / "needed" / other for other in network.needs}
        budget = {**PARAMS[name]["training"], "steps": 20, "micro_batches": 2, "validate_every": 10}
        train_network(network, root, out / name, {**PARAMS[name], "training": budget}, needed=needed)
    if Team.joined().writes:
        (out / "written").write_text(str(Team.joined().rank))


def test_micro_batches_contain_the_clips_of_the_batch(annotated: AnnotatedStore) -> None:
    dataset = HoiDataset(annotated, "train")
    whole, parted = (next(batches(dataset, 3, 0, BatchSpec(parts=range(of), of=of))) for of in (1, 2))
    ids = [[sample.clip_id for sample in batch.samples] for _, batch in parted]
    assert [sorted(part_ids) for part_ids in ids] == [sorted(set(part_ids)) for part_ids in ids]
    assert sorted(chain.from_iterable(ids)) == sorted(sample.clip_id for sample in whole[0][1].samples)
    alone = next(batches(dataset, 3, 0, BatchSpec(parts=[1], of=2)))
    assert [sample.clip_id for sample in alone[0][1].samples] == ids[1]


@pytest.mark.slow
def test_a_training_in_bfloat16_keeps_its_weights_in_float32_and_learns_nearly_the_same(
    annotated_root: Path, out: Path
) -> None:
    for precision in ("float32", "bfloat16"):
        train("diffusion", annotated_root, out / precision, precision=precision, steps=4)
    exact, lower = (load_file(out / precision / "model.safetensors") for precision in ("float32", "bfloat16"))
    assert {value.dtype for value in lower.values()} == {value.dtype for value in exact.values()}
    weights = [name for name in exact if name.startswith("weights.encoder")]
    assert any(not torch.equal(exact[name], lower[name]) for name in weights)
    assert max(float((exact[name] - lower[name]).abs().max()) for name in weights) < 0.02


def test_micro_batches_that_do_not_divide_over_processes_are_refused() -> None:
    with pytest.raises(BadInput, match="a multiple of the 2 processes, got 3"):
        Team(0, 2).own_micro_batches(3)
    assert [list(Team(rank, 2).own_micro_batches(4)) for rank in (0, 1)] == [[0, 2], [1, 3]]
