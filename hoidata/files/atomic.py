"""Writing that leaves either the old file or the whole new one, never half of one; and one writer at a time.

Also content digests and canonical JSON: equal content, equal bytes.
"""

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

from filelock import FileLock, Timeout

from hoidata.errors import BadInput

# A run that was killed may leave workers behind for the moment they need to notice it.
_WAIT_S = 10.0


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``; rename it over ``path`` when the block ends without an error."""
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
    """Write bytes, or text as UTF-8, whole or not at all; gives the file's path."""
    with atomic_file(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return Path(path)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Give an empty temporary folder beside ``path``; put it in the place of ``path`` when the block ends well.

    The old folder is moved aside whole before it is deleted: a process killed meanwhile leaves nothing of it here.
    What writers of ``path`` that were killed left beside it is deleted first.
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
    """Delete what killed writers of ``path`` left beside it; an old folder they had moved aside goes back first.

    Only for the one who holds ``exclusive(path)``: a living writer's files look the same.
    """
    _remove(Path(path), _leftovers(Path(path)))


def remove_dead_leftovers(path: str | Path) -> None:
    """As ``remove_leftovers``, of those writers alone whose process on this machine has ended. For everyone."""
    _remove(Path(path), [left for left in _leftovers(Path(path)) if _is_dead(left.name)])


def _leftovers(path: Path) -> list[Path]:
    """Temporary files and folders of writers of ``path``, killed or at work."""
    if not path.parent.is_dir():
        return []
    pattern = re.compile(rf"\.{re.escape(path.name)}\.[^.]+\.(part|old)")
    return sorted(item for item in path.parent.iterdir() if pattern.fullmatch(item.name))


def _remove(path: Path, left: Iterable[Path]) -> None:
    for item in left:
        if item.suffix == ".old" and not path.exists():
            os.replace(item, path)
    for item in left:
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item, ignore_errors=True)  # another process may delete it at this moment
        else:
            item.unlink(missing_ok=True)


def _machine() -> str:
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def _writer() -> str:
    """Part of the names of temporary files: this machine and process."""
    return f"{_machine()}-{os.getpid()}"


def _is_dead(name: str) -> bool:
    """Whether the writer in a temporary file's name was a process of this machine and has ended."""
    writer = re.search(rf"\.{_machine()}-([0-9]+)-[^.]+\.(part|old)$", name)
    if not writer:
        return False
    try:
        os.kill(int(writer[1]), 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        return False
    return False


@contextmanager
def exclusive(path: str | Path, wait_s: float = _WAIT_S) -> Iterator[int]:
    """Hold the one right to write ``path``; gives the file descriptor of the lock ``.<name>.lock`` beside it.

    The system frees the lock when the last process that has the descriptor ends, however it ends. Raises BadInput
    when another process still holds it after ``wait_s`` seconds.
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
        raise BadInput(path, "nobody else to write it", got, remedy) from None
    try:
        lock.write_text(str(os.getpid()))
        yield descriptors[0]
    finally:
        lock.unlink(missing_ok=True)  # while it is held: filelock holds none on a file that has lost its name
        holding.release()


def sha256_bytes(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: str | Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def canonical_json(value: Any) -> str:
    """JSON with sorted keys and no spaces; refuses NaN and infinity (ValueError)."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
