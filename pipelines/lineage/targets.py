"""The file that a lineage command is about, given by path or digest, and the record of its inputs.

The record of a checkpoint is in its header. That of a store, table or metric file is in dvc.lock, with MD5 instead of
SHA-256. A generated motion names its checkpoints.
"""

import json
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from hoidata.errors import BadInput
from hoidata.files.atomic import sha256_file
from hoidata.files.checksums import corrupted_part, payload_digest
from hoidata.files.numpy_files import load_npz_objects
from hoidata.files.written import read_json
from pipelines.lineage.history import History
from pipelines.lineage.locks import (
    Locked,
    cached_listing,
    dvc_digest,
    lock_files,
    parse_locks,
    producers_of,
    read_locks,
)
from pipelines.lineage.provenance import read_provenance

WEIGHTS = "model.safetensors"
SCHEMA_LOCK = "hoidata.lock/1"
MADE_FROM = "checkpoints"
Kind = Literal["checkpoint", "motion", "data", "manifest"]
_DIGEST = re.compile(r"[0-9a-f]{8,64}(\.dir)?")


@dataclass(frozen=True)
class Target:
    """A file, and the record of its inputs."""

    kind: Kind
    name: str  # its path, for display
    record: dict[str, Any]  # as from ``build_provenance``; for a motion, the SHA-256 of each checkpoint by path
    status: str = "same"  # of the file itself, not of its inputs
    note: str = ""

    @property
    def is_of_lock(self) -> bool:
        """Whether the record is from dvc.lock, so that its digests are DVC's MD5."""
        return self.record.get("schema") == SCHEMA_LOCK


def find_target(root: Path | None, path_or_digest: str, here: Path | None = None) -> Target:
    """The file with a path (relative to ``here``), or a digest that begins with these eight or more characters.

    Raises BadInput without such a file or without a record of its inputs.
    """
    path = (here or Path()) / path_or_digest
    if path.exists():
        return _target_at(root, path)
    if root is not None and _DIGEST.fullmatch(path_or_digest):
        return _target_of_digest(root, path_or_digest)
    expected = "a checkpoint, store, metric file or motion, or a digest of one"
    raise BadInput(path_or_digest, expected, "no file", "correct it")


def _target_at(root: Path | None, path: Path) -> Target:
    for name in (WEIGHTS, "motion.npz"):
        path = path / name if (path / name).is_file() else path
    # Links are not followed: files of the project may be links into DVC's cache.
    base, whole = (Path(os.path.abspath(root)) if root else None), Path(os.path.abspath(path))
    inside = base is not None and whole.is_relative_to(base)
    name = whole.relative_to(base).as_posix() if base is not None and inside else path.as_posix()
    if path.suffix == ".safetensors":
        return _checkpoint(root, path, name)
    if made_from := motion_checkpoints(path):
        return Target("motion", name, made_from)
    if root is None or not inside:
        raise BadInput(path, "a checkpoint or a generated motion", "something else", "run this inside its project")
    return _output(root, name)


def motion_checkpoints(path: Path) -> dict[str, str]:
    """The SHA-256 of each checkpoint that a generated motion names; empty for any other file."""
    if path.suffix != ".npz" or not path.is_file():
        return {}
    try:
        values = json.loads(str(load_npz_objects(path, [MADE_FROM])[MADE_FROM]))
    except (BadInput, ValueError, RecursionError):
        return {}
    return values if isinstance(values, dict) else {}


def _checkpoint(root: Path | None, path: Path, name: str) -> Target:
    try:
        record, fault = read_provenance(path), corrupted_part(path)
    except BadInput:
        # A file that a stage wrote as a checkpoint, and that is now damaged.
        if root is None or (stage := _producer(read_locks(root), name)) is None:
            raise
        record = lock_record(root, read_locks(root), stage)
        return Target("checkpoint", name, record, status="tampered", note="no readable header")
    target = Target("checkpoint", name, record)
    if fault:
        return replace(target, status="tampered", note=f"the {fault} differ from their checksum")
    recorded_in = _recorded_in(root, path, record["stage"]) if root else None
    if recorded_in == "":
        return replace(target, status="orphan", note="not in dvc.lock, neither the present nor a committed one")
    return replace(target, note=recorded_in or "")


def _recorded_in(root: Path, path: Path, stage: str) -> str | None:
    """The lock file with these bytes as output of ``stage``, in words; "" if none has, None without lock files."""
    if not lock_files(root):
        return None
    locks, history = read_locks(root, stage), History(root)
    digests = {dvc_digest(path), dvc_digest(path.parent) if len(list(path.parent.iterdir())) <= 4 else ""}

    def records_output(locks_of_file: dict[str, Locked]) -> bool:
        outs = locks_of_file[stage].outs.values() if stage in locks_of_file else ()
        return any({out, *cached_listing(root, out).values()} & digests for out in outs)

    if records_output(locks):
        return "in dvc.lock"
    searched = set()
    for commit, file, content in history.versions(_possible_locks(root)):
        if content not in searched and records_output(parse_locks({file: content})):
            return f"in {file} of commit {commit[:10]}"
        searched.add(content)
    return ""


def _possible_locks(root: Path) -> list[str]:
    families = (path.relative_to(root).with_suffix(".lock").as_posix() for path in root.glob("models/*/dvc.yaml"))
    return list(dict.fromkeys(["dvc.lock", *families, *lock_files(root)]))


def _producer(locks: dict[str, Locked], path: str) -> str | None:
    """The stage that wrote a path or one of its parent folders."""
    producers = {out: stage.name for stage in locks.values() for out in stage.outs}
    return next((producers[name] for name in (path, *map(str, Path(path).parents)) if name in producers), None)


def _output(root: Path, name: str) -> Target:
    locks = read_locks(root)
    producer = _producer(locks, name)
    if producer is None:
        remedy = "name a checkpoint, a generated motion, or an output of a stage of dvc.yaml"
        raise BadInput(name, "a file with a record of its inputs", "none in dvc.lock", remedy)
    out = next(out for out in locks[producer].outs if Path(name).is_relative_to(out))
    same = dvc_digest(root / out) == locks[producer].outs[out]
    note = "in dvc.lock" if same else "differs from dvc.lock"
    record = lock_record(root, locks, producer)
    return Target("data", name, record, status="same" if same else "tampered", note=note)


def lock_record(root: Path, locks: dict[str, Locked], stage: str) -> dict[str, Any]:
    """The entries of a stage and all upstream stages in dvc.lock, in the form of a checkpoint's provenance."""
    order, inputs = [stage], {path for lock in locks.values() for path in lock.deps}
    # Methods that params.yaml does not list any more may be in a lock file without outputs.
    outs = ((out, lock.name) for lock in locks.values() for out in lock.outs)
    makers = {out: name for out, name in outs if out in inputs or (root / out).exists()}
    for name in order:
        upstream = (producer for path in locks[name].deps for producer in producers_of(makers, path))
        order += [producer for producer in dict.fromkeys(upstream) if producer not in (*order, "code")]
    stages = {name: _lock_stage(root, locks[name]) for name in dict.fromkeys(order)}
    return {"schema": SCHEMA_LOCK, "stage": stage, "stages": stages}


def _lock_stage(root: Path, lock: Locked) -> dict[str, Any]:
    code = {path: digest for path, digest in lock.deps.items() if path.startswith("code/")}
    files: dict[str, str] = {}
    for path, digest in code.items():
        files |= read_json(root / path) if dvc_digest(root / path) == digest else {path: digest}
    inputs = {path: digest for path, digest in lock.deps.items() if path not in code}
    return {"params": lock.params, "code": files, "inputs": inputs, "outputs": lock.outs}


def _target_of_digest(root: Path, digest: str) -> Target:
    """File with a digest: SHA-256 of a checkpoint or its weights, or MD5 of an output in dvc.lock or its history."""
    for path in sorted(root.glob("checkpoints/**/*.safetensors")):
        digests = (payload_digest(path), sha256_file(path), dvc_digest(path) or "")
        if any(one.startswith(digest) for one in digests):
            return _target_at(root, path)
    locks = read_locks(root)
    for lock in locks.values():
        if path := _out_with(root, lock, digest):
            is_there = (root / path).exists()
            return _target_at(root, root / path) if is_there else _missing_target(root, locks, lock.name, path)
    history, files = History(root), _possible_locks(root)
    if commit := history.commit_with(digest, files):
        locks_then = parse_locks({file: text for file in files if (text := history.text(commit, file))})
        for lock in locks_then.values():
            if path := _out_with(root, lock, digest):
                note = f"recorded in commit {commit[:10]}; the file has changed since"
                return replace(_missing_target(root, locks_then, lock.name, path), note=note)
    raise BadInput(digest, "the digest of an output of this project", "none in dvc.lock or git", "name its path")


def _out_with(root: Path, lock: Locked, digest: str) -> str | None:
    """The output, or the file in an output, with a digest."""
    for path, md5 in lock.outs.items():
        if md5.startswith(digest):
            return path
        for name, file_md5 in cached_listing(root, md5).items():
            if file_md5.startswith(digest):
                return f"{path}/{name}"
    return None


def _missing_target(root: Path, locks: dict[str, Locked], stage: str, path: str) -> Target:
    kind: Kind = "checkpoint" if path.startswith("checkpoints/") else "data"
    record = lock_record(root, locks, stage)
    return Target(kind, path, record, status="missing", note="in dvc.lock, but not here")
