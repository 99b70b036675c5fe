"""SHA-256 digests of files, folders and JSON values."""

from pathlib import Path

from hoidata.files import canonical_json, sha256_bytes, sha256_file

COMPILED = {"__pycache__"}


def path_digest(path: Path) -> str | None:
    """SHA-256 of a file, or of a folder's sorted ``digest  relative path`` lines; None if the path does not exist.

    Compiled Python and hidden files do not count.
    """
    if path.is_file():
        return sha256_file(path)
    if not path.is_dir():
        return None
    files = sorted(item for item in path.rglob("*") if item.is_file() and not _is_noise(item.relative_to(path)))
    lines = [f"{sha256_file(item)}  {item.relative_to(path).as_posix()}\n" for item in files]
    return sha256_bytes("".join(lines).encode())


def _is_noise(path: Path) -> bool:
    return path.suffix == ".pyc" or any(part in COMPILED or part.startswith(".") for part in path.parts)


def value_digest(value: object) -> str:
    """SHA-256 of a JSON value in canonical form."""
    return sha256_bytes(canonical_json(value).encode())
