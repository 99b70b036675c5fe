"""The stages as DVC resolves them from all dvc.yaml of the project."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput


@dataclass(frozen=True)
class Stage:
    """One stage of the graph, matrix resolved. name: as ``dvc repro`` takes it; paths relative to the project."""

    name: str
    deps: tuple[str, ...]
    params: tuple[str, ...]
    outs: tuple[str, ...]

    @property
    def code(self) -> tuple[str, ...]:
        """The files that hold the digests of the code this stage runs."""
        return tuple(path for path in self.deps if path.startswith("code/"))

    @property
    def data(self) -> tuple[str, ...]:
        """The files and folders this stage depends on: manifests and outputs of other stages."""
        return tuple(path for path in self.deps if not path.startswith("code/"))


def look_up(values: dict[str, Any], dotted: str) -> Any:
    """The value at a dotted key (``train.small.contact``). Raises BadInput naming the keys there are."""
    found: Any = values
    for key in dotted.split("."):
        if not isinstance(found, dict) or key not in found:
            known = ", ".join(map(str, found)) if isinstance(found, dict) else "none"
            raise BadInput(f"params.yaml: {dotted}", f"one of: {known}", key, "correct params.yaml")
        found = found[key]
    return found


def read_graph(root: Path) -> dict[str, Stage]:
    """All stages by name. Raises BadInput when DVC cannot read them."""
    from dvc.exceptions import DvcException
    from dvc.repo import Repo

    try:
        with Repo(os.fspath(root)) as repo:
            stages = [_stage(Path(repo.root_dir), stage) for stage in repo.index.stages]
    except DvcException as error:
        raise BadInput("dvc.yaml", "stages that DVC can read", str(error), "see what `dvc status` says") from error
    return {stage.name: stage for stage in stages}


def producers(graph: dict[str, Stage]) -> dict[str, Stage]:
    """Which stage makes each output path."""
    return {out: stage for stage in graph.values() for out in stage.outs}


def _stage(root: Path, stage: Any) -> Stage:
    """DVC's own stage as one of ours."""
    file = Path(stage.path).relative_to(root).as_posix()
    name = stage.name if file == "dvc.yaml" else f"{file}:{stage.name}"
    paths = [dep for dep in stage.deps if not hasattr(dep, "params")]
    params = [key for dep in stage.deps if hasattr(dep, "params") for key in dep.params]
    return Stage(name, _relative(root, paths), tuple(params), _relative(root, stage.outs))


def _relative(root: Path, items: list[Any]) -> tuple[str, ...]:
    return tuple(Path(item.fs_path).relative_to(root).as_posix() for item in items)
