"""Loading one sequence while watching which files are opened, and comparing two results field by field."""

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import Clip, SourceFile
from hoidata.datasets.base import Adapter, Quarantined, RawTree, SequenceKey
from hoidata.errors import BadInput
from hoidata.hands import HandPair


@dataclass(frozen=True)
class Loaded:
    """What one sequence gave. error: what ``load`` raised instead. sources: what the RawTree recorded.

    unrecorded: files below the root that were opened without it.
    """

    key: SequenceKey
    results: tuple[Any, ...]
    sources: tuple[SourceFile, ...]
    unrecorded: tuple[str, ...] = ()
    error: Exception | None = None

    @property
    def clips(self) -> list[Clip]:
        return [item for item in self.results if isinstance(item, Clip)]

    @property
    def crashed(self) -> bool:
        return self.error is not None and not isinstance(self.error, BadInput)

    @property
    def problem(self) -> str:
        if self.error is None:
            return ""
        return repr(self.error) if self.crashed else str(self.error)

    @property
    def needed(self) -> list[str]:
        """Paths the clips name as their sources; those read when there are no clips."""
        named = {source.path for clip in self.clips for source in clip.sources}
        return sorted(named or {source.path for source in self.sources})


def load_recorded(adapter: Adapter, root: Path, key: SequenceKey, hands: HandPair) -> Loaded:
    """Load one sequence; errors of any kind are kept, for a check must go on."""
    raw = RawTree(root)
    results: tuple[Any, ...] = ()
    error: Exception | None = None
    with opened_files(root) as opened:
        try:
            results = tuple(adapter.load(raw, key, hands))
        except Exception as raised:  # a defect of the adapter is what the check is looking for
            error = raised
    recorded = {source.path for source in raw.sources}
    unrecorded = tuple(sorted(path for path in opened if not {path, os.path.dirname(path)} & recorded))
    # An error may come before the file it is about was recorded.
    return Loaded(key, _without_root(results, root), raw.sources, () if error else unrecorded, error)


def first_difference(one: Any, other: Any, place: str = "") -> str | None:
    """Where two values differ, bit by bit in arrays: ``object.rotvec``; None when they are equal."""
    if type(one) is not type(other):
        return place or "the kind"
    if isinstance(one, np.ndarray):
        same = one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
        return None if same else place
    if is_dataclass(one):
        pairs = [(item.name, getattr(one, item.name), getattr(other, item.name)) for item in fields(one)]
    elif isinstance(one, Mapping):
        if list(one) != list(other):
            return place
        pairs = [(str(key), one[key], other[key]) for key in one]
    elif isinstance(one, list | tuple):
        if len(one) != len(other):
            return f"{place or 'the number of results'} ({len(one)} and {len(other)})"
        pairs = [(_name(item, number), item, other[number]) for number, item in enumerate(one)]
    else:
        return None if one == other else place
    found = (first_difference(a, b, f"{place}.{name}" if place else name) for name, a, b in pairs)
    return next((item for item in found if item is not None), None)


@contextmanager
def opened_files(root: Path) -> Iterator[set[str]]:
    """Collect the paths, relative to ``root``, of the files below it that Python opens inside the block."""
    _install_hook()
    global _opened
    before, _opened = _opened, []
    result: set[str] = set()
    try:
        yield result
    finally:
        opened, _opened = _opened, before
        for place in (os.path.abspath(root), os.path.realpath(root)):
            below = [path for path in opened if path.startswith(place + os.sep) and os.path.isfile(path)]
            result |= {os.path.relpath(path, place) for path in below}


_opened: list[str] | None = None


@cache
def _install_hook() -> None:
    """Audit hooks stay until the process ends: there is one, and it does nothing outside of ``opened_files``."""
    sys.addaudithook(_note_open)


def _note_open(event: str, arguments: tuple) -> None:
    if _opened is not None and event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
        _opened.append(os.path.abspath(os.fsdecode(arguments[0])))


def _name(item: Any, number: int) -> str:
    return getattr(item, "clip_id", None) or getattr(item, "source_key", None) or str(number)


def _without_root(results: tuple[Any, ...], root: Path) -> tuple[Any, ...]:
    """Reasons with paths below the root, as conversion writes them, so that they can be compared between roots."""
    prefix = f"{root}/"
    return tuple(
        Quarantined(*(getattr(item, field.name).replace(prefix, "") for field in fields(item)))
        if isinstance(item, Quarantined)
        else item
        for item in results
    )
