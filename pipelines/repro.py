"""The graph, after a look at whether what it is going to read is there: DVC itself looks too late."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

from hoidata.errors import MissingResource
from pipelines.lineage.graph import read_graph
from pipelines.lineage.manifests import read_manifest
from pipelines.params import read_params
from pipelines.side_by_side import Run, RunStage, reproduce_side_by_side
from pipelines.stages.adapters import ensure_manifests
from pipelines.stages.base import Place, raw_root
from pipelines.stages.code import write_code
from pipelines.stages.raw import require_hand, write_generated

MOST_JOBS = 4  # a stage can take a gigabyte or two of memory


def reproduce(targets: list[str], jobs: int = 0, wrap: Callable[[RunStage], RunStage] | None = None) -> Run:
    """Preflight, then the targets (all when empty), up to ``jobs`` stages at once; 0: one per core, at most 4.

    wrap: see :func:`reproduce_side_by_side`.

    Raises MissingResource before DVC starts when raw or MANO files that a stale stage needs are absent.
    """
    preflight()
    os.environ.update(stage_environment())
    return reproduce_side_by_side(targets, jobs or min(MOST_JOBS, len(os.sched_getaffinity(0))), wrap)


def stage_environment() -> dict[str, str]:
    """The environment for ``dvc``: its stages run ``python``, which must be this one."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    return {**os.environ, "PATH": path, "DVC_NO_ANALYTICS": "1"}


def preflight() -> None:
    """Write again a generated corpus that a conversion is about to read; refuse when the user's files are missing."""
    params = read_params(Path())
    places = [Place(params["profile"], name) for name in params["datasets"]]
    ensure_manifests(params["profile"], params["datasets"])
    present = [place for place in places if read_manifest(place.manifest).present]
    for place in present:
        if not place.is_generated:
            require_hand(place)
    unreadable = [place for place in present if not _is_readable(place)]
    stale = _stale_stages([f"{stage}@{place}" for place in unreadable for stage in ("raw", "convert")])
    for place in unreadable:
        if not place.is_generated:
            if {f"raw@{place}", f"convert@{place}"} & stale:
                raw_root(place)
        elif f"raw@{place}" not in stale and f"convert@{place}" in stale:
            write_generated(place, read_manifest(place.manifest), place.generated_raw)


def _is_readable(place: Place) -> bool:
    try:
        return raw_root(place).is_dir()
    except MissingResource:
        return False


def _stale_stages(stages: list[str]) -> set[str]:
    """Which of the stages DVC would run again."""
    from dvc.repo import Repo

    known = read_graph(Path())
    wanted = [stage for stage in stages if stage in known]
    if not wanted:
        return set()
    write_code(Path())
    with Repo() as repo:
        return set(repo.status(targets=wanted))
