"""The dvc.lock files of the project and its model families, in the working tree or in a commit."""

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.written import md5_file
from pipelines.params import load_yaml

CACHE = Path(".dvc/cache/files/md5")
# Ignored here and by DVC (.dvcignore): compiled code and unfinished files.
_IGNORED = re.compile(r"__pycache__|.*\.pyc|\..*\.(work|part|old|lock)")


@dataclass(frozen=True)
class Locked:
    """The entry of one stage in a dvc.lock: its last run."""

    name: str
    params: dict[str, Any] = field(default_factory=dict)
    deps: dict[str, str] = field(default_factory=dict)  # MD5 by path; of a folder the MD5 of its listing, with ".dir"
    outs: dict[str, str] = field(default_factory=dict)  # likewise


def lock_files(root: Path) -> list[str]:
    """The existing dvc.lock files, relative to the project."""
    files = [root / "dvc.lock", *sorted(root.glob("models/*/dvc.lock"))]
    return [path.relative_to(root).as_posix() for path in files if path.is_file()]


def read_locks(root: Path, stage: str = "") -> dict[str, Locked]:
    """The last run of each stage, or, faster, of those in the lock file of ``stage``; empty before the first run."""
    file = stage.rpartition(":")[0].removesuffix("yaml") + "lock" if ":" in stage else "dvc.lock"
    return parse_locks({name: (root / name).read_bytes() for name in lock_files(root) if not stage or name == file})


def parse_locks(texts: Mapping[str, bytes]) -> dict[str, Locked]:
    """The stages in the contents of lock files, given by path. Raises BadInput for a malformed file."""
    locks = {}
    for file, text in texts.items():
        prefix = "" if file == "dvc.lock" else f"{file.removesuffix('lock')}yaml:"
        try:
            stages = load_yaml(text)["stages"]
            locks |= {prefix + name: _locked(prefix + name, body) for name, body in stages.items()}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            remedy = "if a run is just writing it, try again; else run `hoidata repro`"
            raise BadInput(file, "a lock file of DVC", type(error).__name__, remedy) from error
    return locks


def _locked(name: str, body: dict[str, Any]) -> Locked:
    def digests(key: str) -> dict[str, str]:
        return {item["path"]: item.get("md5", "") for item in body.get(key) or ()}

    params = {key: value for values in (body.get("params") or {}).values() for key, value in values.items()}
    return Locked(name, params, digests("deps"), digests("outs"))


def producers_of(makers: Mapping[str, str], path: str) -> list[str]:
    """The stages with an output that is the path, in it or around it. makers: the stage of each output."""
    folder = f"{path}/"
    stages = [stage for out, stage in makers.items() if f"{out}/".startswith(folder) or folder.startswith(f"{out}/")]
    return list(dict.fromkeys(stages))


def dvc_digest(path: Path) -> str | None:
    """DVC's MD5 of a file or folder; None if it does not exist."""
    if path.is_file():
        return md5_file(path)
    if not path.is_dir():
        return None
    return listing_digest({name: md5_file(path / name) for name in _files_below(path)})


def _files_below(folder: Path) -> list[str]:
    """The files that are not ignored, relative to the folder."""
    names = [item.relative_to(folder) for item in folder.rglob("*") if item.is_file()]
    return [name.as_posix() for name in names if not any(map(_IGNORED.fullmatch, name.parts))]


def listing_digest(entries: Mapping[str, str]) -> str:
    """DVC's MD5 of a folder, from the MD5 of its files by path."""
    listing = [{"md5": entries[path], "relpath": path} for path in sorted(entries)]
    return hashlib.md5(json.dumps(listing, sort_keys=True).encode()).hexdigest() + ".dir"


def cached_listing(root: Path, digest: str) -> dict[str, str]:
    """MD5 of the files of a folder by path, from DVC's cache; empty if the cache does not have it."""
    path = root / CACHE / digest[:2] / digest[2:]
    try:
        return {item["relpath"]: item["md5"] for item in json.loads(path.read_bytes())}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def outdated_samples(root: Path, profile: str, dataset: str) -> dict[str, str]:
    """Methods whose metrics are older than an input, by name, with the path of that input. Reads only lock files.

    The inputs are those of the sampled motions, direct or indirect, and the motions themselves.
    """
    locks, folder = read_locks(root), f"samples/{profile}/{dataset}"
    makers = {out: lock for lock in locks.values() for out in lock.outs}
    evaluated = locks.get(f"evaluate@{profile}-{dataset}", Locked("")).deps.get(folder, "")
    measured = cached_listing(root, evaluated)

    def changed_input(lock: Locked) -> str:
        inputs = [(path, digest, makers[path]) for path, digest in lock.deps.items() if path in makers]
        changed = (path for path, digest, maker in inputs if maker.outs[path] != digest)
        return next(changed, "") or next(filter(None, (changed_input(maker) for *_, maker in inputs)), "")

    def outdated(path: str) -> str:
        start = f"{path.removeprefix(folder)[1:]}/"
        files = {name.removeprefix(start): md5 for name, md5 in measured.items() if name.startswith(start)}
        is_measured = not measured or listing_digest(files) == makers[path].outs[path]
        return changed_input(makers[path]) if is_measured else path

    samples = [path for path in makers if path.startswith(f"{folder}/")]
    return {Path(path).name: cause for path in samples if (cause := outdated(path))}


def written_digest(path: Path) -> str | None:
    """The MD5 that a file had when its stage wrote it, from dvc.lock of its project; None if not recorded."""
    path = Path(os.path.abspath(path))
    root = next((folder for folder in path.parents if (folder / "dvc.lock").is_file()), None)
    if root is None:
        return None
    stamps = tuple((root / name).stat().st_mtime_ns for name in lock_files(root))
    return _written_digests(root, stamps).get(path.relative_to(root).as_posix())


@cache
def _written_digests(root: Path, _stamps: tuple[int, ...]) -> dict[str, str]:
    return {path: md5 for lock in read_locks(root).values() for path, md5 in written_files(root, lock).items()}


def written_files(root: Path, lock: Locked) -> dict[str, str]:
    """MD5 by path of all files a stage wrote, if DVC's cache still has the listings of its folders."""
    files = {}
    for out, md5 in lock.outs.items():
        if not md5.endswith(".dir"):
            files[out] = md5
        files |= {f"{out}/{name}": digest for name, digest in cached_listing(root, md5).items()}
    return files


def other_files(root: Path, lock: Locked, out: str) -> list[str]:
    """The files of one output that its stage did not write like this: changed, missing and additional files.

    The output itself if the cache has no listing of its files.
    """
    if dvc_digest(root / out) == lock.outs[out]:
        return []
    before = {path: md5 for path, md5 in written_files(root, lock).items() if Path(path).is_relative_to(out)}
    if not before:
        return [out]
    names = {*before, *(f"{out}/{name}" for name in _files_below(root / out))}
    return sorted(name for name in names if dvc_digest(root / name) != before.get(name))
