"""The adapter interface: one class per dataset converts raw files to clips.

An adapter works in three steps:

1. locate: ``sequences`` lists the sequences of a raw folder by file name;
2. load: ``load`` reads the files of one sequence through ``RawTree``, which records and checks them;
3. convert: ``load`` changes frame, unit and hand convention and returns each ``Clip``.

Code outside of the adapters is independent of the dataset.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

from hoidata.clips.clip import Clip, SourceFile, WorldFrame
from hoidata.clips.hand_parameters import HandConvention
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.recording import HandRecording
from hoidata.dataset_folders import DatasetFacts
from hoidata.datasets import checks
from hoidata.errors import BadInput, RawFileChanged
from hoidata.files import sha256_bytes, sha256_file
from hoidata.hands import HandPair

__all__ = ["Adapter", "AdapterBase", "DatasetPart", "HasHandRecordings", "Quarantined", "RawTree", "SequenceKey"]

_SMALL_FILE_BYTES = 65536
_MAX_FILE_BYTES = 256 << 20
_MAX_FRAME_FILE_BYTES = 1 << 20


@dataclass(frozen=True, order=True)
class SequenceKey:
    """Identifies one raw sequence; ``str(key)`` is the beginning of the ids of its clips."""

    dataset: str
    subject: str  # the person, as the source names them
    name: str  # unique in the dataset, with slashes: s1/mug_drink_1

    def __str__(self) -> str:
        return f"{self.dataset}/{self.name}"


@dataclass(frozen=True)
class DatasetPart:
    """A group of files that a raw folder contains; the part is present if one file matches one of the patterns.

    Every file that the adapter reads must match a pattern of some part: ``hoidata raw scan`` lists only these files.
    """

    contents: str  # in words: hand motion
    patterns: tuple[str, ...]  # globs below the raw root
    archive: str  # the archive or page to download
    optional: bool = False  # conversion works without it
    unneeded_with: str = ""  # the adapter's setting that makes a required part optional, such as clips=whole

    def is_in(self, root: Path) -> bool:
        """Whether the raw folder ``root`` has a file of this part."""
        return any(next(Path(root).glob(pattern), None) is not None for pattern in self.patterns)

    def matches(self, path: str) -> bool:
        """Whether a source file matches a pattern. A folder of frame files matches if its files do."""
        candidates = [text.split("/") for text in (path, f"{path}/000000.txt")]
        patterns = [pattern.split("/") for pattern in self.patterns]
        return any(len(names) == len(p) and all(map(fnmatchcase, names, p)) for p in patterns for names in candidates)


@runtime_checkable
class Adapter(Protocol):
    """Reads one dataset. Must be picklable, as a frozen dataclass without open files is: workers receive a copy.

    Settings are dataclass fields with defaults. Users set them under ``convert`` in params.yaml.
    """

    @property
    def name(self) -> str:
        """Name of the dataset: lower-case letters, digits and ``_``."""
        ...

    @property
    def version(self) -> str:
        """Release of the dataset that the adapter reads."""
        ...

    @property
    def licence(self) -> str:
        """Licence of the dataset in words."""
        ...

    @property
    def may_be_shared(self) -> bool:
        """Whether the licence permits passing on derived data."""
        ...

    @property
    def where_to_register(self) -> str:
        """Page on which users get the raw files."""
        ...

    @property
    def needs_mano(self) -> bool:
        """Whether the raw files have MANO parameters, which are useless without the licensed MANO files."""
        ...

    @property
    def source_fps(self) -> float:
        """Frames per second of the raw files; a rate stated in a file takes precedence."""
        ...

    @property
    def frame(self) -> WorldFrame:
        """World frame of the clips."""
        ...

    @property
    def hand_convention(self) -> HandConvention:
        """Meaning of the source's hand parameters."""
        ...

    @property
    def parts(self) -> tuple[DatasetPart, ...]:
        """Files of a complete raw folder, and the archive of each."""
        ...

    def sequences(self, root: Path) -> list[SequenceKey]:
        """Locate: the keys of all sequences below ``root``, sorted. Reads file names only and opens no file."""
        ...

    def load(self, raw: "RawTree", key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """Load and convert one sequence: its clips, and a ``Quarantined`` for every interval that gives no clip.

        The adapter opens every file through ``raw``. Raises BadInput if the whole sequence is unusable.
        """
        ...


@runtime_checkable
class HasHandRecordings(Protocol):
    """An adapter whose source has hands with another skeleton than MANO's; the store has them next to the clips."""

    def recordings(self, raw: "RawTree", key: SequenceKey) -> list[HandRecording]:
        """The whole recording of one sequence; empty if the files that describe the hand are missing."""
        ...


class AdapterBase:
    """Base class of adapters: takes name, licence and other facts from ``facts.toml`` in the adapter's folder.

    A subclass declares ``facts``. Its settings are dataclass fields of type int (0 or more), bool or Literal. Creating
    an adapter with a value of another type raises BadInput.
    """

    facts: ClassVar[DatasetFacts]
    without_mano: ClassVar[str] = ""  # the setting that makes MANO files unnecessary, such as hands=keypoints

    name = property(attrgetter("facts.name"))
    version = property(attrgetter("facts.version"))
    licence = property(attrgetter("facts.licence"))
    may_be_shared = property(attrgetter("facts.may_be_shared"))
    where_to_register = property(attrgetter("facts.where_to_register"))
    licences = property(attrgetter("facts.licences"))
    derives_verbs = property(attrgetter("facts.derives_verbs"))

    def __post_init__(self) -> None:
        checks.settings(self)

    @property
    def needs_mano(self) -> bool:
        setting, _, value = self.without_mano.partition("=")
        return self.facts.needs_mano and (not setting or getattr(self, setting) != value)

    @property
    def source_fps(self) -> float:
        return float(self.facts.source_fps)

    def new_clip(self, key: SequenceKey, **fields: Any) -> Clip:
        """A clip of a sequence. Unless given, its id is the key, and its frame rate that of the source."""
        origin = {"dataset": self.name, "subject": key.subject, "sequence": key.name}
        return Clip(**{"clip_id": str(key), **origin, "source_fps": self.source_fps, **fields})


@dataclass
class RawTree:
    """A raw dataset folder that records the files read from it and checks them against a manifest.

    Paths are relative to ``root``, with forward slashes. If there is a manifest, reading a file that it does not list
    or whose digest differs raises BadInput.
    """

    root: Path
    manifest: Mapping[str, SourceFile] | None = None  # by path
    _sources: dict[str, SourceFile] = field(default_factory=dict)
    _inside_of_root: dict[str, bool] = field(default_factory=dict)

    @property
    def sources(self) -> tuple[SourceFile, ...]:
        """All files read so far, sorted by path. A folder read by ``read_folder`` is one entry."""
        return tuple(self._sources[path] for path in sorted(self._sources))

    def recorded(self, *paths: str) -> tuple[SourceFile, ...]:
        """The files read so far at or below these paths, sorted by path."""
        return tuple(s for s in self.sources if any(s.path == p or s.path.startswith(f"{p}/") for p in paths))

    def file(self, path: str) -> Path:
        """Record and check one file; returns its path on disk. Raises BadInput if it is missing."""
        file = self._inside(path)
        self._record(SourceFile(path, file.stat().st_size, sha256_file(file)))
        return file

    def read(self, path: str, max_bytes: int = _MAX_FILE_BYTES) -> bytes:
        """Record and check one file; returns its bytes. Raises BadInput if it is missing or too large."""
        file = self._inside(path)
        size = file.stat().st_size
        if size > max_bytes:
            raise BadInput(path, f"a file of at most {max_bytes} bytes", f"{size} bytes")
        data = file.read_bytes()
        self._record(SourceFile(path, len(data), sha256_bytes(data)))
        return data

    def read_folder(self, folder: str, names: Iterable[str]) -> list[bytes]:
        """Read many small files of one folder, in the order of ``names``, and record the folder as one source.

        The folder's digest is the SHA-256 of one ``<sha256>  <name>`` line per file, and its size is the sum.
        A manifest lists either the files or the folder.
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
        """Sorted names of a folder's files that end in ``suffix`` in any case; empty if the folder is missing."""
        path = self.root / folder
        if not path.is_dir():
            return []
        with os.scandir(path) as items:
            return sorted(item.name for item in items if item.name.lower().endswith(suffix) and item.is_file())

    def has(self, path: str) -> bool:
        """Whether the file exists."""
        return (self.root / path).is_file()

    def _small_files(self, folder: str, names: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Yield name and bytes of each file. Opens the folder once, because resolving each path is slow."""
        if not self._is_inside(folder) or not (self.root / folder).is_dir():
            yield from ((name, self._read_linked_or_large(f"{folder}/{name}")) for name in names)
            return
        descriptor = os.open(self.root / folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            for name in names:
                data = _read_small(descriptor, name)
                yield name, self._read_linked_or_large(f"{folder}/{name}") if data is None else data
        finally:
            os.close(descriptor)

    def _read_linked_or_large(self, path: str) -> bytes:
        file = self._inside(path)
        size = file.stat().st_size
        if size > _MAX_FRAME_FILE_BYTES:
            raise BadInput(path, f"a file of one frame, at most {_MAX_FRAME_FILE_BYTES} bytes", f"{size} bytes")
        return file.read_bytes()

    def _is_inside(self, path: str) -> bool:
        if path not in self._inside_of_root:
            self._inside_of_root[path] = (self.root / path).resolve().is_relative_to(self.root.resolve())
        return self._inside_of_root[path]

    def _inside(self, path: str) -> Path:
        file = self.root / path
        if not file.is_file():
            error_type = RawFileChanged if path in (self.manifest or ()) else BadInput
            raise error_type(path, "a file", "nothing there", "check that the download is complete and unpacked here")
        if not self._is_inside(path):
            raise BadInput(path, "a file inside the raw folder", "a link that leaves it", "replace the link by a copy")
        return file

    def _record(self, source: SourceFile) -> None:
        if self.manifest is not None:
            self._check(source)
        self._sources[source.path] = source

    def _check(self, source: SourceFile) -> None:
        listed = (self.manifest or {}).get(source.path)
        if listed is None:
            raise BadInput(source.path, "a file listed in the manifest", "an unlisted one", "scan the raw folder again")
        if listed.sha256 != source.sha256:
            expected = f"SHA-256 {listed.sha256[:12]} ({listed.size} bytes)"
            got = f"{source.sha256[:12]} ({source.size} bytes)"
            raise RawFileChanged(source.path, expected, got, "restore the file, or scan the raw folder again")


def _read_small(folder: int, name: str) -> bytes | None:
    """The bytes of a small file in an open folder; None if it is missing, large, a link or in another folder."""
    if "/" in name:
        return None
    try:
        stream = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
    except OSError:
        return None
    try:
        data = os.read(stream, _SMALL_FILE_BYTES)
    except OSError:
        return None
    finally:
        os.close(stream)
    return data if len(data) < _SMALL_FILE_BYTES else None
