"""Stage train: one network on one dataset, with the record of what it was made from."""

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from hoidata.files import sha256_file
from models.registry import load_network
from pipelines.lineage.graph import producers, written_graph
from pipelines.lineage.provenance import build_provenance
from pipelines.params import laid_over, read_file, read_params
from pipelines.stages.base import StagePaths, empty_reason, load_hands, load_settings, write_empty


@dataclass(frozen=True)
class TrainParams:
    """preset: which method; size: which sizes and budgets, laid over it. Each has a section per network, whose keys the
    network checks.

    processes: how many train one network together; ``training.micro_batches`` says what each step computes.
    """

    preset: Literal["paper", "ours"]
    size: Literal["small", "full"]
    seed: int
    paper: Mapping[str, Any]
    ours: Mapping[str, Any]
    small: Mapping[str, Any]
    full: Mapping[str, Any]
    processes: int = 1

    def of(self, network: str) -> dict[str, Any]:
        """The network's settings by preset and size, with the seed; a network without any keeps its defaults."""
        method, size = (getattr(self, name).get(network) or {} for name in (self.preset, self.size))
        return laid_over(laid_over(method, size), {"seed": self.seed})


def run(paths: StagePaths) -> None:
    """Train ``paths.model``; a dataset without clips, or without what the network builds on, gives an empty output.

    A killed training goes on where it was: what it needs for that, and its losses, lie in ``paths.training``.
    """
    needed = [paths.checkpoints / name for name in load_network(paths.model).needs]
    if reason := next(filter(None, map(empty_reason, [paths.clips, *needed])), None):
        write_empty(paths.checkpoint, reason)
        return
    from models.common.team import run_team

    processes = load_settings(TrainParams, "train").processes
    meeting = tempfile.TemporaryDirectory() if processes > 1 else nullcontext("")
    with meeting as folder:
        run_team(train, processes, Path(folder) / "team", paths)


def train(paths: StagePaths) -> None:
    """One process of the training of ``paths.model``."""
    params = load_settings(TrainParams, "train").of(paths.model)
    code = Path("code", "train", f"{paths.model}.json")
    train_into(paths.checkpoint, paths, params, paths.training, code)


def full_key(network: str, key: str, path: Path = Path("params.yaml")) -> str:
    """The key of params.yaml that decides a setting of a network, such as ``train.small.length.training.steps``.

    The one of the size where nothing is said: what is written there is laid over the preset.
    """
    values, chosen = read_file(path), load_settings(TrainParams, "train", path)
    profile = ("profiles", str(values.get("profile")))
    places = [(*at, "train", own, network) for own in (chosen.size, chosen.preset) for at in (profile, ())]
    for place in places:
        if _is_said(values, (*place, *key.split("."))):
            return ".".join((*place, key))
    return ".".join((*places[1], key))


def _is_said(values: Any, names: Sequence[str]) -> bool:
    for name in names:
        if not isinstance(values, Mapping) or name not in values:
            return False
        values = values[name]
    return True


def train_into(made: Path, paths: StagePaths, params: Mapping[str, Any], progress: Path, code: Path) -> None:
    """Train ``paths.model`` by its settings into the output ``made``. progress: of a killed training.

    code: the file with the digests of what runs.
    """
    from models.common.repeatable import chosen_device, make_repeatable
    from models.common.team import Team
    from models.common.training import train_network

    network = load_network(paths.model)
    stage = producers(written_graph(Path()))[made.as_posix()].name
    make_repeatable(threads=1)  # stages run side by side; more processes train one network together
    train_network(
        network,
        paths.data,
        made,
        params,
        load_hands(paths.profile),
        needed={load_network(name): paths.checkpoints / name for name in network.needs},
        provenance=lambda facts: build_provenance(Path(), stage, facts),
        device=Team.joined().device(chosen_device(read_params(Path()).get("device", "auto"))),
        progress=progress,
        code=sha256_file(code) if code.is_file() else "",
        full_key=partial(full_key, network.name),
    )
