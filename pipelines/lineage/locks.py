"""What DVC noted of every stage it ran: dvc.lock of the project and of its families, today or as of a commit."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from hoidata.errors import BadInput

CACHE = Path(".dvc/cache/files/md5")
# Neither DVC (.dvcignore) nor we count these.
_IGNORED = {"__pycache__"}


@dataclass(frozen=True)
class Locked:
    """One run of a stage. deps and outs: MD5 by path (of a folder: of its listing, ending in ``.dir``)."""

    name: str
    params: dict[str, Any] = field(default_factory=dict)
    deps: dict[str, str] = field(default_factory=dict)
    outs: dict[str, str] = field(default_factory=dict)


def lock_files(root: Path) -> list[str]:
    """The dvc.lock files there are, relative to the project."""
    found = [root / "dvc.lock", *sorted(root.glob("models/*/dvc.lock"))]
    return [path.relative_to(root).as_posix() for path in found if path.is_file()]


def read_locks(root: Path) -> dict[str, Locked]:
    """The last run of every stage by its name; empty where nothing ever ran."""
    return parse_locks({name: (root / name).read_bytes() for name in lock_files(root)})


def parse_locks(texts: Mapping[str, bytes]) -> dict[str, Locked]:
    """The stages of lock files given by their paths. Raises BadInput for a file DVC cannot have written."""
    found = {}
    for file, text in texts.items():
        prefix = "" if file == "dvc.lock" else f"{file.removesuffix('lock')}yaml:"
        try:
            stages = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))["stages"]
            found |= {prefix + name: _locked(prefix + name, body) for name, body in stages.items()}
        except (yaml.YAMLError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise BadInput(file, "a lock file of DVC", type(error).__name__, "run `dvc repro`") from error
    return found


def _locked(name: str, body: dict[str, Any]) -> Locked:
    def digests(key: str) -> dict[str, str]:
        return {item["path"]: item.get("md5", "") for item in body.get(key) or ()}

    params = {key: value for values in (body.get("params") or {}).values() for key, value in values.items()}
    return Locked(name, params, digests("deps"), digests("outs"))


def dvc_digest(path: Path) -> str | None:
    """The MD5 by which DVC knows a file or folder; None when there is nothing."""
    if path.is_file():
        return _md5(path)
    if not path.is_dir():
        return None
    files = (item for item in path.rglob("*") if item.is_file() and not _IGNORED & set(item.parts))
    entries = {item.relative_to(path).as_posix(): _md5(item) for item in files if item.suffix != ".pyc"}
    return listing_digest(entries)


def listing_digest(entries: Mapping[str, str]) -> str:
    """The MD5 by which DVC knows a folder of these files, given by path and MD5."""
    listing = [{"md5": entries[path], "relpath": path} for path in sorted(entries, key=lambda path: path.split("/"))]
    return hashlib.md5(json.dumps(listing, sort_keys=True).encode()).hexdigest() + ".dir"


def cached_listing(root: Path, digest: str) -> dict[str, str]:
    """MD5 of the files of a folder by path, where DVC's cache still knows that folder."""
    path = root / CACHE / digest[:2] / digest[2:]
    try:
        return {item["relpath"]: item["md5"] for item in json.loads(path.read_bytes())}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _md5(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "md5").hexdigest()
