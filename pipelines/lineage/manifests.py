"""Manifests: which raw files a dataset consists of, without the files.

A manifest is small public JSON (relative paths, sizes, SHA-256, licence) that stands for raw data DVC never sees.
A folder of per-frame files is one entry, digested as ``RawTree.read_folder`` does.
"""

import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

from hoidata.clips.clip import SourceFile
from hoidata.datasets.base import Adapter, DatasetPart, RawTree
from hoidata.errors import BadInput
from hoidata.files import write_whole
from hoidata.settings import build_config

SCHEMA = "hoidata.manifest/1"
REMEDY = "restore it with git checkout, or write it again with `hoidata raw scan`"
FRAME_FILE = re.compile(r"\d{6}\.txt|\d{1,6}\.(?:json|pickle)")
NEVER_READ = re.compile(r"\.(png|jpe?g|mp4|avi|mkv|zip|tar|tgz|tar\.gz|part[a-z]*)$", re.IGNORECASE)


@dataclass(frozen=True)
class Manifest:
    """One dataset of one profile.

    present: False means the user does not have it: every stage of it is empty. source: ``generated`` from ``recipe``
    (then everything made from it is synthetic) or the user's ``files``. files: empty in a committed recipe.
    version: of the dataset's release. may_be_shared: the licence lets what is derived from it be passed on.
    """

    dataset: str
    present: bool
    source: Literal["generated", "files"]
    licence: str
    where_to_register: str = ""
    version: str = ""
    may_be_shared: bool = False
    recipe: dict[str, Any] | None = None
    files: tuple[SourceFile, ...] = ()

    @property
    def synthetic(self) -> bool:
        return self.source == "generated"

    @property
    def by_path(self) -> dict[str, SourceFile]:
        return {entry.path: entry for entry in self.files}

    def with_files(self, files: tuple[SourceFile, ...]) -> "Manifest":
        return replace(self, present=True, files=files)


def read_manifest(path: Path) -> Manifest:
    """Read a manifest. Raises BadInput when it is missing, no JSON, or of another schema."""
    try:
        values = json.loads(path.read_text())
    except FileNotFoundError as error:
        remedy = f"write it with `hoidata raw scan {path.stem}`, or restore it with git checkout"
        raise BadInput(path, "a manifest", "no file", remedy) from error
    except (ValueError, RecursionError, OSError) as error:
        raise BadInput(path, "a JSON manifest", str(error), "restore it, or run `hoidata raw scan`") from error
    if not isinstance(values, dict) or values.pop("schema", None) != SCHEMA:
        raise BadInput(path, f"schema {SCHEMA}", "another one", REMEDY)
    try:
        files = tuple(SourceFile(**entry) for entry in values.pop("files", ()))
    except TypeError as error:
        raise BadInput(path, "files with path, size and sha256", str(error), REMEDY) from error
    if not all(
        type(file.size) is int and isinstance(file.path, str) and isinstance(file.sha256, str) for file in files
    ):
        raise BadInput(path, "files with path, size and sha256", "other types of values", REMEDY)
    try:
        return replace(build_config(Manifest, values, str(path)), files=files)
    except BadInput as error:
        raise BadInput(error.where, error.expected, error.got, REMEDY) from error


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write a manifest, one line per file entry so that version control shows which one changed."""
    head = {"schema": SCHEMA, **{key: value for key, value in asdict(manifest).items() if key != "files"}}
    lines = json.dumps(head, indent=2, ensure_ascii=False)[:-2]
    entries = ",\n    ".join(json.dumps(asdict(entry), ensure_ascii=False) for entry in manifest.files)
    body = f"[\n    {entries}\n  ]" if manifest.files else "[]"
    write_whole(path, f'{lines},\n  "files": {body}\n}}\n')


def absent_manifest(adapter: Adapter) -> Manifest:
    """The manifest of a dataset the user does not have (yet)."""
    facts = {"version": adapter.version, "may_be_shared": adapter.may_be_shared}
    return Manifest(adapter.name, False, "files", adapter.licence, adapter.where_to_register, **facts)


# The hand of a profile for which no MANO files were scanned.
ABSENT_HAND = Manifest("hand", False, "files", "MANO: non-commercial research licence", "https://mano.is.tue.mpg.de")


def scan_files(root: Path, parts: Sequence[DatasetPart] | None = None) -> tuple[SourceFile, ...]:
    """Every raw file below ``root``, digested; images, videos and archives are passed over.

    parts: only files that one of these parts names (``Adapter.parts``), so that what no adapter reads is not hashed.
    """
    patterns = ["**"] if parts is None else [pattern for part in parts for pattern in part.patterns]
    tree = RawTree(root)
    for folder, names in _folders(root, "", [tuple(pattern.split("/")) for pattern in patterns]):
        if names and all(FRAME_FILE.fullmatch(name) for name in names):
            tree.read_folder(folder, names)
            continue
        for name in names:
            tree.file(f"{folder}/{name}" if folder else name)
    return tree.sources


def _folders(root: Path, folder: str, patterns: list[tuple[str, ...]]) -> Iterator[tuple[str, list[str]]]:
    """Each folder below root (as a relative path) with the sorted names of its data files that match a pattern.

    patterns: what is left of each below this folder, segment by segment; ``**`` stands for everything below.
    """
    entries = sorted(os.scandir(root / folder), key=lambda entry: entry.name)
    entries = [entry for entry in entries if not entry.name.startswith(".")]
    files = [entry.name for entry in entries if entry.is_file() and not NEVER_READ.search(entry.name)]
    yield folder, [name for name in files if any(len(rest) == 1 and _fits(name, rest[0]) for rest in patterns)]
    for entry in entries:
        below = [rest if rest[0] == "**" else rest[1:] for rest in patterns if _fits(entry.name, rest[0])]
        below = [rest for rest in below if rest]
        # A link to a folder it lies in would never end.
        endless = entry.is_symlink() and (root / folder).resolve().is_relative_to(Path(entry.path).resolve())
        if below and entry.is_dir() and not endless:
            yield from _folders(root, f"{folder}/{entry.name}" if folder else entry.name, below)


def _fits(name: str, segment: str) -> bool:
    return segment == "**" or fnmatchcase(name, segment)


def missing_parts(adapter: Adapter, root: Path) -> list[DatasetPart]:
    """The parts of a dataset of which nothing is below ``root``, required ones first."""
    return sorted((part for part in adapter.parts if not part.is_in(root)), key=lambda part: part.optional)


def part_of(adapter: Adapter, path: str) -> DatasetPart | None:
    """The part of the dataset a manifest entry belongs to; a folder of frame files is known by its files."""
    return next((part for part in adapter.parts if part.matches(path)), None)


@dataclass(frozen=True)
class Difference:
    """One entry that is not as the manifest says."""

    path: str
    problem: Literal["missing", "changed", "unlisted"]


def verify_files(root: Path, manifest: Manifest, parts: Sequence[DatasetPart] | None = None) -> list[Difference]:
    """How the files below ``root`` differ from the manifest; an empty list when they are those it lists.

    parts: as in ``scan_files``, and the same ones.
    """
    listed, found = manifest.by_path, {entry.path: entry for entry in scan_files(root, parts)}
    differences = [Difference(path, "missing") for path in listed if path not in found]
    differences += [Difference(path, "unlisted") for path in found if path not in listed]
    both = listed.keys() & found.keys()
    differences += [Difference(path, "changed") for path in both if listed[path].sha256 != found[path].sha256]
    return sorted(differences, key=lambda item: item.path)
