"""The state from which a killed training resumes: a safetensors file and the log, outside of its output folder."""

import csv
import json
import math
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from hoidata.files import atomic_file, remove_dead_leftovers, write_whole

STATE_NAME, LOG_NAME = "state.safetensors", "log.csv"
# Seconds between two saves, and the least multiple of the last save's duration: saving takes at most 1/50 of the time.
SAVE_AFTER_S, SAVE_INTERVAL_FACTOR = 10.0, 50
# Seconds between two lines of a training, and their largest number per doubling of its duration.
LINE_AFTER_S, LINES_PER_DURATION = 5.0, 50
Row = dict[str, float | None]
WEIGHTS = "weights that are not finite"


class Diverged(Exception):
    """A loss or a weight is not finite, so further steps cannot help."""

    def __init__(self, step: int, quantity: str, state: "State") -> None:
        """quantity: for instance "a loss of nan". state: the training at that moment."""
        super().__init__(f"{quantity} at step {step}")
        self.step, self.quantity, self.state = step, quantity, state


@dataclass
class State:
    """The state of a training after ``step``; together with seed and step it determines the next step."""

    network: nn.Module
    ema_network: nn.Module  # running average of the weights
    optimiser: torch.optim.Optimizer
    step: int = 0
    best: dict[str, Tensor] = field(default_factory=dict)  # weights at the lowest validation loss
    best_loss: float = math.inf
    log: list[Row] = field(default_factory=list)  # one entry per validation
    running: dict[str, Tensor] = field(default_factory=dict)  # sums of losses since the last entry, over the team

    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the state: names to values."""
        groups: dict[str, Mapping[str, Tensor]] = {
            "network": self.network.state_dict(),
            "kept": self.ema_network.state_dict(),
            "best": self.best,
            "running": self.running,
            "optimiser": {
                f"{number}.{name}": value
                for number, values in self.optimiser.state_dict()["state"].items()
                for name, value in values.items()
            },
        }
        return {f"{group}/{name}": value for group, named in groups.items() for name, value in named.items()}

    def restore(self, tensors: Mapping[str, Tensor], numbers: Mapping[str, Any]) -> None:
        """The inverse of ``tensors``; numbers: step, best_loss and log."""
        groups: dict[str, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            group, _, name_in_group = name.partition("/")
            groups.setdefault(group, {})[name_in_group] = value
        self.network.load_state_dict(groups["network"])
        self.ema_network.load_state_dict(groups["kept"])
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in groups.get("optimiser", {}).items():
            number, _, moment = name.partition(".")
            moments.setdefault(int(number), {})[moment] = value
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})
        device = next(iter(self.network.state_dict().values())).device
        self.best = {name: value.to(device) for name, value in groups.get("best", {}).items()}
        self.running = {name: groups["running"][name].to(device) for name in numbers["losses"]}
        self.step, self.log = numbers["step"], numbers["log"]
        self.best_loss = math.inf if numbers["best_loss"] is None else numbers["best_loss"]


@dataclass
class Progress:
    """Saves and restores the state of one training."""

    folder: Path  # of this training only
    digest: str  # of all inputs of the training; a state with another digest is not restored
    writes: bool = True  # whether this process of the team writes
    next_save_s: float = field(default_factory=lambda: time.monotonic() + SAVE_AFTER_S)  # by ``time.monotonic``

    @property
    def state_file(self) -> Path:
        return self.folder / STATE_NAME

    def load(self, state: State) -> None:
        """Restore the saved state; start from scratch if it cannot be read or is of another training."""
        if self.writes:
            remove_dead_leftovers(self.state_file)
            remove_dead_leftovers(self.folder / LOG_NAME)
        if not self.state_file.is_file():
            return
        try:
            if self.read(state):
                return self._report(f"resumes after step {state.step}")
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            return self._report(f"starts from scratch: {self.state_file} cannot be read ({type(error).__name__})")
        self._report(f"starts from scratch: {self.state_file} is of other settings, data or code")

    def read(self, state: State) -> bool:
        """Restore the saved state; False if it belongs to another training."""
        with safe_open(self.state_file, framework="pt") as stored:
            numbers = json.loads((stored.metadata() or {})["hoidata"])
            if is_same := numbers["digest"] == self.digest:
                state.restore({name: stored.get_tensor(name) for name in stored.keys()}, numbers)  # noqa: SIM118
        return is_same

    def save_if_due(self, state: State, interval: int) -> None:
        """After a step: write the log if it has grown; save the state every ``interval`` steps, or sooner by time."""
        if self.writes and state.log and state.log[-1]["step"] == state.step:
            write_log(self.folder / LOG_NAME, state.log)
        if self.writes and (state.step % interval == 0 or time.monotonic() >= self.next_save_s):
            start = time.monotonic()
            self.save(state)
            duration_s = time.monotonic() - start
            self.next_save_s = start + duration_s + max(SAVE_AFTER_S, SAVE_INTERVAL_FACTOR * duration_s)

    def save(self, state: State) -> None:
        """Save the whole state atomically. Raises Diverged instead if a weight is not finite."""
        best_loss = None if math.isinf(state.best_loss) else state.best_loss
        numbers = {"digest": self.digest, "step": state.step, "best_loss": best_loss}
        numbers["losses"] = list(state.running)  # in the order of the log's columns
        tensors = {name: value.detach().cpu().contiguous() for name, value in sorted(state.tensors().items())}
        if not all_finite(tensors):
            raise Diverged(state.step, WEIGHTS, state)
        metadata = {"hoidata": json.dumps({**numbers, "log": state.log})}  # losses may be NaN
        write_whole(self.state_file, save(tensors, metadata=metadata))

    def clear(self) -> None:
        """Remove the saved state."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _report(self, message: str) -> None:
        if self.writes:
            print(f"training in {self.folder} {message}", file=sys.stderr)


class Line:
    """Prints step, loss and time left of a training; `hoidata repro` repeats the line from the stage's log."""

    def __init__(self, step: int, steps: int) -> None:
        """step: after which the training starts or resumes."""
        self.first, self.steps, self.start_s = step, steps, time.monotonic()
        self.next_s = self.start_s + LINE_AFTER_S

    def print_if_due(self, step: int, loss: Tensor) -> None:
        """After a step: print a line to standard error; reading the loss waits for the device."""
        now = time.monotonic()
        if now < self.next_s:
            return
        left = timedelta(seconds=round((now - self.start_s) / (step - self.first) * (self.steps - step)))
        print(f"step {step:,} of {self.steps:,}, loss {float(loss):.4g}, {left} left", file=sys.stderr, flush=True)
        self.next_s = now + max(LINE_AFTER_S, (now - self.start_s) / LINES_PER_DURATION)


def all_finite(tensors: Mapping[str, Tensor]) -> bool:
    """Whether every number is finite; the host waits for the device here."""
    return all(bool(value.isfinite().all()) for value in tensors.values())


def write_log(path: Path, log: list[Row]) -> None:
    """Write log.csv: step, validation loss, mean training losses since the previous line; empty if not known."""
    with atomic_file(path) as partial, open(partial, "w", newline="") as stream:
        writer = csv.DictWriter(stream, list(log[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {name: "" if value is None else f"{value:.6g}" for name, value in entry.items()} for entry in log
        )
