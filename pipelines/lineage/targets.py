"""What ``hoidata lineage`` is asked about, by path or digest, with the record of how it was made.

A checkpoint carries its record; a store, table or metric file has that of dvc.lock, where digests are MD5 instead of
SHA-256; a generated motion names its checkpoints.
"""

import json
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from hoidata.errors import BadInput
from hoidata.files.atomic import sha256_file
from hoidata.files.numpy_files import load_npz_objects
from hoidata.files.sealed import payload_digest, seal_fault
from hoidata.files.written import read_json
from pipelines.lineage.history import History
from pipelines.lineage.locks import Locked, cached_listing, dvc_digest, lock_files, parse_locks, read_locks
from pipelines.lineage.provenance import read_provenance

WEIGHTS = "model.safetensors"
SCHEMA_LOCK = "hoidata.lock/1"
MADE_FROM = "checkpoints"
Kind = Literal["checkpoint", "motion", "data", "manifest"]
_DIGEST = re.compile(r"[0-9a-f]{8,64}(\.dir)?")


@dataclass(frozen=True)
class Target:
    """name: the path as shown. status and note: of its own bytes, whatever it was made from.

    record: as ``build_provenance`` gives it; of a motion instead the SHA-256 of each checkpoint by path.
    """

    kind: Kind
    name: str
    record: dict[str, Any]
    status: str = "same"
    note: str = ""

    @property
    def is_of_lock(self) -> bool:
        """Whether the record's digests are DVC's."""
        return self.record.get("schema") == SCHEMA_LOCK


def find_target(root: Path | None, words: str, here: Path | None = None) -> Target:
    """What a path (relative to ``here``) or a digest means. root: the project, None outside of any.

    Raises BadInput where nothing is found, or no record of how it was made.
    """
    path = (here or Path()) / words
    if path.exists():
        return _target_at(root, path)
    if root is not None and _DIGEST.fullmatch(words):
        return _target_of_digest(root, words)
    raise BadInput(words, "a checkpoint, store, metric file or motion, or a digest of one", "no file", "correct it")


def _target_at(root: Path | None, path: Path) -> Target:
    for name in (WEIGHTS, "motion.npz"):
        path = path / name if (path / name).is_file() else path
    # Links are not followed: DVC may keep what lies in the project elsewhere.
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
    """The SHA-256 of each checkpoint a generated motion names; empty for any other file."""
    if path.suffix != ".npz" or not path.is_file():
        return {}
    try:
        values = json.loads(str(load_npz_objects(path, [MADE_FROM])[MADE_FROM]))
    except (BadInput, ValueError, RecursionError):
        return {}
    return values if isinstance(values, dict) else {}


def _checkpoint(root: Path | None, path: Path, name: str) -> Target:
    try:
        record, fault = read_provenance(path), seal_fault(path)
    except BadInput:
        # What DVC wrote as a checkpoint and is none any more.
        if root is None or (made := _maker(read_locks(root), name)) is None:
            raise
        return Target("checkpoint", name, lock_record(root, read_locks(root), made), "tampered", "no readable header")
    target = Target("checkpoint", name, record)
    if fault:
        return replace(target, status="tampered", note=f"the {fault} are not what was written")
    if root is None:
        return target
    found = _where_recorded(root, path, record["stage"])
    if found is None:
        return target
    return replace(
        target, status="same" if found else "orphan", note=found or "no dvc.lock here, now or before, knows it"
    )


def _where_recorded(root: Path, path: Path, stage: str) -> str | None:
    """Where DVC noted these bytes as made by ``stage``, in words; "" for nowhere, None where it noted nothing."""
    if not lock_files(root):
        return None
    locks, history = read_locks(root, stage), History(root)
    digests = {dvc_digest(path), dvc_digest(path.parent) if len(list(path.parent.iterdir())) <= 4 else ""}

    def knows(of: dict[str, Locked]) -> bool:
        outs = of[stage].outs.values() if stage in of else ()
        return any({out, *cached_listing(root, out).values()} & digests for out in outs)

    if knows(locks):
        return "in dvc.lock"
    seen = set()
    for commit, file, content in history.versions(_possible_locks(root)):
        if content not in seen and knows(parse_locks({file: content})):
            return f"in {file} of commit {commit[:10]}"
        seen.add(content)
    return ""


def _possible_locks(root: Path) -> list[str]:
    families = (path.relative_to(root).with_suffix(".lock").as_posix() for path in root.glob("models/*/dvc.yaml"))
    return list(dict.fromkeys(["dvc.lock", *families, *lock_files(root)]))


def _maker(locks: dict[str, Locked], path: str) -> str | None:
    """The stage that made a path, or a folder it lies in."""
    made = {out: stage.name for stage in locks.values() for out in stage.outs}
    return next((made[name] for name in (path, *map(str, Path(path).parents)) if name in made), None)


def _output(root: Path, name: str) -> Target:
    locks = read_locks(root)
    maker = _maker(locks, name)
    if maker is None:
        remedy = "name a checkpoint, a generated motion, or what a stage of dvc.yaml made"
        raise BadInput(name, "something with a record of how it was made", "none in dvc.lock", remedy)
    out = next(out for out in locks[maker].outs if Path(name).is_relative_to(out))
    same = dvc_digest(root / out) == locks[maker].outs[out]
    note = "in dvc.lock" if same else "not what the stage wrote, by dvc.lock"
    return Target("data", name, lock_record(root, locks, maker), "same" if same else "tampered", note)


def lock_record(root: Path, locks: dict[str, Locked], stage: str) -> dict[str, Any]:
    """What dvc.lock notes of a stage and of all behind it, in the form of a checkpoint's provenance."""
    made, order = {out: lock.name for lock in locks.values() for out in lock.outs}, [stage]
    for name in order:
        order += [made[path] for path in locks[name].deps if path in made and made[path] not in (*order, "code")]
    stages = {name: _lock_stage(root, locks[name]) for name in dict.fromkeys(order)}
    return {"schema": SCHEMA_LOCK, "stage": stage, "stages": stages}


def _lock_stage(root: Path, lock: Locked) -> dict[str, Any]:
    code = {path: digest for path, digest in lock.deps.items() if path.startswith("code/")}
    files: dict[str, str] = {}
    for path, digest in code.items():
        known = dvc_digest(root / path) == digest
        files |= read_json(root / path) if known else {path: digest}
    inputs = {path: digest for path, digest in lock.deps.items() if path not in code}
    return {"params": lock.params, "code": files, "inputs": inputs, "outputs": lock.outs}


def _target_of_digest(root: Path, digest: str) -> Target:
    """What has a digest: of a checkpoint's tensors or file (SHA-256), of any output as DVC has it (MD5), ever."""
    for path in sorted(root.glob("checkpoints/**/*.safetensors")):
        if any(found.startswith(digest) for found in (payload_digest(path), sha256_file(path), dvc_digest(path) or "")):
            return _target_at(root, path)
    locks = read_locks(root)
    for lock in locks.values():
        if path := _out_with(root, lock, digest):
            return _target_at(root, root / path) if (root / path).exists() else _gone(root, locks, lock.name, path)
    history = History(root)
    files = _possible_locks(root)
    if commit := history.commit_with(digest, files):
        texts = {file: text for file in files if (text := history.text(commit, file))}
        then = parse_locks(texts)
        for lock in then.values():
            if path := _out_with(root, lock, digest):
                note = f"made as of commit {commit[:10]}; other bytes lie there now"
                return replace(_gone(root, then, lock.name, path), note=note)
    raise BadInput(digest, "the digest of something made here", "no such digest in dvc.lock or git", "name its path")


def _out_with(root: Path, lock: Locked, digest: str) -> str | None:
    """The output, or the file in one, that has a digest."""
    for path, md5 in lock.outs.items():
        if md5.startswith(digest):
            return path
        inside = (f"{path}/{name}" for name, found in cached_listing(root, md5).items() if found.startswith(digest))
        if found := next(inside, None):
            return found
    return None


def _gone(root: Path, locks: dict[str, Locked], stage: str, path: str) -> Target:
    kind: Kind = "checkpoint" if path.startswith("checkpoints/") else "data"
    return Target(kind, path, lock_record(root, locks, stage), "missing", "noted in dvc.lock, no longer here")
