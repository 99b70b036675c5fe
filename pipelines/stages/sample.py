"""Stage sample: motions of families for the test clips of one dataset, a store of clips per family."""

from dataclasses import replace
from pathlib import Path

from pipelines.params import read_params
from pipelines.stages.base import StagePaths, empty_reason, load_hands, write_empty


def run(paths: StagePaths) -> None:
    """Write the motions of the families in ``paths.family``, separated by commas.

    A dataset without clips, or a family that is not trained, gives an empty output.
    """
    for family in paths.family.split(","):
        family_paths = replace(paths, family=family)
        if reason := empty_reason(paths.clips):
            write_empty(family_paths.samples, reason)
        else:
            sample(family_paths, read_params(Path()), family)


def sample(paths: StagePaths, params: dict, family: str) -> None:
    """Write the motions of a family into ``paths.samples``, with settings of ``params`` (all of params.yaml)."""
    from models.common.predicting import sample_family
    from models.common.repeatable import chosen_device, make_repeatable
    from models.registry import load_family

    section = dict(params.get("sample") or {})
    names = [name for name, value in section.items() if isinstance(value, dict) and name != "windows"]
    settings = {name: section.pop(name) for name in names}
    make_repeatable(threads=1)
    counts = sample_family(
        load_family(family),
        paths.data,
        paths.checkpoints,
        paths.samples,
        section,
        load_hands(paths.profile),
        settings=settings,
        encoder=(params.get("annotate") or {}).get("encoder", ""),
        device=chosen_device(params.get("device", "auto")),
    )
    print(f"{paths}: {counts['clips']} motions")
