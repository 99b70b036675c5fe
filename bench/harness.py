"""What the benchmarks share: alternating runs with medians, the memory of a process tree, a table."""

import statistics
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

RUNS = 5
WIDTH = 140  # of tables written to a file


class Times(NamedTuple):
    """Seconds. processor: of this process, steadier on a busy machine. first: the call that compiles and warms up, by
    the clock; it does not count in the two medians."""

    median: float
    processor: float
    first: float


def medians(variants: Mapping[str, Callable[[], object]], runs: int = RUNS) -> dict[str, Times]:
    """Times of each variant; they take turns."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in variants}
    for _ in range(runs + 1):
        for name, work in variants.items():
            start = time.perf_counter(), time.process_time()
            work()
            times[name].append((time.perf_counter() - start[0], time.process_time() - start[1]))
    return {
        name: Times(*(statistics.median(column) for column in zip(*values[1:], strict=True)), values[0][0])
        for name, values in times.items()
    }


def show(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """One table, the first column left-aligned, the others right-aligned."""
    table = Table(title=title, title_justify="left")
    for number, name in enumerate(columns):
        table.add_column(name, justify="right" if number else "left")
    for row in rows:
        table.add_row(*row)
    console = Console()
    (console if console.is_terminal else Console(width=WIDTH)).print(table)


class TreeMemory:
    """Peak memory of a process and all below it, while the block runs, from /proc (Linux).

    peak_at_once: the largest sum of resident memory seen at one moment (sampled 50 times a second); own_at_once: of
    the memory that is no file's, which the system cannot take back. sum_of_peaks: every process's own highest mark
    (VmHWM) added up, an upper bound. Pages processes share count for each.
    """

    def __init__(self, root: int) -> None:
        self.root = root
        self.peak_at_once = 0
        self.own_at_once = 0
        self.peaks: dict[int, int] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "TreeMemory":
        self._thread.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join()

    @property
    def sum_of_peaks(self) -> int:
        return sum(self.peaks.values())

    def _watch(self) -> None:
        while not self._stop.wait(0.02):
            now = {pid: _memory(pid) for pid in _tree(self.root)}
            self.peak_at_once = max(self.peak_at_once, sum(resident for resident, _, _ in now.values()))
            self.own_at_once = max(self.own_at_once, sum(own for _, own, _ in now.values()))
            for pid, (_, _, highest) in now.items():
                self.peaks[pid] = max(self.peaks.get(pid, 0), highest)


def _tree(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(below for child in children for below in _tree(int(child)))]


def _memory(pid: int) -> tuple[int, int, int]:
    """Bytes resident now, of those no file's, and at most so far; none for a process that has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0, 0, 0
    found = dict(line.split(":", 1) for line in lines)
    resident, own, highest = (int(found.get(name, "0 kB").split()[0]) for name in ("VmRSS", "RssAnon", "VmHWM"))
    return resident * 1024, own * 1024, highest * 1024
