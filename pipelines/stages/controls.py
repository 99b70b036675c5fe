"""Stage controls: the rows that show what a figure sees, sampled and measured one after another in one process."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from pipelines.params import read_params
from pipelines.stages.base import StagePaths, empty_reason, load_settings, write_empty
from pipelines.stages.evaluate import run as evaluate
from pipelines.stages.sample import sample

OFF = "off: params.yaml names no families under controls"


@dataclass(frozen=True)
class ControlSettings:
    """families: which rows; none turns the stage off. samples: motions per test clip; None: as in the stage sample."""

    families: tuple[str, ...] = ()
    samples: int | None = None


def run(paths: StagePaths) -> None:
    """Write motions and metrics of every row, as sample and evaluate would, into folders ``controls`` beside theirs."""
    settings = load_settings(ControlSettings, "controls")
    rows = {name: replace(paths, family=f"controls/{name}") for name in settings.families}
    folders = [replace(paths, family="controls").samples, paths.metrics.parent / "controls"]
    if reason := empty_reason(paths.clips) if rows else OFF:
        for folder in folders:
            write_empty(folder, reason)
        return
    params = read_params(Path())
    if settings.samples is not None:
        params = params | {"sample": params["sample"] | {"samples": settings.samples}}
    for folder in folders:
        _clear(folder, {path.name for row in rows.values() for path in (row.samples, row.metrics)})
    for name, row in rows.items():
        sample(row, params, name)
        evaluate(row)


def _clear(folder: Path, kept: set[str]) -> None:
    """Remove what earlier runs left of rows that are asked for no more."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name not in kept:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
