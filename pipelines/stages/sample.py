"""Stage sample: the motions of one family for the test clips of one dataset, as an ordinary store of clips."""

from pathlib import Path

from pipelines.params import read_params
from pipelines.stages.base import Place, empty_reason, load_hands, write_empty
from pipelines.stages.listed import off_reason


def run(place: Place) -> None:
    """Write the motions; a dataset without clips, or a family that is not trained, gives an empty output."""
    if reason := off_reason(place.family) or empty_reason(place.clips):
        write_empty(place.samples, reason)
        return
    sample(place, read_params(Path()), place.family)


def sample(place: Place, params: dict, family: str) -> None:
    """Motions of a family into ``place.samples``; params: all of params.yaml."""
    from models.common.device import chosen_device
    from models.common.predicting import sample_family
    from models.common.training import make_repeatable
    from models.registry import load_family

    section = dict(params.get("sample") or {})
    settings = {name: section.pop(name) for name in list(section) if isinstance(section[name], dict)}
    make_repeatable(0, threads=2)
    counts = sample_family(
        load_family(family),
        place.data,
        place.checkpoints,
        place.samples,
        section,
        load_hands(place.profile),
        settings=settings,
        device=chosen_device(params.get("device", "auto")),
    )
    print(f"{place}: {counts['clips']} motions")
