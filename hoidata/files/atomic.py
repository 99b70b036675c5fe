"""Atomic writes of files and folders, exclusive locks, content digests and canonical JSON."""

import hashlib
import json
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from filelock import FileLock, Timeout

from hoidata.errors import BadInput

# Workers of a killed run need a moment to notice it.
_WAIT_S = 10.0


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``, and rename it to ``path`` if the block ends without an error."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.{_writer()}-", suffix=".part", dir=path.parent)
    os.close(handle)
    partial = Path(name)
    partial.chmod(0o644)
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: str | Path, content: str | bytes) -> Path:
    """Write bytes, or text as UTF-8, atomically. Returns the file's path."""
    with atomic_file(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return Path(path)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield an empty temporary folder next to ``path``, and replace ``path`` by it if the block ends without an error.

    The old folder is renamed before its deletion, so a killed process leaves no partly deleted folder at ``path``.
    Leftovers of killed writers of ``path`` are deleted first.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_dead_leftovers(path)
    partial = Path(tempfile.mkdtemp(prefix=f".{path.name}.{_writer()}-", suffix=".part", dir=path.parent))
    partial.chmod(0o755)
    try:
        yield partial
        old = partial.with_suffix(".old")
        if path.exists():
            os.replace(path, old)
        os.replace(partial, path)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def remove_leftovers(path: str | Path) -> None:
    """Delete leftovers of killed writers next to ``path``, after restoring an old folder that they had renamed.

    Requires ``exclusive(path)``, because a running writer's files look the same.
    """
    _remove(Path(path), _leftovers(Path(path)))


def remove_dead_leftovers(path: str | Path) -> None:
    """As ``remove_leftovers``, for writers whose process on this machine has ended. Requires no lock."""
    _remove(Path(path), [item for item in _leftovers(Path(path)) if _is_dead(item.name)])


def _leftovers(path: Path) -> list[Path]:
    """Temporary files and folders of writers of ``path``, killed or running."""
    if not path.parent.is_dir():
        return []
    pattern = re.compile(rf"\.{re.escape(path.name)}\.[^.]+\.(part|old)")
    return sorted(item for item in path.parent.iterdir() if pattern.fullmatch(item.name))


def _remove(path: Path, leftovers: Iterable[Path]) -> None:
    for item in leftovers:
        if item.suffix == ".old" and not path.exists():
            os.replace(item, path)
    for item in leftovers:
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item, ignore_errors=True)  # another process may delete it at this moment
        else:
            item.unlink(missing_ok=True)


def _machine() -> str:
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def _writer() -> str:
    """This machine and process, as part of a temporary file's name."""
    return f"{_machine()}-{os.getpid()}"


def _is_dead(name: str) -> bool:
    """Whether the writer in a temporary file's name is a process of this machine that has ended."""
    writer = re.search(rf"\.{_machine()}-([0-9]{{1,9}})-[^.]+\.(part|old)$", name)
    return writer is not None and not psutil.pid_exists(int(writer[1]))


@contextmanager
def exclusive(path: str | Path, wait_s: float = _WAIT_S) -> Iterator[int]:
    """Lock ``path`` for writing. Yields the file descriptor of the lock file ``.<name>.lock`` next to it.

    The system releases the lock when the last process with the descriptor ends. Raises BadInput if another process
    still has the lock after ``wait_s`` seconds.
    """
    path, descriptors = Path(path), []
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.parent / f".{path.name}.lock"
    holding = FileLock(lock, wait_s, on_acquired=descriptors.append)
    try:
        holding.acquire()
    except Timeout:
        holder = lock.read_text() if lock.exists() else ""
        got = f"process {holder or 'unknown'} at work on it"
        remedy = "wait for that run to end, or end it, and run again"
        raise BadInput(path, "no other writer", got, remedy) from None
    try:
        lock.write_text(str(os.getpid()))
        yield descriptors[0]
    finally:
        lock.unlink(missing_ok=True)  # before the release: another process must not lock a deleted file
        holding.release()


def sha256_bytes(data: bytes) -> str:
    """SHA-256 of bytes as hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: str | Path) -> str:
    """SHA-256 of a file as hexadecimal digits."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def canonical_json(value: Any) -> str:
    """JSON with sorted keys and no spaces; refuses NaN and infinity (ValueError)."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
