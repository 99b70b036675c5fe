"""`hoidata repro`: check that all raw files exist, then run the stale stages in parallel."""

import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput, MissingResource
from pipelines.lineage.graph import look_up, read_graph, written_graph
from pipelines.lineage.locks import read_locks
from pipelines.lineage.manifests import read_manifest
from pipelines.parallel_repro import Plan, Run, RunStage, reproduce_in_parallel, stale_stages
from pipelines.params import read_file, read_params
from pipelines.stages import code
from pipelines.stages.adapters import ensure_manifests, raw_files
from pipelines.stages.base import StagePaths
from pipelines.stages.raw import require_hand, write_generated

MAX_JOBS = 4  # a stage may need up to two gigabytes of memory


def reproduce(
    targets: list[str], jobs: int = 0, wrap: Callable[[RunStage], RunStage] | None = None, force: bool = False
) -> Run:
    """Check the raw files, then update DVC targets (none: all) with ``jobs`` parallel stages (0: ``default_jobs``).

    Raises MissingResource if raw or MANO files that a stale stage needs are missing.
    """
    preflight()
    os.environ.update(stage_environment())
    return reproduce_in_parallel(targets, jobs or default_jobs(), wrap, force)


def default_jobs() -> int:
    """The number of parallel stages: one per core, at most 4."""
    return min(MAX_JOBS, len(os.sched_getaffinity(0)))


def plan(targets: list[str], force: bool = False) -> Plan:
    """The stages that ``reproduce`` would run; writes the digests of the code, which tell DVC what has changed."""
    require_settings(Path())
    code.run(StagePaths(""))
    stale = stale_stages(targets, force)
    return replace(stale, growth=steps_growth(Path(), stale.upstream))


def steps_growth(root: Path, names: Iterable[str]) -> dict[str, float]:
    """By training among the stages ``names``: its steps in params.yaml divided by those of its last run."""
    graph, locks, values = written_graph(root), read_locks(root), read_file(root / "params.yaml")
    growth = {}
    for name in (name for name in names if name in graph and name in locks):
        now = _steps({key: look_up(values, key) for key in graph[name].params if key.startswith("train.")})
        before = _steps(locks[name].params)
        growth |= {name: now / before} if now and before else {}
    return growth


def _steps(sections: Mapping[str, Any]) -> int:
    """The training steps in sections of params.yaml by key, 0 without any; a size overrides a preset."""
    by_size = sorted(sections, key=lambda key: key.startswith(("train.small", "train.full")))
    trainings = [sections[key].get("training") or {} for key in by_size if isinstance(sections[key], Mapping)]
    return next((training["steps"] for training in reversed(trainings) if "steps" in training), 0)


def stage_environment() -> dict[str, str]:
    """The environment for ``dvc``, whose stages call ``python`` and must find this interpreter."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    return {**os.environ, "PATH": path, "DVC_NO_ANALYTICS": "1"}


def preflight() -> None:
    """Write generated corpora that a conversion will read; raise MissingResource if the user's files are missing."""
    require_settings(Path())
    params = read_params(Path())
    runs = [StagePaths(params["profile"], name) for name in params["datasets"]]
    ensure_manifests(params["profile"], params["datasets"])
    present = [paths for paths in runs if read_manifest(paths.manifest).present]
    for paths in present:
        if not paths.is_generated:
            require_hand(paths)
    unreadable = [paths for paths in present if not _is_readable(paths)]
    stale = _stale_stages([f"{stage}@{paths}" for paths in unreadable for stage in ("raw", "convert")])
    for paths in unreadable:
        if not paths.is_generated:
            if {f"raw@{paths}", f"convert@{paths}"} & stale:
                raw_files(paths)
        elif f"raw@{paths}" not in stale and f"convert@{paths}" in stale:
            write_generated(paths, read_manifest(paths.manifest), paths.generated_raw)


def require_settings(root: Path) -> None:
    """Raise BadInput if a stage depends on a key that params.yaml lacks; DVC's error does not say what to add.

    Usually it is the section of a new network under one of the presets or sizes. An empty section is enough.
    """
    values = read_file(root / "params.yaml")
    for stage in written_graph(root).values():
        for key in stage.params:
            try:
                look_up(values, key)
            except BadInput as error:
                if (root / key).is_file():  # a stage may depend on another file of settings
                    continue
                section, _, name = key.rpartition(".")
                remedy = f"add `{name}: {{}}` under `{section}`, or remove the key from the stage's `params`"
                expected = f"a section for the stage {stage.name}"
                raise BadInput(f"params.yaml: {key}", expected, "none", remedy) from error


def _is_readable(paths: StagePaths) -> bool:
    try:
        return raw_files(paths).is_dir()
    except MissingResource:
        return False


def _stale_stages(stages: list[str]) -> set[str]:
    """Those of the stages that DVC would run again."""
    from dvc.repo import Repo

    graph = read_graph(Path())
    existing = [stage for stage in stages if stage in graph]
    if not existing:
        return set()
    code.write_code(Path())
    with Repo() as repo:
        return set(repo.status(targets=existing))
