"""Stage train: one network on one dataset, with the record of what it was made from."""

from pathlib import Path
from typing import Any, Literal

from hoidata.files.atomic import atomic_folder
from models.common.device import chosen_device
from models.common.family import Network
from models.registry import load_network
from pipelines.lineage.graph import producers, read_graph, read_params
from pipelines.lineage.provenance import build_provenance
from pipelines.stages.base import Place, StageParams, empty_reason, load_hands, load_params, write_empty


class TrainParams(StageParams):
    """size: which of the two budgets to take. Each holds a section per network, whose keys the network checks."""

    size: Literal["demo", "paper"]
    seed: int
    demo: dict[str, dict[str, Any]]
    paper: dict[str, dict[str, Any]]

    def of(self, network: str) -> dict[str, Any]:
        """The network's section in the chosen size, with the seed; a network without one keeps its defaults."""
        return {**getattr(self, self.size).get(network, {}), "seed": self.seed}


def run(place: Place) -> None:
    """Train ``place.model``; a dataset without clips, or without what the network builds on, gives an empty output."""
    network = load_network(place.model)
    needed = {load_network(name): place.checkpoints / name for name in network.needs}
    for folder in (place.clips, *needed.values()):
        if reason := empty_reason(folder):
            write_empty(place.checkpoint, reason)
            return
    train(place, network, needed)


def train(place: Place, network: Network, needed: dict[Network, Path]) -> None:
    """Train, and store with the weights what they were made from."""
    from models.common.training import train_network

    params = load_params(TrainParams, "train").of(network.name)
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
