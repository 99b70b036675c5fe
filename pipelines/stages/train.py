"""Stage train: one network on one dataset, with the record of what it was made from."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hoidata.files.atomic import atomic_folder
from models.registry import load_network
from pipelines.lineage.graph import producers, read_graph
from pipelines.lineage.provenance import build_provenance
from pipelines.params import read_params
from pipelines.stages.base import Place, empty_reason, load_hands, load_settings, write_empty
from pipelines.stages.listed import off_reason


@dataclass(frozen=True)
class TrainParams:
    """size: which of the two budgets to take. Each holds a section per network, whose keys the network checks."""

    size: Literal["demo", "paper"]
    seed: int
    demo: Mapping[str, Any]
    paper: Mapping[str, Any]

    def of(self, network: str) -> dict[str, Any]:
        """The network's section in the chosen size, with the seed; a network without one keeps its defaults."""
        return {**getattr(self, self.size).get(network, {}), "seed": self.seed}


def run(place: Place) -> None:
    """Train ``place.model``; a dataset without clips, or without what the network builds on, gives an empty output."""
    if reason := off_reason(place.model) or empty_reason(place.clips):
        write_empty(place.checkpoint, reason)
        return
    from models.common.device import chosen_device
    from models.common.training import train_network

    network = load_network(place.model)
    needed = {load_network(name): place.checkpoints / name for name in network.needs}
    if reason := next(filter(None, map(empty_reason, needed.values())), None):
        write_empty(place.checkpoint, reason)
        return
    params = load_settings(TrainParams, "train").of(network.name)
    stage = producers(read_graph(Path()))[place.checkpoint.as_posix()].name
    with atomic_folder(place.checkpoint) as partial:
        train_network(
            network,
            place.data,
            partial,
            params,
            load_hands(place.profile),
            needed=needed,
            provenance=lambda facts: build_provenance(Path(), stage, facts),
            device=chosen_device(read_params(Path()).get("device", "auto")),
        )
