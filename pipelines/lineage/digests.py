"""SHA-256 digests of files, folders and JSON values."""

import re
from pathlib import Path

from hoidata.files import canonical_json, sha256_bytes, sha256_file

_NOISE = re.compile(r"\.|__pycache__$")


def path_digest(path: Path) -> str | None:
    """SHA-256 of a file, or of a folder's sorted ``digest  relative path`` lines; None if the path does not exist.

    Compiled Python and hidden files do not count.
    """
    if path.is_file():
        return sha256_file(path)
    if not path.is_dir():
        return None
    names = (item.relative_to(path) for item in sorted(path.rglob("*")) if item.is_file())
    files = (name for name in names if name.suffix != ".pyc" and not any(map(_NOISE.match, name.parts)))
    return sha256_bytes("".join(f"{sha256_file(path / name)}  {name.as_posix()}\n" for name in files).encode())


def value_digest(value: object) -> str:
    """SHA-256 of a JSON value in canonical form."""
    return sha256_bytes(canonical_json(value).encode())
