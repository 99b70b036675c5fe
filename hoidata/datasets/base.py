"""What an adapter is: a named reader of one dataset's raw files that gives clips.

Three short steps in one file and one class:
locate (``sequences``: which sequences are there), load (read the files of one sequence through ``RawTree``) and
convert (change of frame, unit and convention, into ``Clip``). Nothing outside an adapter knows a dataset's quirks.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from operator import attrgetter
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from hoidata.clips.clip import Clip, SourceFile, WorldFrame
from hoidata.clips.hand_parameters import HandConvention
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.recording import HandRecording
from hoidata.dataset_folders import DatasetFacts
from hoidata.datasets import checks
from hoidata.errors import BadInput, ChangedMeanwhile
from hoidata.files import sha256_bytes, sha256_file
from hoidata.hands import HandPair

__all__ = ["Adapter", "DatasetPart", "Described", "Quarantined", "RawTree", "Recorded", "SequenceKey"]

_SMALL_BYTES = 65536
_LARGEST_FILE = 256 << 20
_LARGEST_FRAME_FILE = 1 << 20


@dataclass(frozen=True, order=True)
class SequenceKey:
    """One raw sequence. name: its path-like name below the dataset (``s1/mug_drink_1``); subject: as in the source."""

    dataset: str
    subject: str
    name: str

    def __str__(self) -> str:
        return f"{self.dataset}/{self.name}"


@dataclass(frozen=True)
class DatasetPart:
    """Files a raw folder must hold: at least one match of one of ``patterns`` (globs below the raw root).

    Every file the adapter may read matches a pattern of some part: no other is scanned into a manifest.
    what: in words; where: the archive or page it comes from. optional: conversion works without it. unneeded_with: the
    setting of the adapter that makes a required part optional, ``clips=whole``, or "".
    """

    what: str
    patterns: tuple[str, ...]
    where: str
    optional: bool = False
    unneeded_with: str = ""

    def is_in(self, root: Path) -> bool:
        return any(next(Path(root).glob(pattern), None) is not None for pattern in self.patterns)

    def holds(self, path: str) -> bool:
        """Whether a source of that path matches a pattern; a folder of frame files is known by its files."""
        tries = [text.split("/") for text in (path, f"{path}/000000.txt")]
        patterns = [pattern.split("/") for pattern in self.patterns]
        return any(len(names) == len(p) and all(map(fnmatchcase, names, p)) for p in patterns for names in tries)


@runtime_checkable
class Adapter(Protocol):
    """Reader of one dataset. Must be picklable (a frozen dataclass without open files): workers get a copy.

    Its settings (margins, which hands) are dataclass fields with defaults, set in params.yaml under ``convert``.

    name: of the dataset, lower case. version: of the release the adapter reads. licence, where_to_register: shown to
    users who lack the data. may_be_shared: the licence lets derived data be passed on.
    needs_mano: the raw files hold MANO parameters, meaningless without the licensed MANO files.
    source_fps: frames per second of the raw files (a file's own figure wins).
    frame: the world frame of its clips. hand_convention: what the source's hand parameters mean.
    parts: what a complete raw folder holds, and where each part is to be had.
    """

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> str: ...
    @property
    def licence(self) -> str: ...
    @property
    def may_be_shared(self) -> bool: ...
    @property
    def where_to_register(self) -> str: ...
    @property
    def needs_mano(self) -> bool: ...
    @property
    def source_fps(self) -> float: ...
    @property
    def frame(self) -> WorldFrame: ...
    @property
    def hand_convention(self) -> HandConvention: ...
    @property
    def parts(self) -> tuple[DatasetPart, ...]: ...

    def sequences(self, root: Path) -> list[SequenceKey]:
        """Locate: the keys of all sequences below ``root``, sorted. Looks at names only, opens no motion file."""
        ...

    def load(self, raw: "RawTree", key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """Load and convert one sequence: its clips, and the stretches left out of it.

        Every file is reached through ``raw``. Raises BadInput when the whole sequence cannot be used.
        """
        ...


@runtime_checkable
class Recorded(Protocol):
    """An adapter whose source has hands of its own skeleton, which are kept beside the clips."""

    def recordings(self, raw: "RawTree", key: SequenceKey) -> list[HandRecording]:
        """The whole recording of one sequence, or none where the files that describe the hand are missing."""
        ...


class Described:
    """The facts of an adapter, as ``facts.toml`` of its folder states them; it declares ``facts`` alone.

    Its settings are dataclass fields of type int (0 or more), bool or Literal, and checked by that type.
    """

    facts: ClassVar[DatasetFacts]
    # The setting with which no MANO files are needed, where there is one: ``hands=keypoints``.
    without_mano: ClassVar[str] = ""

    name = property(attrgetter("facts.name"))
    version = property(attrgetter("facts.version"))
    licence = property(attrgetter("facts.licence"))
    may_be_shared = property(attrgetter("facts.may_be_shared"))
    where_to_register = property(attrgetter("facts.where_to_register"))
    licences = property(attrgetter("facts.licences"))

    def __post_init__(self) -> None:
        checks.settings(self)

    @property
    def needs_mano(self) -> bool:
        setting, _, value = self.without_mano.partition("=")
        return self.facts.needs_mano and (not setting or getattr(self, setting) != value)

    @property
    def source_fps(self) -> float:
        return float(self.facts.source_fps)


@dataclass
class RawTree:
    """A raw dataset folder that remembers what was read from it and checks it against a manifest.

    Paths are relative to ``root`` with forward slashes. ``sources`` holds every file read so far (a folder of
    per-frame files counts as one, see ``read_folder``). With a manifest (path -> SourceFile), a file whose digest
    differs, or that is not listed, raises BadInput.
    """

    root: Path
    manifest: Mapping[str, SourceFile] | None = None
    _sources: dict[str, SourceFile] = field(default_factory=dict)
    _inside_of_root: dict[str, bool] = field(default_factory=dict)

    @property
    def sources(self) -> tuple[SourceFile, ...]:
        return tuple(self._sources[path] for path in sorted(self._sources))

    def recorded(self, *places: str) -> tuple[SourceFile, ...]:
        """The sources read so far that are one of these paths or lie below one of them, sorted by path."""
        return tuple(s for s in self.sources if any(s.path == p or s.path.startswith(f"{p}/") for p in places))

    def file(self, path: str) -> Path:
        """The absolute path of one file, after recording and checking it. Raises BadInput when it is missing."""
        place = self._inside(path)
        self._record(SourceFile(path, place.stat().st_size, sha256_file(place)))
        return place

    def read(self, path: str, largest: int = _LARGEST_FILE) -> bytes:
        """The bytes of one file of at most ``largest`` bytes (256 MiB), recorded and checked."""
        place = self._inside(path)
        size = place.stat().st_size
        if size > largest:
            raise BadInput(path, f"a file of at most {largest} bytes", f"{size} bytes")
        data = place.read_bytes()
        self._record(SourceFile(path, len(data), sha256_bytes(data)))
        return data

    def read_folder(self, folder: str, names: Iterable[str]) -> list[bytes]:
        """The bytes of many small files of one folder; recorded as one source.

        Its digest is the SHA-256 of one ``<sha256>  <name>`` line per file, its size the sum. In a manifest either
        the files or the folder may be listed.
        """
        contents, lines = [], []
        listed = self.manifest is not None and folder not in self.manifest
        for name, data in self._small_files(folder, names):
            digest = sha256_bytes(data)
            if listed:
                self._check(SourceFile(f"{folder}/{name}", len(data), digest))
            contents.append(data)
            lines.append(f"{digest}  {name}\n")
        whole = SourceFile(folder, sum(map(len, contents)), sha256_bytes("".join(lines).encode()))
        if self.manifest is not None and folder in self.manifest:
            self._check(whole)
        self._sources[folder] = whole
        return contents

    def names(self, folder: str, suffix: str = "") -> list[str]:
        """Sorted names of the plain files in a folder that end in ``suffix`` (any case); none when it is absent."""
        place = self.root / folder
        if not place.is_dir():
            return []
        with os.scandir(place) as items:
            return sorted(item.name for item in items if item.name.lower().endswith(suffix) and item.is_file())

    def has(self, path: str) -> bool:
        return (self.root / path).is_file()

    def _small_files(self, folder: str, names: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Name and bytes of each file. The folder is opened once: a path per file costs more than the bytes do."""
        if not self._is_inside(folder) or not (self.root / folder).is_dir():
            yield from ((name, self._read_linked_or_large(f"{folder}/{name}")) for name in names)
            return
        opened = os.open(self.root / folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            for name in names:
                data = _read_small(opened, name)
                yield name, self._read_linked_or_large(f"{folder}/{name}") if data is None else data
        finally:
            os.close(opened)

    def _read_linked_or_large(self, path: str) -> bytes:
        place = self._inside(path)
        size = place.stat().st_size
        if size > _LARGEST_FRAME_FILE:
            raise BadInput(path, f"a file of one frame, at most {_LARGEST_FRAME_FILE} bytes", f"{size} bytes")
        return place.read_bytes()

    def _is_inside(self, path: str) -> bool:
        if path not in self._inside_of_root:
            self._inside_of_root[path] = (self.root / path).resolve().is_relative_to(self.root.resolve())
        return self._inside_of_root[path]

    def _inside(self, path: str) -> Path:
        place = self.root / path
        if not place.is_file():
            kind = ChangedMeanwhile if path in (self.manifest or ()) else BadInput
            raise kind(path, "a file", "nothing there", "check that the download is complete and unpacked here")
        if not self._is_inside(path):
            raise BadInput(path, "a file inside the raw folder", "a link that leaves it", "replace the link by a copy")
        return place

    def _record(self, source: SourceFile) -> None:
        if self.manifest is not None:
            self._check(source)
        self._sources[source.path] = source

    def _check(self, found: SourceFile) -> None:
        listed = (self.manifest or {}).get(found.path)
        if listed is None:
            raise BadInput(found.path, "a file listed in the manifest", "an unlisted one", "scan the raw folder again")
        if listed.sha256 != found.sha256:
            expected = f"SHA-256 {listed.sha256[:12]} ({listed.size} bytes)"
            got = f"{found.sha256[:12]} ({found.size} bytes)"
            raise ChangedMeanwhile(found.path, expected, got, "restore the file, or scan the raw folder again")


def _read_small(folder: int, name: str) -> bytes | None:
    """The bytes of a file of an open folder; None for a link, a missing file, another folder's or a big one."""
    if "/" in name:
        return None
    try:
        stream = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
    except OSError:
        return None
    try:
        data = os.read(stream, _SMALL_BYTES)
    except OSError:
        return None
    finally:
        os.close(stream)
    return data if len(data) < _SMALL_BYTES else None
