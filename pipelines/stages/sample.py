"""Stage sample: the motions of one family for the test clips of one dataset, as an ordinary store of clips."""

from pathlib import Path

from pipelines.params import read_params
from pipelines.stages.base import StagePaths, empty_reason, load_hands, write_empty
from pipelines.stages.listed import off_reason


def run(paths: StagePaths) -> None:
    """Write the motions; a dataset without clips, or a family that is not trained, gives an empty output."""
    if reason := off_reason(paths.family) or empty_reason(paths.clips):
        write_empty(paths.samples, reason)
        return
    sample(paths, read_params(Path()), paths.family)


def sample(paths: StagePaths, params: dict, family: str) -> None:
    """Motions of a family into ``paths.samples``; params: all of params.yaml."""
    from models.common.device import chosen_device
    from models.common.predicting import sample_family
    from models.common.repeatable import make_repeatable
    from models.registry import load_family

    section = dict(params.get("sample") or {})
    settings = {name: section.pop(name) for name in list(section) if isinstance(section[name], dict)}
    make_repeatable(threads=1)
    counts = sample_family(
        load_family(family),
        paths.data,
        paths.checkpoints,
        paths.samples,
        section,
        load_hands(paths.profile),
        settings=settings,
        device=chosen_device(params.get("device", "auto")),
    )
    print(f"{paths}: {counts['clips']} motions")
