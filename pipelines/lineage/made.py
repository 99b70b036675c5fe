"""What a whole run made, as a small table that is committed: by it a clone proves that it made the same.

dvc.lock is not committed in its place: it names the digests of all code, so that every edit would change it, and of
networks, whose last bits depend on the processor. Here stand the outputs of the data stages by DVC's digest, which are
the same on every x86-64 processor with AVX2 (``hoidata.processor``), and the networks by the digest of their weights
alone, with the processor.
"""

import json
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.atomic import write_whole
from hoidata.files.sealed import payload_digest
from hoidata.files.written import read_json
from hoidata.processor import processor_name
from pipelines.lineage.locks import dvc_digest, read_locks
from pipelines.lineage.provenance import library_versions
from pipelines.lineage.tree import Node

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
