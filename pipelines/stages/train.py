"""Stage train: one of the four models on one dataset, with the record of what it was made from."""

from pathlib import Path
from typing import Any, Literal

from hoidata.files.atomic import atomic_folder
from pipelines.lineage.graph import look_up, producers, read_graph
from pipelines.lineage.provenance import build_provenance
from pipelines.stages.base import Place, StageParams, empty_reason, load_hands, load_params, write_empty

NEEDS = {"contact": (), "length": (), "diffusion": ("contact",), "refiner": ("diffusion",)}


class TrainParams(StageParams):
    """size: which of the two budgets to take. Each holds a section per model, whose keys the model itself checks."""

    size: Literal["demo", "paper"]
    seed: int
    demo: dict[str, dict[str, Any]]
    paper: dict[str, dict[str, Any]]

    def of(self, model: str) -> dict[str, Any]:
        """The model's section in the chosen size, with the seed."""
        sections = getattr(self, self.size)
        return {**look_up(sections, model), "seed": self.seed}


def run(place: Place) -> None:
    """Train ``place.model``; a dataset without clips, or without what the model builds on, gives an empty output."""
    params = load_params(TrainParams, "train")
    upstream = {name: place.checkpoints / name for name in NEEDS[place.model]}
    for folder in (place.clips, *upstream.values()):
        if reason := empty_reason(folder):
            write_empty(place.checkpoint, reason)
            return
    train(place, params, upstream)


def train(place: Place, params: TrainParams, upstream: dict[str, Path]) -> None:
    """Train, and store with the weights what they were made from."""
    from models.common.training import train_model

    stage = producers(read_graph(Path()))[place.checkpoint.as_posix()].name
    with atomic_folder(place.checkpoint) as part:
        train_model(
            place.model,
            place.data,
            part,
            params.of(place.model),
            hands=load_hands(place.profile),
            provenance=lambda facts: build_provenance(Path(), stage, facts),
            upstream=upstream,
        )
