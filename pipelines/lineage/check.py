"""Hash all files again: outputs against dvc.lock, checkpoints against their checksums, raw files against manifests.

A digest table records the outputs of a whole run. It is committed, so that a clone can check that it gives the same
results. dvc.lock does not serve for this: it contains digests of all code. The table has DVC's digests of the data
stages' outputs, which are equal on every x86-64 processor with AVX2 (``hoidata.processor``). Of networks it has the
digests of the weights, whose last bits depend on the processor, and the processor's name.
"""

import json
from collections.abc import Iterator
from pathlib import Path

from hoidata.errors import BadInput
from hoidata.files.atomic import write_whole
from hoidata.files.checksums import corrupted_part, payload_digest
from hoidata.files.written import read_json
from hoidata.processor import processor_name
from pipelines.lineage.locks import Locked, dvc_digest, other_files, producers_of, read_locks
from pipelines.lineage.provenance import library_versions
from pipelines.lineage.raw import RawList, raw_list
from pipelines.lineage.targets import Target, lock_record
from pipelines.lineage.tree import Kind, Node, raw_folder

SCHEMA = "hoidata.made/1"
SHOWN = 5


def check(root: Path, target: Target | None = None) -> list[Node]:
    """One node per output, checkpoint and raw folder upstream of a target; without a target, of all stages that ran."""
    locks = read_locks(root)
    upstream = _upstream(root, target, locks) if target else set(locks)
    outs = {path: locks[name] for name in locks.keys() & upstream for path in locks[name].outs}
    outs.pop("code", None)  # every run writes it again
    return [node for path in sorted(outs) for node in _check_output(root, path, outs[path])]


def _upstream(root: Path, target: Target, locks: dict[str, Locked]) -> set[str]:
    """The stages behind a target; for a generated motion those behind its networks."""
    if target.kind != "motion":
        return set(target.record["stages"])
    makers = {out: lock.name for lock in locks.values() for out in lock.outs}
    trained = {stage for path in target.record for stage in producers_of(makers, path)}
    return {name for stage in trained for name in lock_record(root, locks, stage)["stages"]}


def _check_output(root: Path, path: str, lock: Locked) -> Iterator[Node]:
    if not (root / path).exists():
        yield Node("data", path, "missing", "noted in dvc.lock")
        return
    others = other_files(root, lock, path)
    more = f" and {len(others) - SHOWN} more" if len(others) > SHOWN else ""
    detail = f"differs from dvc.lock: {', '.join(others[:SHOWN])}{more}" if others else ""
    yield Node("data", path, "tampered" if others else "same", detail)
    for file in sorted((root / path).rglob("*.safetensors")):
        yield _check_checksum(file, file.relative_to(root).as_posix())
    listed = raw_list(root, path)
    if listed is not None and listed.files:
        yield _check_raw(root, path, listed)


def _check_checksum(file: Path, name: str) -> Node:
    try:
        fault = corrupted_part(file)
    except BadInput:
        fault = "header"
    detail = f"the {fault} differ from their checksum" if fault else ""
    return Node("checkpoint", name, "tampered" if fault else "same", detail)


def _check_raw(root: Path, path: str, listed: RawList) -> Node:
    """Hash the raw files of one dataset and compare them with its manifest."""
    from pipelines.lineage.manifests import read_manifest, verify_files  # imports adapters

    manifest, folder = read_manifest(root / path), raw_folder(root, path, listed)
    if folder is None or not folder.is_dir():
        return Node("raw", listed.dataset, "missing" if listed.synthetic else "needs licensed data", manifest.licence)
    problems = [item for item in verify_files(folder, manifest) if item.problem != "unlisted"]
    if not problems:
        return Node("raw", folder.as_posix(), "same", f"{len(manifest.files)} files")
    status = "changed" if any(item.problem == "changed" for item in problems) else "missing"
    return Node("raw", folder.as_posix(), status, ", ".join(f"{item.path} {item.problem}" for item in problems[:SHOWN]))


def write_made(root: Path, profile: str, path: Path) -> Path:
    """Write the digest table of a profile's outputs; run ``check`` first, so that they are those of the last run."""
    outs = sorted(out for lock in read_locks(root).values() for out in lock.outs if out.startswith(f"data/{profile}/"))
    if not outs:
        raise BadInput(root / "dvc.lock", f"a run of the profile {profile}", "none", "run `hoidata repro` first")
    networks = sorted((root / "checkpoints" / profile).rglob("*.safetensors"), key=Path.as_posix)
    table = {
        "schema": SCHEMA,
        "profile": profile,
        "processor": processor_name(),
        "libraries": library_versions(),
        "outputs": {out: dvc_digest(root / out) for out in outs},
        "networks": {path.relative_to(root).as_posix(): payload_digest(path) for path in networks},
    }
    return write_whole(path, json.dumps(table, indent=1) + "\n")


def compare_made(root: Path, path: Path) -> list[Node]:
    """Compare the outputs here with a digest table; one node per entry.

    Other weights have the status ``recorded`` if processor or libraries differ, since these change the last bits.
    """
    table = read_json(path)
    if table["schema"] != SCHEMA:
        raise BadInput(path, f"schema {SCHEMA}", str(table["schema"]), "use the table of this version")
    table.check({"outputs": dict, "networks": dict, "processor": str, "libraries": dict})
    nodes = [_node("data", name, digest, dvc_digest(root / name)) for name, digest in table["outputs"].items()]
    recorded = {"processor": table["processor"], **table["libraries"]}
    current = {"processor": processor_name(), **library_versions()}
    changed = {name: value for name, value in current.items() if recorded.get(name) != value}
    environment = "; ".join(f"{name} {recorded.get(name)} there, {value} here" for name, value in changed.items())
    for name, digest in table["networks"].items():
        digest_here = payload_digest(root / name) if (root / name).is_file() else None
        node = _node("checkpoint", name, digest, digest_here)
        is_excused = node.status == "changed" and environment
        nodes.append(Node("checkpoint", name, "recorded", environment) if is_excused else node)
    return nodes


def _node(kind: Kind, name: str, expected: str, digest_here: str | None) -> Node:
    if digest_here is None:
        return Node(kind, name, "missing", "in the table, but not here")
    is_same = digest_here == expected
    return Node(kind, name, "same" if is_same else "changed", "" if is_same else "differs from the table")
