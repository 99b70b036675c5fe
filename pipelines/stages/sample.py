"""Stage sample: the motions of one family for the test clips of one dataset, as an ordinary store of clips."""

from pathlib import Path

from models.common.device import chosen_device
from models.common.predicting import sample_family
from models.common.training import make_repeatable
from models.registry import load_family
from pipelines.lineage.graph import read_params
from pipelines.stages.base import Place, load_hands


def run(place: Place) -> None:
    """Write the motions; a dataset without clips, or a family that is not trained, gives an empty output."""
    params = read_params(Path())
    section = dict(params.get("sample") or {})
    settings = {name: section.pop(name) for name in list(section) if isinstance(section[name], dict)}
    family = load_family(place.family)
    make_repeatable(0, threads=2)
    counts = sample_family(
        family,
        place.data,
        place.checkpoints,
        place.samples,
        section,
        load_hands(place.profile),
        settings=settings,
        device=chosen_device(params.get("device", "auto")),
    )
    print(f"{place}: {counts['clips']} motions")
