"""Loads one sequence while recording which files are opened, compares results field by field; outcomes of the rules."""

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hoidata.clips.clip import Clip, SourceFile
from hoidata.datasets.base import Adapter, Quarantined, RawTree, SequenceKey
from hoidata.errors import BadInput
from hoidata.hands import HandPair

SHOWN = 3


@dataclass(frozen=True)
class Finding:
    """A rule with its outcome."""

    rule: str  # as a sentence
    outcome: Literal["pass", "warn", "fail", "skip"]  # warn: suspicious, may be right; skip: not testable on this input
    detail: str = ""  # the first problems, or the reason for skipping


def finding(rule: str, problems: Sequence[str], outcome: Literal["fail", "warn"] = "fail") -> Finding:
    """Outcome "pass" without problems, else ``outcome`` with the first problems."""
    if not problems:
        return Finding(rule, "pass")
    rest = len(problems) - SHOWN
    return Finding(rule, outcome, "; ".join(problems[:SHOWN]) + (f"; and {rest} more" if rest > 0 else ""))


def skipped(rule: str, why: str) -> Finding:
    """The rule was not tried."""
    return Finding(rule, "skip", why)


def undecided(rule: str, why: str) -> Finding:
    """The input has too little data for a verdict."""
    return Finding(rule, "skip", f"not decided: {why}")


@dataclass(frozen=True)
class Loaded:
    """Result of loading one sequence."""

    key: SequenceKey
    results: tuple[Any, ...]
    sources: tuple[SourceFile, ...]  # recorded by the RawTree
    unrecorded: tuple[str, ...] = ()  # files below the root that were opened without the RawTree
    error: Exception | None = None  # raised by ``load``

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
        """Paths that the clips name as sources; without clips, all paths that were read."""
        named = {source.path for clip in self.clips for source in clip.sources}
        return sorted(named or {source.path for source in self.sources})


def load_recorded(adapter: Adapter, root: Path, key: SequenceKey, hands: HandPair) -> Loaded:
    """Load one sequence. Any error is stored in the result so that the check continues."""
    raw = RawTree(root)
    results: tuple[Any, ...] = ()
    error: Exception | None = None
    with opened_files(root) as opened:
        try:
            results = tuple(adapter.load(raw, key, hands))
        except Exception as raised:  # the check reports defects of the adapter
            error = raised
    recorded = {source.path for source in raw.sources}
    unrecorded = tuple(sorted(path for path in opened if not {path, os.path.dirname(path)} & recorded))
    # An error may come before the file it is about was recorded.
    return Loaded(key, _without_root(results, root), raw.sources, () if error else unrecorded, error=error)


def first_difference(one: Any, other: Any, path: str = "") -> str | None:
    """Path of the first field in which two values differ, such as ``object.rotvec``; None if they are equal.

    Arrays are compared bit by bit.
    """
    if type(one) is not type(other):
        return path or "the kind"
    if isinstance(one, np.ndarray):
        same = one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
        return None if same else path
    if is_dataclass(one):
        pairs = [(item.name, getattr(one, item.name), getattr(other, item.name)) for item in fields(one)]
    elif isinstance(one, Mapping):
        if list(one) != list(other):
            return path
        pairs = [(str(key), one[key], other[key]) for key in one]
    elif isinstance(one, list | tuple):
        if len(one) != len(other):
            return f"{path or 'the number of results'} ({len(one)} and {len(other)})"
        pairs = [(_name(item, number), item, other[number]) for number, item in enumerate(one)]
    else:
        return None if one == other else path
    differences = (first_difference(a, b, f"{path}.{name}" if path else name) for name, a, b in pairs)
    return next((item for item in differences if item is not None), None)


@contextmanager
def opened_files(root: Path) -> Iterator[set[str]]:
    """Collect the paths, relative to ``root``, of the files below it that Python opens inside the block."""
    _install_hook()
    global _opened
    outer, _opened = _opened, []
    result: set[str] = set()
    try:
        yield result
    finally:
        opened, _opened = _opened, outer
        for root_path in (os.path.abspath(root), os.path.realpath(root)):
            below = [path for path in opened if path.startswith(root_path + os.sep) and os.path.isfile(path)]
            result |= {os.path.relpath(path, root_path) for path in below}


_opened: list[str] | None = None


@cache
def _install_hook() -> None:
    """Install one audit hook, which Python cannot remove; it is idle outside of ``opened_files``."""
    sys.addaudithook(_note_open)


def _note_open(event: str, arguments: tuple) -> None:
    if _opened is not None and event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
        _opened.append(os.path.abspath(os.fsdecode(arguments[0])))


def _name(item: Any, number: int) -> str:
    return getattr(item, "clip_id", None) or getattr(item, "source_key", None) or str(number)


def _without_root(results: tuple[Any, ...], root: Path) -> tuple[Any, ...]:
    """Remove the root from the paths in reasons, as conversion does, so that results of two roots are comparable."""
    prefix = f"{root}/"
    return tuple(
        Quarantined(*(getattr(item, field.name).replace(prefix, "") for field in fields(item)))
        if isinstance(item, Quarantined)
        else item
        for item in results
    )
