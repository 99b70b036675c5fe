"""Fuzzing of one parser in one process: mutate, run, keep what reaches new lines, stop at nothing but the count.

A fault is any exception but BadInput and MissingResource, any warning, a call over one second, or memory refused by
the limit of 1 GiB above what the process had at its start. Faults are saved, and the run goes on.
"""

import contextlib
import hashlib
import mmap
import random
import resource
import struct
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput, MissingResource
from tests.fuzz.coverage import LineCoverage, code_objects
from tests.fuzz.mutation import LONGEST, mutate
from tests.fuzz.structure import Bytes

SLOWEST_S = 1.0
_NOTABLE_S = 0.1  # longer calls are repeated: the machine may have been busy
MEMORY_BYTES = 1 << 30
_TRACED = 24  # one execution in so many is traced; the others run at full speed
_STRUCTURED = 0.6
_MOST_FAULTS = 20
_LARGEST_CORPUS = 400


@dataclass(frozen=True)
class Target:
    """One parser. seeds: small valid files; run: parses bytes; code: functions whose lines count.

    structure: mutation that knows the format; longest: inputs are not made larger than this.
    """

    name: str
    seeds: Callable[[], Sequence[bytes]]
    run: Callable[[bytes], Any]
    code: Sequence[Any]
    tokens: Sequence[bytes] = ()
    structure: Bytes | None = None
    longest: int = LONGEST
    structured_only: bool = False


@dataclass
class Outcome:
    """What happened to one target. slowest_s: of one call; peak_bytes: of the whole process."""

    name: str
    executions: int = 0
    accepted: int = 0
    seconds: float = 0.0
    slowest_s: float = 0.0
    peak_bytes: int = 0
    lines: int = 0
    reached: int = 0
    missing: list[str] = field(default_factory=list)
    faults: list[dict[str, str]] = field(default_factory=list)


class Watched:
    """A file the parent reads: how many inputs were started, and the one that is running."""

    def __init__(self, path: Path, longest: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes(16 + longest))
        with open(path, "r+b") as stream:
            self._map = mmap.mmap(stream.fileno(), 0)

    def note(self, number: int, data: bytes) -> None:
        self._map[:16] = struct.pack("<QQ", number, len(data))
        self._map[16 : 16 + len(data)] = data

    @staticmethod
    def read(path: Path) -> tuple[int, bytes]:
        content = path.read_bytes() if path.is_file() else bytes(16)
        number, length = struct.unpack("<QQ", content[:16])
        return number, content[16 : 16 + length]


def fuzz(target: Target, seed: int, executions: int, seconds: float, folder: Path) -> Outcome:
    """Run one target until either limit. Inputs depend on ``seed`` alone; folder: where faults are saved."""
    seeds = list(target.seeds())
    coverage = LineCoverage(code_objects(target.code))
    watched = Watched(folder / "running" / target.name, max(target.longest, *map(len, seeds)))
    limit_memory()
    warnings.simplefilter("error")  # a file must not make a conversion print warnings either
    outcome = Outcome(target.name, lines=len(coverage.lines))
    corpus, rng = list(seeds), random.Random(f"{seed} {target.name}")
    start = time.perf_counter()
    while outcome.executions < executions and time.perf_counter() - start < seconds:
        number = outcome.executions
        data = seeds[number] if number < len(seeds) else _next_input(rng, target, corpus)
        watched.note(number, data)
        traced = number < len(seeds) or number % _TRACED == 0
        if _execute(target, data, coverage if traced else None, outcome, folder) and number >= len(seeds):
            corpus.append(data)
            del corpus[len(seeds) : len(corpus) - _LARGEST_CORPUS]
        outcome.executions += 1
        if len(outcome.faults) >= _MOST_FAULTS:
            break
    outcome.seconds = time.perf_counter() - start
    outcome.reached = len(coverage.reached)
    outcome.missing = [f"{Path(file).name}:{line}" for file, line in coverage.missing]
    outcome.peak_bytes = peak_bytes()
    return outcome


def _next_input(rng: random.Random, target: Target, corpus: list[bytes]) -> bytes:
    data = rng.choice(corpus)
    if target.structure is not None and (target.structured_only or rng.random() < _STRUCTURED):
        data = target.structure(rng, data)
        if target.structured_only or rng.random() < 0.85:
            return data[: target.longest]
    return mutate(rng, data, corpus, target.tokens)[: target.longest]


def _execute(target: Target, data: bytes, coverage: LineCoverage | None, outcome: Outcome, folder: Path) -> bool:
    """One call; True when it reached something new."""
    steps_before = len(coverage.steps) if coverage else 0
    begin = time.perf_counter()
    try:
        coverage.trace(target.run, data) if coverage else target.run(data)
        outcome.accepted += 1
    except (BadInput, MissingResource) as error:
        if "MemoryError" in str(error):
            _note_fault(target, data, f"memory: {str(error)[:200]}", outcome, folder)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        _note_fault(target, data, _described(error), outcome, folder)
    duration = time.perf_counter() - begin
    if duration > _NOTABLE_S:
        duration = min(duration, _repeated(target, data))
        if duration > SLOWEST_S:
            _note_fault(target, data, f"{duration:.2f} s", outcome, folder)
    outcome.slowest_s = max(outcome.slowest_s, duration)
    return coverage is not None and len(coverage.steps) > steps_before


def _repeated(target: Target, data: bytes) -> float:
    """The shortest of two more runs: a busy machine may have taken the time."""
    durations = []
    for _ in range(2):
        begin = time.perf_counter()
        with contextlib.suppress(Exception):
            target.run(data)
        durations.append(time.perf_counter() - begin)
    return min(durations)


def _described(error: BaseException) -> str:
    """Type and the last place in our own code: one defect, one description."""
    places = [frame for frame in traceback.extract_tb(error.__traceback__) if "/site-packages/" not in frame.filename]
    ours = [frame for frame in places if "/hoidata/" in frame.filename or "/pipelines/" in frame.filename] or places
    return f"{type(error).__name__} at {Path(ours[-1].filename).name}:{ours[-1].lineno}"


def _note_fault(target: Target, data: bytes, what: str, outcome: Outcome, folder: Path) -> None:
    if any(fault["what"] == what for fault in outcome.faults):
        return
    path = save_fault(folder, target.name, data)
    outcome.faults.append({"what": what, "path": str(path)})


def save_fault(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name / f"{hashlib.sha256(data).hexdigest()[:16]}.bin"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def peak_bytes() -> int:
    """The most memory this process ever held (Linux counts in KiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
