"""Every byte looked at again: outputs against dvc.lock, checkpoints against seals, raw files against manifests.

What a whole run made is also kept as a small table that is committed: by it a clone proves that it made the same.
dvc.lock names the digests of all code, so every edit changes it, and of networks, whose last bits depend on the
processor. The table has the outputs of the data stages by DVC's digest, which are the same on every x86-64 processor
with AVX2 (``hoidata.processor``), and the networks by the digest of their weights alone, with the processor.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.atomic import write_whole
from hoidata.files.sealed import payload_digest, seal_fault
from hoidata.files.written import read_json
from hoidata.processor import processor_name
from pipelines.lineage.locks import Locked, dvc_digest, other_files, read_locks
from pipelines.lineage.provenance import library_versions
from pipelines.lineage.raw import raw_list
from pipelines.lineage.targets import Target
from pipelines.lineage.tree import Node, raw_folder

SHOWN = 5


def check(root: Path, target: Target | None = None) -> list[Node]:
    """One node per output, checkpoint and raw folder behind ``target``, or of all that was ever run here."""
    locks = read_locks(root)
    behind = target.record["stages"] if target and target.kind != "motion" else locks
    outs = {path: locks[name] for name in locks.keys() & behind.keys() for path in locks[name].outs}
    outs.pop("code", None)  # written anew by every run
    return [node for path in sorted(outs) for node in _checked(root, path, outs[path])]


def _checked(root: Path, path: str, lock: Locked) -> Iterator[Node]:
    if not (root / path).exists():
        yield Node("data", path, "missing", "noted in dvc.lock")
        return
    others = other_files(root, lock, path)
    detail = f"not what dvc.lock says: {_some(others)}" if others else ""
    yield Node("data", path, "tampered" if others else "same", detail)
    for file in sorted((root / path).rglob("*.safetensors")):
        yield _sealed(file, file.relative_to(root).as_posix())
    listed = raw_list(root, path)
    if listed is not None and listed.files:
        yield _raw(root, path)


def _some(names: list[str]) -> str:
    return ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")


def _sealed(file: Path, name: str) -> Node:
    try:
        fault = seal_fault(file)
    except BadInput:
        fault = "header"
    return (
        Node("checkpoint", name, "tampered", f"the {fault} are not what was written")
        if fault
        else Node("checkpoint", name, "same")
    )


def _raw(root: Path, path: str) -> Node:
    """The raw files of one dataset, read again."""
    from pipelines.lineage.manifests import read_manifest, verify_files  # imports adapters

    listed, manifest = raw_list(root, path), read_manifest(root / path)
    assert listed is not None
    folder = raw_folder(root, path, listed)
    if folder is None or not folder.is_dir():
        return Node("raw", listed.dataset, "missing" if listed.synthetic else "needs licensed data", manifest.licence)
    problems = [item for item in verify_files(folder, manifest) if item.problem != "unlisted"]
    if not problems:
        return Node("raw", folder.as_posix(), "same", f"{len(manifest.files)} files")
    status = "changed" if any(item.problem == "changed" for item in problems) else "missing"
    return Node("raw", folder.as_posix(), status, ", ".join(f"{item.path} {item.problem}" for item in problems[:5]))


SCHEMA = "hoidata.made/1"


def write_made(root: Path, profile: str, path: Path) -> Path:
    """Write the table of what lies here, which is to be what the last run made (``hoidata lineage check``)."""
    outs = sorted(out for lock in read_locks(root).values() for out in lock.outs if out.startswith(f"data/{profile}/"))
    if not outs:
        raise BadInput(root / "dvc.lock", f"a run of the profile {profile}", "none", "run `hoidata repro` first")
    table = {
        "schema": SCHEMA,
        "profile": profile,
        "processor": processor_name(),
        "libraries": library_versions(),
        "outputs": {out: dvc_digest(root / out) for out in outs},
        "networks": {name: payload_digest(root / name) for name in _networks(root, profile)},
    }
    return write_whole(path, json.dumps(table, indent=1) + "\n")


def compare_made(root: Path, path: Path) -> list[Node]:
    """One node per entry of a table, against what lies here.

    A network of other weights is no fault where another processor or library made it, and is ``recorded`` then.
    """
    table = read_json(path)
    if table["schema"] != SCHEMA:
        raise BadInput(path, f"schema {SCHEMA}", str(table["schema"]), "take the one of this version")
    table.check({"outputs": dict, "networks": dict, "processor": str, "libraries": dict})
    nodes = [_node("data", root, name, digest, dvc_digest(root / name)) for name, digest in table["outputs"].items()]
    elsewhere = "; ".join(_other_circumstances(table))
    for name, digest in table["networks"].items():
        found = payload_digest(root / name) if (root / name).is_file() else None
        node = _node("checkpoint", root, name, digest, found)
        is_excused = node.status == "changed" and elsewhere
        nodes.append(Node("checkpoint", name, "recorded", elsewhere) if is_excused else node)
    return nodes


def _node(kind: Any, root: Path, name: str, digest: str | None, found: str | None) -> Node:
    if found is None:
        return Node(kind, name, "missing", "listed, not here")
    return Node(kind, name, "same") if found == digest else Node(kind, name, "changed", "not the bytes that are listed")


def _other_circumstances(table: dict[str, Any]) -> list[str]:
    here = {"processor": processor_name(), **library_versions()}
    then = {"processor": table["processor"], **table["libraries"]}
    return [f"{name} {then.get(name)} there, {value} here" for name, value in here.items() if then.get(name) != value]


def _networks(root: Path, profile: str) -> list[str]:
    paths = (root / "checkpoints" / profile).rglob("*.safetensors")
    return sorted(path.relative_to(root).as_posix() for path in paths)
