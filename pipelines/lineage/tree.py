"""The lineage of a file: what it was made from, and whether each piece is still the same today."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from hoidata.errors import BadInput
from hoidata.files.atomic import sha256_file
from pipelines.lineage.digests import path_digest
from pipelines.lineage.graph import Stage, look_up, written_graph
from pipelines.lineage.history import History
from pipelines.lineage.locks import dvc_digest, read_locks
from pipelines.lineage.raw import RawList, raw_list
from pipelines.lineage.targets import Target, find_target
from pipelines.params import chosen_params, load_yaml, read_params

Kind = Literal["checkpoint", "motion", "stage", "param", "code", "data", "manifest", "raw"]
# From worst to best. recorded: read from the header alone, there is no project here to compare it with.
STATUSES = {
    "tampered": "not the bytes its maker wrote",
    "orphan": "no dvc.lock, today's or a committed one, knows it",
    "missing": "not here",
    "needs licensed data": "made from the user's own raw files, which are not here",
    "changed": "something else now, by an edit or another run",
    "uncommitted": "as recorded, but in no commit",
    "recorded": "nothing here to compare it with",
    "same": "as recorded",
}
Status = Literal[
    "tampered", "orphan", "missing", "needs licensed data", "changed", "uncommitted", "recorded", "same"
]  # fmt: skip


@dataclass(frozen=True)
class Node:
    """One thing a file was made from. status compares it alone, not what lies behind it, with today.

    repeated: this node's own tree stands elsewhere, under the same name. digest: as recorded, with its algorithm.
    """

    kind: Kind
    name: str
    status: Status
    detail: str = ""
    children: tuple["Node", ...] = ()
    repeated: bool = False
    digest: str = ""

    def walk(self) -> list["Node"]:
        """This node and all below it."""
        return [self, *(node for child in self.children for node in child.walk())]


def overall_status(tree: Node) -> Status:
    """``same`` when nothing behind the file has changed, else the worst that was found."""
    found = {node.status for node in tree.walk()}
    return next(status for status in STATUSES if status in found)  # pyright: ignore[reportReturnType]


def tree_as_json(tree: Node) -> dict[str, Any]:
    """The tree as JSON values."""
    values: dict[str, Any] = {"kind": tree.kind, "name": tree.name, "status": tree.status, "detail": tree.detail}
    values |= {"digest": tree.digest} if tree.digest else {}
    values |= {"repeated": True} if tree.repeated else {}
    return {**values, "children": [tree_as_json(child) for child in tree.children]}


def target_tree(root: Path | None, target: Target) -> Node:
    """The tree behind a target, compared with the project at ``root``; nothing is compared where there is none."""
    if target.kind == "motion":
        children = tuple(_named_checkpoint(root, name, digest) for name, digest in target.record.items())
        return Node("motion", target.name, target.status, f"made by {len(children)} networks", children)  # pyright: ignore
    children = (_Comparison(root, target).stage(target.record["stage"]),)
    detail = "; ".join(filter(None, (_summary(target.record), target.note)))
    return Node(target.kind, target.name, target.status, detail, children, digest=_own_digest(target))  # pyright: ignore


def _named_checkpoint(root: Path | None, name: str, recorded: str) -> Node:
    """A checkpoint as a motion names it: by its path in the project and the SHA-256 of its file."""
    digest = f"sha256 {recorded}"
    if root is None:
        return Node("checkpoint", name, "recorded", digest=digest)
    if not (root / name).is_file():
        return Node("checkpoint", name, "missing", digest=digest)
    tree = target_tree(root, find_target(root, name, root))
    if tree.status == "same" and sha256_file(root / name) != recorded:
        return Node("checkpoint", name, "changed", "another one than the motion was made with", digest=digest)
    return Node("checkpoint", name, tree.status, tree.detail, tree.children, digest=digest)


def _own_digest(target: Target) -> str:
    record = target.record
    if target.is_of_lock:
        outs = record["stages"][record["stage"]]["outputs"]
        return next((f"md5 {md5}" for path, md5 in outs.items() if Path(target.name).is_relative_to(path)), "")
    payload = record.get("seal", {}).get("payload_sha256")
    return f"sha256 {payload}" if payload else ""


def _summary(record: dict[str, Any]) -> str:
    if "clips" not in record:
        return ""
    counts = ", ".join(f"{len(ids)} {split}" for split, ids in record["clips"].items())
    kind = "synthetic data" if record.get("synthetic") else "real data"
    return f"{record.get('model', '')}, seed {record.get('seed')}, {kind}, clips: {counts}"


@dataclass
class _Comparison:
    """A record beside today. root: None where there is no project."""

    root: Path | None
    target: Target
    shown: set[str] = field(default_factory=set)
    digests: dict[str, str | None] = field(default_factory=dict)
    code_files: dict[str, dict[str, str]] = field(default_factory=dict)

    @cached_property
    def stages(self) -> dict[str, Any]:
        return self.target.record["stages"]

    @cached_property
    def made_by(self) -> dict[str, str]:
        return {path: name for name, record in self.stages.items() for path in record.get("outputs", ())}

    @cached_property
    def home(self) -> Path:
        assert self.root is not None
        return self.root

    @cached_property
    def params(self) -> dict[str, Any]:
        return read_params(self.home)

    @cached_property
    def stages_today(self) -> dict[str, Stage]:
        return written_graph(self.home)

    @cached_property
    def code_today(self) -> dict[str, dict[str, str]]:
        from pipelines.stages.code import code_today

        wanted = {file for name in self.stages for file in self.stages_today.get(name, _NO_STAGE).code}
        return code_today(self.home, wanted)

    @cached_property
    def history(self) -> History:
        return History(self.home)

    @cached_property
    def made(self) -> dict[str, str]:
        """What DVC noted as made, by path."""
        return {path: md5 for lock in read_locks(self.home).values() for path, md5 in lock.outs.items()}

    @cached_property
    def commits(self) -> dict[tuple[str, str], str]:
        """The commits that held the code files that are others now."""
        changed = [
            (path, digest)
            for name, record in self.stages.items()
            for path, digest in record["code"].items()
            if self.code_of(name).get(path) != digest
        ]
        return self.history.commits_of(changed)

    def code_of(self, name: str) -> dict[str, str]:
        if name not in self.code_files:
            files = self.stages_today.get(name, _NO_STAGE).code
            today = (self.code_today.get(file, {}).items() for file in files)
            self.code_files[name] = {path: digest for items in today for path, digest in items}
        return self.code_files[name]

    def stage(self, name: str) -> Node:
        if name in self.shown:
            return Node("stage", name, "same", "shown elsewhere in this tree", repeated=True)
        self.shown.add(name)
        record = self.stages[name]
        children = [self.param(key, value) for key, value in record["params"].items()]
        children.append(self.code(name))
        children += [self.input(path, digest) for path, digest in record["inputs"].items()]
        children += [node for path in record.get("outputs", ()) if (node := self.raw(path))]
        status, detail = self.wiring(name)
        return Node("stage", name, status, detail, tuple(children))

    def wiring(self, name: str) -> tuple[Status, str]:
        """Whether a stage depends on the same things by name."""
        if self.root is None:
            return "recorded", ""
        record, today = self.stages[name], self.stages_today.get(name)
        if today is None:
            return ("missing", "no such stage now") if self.target.is_of_lock else ("same", "")
        other = {*record["inputs"], *record["params"]} ^ {*today.data, *today.params}
        return ("changed", f"depends on other things now: {', '.join(sorted(other))}") if other else ("same", "")

    def param(self, key: str, recorded: Any) -> Node:
        if self.root is None:
            return Node("param", key, "recorded", str(recorded))
        try:
            now = look_up(self.params, key)
        except BadInput:
            return Node("param", key, "missing", f"was {recorded}")
        if now != recorded:
            changes = "; ".join(value_changes(recorded, now))
            return Node("param", key, "changed", f"{changes}{self.as_committed(key, recorded)}")
        if "params.yaml" in self.history.uncommitted and self.committed_params(key) != now:
            return Node("param", key, "uncommitted", str(recorded))
        return Node("param", key, "same", str(recorded))

    def committed_params(self, key: str, commit: str = "HEAD") -> Any:
        return self.value_in(self.history.text(commit, "params.yaml"), key)

    def value_in(self, text: bytes, key: str) -> Any:
        """A param of another params.yaml, under the profile that is chosen now; None where it has no such thing."""
        try:
            values = load_yaml(text)
            if "profile" in self.params:
                values["profile"] = self.params["profile"]
            return look_up(chosen_params(values), key)
        except (BadInput, ValueError, TypeError, AttributeError, RecursionError):
            return None

    def as_committed(self, key: str, recorded: Any) -> str:
        versions = self.history.versions(["params.yaml"])
        found = (commit for commit, _, text in versions if self.value_in(text, key) == recorded)
        commit = next(found, None)
        return f" (as recorded in commit {commit[:10]})" if commit else ""

    def code(self, stage: str) -> Node:
        """One node for a stage's code, with a child for each file it ran then or would run now."""
        recorded = self.stages[stage]["code"]
        today = {} if self.root is None else self.code_of(stage)
        if self.root is not None and recorded and all(path.startswith("code/") for path in recorded):
            return Node("code", "code", "changed", "which files it was is not recorded; they are others now")
        children = tuple(self.file(path, recorded.get(path), today.get(path)) for path in sorted({*recorded, *today}))
        worst = overall_status(Node("code", "code", "same", children=children))
        changed = ", ".join(node.name for node in children if node.status not in ("same", "recorded"))
        return Node("code", "code", worst, changed or f"{len(children)} files", children)

    def file(self, path: str, recorded: str | None, today: str | None) -> Node:
        digest = f"sha256 {recorded}" if recorded else ""
        if self.root is None:
            return Node("code", path, "recorded", digest=digest)
        if today != recorded:
            commit = self.commits.get((path, recorded or ""))
            detail = f"as recorded in commit {commit}" if commit else "" if recorded else "not among the code then"
            return Node("code", path, "missing" if today is None else "changed", detail, digest=digest)
        return Node("code", path, "uncommitted" if path in self.history.uncommitted else "same", digest=digest)

    def input(self, path: str, recorded: str | None) -> Node:
        kind: Kind = "manifest" if path.startswith("manifests/") else "data"
        maker = self.made_by.get(path)
        children = (self.stage(maker),) if maker else ()
        algorithm = "md5" if self.target.is_of_lock else "sha256"
        digest = f"{algorithm} {recorded}" if recorded else ""
        status, detail = self.path_status(path, recorded)
        return Node(kind, path, status, detail or ("" if recorded else "absent"), children, digest=digest)

    def path_status(self, path: str, recorded: str | None) -> tuple[Status, str]:
        if self.root is None:
            return "recorded", ""
        now = self.digest(path, dvc_digest if self.target.is_of_lock else path_digest)
        if now == recorded:
            return ("uncommitted" if path in self.history.uncommitted else "same"), ""
        if now is None:
            return "missing", ""
        if path in self.made and self.digest(path, dvc_digest) != self.made[path]:
            return "tampered", "not what the stage wrote, by dvc.lock"
        return "changed", ""

    def digest(self, path: str, digest: Callable[[Path], str | None]) -> str | None:
        key = f"{digest.__name__} {path}"
        if key not in self.digests:
            self.digests[key] = digest(self.home / path)
        return self.digests[key]

    def raw(self, path: str) -> Node | None:
        """The raw files of a file-level manifest: whether they are there, in size; their bytes are for ``check``."""
        listed = raw_list(self.root, path) if self.root is not None else None
        if self.root is None or listed is None or not listed.files:
            return None
        folder = raw_folder(self.root, path, listed)
        status, detail = raw_status(folder, listed)
        return Node("raw", folder.as_posix() if folder else listed.dataset, status, detail)


_NO_STAGE = Stage("", (), (), ())


def raw_folder(root: Path, path: str, listed: RawList) -> Path | None:
    """Where the raw files of ``data/<profile>/<dataset>/raw.json`` lie, if anywhere."""
    from pipelines.stages.base import StagePaths, own_root

    profile, dataset = Path(path).parts[-3:-1]
    own = own_root(dataset) or own_root(dataset.partition("-")[0])  # a variant reads the files of its source
    return root / StagePaths(profile, dataset).generated_raw if listed.synthetic else own


def raw_status(folder: Path | None, listed: RawList) -> tuple[Status, str]:
    """What a look at names and sizes tells of the raw files."""
    facts = f"{len(listed.files)} files, {listed.licence}"
    gone = [path for path, _, _ in listed.files if folder is None or not (folder / path).exists()]
    if folder is None or gone:
        remedy = "written again when it is needed" if listed.synthetic else listed.where_to_register
        detail = f"{facts}; {len(gone)} not here, first {gone[0]}; {remedy}"
        return ("missing" if listed.synthetic else "needs licensed data"), detail
    files = ((path, folder / path, size) for path, size, _ in listed.files)
    other = [name for name, path, size in files if path.is_file() and path.stat().st_size != size]
    if other:
        return "changed", f"{facts}; {len(other)} of another size, first {other[0]}"
    return "same", facts


def value_changes(before: Any, after: Any, key: str = "") -> list[str]:
    """The leaves that differ, as ``key: before -> after``."""
    if not (isinstance(before, dict) and isinstance(after, dict)):
        return [] if before == after else [f"{key or 'value'}: {before} -> {after}"]
    names = dict.fromkeys([*before, *after])
    parts = (value_changes(before.get(name), after.get(name), f"{key}.{name}".lstrip(".")) for name in names)
    return [change for part in parts for change in part]
