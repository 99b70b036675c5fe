"""What a training keeps so that a killed one goes on: one safetensors file and its log, outside of its output."""

import csv
import json
import math
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from hoidata.files import atomic_file, remove_dead_leftovers, write_whole

STATE_NAME, LOG_NAME = "state.safetensors", "log.csv"
# Seconds between two saves, and how many times longer than the last save they are at least: saving a large network
# takes at most a fiftieth of the time.
SAVE_AFTER_S, SAVE_SHARE = 10.0, 50
Row = dict[str, float | None]
WEIGHTS = "weights that are not finite"


class Diverged(Exception):
    """A training met a number that is not finite, so no further step can help.

    step: of the training. what: the quantity, for instance "a loss of nan". state: the training at that moment.
    """

    def __init__(self, step: int, what: str, state: "State") -> None:
        super().__init__(f"{what} at step {step}")
        self.step, self.what, self.state = step, what, state


@dataclass
class State:
    """Where a training stands after ``step``; with (seed, step) it is all that the next step depends on.

    kept: running average of the network's weights. best: weights at the lowest validation loss, ``best_loss``.
    log: a row per validation. running: losses added up since the last row, over the team.
    """

    network: nn.Module
    kept: nn.Module
    optimiser: torch.optim.Optimizer
    step: int = 0
    best: dict[str, Tensor] = field(default_factory=dict)
    best_loss: float = math.inf
    log: list[Row] = field(default_factory=list)
    running: dict[str, Tensor] = field(default_factory=dict)

    def tensors(self) -> dict[str, Tensor]:
        """All of it that is tensors, by name."""
        groups: dict[str, Mapping[str, Tensor]] = {
            "network": self.network.state_dict(),
            "kept": self.kept.state_dict(),
            "best": self.best,
            "running": self.running,
            "optimiser": {f"{row}.{name}": value for row, name, value in self._moments()},
        }
        return {f"{group}/{name}": value for group, named in groups.items() for name, value in named.items()}

    def _moments(self) -> Iterator[tuple[int, str, Tensor]]:
        for row, values in self.optimiser.state_dict()["state"].items():
            for name, value in values.items():
                yield row, name, value

    def restore(self, tensors: Mapping[str, Tensor], numbers: Mapping[str, Any]) -> None:
        """The inverse of ``tensors``; numbers: step, best_loss and log."""
        groups: dict[str, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            group, _, own = name.partition("/")
            groups.setdefault(group, {})[own] = value
        self.network.load_state_dict(groups["network"])
        self.kept.load_state_dict(groups["kept"])
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in groups.get("optimiser", {}).items():
            row, _, own = name.partition(".")
            moments.setdefault(int(row), {})[own] = value
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})
        device = next(iter(self.network.state_dict().values())).device
        self.best = {name: value.to(device) for name, value in groups.get("best", {}).items()}
        self.running = {name: groups["running"][name].to(device) for name in numbers["losses"]}
        self.step, self.log = numbers["step"], numbers["log"]
        self.best_loss = math.inf if numbers["best_loss"] is None else numbers["best_loss"]


@dataclass
class Progress:
    """folder: of this training alone. digest: of everything it is made from; a state of another is not taken up.

    writes: whether this process is the one of its team that writes. next_save_s: when time alone is a reason to save,
    by the clock ``time.monotonic``.
    """

    folder: Path
    digest: str
    writes: bool = True
    next_save_s: float = field(default_factory=lambda: time.monotonic() + SAVE_AFTER_S)

    @property
    def state_file(self) -> Path:
        return self.folder / STATE_NAME

    def load(self, state: State) -> None:
        """Go on from what was saved; where it belongs to another training, or cannot be read, start anew and say so."""
        if self.writes:
            remove_dead_leftovers(self.state_file)
            remove_dead_leftovers(self.folder / LOG_NAME)
        if not self.state_file.is_file():
            return
        try:
            if self.read(state):
                return self._say(f"goes on after step {state.step}")
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            return self._say(f"starts anew: {self.state_file} cannot be read ({type(error).__name__})")
        self._say(f"starts anew: {self.state_file} is of other settings, data or code")

    def read(self, state: State) -> bool:
        """Restore what was saved; False where it belongs to another training."""
        with safe_open(self.state_file, framework="pt") as stored:
            numbers = json.loads((stored.metadata() or {})["hoidata"])
            if is_same := numbers["digest"] == self.digest:
                state.restore({name: stored.get_tensor(name) for name in stored.keys()}, numbers)  # noqa: SIM118
        return is_same

    def keep(self, state: State, every: int) -> None:
        """After a step: the log where it has grown, and everything after ``every`` steps or when it is time."""
        if self.writes and state.log and state.log[-1]["step"] == state.step:
            write_log(self.folder / LOG_NAME, state.log)
        if self.writes and (state.step % every == 0 or time.monotonic() >= self.next_save_s):
            start = time.monotonic()
            self.save(state)
            took = time.monotonic() - start
            self.next_save_s = start + took + max(SAVE_AFTER_S, SAVE_SHARE * took)

    def save(self, state: State) -> None:
        """Everything, whole or not at all. Raises Diverged where a weight is no finite number: none such is kept."""
        best_loss = None if math.isinf(state.best_loss) else state.best_loss
        numbers = {"digest": self.digest, "step": state.step, "best_loss": best_loss}
        numbers["losses"] = list(state.running)  # in the order of the log's columns
        tensors = {name: value.detach().cpu().contiguous() for name, value in sorted(state.tensors().items())}
        if not all_finite(tensors):
            raise Diverged(state.step, WEIGHTS, state)
        metadata = {"hoidata": json.dumps({**numbers, "log": state.log})}  # losses may be no number
        write_whole(self.state_file, save(tensors, metadata=metadata))

    def clear(self) -> None:
        """Nothing is left to go on with."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _say(self, what: str) -> None:
        if self.writes:
            print(f"training in {self.folder} {what}", file=sys.stderr)


def all_finite(tensors: Mapping[str, Tensor]) -> bool:
    """Whether every number is finite; the host waits for the device here."""
    return all(bool(value.isfinite().all()) for value in tensors.values())


def write_log(path: Path, log: list[Row]) -> None:
    """log.csv: step, validation loss (empty without validation clips), mean training losses since the row before."""
    with atomic_file(path) as partial, open(partial, "w", newline="") as stream:
        writer = csv.DictWriter(stream, list(log[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: "" if value is None else f"{value:.6g}" for name, value in row.items()} for row in log)
