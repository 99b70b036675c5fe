"""Manifests: the list of a dataset's raw files, which DVC tracks instead of the files.

A manifest is a small public JSON file with relative paths, sizes, SHA-256 and the licence. A folder of per-frame files
is one entry, with the digest of ``RawTree.read_folder``.
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
    """The raw files of one dataset in one profile."""

    dataset: str
    present: bool  # False: the user does not have the dataset, and all its stages give empty outputs
    source: Literal["generated", "files"]  # "generated" data is synthetic
    licence: str
    where_to_register: str = ""
    version: str = ""  # of the dataset's release
    may_be_shared: bool = False  # whether the licence permits sharing derived data
    recipe: dict[str, Any] | None = None  # seed and size of a generated corpus
    files: tuple[SourceFile, ...] = ()  # empty in a committed manifest with a recipe

    @property
    def synthetic(self) -> bool:
        return self.source == "generated"

    def with_files(self, files: tuple[SourceFile, ...]) -> "Manifest":
        return replace(self, present=True, files=files)


def read_manifest(path: Path) -> Manifest:
    """Read a manifest. Raises BadInput if it is missing, is not JSON, or has another schema."""
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
        if {(type(file.path), type(file.size), type(file.sha256)) for file in files} - {(str, int, str)}:
            raise TypeError("other types of values")
    except TypeError as error:
        raise BadInput(path, "files with path, size and sha256", str(error), REMEDY) from error
    try:
        return replace(build_config(Manifest, values, str(path)), files=files)
    except BadInput as error:
        raise BadInput(error.where, error.expected, error.got, REMEDY) from error


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write a manifest, with one line per file entry for readable diffs."""
    head = {"schema": SCHEMA, **{key: value for key, value in asdict(manifest).items() if key != "files"}}
    lines = json.dumps(head, indent=2, ensure_ascii=False)[:-2]
    entries = ",\n    ".join(json.dumps(asdict(entry), ensure_ascii=False) for entry in manifest.files)
    body = f"[\n    {entries}\n  ]" if manifest.files else "[]"
    write_whole(path, f'{lines},\n  "files": {body}\n}}\n')


def absent_manifest(adapter: Adapter) -> Manifest:
    """The manifest of a dataset that the user does not have."""
    return Manifest(
        dataset=adapter.name,
        present=False,
        source="files",
        licence=adapter.licence,
        where_to_register=adapter.where_to_register,
        version=adapter.version,
        may_be_shared=adapter.may_be_shared,
    )


# The hand model of a profile without scanned MANO files.
ABSENT_HAND = Manifest("hand", False, "files", "MANO: non-commercial research licence", "https://mano.is.tue.mpg.de")


def scan_files(root: Path, parts: Sequence[DatasetPart] | None = None) -> tuple[SourceFile, ...]:
    """Hash all raw files of ``parts`` (None: all) below ``root`` except images, videos and archives."""
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
    """All folders at and below ``folder``, relative to root, with the sorted names of data files that match a pattern.

    ``patterns`` has the remaining path segments of each glob pattern; ``**`` matches everything below.
    """
    entries = sorted(os.scandir(root / folder), key=lambda entry: entry.name)
    entries = [entry for entry in entries if not entry.name.startswith(".")]
    files = [entry.name for entry in entries if entry.is_file() and not NEVER_READ.search(entry.name)]
    last_segments = [segments[0] for segments in patterns if len(segments) == 1]
    yield folder, [name for name in files if any(_fits(name, segment) for segment in last_segments)]
    for entry in entries:
        fitting = (segments for segments in patterns if _fits(entry.name, segments[0]))
        remaining = [rest for segments in fitting if (rest := segments if segments[0] == "**" else segments[1:])]
        # A link to one of its parent folders would recurse forever.
        is_recursive = entry.is_symlink() and (root / folder).resolve().is_relative_to(Path(entry.path).resolve())
        if remaining and entry.is_dir() and not is_recursive:
            yield from _folders(root, f"{folder}/{entry.name}" if folder else entry.name, remaining)


def _fits(name: str, segment: str) -> bool:
    return segment == "**" or fnmatchcase(name, segment)


def missing_parts(adapter: Adapter, root: Path) -> list[DatasetPart]:
    """The parts of a dataset without any file below ``root``, required parts first."""
    return sorted((part for part in adapter.parts if not part.is_in(root)), key=lambda part: part.optional)


def part_of(adapter: Adapter, path: str) -> DatasetPart | None:
    """The part of the dataset that a manifest entry belongs to, or None."""
    return next((part for part in adapter.parts if part.matches(path)), None)


@dataclass(frozen=True)
class Difference:
    """An entry that differs from the manifest."""

    path: str
    problem: Literal["missing", "changed", "unlisted"]


def verify_files(root: Path, manifest: Manifest, parts: Sequence[DatasetPart] | None = None) -> list[Difference]:
    """The differences between the files below ``root`` and the manifest; ``parts`` as for ``scan_files``."""
    listed, present = ({entry.path: entry for entry in files} for files in (manifest.files, scan_files(root, parts)))
    differences = [Difference(path, "missing") for path in listed if path not in present]
    differences += [Difference(path, "unlisted") for path in present if path not in listed]
    both = listed.keys() & present.keys()
    differences += [Difference(path, "changed") for path in both if listed[path].sha256 != present[path].sha256]
    return sorted(differences, key=lambda item: item.path)
