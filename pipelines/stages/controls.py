"""Stage controls: motions of retrieval baselines and negative controls, sampled one after another in one process."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from models.registry import family_module
from pipelines.params import read_params
from pipelines.stages.base import StagePaths, empty_reason, load_settings, write_empty
from pipelines.stages.families import OPTIONAL_FAMILIES
from pipelines.stages.sample import sample

OFF = "off: params.yaml names no families under controls"


@dataclass(frozen=True)
class ControlSettings:
    """The section ``controls`` of params.yaml."""

    families: tuple[str, ...] = ()  # baselines and negative controls to sample; none turns the stage off
    samples: int | None = None  # motions per test clip; None: as in the stage sample


def run(paths: StagePaths) -> None:
    """Sample each baseline and control, as the stage sample does, into the folder ``controls``.

    With ``paths.family``, sample only those that use the networks of this optional family, into ``controls-<family>``.
    """
    settings = load_settings(ControlSettings, "controls")
    folder = replace(paths, family="-".join(filter(None, ("controls", paths.family)))).samples
    names = [name for name in settings.families if _optional_family(name) == paths.family]
    if reason := empty_reason(paths.clips) if names else OFF:
        write_empty(folder, reason)
        return
    params = read_params(Path())
    if settings.samples is not None:
        params = params | {"sample": params["sample"] | {"samples": settings.samples}}
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name not in names:  # sampled by an earlier run with other settings
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name in names:
        sample(replace(paths, family=f"{folder.name}/{name}"), params, name)


def _optional_family(name: str) -> str:
    """The optional family whose networks a baseline or control uses; empty if none."""
    folder = family_module(name).split(".")[1]
    return folder if folder in OPTIONAL_FAMILIES else ""
