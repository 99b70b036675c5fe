"""The trained networks of a family that a command uses."""

from collections.abc import Mapping, Sequence
from typing import Any

from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from models.common.checkpoints import FILE_NAME, read_info
from pipelines.objects import nearest_name
from pipelines.stages.base import StagePaths


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
