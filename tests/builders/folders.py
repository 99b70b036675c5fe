"""Folders of small text files."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


def write_text(root: Path, files: Mapping[str, str]) -> Path:
    """Write each text to its path below ``root``, which is returned."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


@contextmanager
def kept(path: Path) -> Iterator[bytes]:
    """Gives the bytes of a file, and puts them back however the block ends."""
    whole = path.read_bytes()
    try:
        yield whole
    finally:
        path.write_bytes(whole)


@contextmanager
def moved(path: Path, aside: Path) -> Iterator[None]:
    """A file or folder is elsewhere meanwhile."""
    shutil.move(path, aside)
    try:
        yield
    finally:
        shutil.move(aside, path)
