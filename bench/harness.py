"""Shared by the benchmarks: the embedded corpora, alternating runs with medians, and a table."""

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from hoidata.synthetic.corpus import write_corpus

RUNS = 5
WIDTH = 140  # of tables written to a file
CORPORA = ("h2o", "grab", "arctic")


class Times(NamedTuple):
    """Durations of one variant, seconds."""

    median: float  # wall clock, without the first call
    processor: float  # median processor time of this process; it varies less on a busy machine
    first: float  # wall clock of the first call, which compiles and warms up


def medians(variants: Mapping[str, Callable[[], object]], runs: int = RUNS) -> dict[str, Times]:
    """Measure each variant; their runs alternate."""
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
    for cells in rows:
        table.add_row(*cells)
    console = Console()
    (console if console.is_terminal else Console(width=WIDTH)).print(table)


def embedded_root() -> Path:
    """The embedded corpora: HOIDATA_BENCH_CORPORA, or those of ``make demo``, or generated once."""
    configured = os.environ.get("HOIDATA_BENCH_CORPORA")
    demo_folder = Path(".hoidata", "raw", "embedded")
    if configured or all((demo_folder / name).is_dir() for name in CORPORA):
        return Path(configured or demo_folder).resolve()
    folder = Path(".hoidata", "bench", "embedded").resolve()
    for name in CORPORA:
        if not (folder / name).is_dir():
            write_corpus(name, folder / name)
    return folder
