"""What the commands that make motions are given, the object and the trained networks, and what they give back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.store.store import open_store
from models.common.checkpoints import FILE_NAME, read_info
from pipelines.stages.base import StagePaths


@dataclass(frozen=True)
class MeshWish:
    """How to read the user's mesh file; "" for what is to be assumed or found, as in ``read_user_object``."""

    unit: str = ""
    up: str = ""
    hinge: str = ""


@dataclass(frozen=True)
class Written:
    """paths of the files; notes: what was assumed, chosen or never seen in training, for the person who asked."""

    paths: list[Path]
    notes: list[str]


def stored_object(name: str, clips: Path, hands: HandPair) -> ObjectModel:
    """An object of the dataset by name. Raises BadInput that lists the names there are."""
    store = open_store(clips, hands)
    names = list(store.objects["object"])
    if name not in names:
        expected = f"a mesh file (.obj, .ply, .stl, .glb) or one of: {', '.join(names)}"
        raise BadInput("--object", expected, name, nearest_name(name, names) or "correct the name or path")
    return store.object_model(name)


def nearest_name(name: str, names: Sequence[str]) -> str:
    """Which of the names was likely meant, as a question; empty where none is near."""
    near = get_close_matches(name, names, 1)
    return f"did you mean {near[0]!r}?" if near else ""


def mesh_notes(model: ObjectModel) -> list[str]:
    """What was repaired of a mesh, and which parts of it have no inside that hands could be kept out of."""
    index = surface_index(model)
    note = [] if index.solid_note is None else [f"mesh: {index.solid_note}"]
    return note if index.is_solid else [f"{note[0]}; hands are drawn to its surface, not kept out of it"]


def trained_run(
    family: str, networks: Sequence[str], model: str, profile: str, datasets: Sequence[str], hands: HandPair
) -> tuple[StagePaths, Mapping[str, Any]]:
    """The dataset asked for, or the first that has these networks, and the facts of the last network.

    model: the dataset, or "". Raises MissingResource where none is trained, BadInput for another hand.
    """
    check_dataset(model, profile, datasets)
    runs = [StagePaths(profile, name) for name in ((model,) if model else dict.fromkeys(datasets))]
    trained = [run for run in runs if all((run.checkpoints / name / FILE_NAME).is_file() for name in networks)]
    if not trained:
        where = ", ".join(map(str, runs))
        remedy = f"name a dataset under family_datasets.{family} in params.yaml, then `hoidata repro`"
        raise MissingResource(f"no networks of {family} ({where}): {remedy}")
    each = {name: read_info(trained[0].checkpoints / name / FILE_NAME)["facts"] for name in networks}
    for name, facts in each.items():
        if facts["hand_digest"] != hands.digest:
            remedy = "train it with the hand of this profile"
            raise BadInput(trained[0].checkpoints / name, f"hand {facts['hand']}", hands.name, remedy)
    return trained[0], each[networks[-1]]


def check_dataset(name: str, profile: str, datasets: Sequence[str]) -> None:
    """Raise BadInput that lists the datasets of params.yaml for an unknown one; "" is none."""
    paths = StagePaths(profile, name)
    if name and name not in datasets and not paths.data.is_dir() and not paths.checkpoints.is_dir():
        known = list(dict.fromkeys(datasets))
        remedy = nearest_name(name, known) or "name one of them, or leave it out"
        raise BadInput("--model", f"a dataset of params.yaml: {', '.join(known)}", name, remedy)


def trained_on(facts: Mapping[str, Any]) -> str:
    """How many clips of which datasets a network learned from, in words."""
    kind = "SYNTHETIC" if facts["synthetic"] else "recorded"
    return ", ".join(f"{count} {kind} {name} clips" for name, count in facts["datasets"].items())
