"""Every byte looked at again: outputs against dvc.lock, checkpoints against seals, raw files against manifests."""

from collections.abc import Iterator
from pathlib import Path

from hoidata.errors import BadInput
from hoidata.files.sealed import seal_fault
from pipelines.lineage.locks import Locked, other_files, read_locks
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
