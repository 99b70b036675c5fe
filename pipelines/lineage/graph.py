"""The stages of all dvc.yaml files of the project, with matrices resolved."""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from pipelines.params import load_yaml, read_file

# The keys of a stage that ``written_graph`` understands; for any other key it falls back to DVC.
_OUTS = ("outs", "metrics", "plots")
_KNOWN_KEYS = {"desc", "wdir", "matrix", "cmd", "deps", "params", *_OUTS, "always_changed", "frozen", "meta"}
_REFERENCE = re.compile(r"\$\{([\w.]+)\}")


@dataclass(frozen=True)
class Stage:
    """One stage of the graph, with its matrix resolved. Paths are relative to the project."""

    name: str  # as ``dvc repro`` accepts it
    deps: tuple[str, ...]
    params: tuple[str, ...]
    outs: tuple[str, ...]

    @property
    def code(self) -> tuple[str, ...]:
        """The files with the digests of the code this stage runs."""
        return tuple(path for path in self.deps if path.startswith("code/"))

    @property
    def data(self) -> tuple[str, ...]:
        """The files and folders this stage depends on: manifests and outputs of other stages."""
        return tuple(path for path in self.deps if not path.startswith("code/"))


def look_up(values: dict[str, Any], dotted: str) -> Any:
    """The value at a dotted key (``train.small.contact``). Raises BadInput that lists the existing keys."""
    value: Any = values
    for key in dotted.split("."):
        if not isinstance(value, dict) or key not in value:
            keys = ", ".join(map(str, value)) if isinstance(value, dict) else "none"
            raise BadInput(f"params.yaml: {dotted}", f"one of: {keys}", key, "correct params.yaml")
        value = value[key]
    return value


def read_graph(root: Path) -> dict[str, Stage]:
    """All stages by name, as DVC reads them. Raises BadInput if it cannot."""
    from dvc.exceptions import DvcException
    from dvc.repo import Repo

    try:
        with Repo(os.fspath(root)) as repo:
            stages = [_stage(Path(repo.root_dir), stage) for stage in repo.index.stages]
    except DvcException as error:
        raise BadInput("dvc.yaml", "stages that DVC can read", str(error), "see what `dvc status` says") from error
    return {stage.name: stage for stage in stages}


def written_graph(root: Path) -> dict[str, Stage]:
    """The result of ``read_graph`` in a tenth of the time; uses DVC only for keys that this module does not know."""
    params = read_file(root / "params.yaml")
    files = (root / "dvc.yaml", *sorted(root.glob("models/*/dvc.yaml")), *root.glob("pipelines/dvc.yaml"))
    try:
        names = [path.relative_to(root).as_posix() for path in files]
        stages = [stage for name in names for stage in _written(root, name, params)]
    except (BadInput, ValueError, TypeError, AttributeError, KeyError, OSError):
        return read_graph(root)
    return {stage.name: stage for stage in stages}


def _written(root: Path, file: str, params: dict[str, Any]) -> Iterator[Stage]:
    """The stages of one dvc.yaml, with matrices resolved. Raises ValueError for unknown syntax."""
    stages = load_yaml((root / file).read_bytes())["stages"]
    prefix = "" if file == "dvc.yaml" else f"{file}:"
    for name, body in stages.items():
        if unknown := body.keys() - _KNOWN_KEYS:
            raise ValueError(f"{file}: {name}: {unknown}")
        base = Path(file).parent / body.get("wdir", ".")
        for item in _items(body.get("matrix") or {}, params):
            values = {**params, "item": item}
            paths, names, outs = (_listed(body, keys, values) for keys in (("deps",), ("params",), _OUTS))
            suffix = f"@{'-'.join(map(str, item.values()))}" if item else ""
            yield Stage(f"{prefix}{name}{suffix}", _below(base, paths), tuple(names), _below(base, outs))


def _items(matrix: dict[str, Any], params: dict[str, Any]) -> list[dict[str, str]]:
    """The combinations of a matrix, in DVC's order."""
    lists = [values if isinstance(values, list) else look_up(params, values.strip("${}")) for values in matrix.values()]
    filled = [[_filled(str(value), params) for value in values] for values in lists]
    return [dict(zip(matrix, combination, strict=True)) for combination in product(*filled)]


def _listed(body: dict[str, Any], keys: tuple[str, ...], values: dict[str, Any]) -> list[str]:
    """The entries of a stage's lists (plain or with options), with references filled in."""
    entries = [entry for key in keys for entry in body.get(key) or ()]
    names = [next(iter(entry)) if isinstance(entry, dict) else entry for entry in entries]
    return [_filled(name, values) for name in names]


def _filled(text: str, values: dict[str, Any]) -> str:
    filled = _REFERENCE.sub(lambda match: str(look_up(values, match[1])), text)
    if "${" in filled:
        raise ValueError(text)
    return filled


def _below(base: Path, paths: list[str]) -> tuple[str, ...]:
    return tuple(os.path.normpath(base / path) for path in paths)


def producers(graph: dict[str, Stage]) -> dict[str, Stage]:
    """The stage that writes each output path."""
    return {out: stage for stage in graph.values() for out in stage.outs}


def _stage(root: Path, stage: Any) -> Stage:
    """Convert a stage of DVC."""
    file = Path(stage.path).relative_to(root).as_posix()
    name = stage.name if file == "dvc.yaml" else f"{file}:{stage.name}"
    paths = [dep for dep in stage.deps if not hasattr(dep, "params")]
    params = [key for dep in stage.deps if hasattr(dep, "params") for key in dep.params]
    deps, outs = ([Path(item.fs_path).relative_to(root).as_posix() for item in items] for items in (paths, stage.outs))
    return Stage(name, tuple(deps), tuple(params), tuple(outs))
