"""The lineage of a checkpoint: what it was made from, and whether each piece is still the same today."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from hoidata.errors import BadInput
from pipelines.lineage.digests import path_digest
from pipelines.lineage.graph import Stage, look_up, read_graph
from pipelines.lineage.provenance import read_provenance
from pipelines.params import read_params
from pipelines.stages.code import code_today

Kind = Literal["checkpoint", "stage", "param", "code", "data", "manifest"]
Status = Literal["same", "changed", "missing"]


@dataclass(frozen=True)
class Node:
    """One thing a checkpoint was made from. status compares it alone, not what lies behind it, with today.

    repeated: this node's own tree stands elsewhere, under the same name.
    """

    kind: Kind
    name: str
    status: Status
    detail: str = ""
    children: tuple["Node", ...] = ()
    repeated: bool = False

    def walk(self) -> list["Node"]:
        """This node and all below it."""
        return [self, *(node for child in self.children for node in child.walk())]


@dataclass
class _Comparison:
    root: Path
    stages: dict[str, Any]
    params: dict[str, Any]
    made_by: dict[str, str]
    stages_today: dict[str, Stage]
    code_today: dict[str, dict[str, str]]
    shown: set[str] = field(default_factory=set)
    digests: dict[str, str | None] = field(default_factory=dict)

    def path_status(self, path: str, recorded: str | None) -> Status:
        if path not in self.digests:
            self.digests[path] = path_digest(self.root / path)
        now = self.digests[path]
        return "same" if now == recorded else "missing" if now is None else "changed"


def lineage_tree(root: Path, checkpoint: Path) -> tuple[Node, dict[str, Any]]:
    """The tree behind ``checkpoint``, compared with the working tree at ``root``, and the provenance it came from."""
    provenance = read_provenance(checkpoint)
    if imported := provenance.get("imported"):
        files = tuple(Node("data", f"published {kind}", "same", _short(digest)) for kind, digest in imported.items())
        return Node("checkpoint", checkpoint.as_posix(), "same", _summary(provenance), files), provenance
    stages = provenance["stages"]
    made_by = {path: name for name, record in stages.items() for path in record.get("outputs", ())}
    comparison = _Comparison(root, stages, read_params(root), made_by, read_graph(root), code_today(root))
    top = _stage_node(comparison, provenance["stage"])
    return Node("checkpoint", checkpoint.as_posix(), "same", _summary(provenance), (top,)), provenance


def overall_status(tree: Node) -> Status:
    """``same`` when nothing behind the checkpoint has changed, else the worst that was found."""
    found = {node.status for node in tree.walk()}
    return "missing" if "missing" in found else "changed" if "changed" in found else "same"


def tree_as_json(tree: Node) -> dict[str, Any]:
    """The tree as JSON values."""
    values: dict[str, Any] = {"kind": tree.kind, "name": tree.name, "status": tree.status, "detail": tree.detail}
    if tree.repeated:
        values["repeated"] = True
    return {**values, "children": [tree_as_json(child) for child in tree.children]}


def _summary(provenance: dict[str, Any]) -> str:
    clips = provenance.get("clips", {})
    counts = clips if isinstance(clips, str) else ", ".join(f"{len(ids)} {split}" for split, ids in clips.items())
    kind = "synthetic data" if provenance.get("synthetic") else "real data"
    return f"{provenance.get('model', '')}, seed {provenance.get('seed')}, {kind}, clips: {counts}"


def _stage_node(comparison: _Comparison, name: str) -> Node:
    if name in comparison.shown:
        return Node("stage", name, "same", "shown elsewhere in this tree", repeated=True)
    comparison.shown.add(name)
    record = comparison.stages[name]
    children = [_param_node(comparison, key, value) for key, value in record["params"].items()]
    today = comparison.stages_today.get(name)
    files = today.code if today else ()
    code_today = {path: digest for file in files for path, digest in comparison.code_today.get(file, {}).items()}
    children.append(_code_node(record["code"], code_today))
    children += [_input_node(comparison, path, digest) for path, digest in record["inputs"].items()]
    recorded = {*record["inputs"], *record["params"]}
    other = recorded ^ {*today.data, *today.params} if today else set()
    detail = f"depends on other things now: {', '.join(sorted(other))}" if other else ""
    return Node("stage", name, "changed" if other else "same", detail, tuple(children))


def _param_node(comparison: _Comparison, key: str, recorded: Any) -> Node:
    try:
        now = look_up(comparison.params, key)
    except BadInput:
        return Node("param", key, "missing", f"was {recorded}")
    if now == recorded:
        return Node("param", key, "same", str(recorded))
    return Node("param", key, "changed", "; ".join(_value_changes(recorded, now)))


def _value_changes(before: Any, after: Any, key: str = "") -> list[str]:
    """The leaves that differ, as ``key: before -> after``."""
    if not (isinstance(before, dict) and isinstance(after, dict)):
        return [] if before == after else [f"{key or 'value'}: {before} -> {after}"]
    names = dict.fromkeys([*before, *after])
    parts = (_value_changes(before.get(name), after.get(name), f"{key}.{name}".lstrip(".")) for name in names)
    return [change for part in parts for change in part]


def _code_node(recorded: dict[str, str], today: dict[str, str]) -> Node:
    """One node for a stage's code, with a child for each file it ran then or would run now."""
    children = tuple(_file_node(path, recorded.get(path), today.get(path)) for path in sorted({*recorded, *today}))
    worst = overall_status(Node("code", "code", "same", children=children))
    changed = ", ".join(node.name for node in children if node.status != "same")
    return Node("code", "code", worst, changed or f"{len(children)} files", children)


def _file_node(path: str, recorded: str | None, today: str | None) -> Node:
    status: Status = "same" if today == recorded else "missing" if today is None else "changed"
    return Node("code", path, status, _short(recorded))


def _input_node(comparison: _Comparison, path: str, recorded: str | None) -> Node:
    kind: Kind = "manifest" if path.startswith("manifests/") else "data"
    maker = comparison.made_by.get(path)
    children = (_stage_node(comparison, maker),) if maker else ()
    return Node(kind, path, comparison.path_status(path, recorded), _short(recorded), children)


def _short(digest: str | None) -> str:
    return f"sha256 {digest[:12]}" if digest else "absent"
