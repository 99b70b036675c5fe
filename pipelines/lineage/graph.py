"""The stages as dvc.yaml and params.yaml state them: the one description of the graph, read without DVC."""

import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from hoidata.errors import BadInput

PLACEHOLDER = re.compile(r"\$\{([^}]+)\}")
CODE_ROOTS = ("hoidata", "models", "pipelines")


@dataclass(frozen=True)
class Stage:
    """One stage of the graph, matrix resolved. name: as ``dvc repro`` takes it; paths relative to the project."""

    name: str
    command: str
    deps: tuple[str, ...]
    params: tuple[str, ...]
    outs: tuple[str, ...]

    @property
    def code(self) -> tuple[str, ...]:
        """The code this stage depends on."""
        return tuple(path for path in self.deps if path.split("/")[0] in CODE_ROOTS)

    @property
    def data(self) -> tuple[str, ...]:
        """The files and folders this stage depends on: manifests and outputs of other stages."""
        return tuple(path for path in self.deps if path.split("/")[0] not in CODE_ROOTS)


def read_params(root: Path) -> dict[str, Any]:
    """All of params.yaml."""
    values = yaml.safe_load((root / "params.yaml").read_text())
    if not isinstance(values, dict):
        raise BadInput("params.yaml", "a mapping of sections", type(values).__name__, "restore it with git checkout")
    return values


def look_up(values: dict[str, Any], dotted: str) -> Any:
    """The value at a dotted key (``train.demo.contact``). Raises BadInput naming the keys there are."""
    found: Any = values
    for key in dotted.split("."):
        if not isinstance(found, dict) or key not in found:
            known = ", ".join(map(str, found)) if isinstance(found, dict) else "none"
            raise BadInput(f"params.yaml: {dotted}", f"one of: {known}", key, "correct params.yaml")
        found = found[key]
    return found


def read_graph(root: Path) -> dict[str, Stage]:
    """All stages of dvc.yaml by name."""
    params = read_params(root)
    stages = yaml.safe_load((root / "dvc.yaml").read_text())["stages"]
    resolved = (_resolve(name, entry, params) for name, entry in stages.items())
    return {stage.name: stage for group in resolved for stage in group}


def producers(graph: dict[str, Stage]) -> dict[str, Stage]:
    """Which stage makes each output path."""
    return {out: stage for stage in graph.values() for out in stage.outs}


def _resolve(name: str, entry: dict[str, Any], params: dict[str, Any]) -> list[Stage]:
    """One stage per combination of the matrix's axes, named as DVC names them."""
    axes = {axis: _fill(value, params, {}) for axis, value in entry.get("matrix", {}).items()}
    combinations = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    return [_stage(name, entry, params, item) for item in combinations]


def _stage(name: str, entry: dict[str, Any], params: dict[str, Any], item: dict[str, str]) -> Stage:
    def filled(key: str) -> tuple[str, ...]:
        return tuple(_fill(_path_of(value), params, item) for value in entry.get(key, ()))

    address = f"{name}@{'-'.join(item.values())}" if item else name
    command = " ".join(_fill(entry["cmd"], params, item).split())
    outs = filled("outs") + filled("metrics")
    return Stage(address, command, filled("deps"), filled("params"), outs)


def _path_of(entry: str | dict[str, Any]) -> str:
    """The path of an output written as ``path`` or ``path: {options}``."""
    return entry if isinstance(entry, str) else next(iter(entry))


def _fill(value: Any, params: dict[str, Any], item: dict[str, str]) -> Any:
    """``value`` with its ``${...}`` placeholders replaced; one that is a placeholder as a whole keeps its type."""
    if isinstance(value, list):
        return [_fill(entry, params, item) for entry in value]
    if whole := PLACEHOLDER.fullmatch(value):
        return _placeholder(whole.group(1), params, item)
    return PLACEHOLDER.sub(lambda match: str(_placeholder(match.group(1), params, item)), value)


def _placeholder(name: str, params: dict[str, Any], item: dict[str, str]) -> Any:
    return item[name.removeprefix("item.")] if name.startswith("item.") else look_up(params, name)
