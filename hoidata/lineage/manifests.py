"""Manifests: which raw files a dataset consists of, without the files.

A manifest is small public JSON (relative paths, sizes, SHA-256, licence) that stands for raw data DVC never sees.
A folder of per-frame text files is one entry, digested as ``RawTree.read_folder`` does.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from hoidata.adapters.base import RawTree
from hoidata.errors import BadInput
from hoidata.files import atomic_file
from hoidata.schema.clip import SourceFile

SCHEMA = "hoidata.manifest/1"
FRAME_FILE = re.compile(r"\d{6}\.txt")
NEVER_READ = re.compile(r"\.(png|jpe?g|mp4|avi|mkv|zip|tar|tgz|tar\.gz|part[a-z]*)$", re.IGNORECASE)


@dataclass(frozen=True)
class Manifest:
    """One dataset of one profile.

    present: False means the user does not have it: every stage of it is empty. source: ``generated`` from ``recipe``
    (then everything made from it is synthetic) or the user's ``files``. files: empty in a committed recipe.
    """

    dataset: str
    present: bool
    source: Literal["generated", "files"]
    licence: str
    where_to_register: str = ""
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
        raise BadInput(path, "a manifest", "no file", "restore it with git checkout") from error
    except ValueError as error:
        raise BadInput(path, "a JSON manifest", str(error), "restore it, or run `hoidata raw scan`") from error
    if not isinstance(values, dict) or values.pop("schema", None) != SCHEMA:
        raise BadInput(path, f"schema {SCHEMA}", "another one", "write it anew with `hoidata raw scan`")
    try:
        files = tuple(SourceFile(**entry) for entry in values.pop("files", ()))
        return Manifest(**values, files=files)
    except TypeError as error:
        raise BadInput(path, "the fields of a manifest", str(error), "write it anew with `hoidata raw scan`") from error


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write a manifest, one line per file entry so that version control shows which one changed."""
    head = {"schema": SCHEMA, **{key: value for key, value in asdict(manifest).items() if key != "files"}}
    lines = json.dumps(head, indent=2, ensure_ascii=False)[:-2]
    entries = ",\n    ".join(json.dumps(asdict(entry), ensure_ascii=False) for entry in manifest.files)
    body = f"[\n    {entries}\n  ]" if manifest.files else "[]"
    with atomic_file(path) as part:
        part.write_text(f'{lines},\n  "files": {body}\n}}\n')


def scan_files(root: Path) -> tuple[SourceFile, ...]:
    """Every raw file below ``root`` an adapter might read, digested; images, videos and archives are passed over."""
    tree = RawTree(root)
    for folder, names in _folders(root):
        if names and all(FRAME_FILE.fullmatch(name) for name in names):
            tree.read_folder(folder, names)
            continue
        for name in names:
            tree.file(f"{folder}/{name}" if folder else name)
    return tree.sources


def _folders(root: Path) -> Iterator[tuple[str, list[str]]]:
    """Each folder below root (as a relative path) with the sorted names of its data files."""
    for place in sorted([root, *(item for item in root.rglob("*") if item.is_dir())]):
        folder = "" if place == root else place.relative_to(root).as_posix()
        if any(part.startswith(".") for part in folder.split("/")):
            continue
        names = sorted(item.name for item in place.iterdir() if item.is_file())
        yield folder, [name for name in names if not name.startswith(".") and not NEVER_READ.search(name)]


@dataclass(frozen=True)
class Difference:
    """One entry that is not as the manifest says."""

    path: str
    problem: Literal["missing", "changed", "unlisted"]


def verify_files(root: Path, manifest: Manifest) -> list[Difference]:
    """How the files below ``root`` differ from the manifest; an empty list when they are those it lists."""
    listed, found = manifest.by_path, {entry.path: entry for entry in scan_files(root)}
    differences = [Difference(path, "missing") for path in listed if path not in found]
    differences += [Difference(path, "unlisted") for path in found if path not in listed]
    both = listed.keys() & found.keys()
    differences += [Difference(path, "changed") for path in both if listed[path].sha256 != found[path].sha256]
    return sorted(differences, key=lambda item: item.path)
