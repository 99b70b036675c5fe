"""Time, memory and bytes per clip of conversion, annotation and contact, for corpora of several sizes.

``python -m bench scale``. The raw files are hard links to those of the embedded corpora under the names of further
subjects. HOIDATA_BENCH_COPIES: numbers of copies of the corpora (1,4,16; 26 copies have as many clips as Text2HOI
reports). Each stage runs in a separate process, conversion on HOIDATA_BENCH_JOBS workers (2). Memory is the peak of the
largest process. A linear cost has the same value per further clip at all sizes.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from bench.harness import CORPORA, embedded_root, show
from hoidata.lifetime import end_with_parent
from hoidata.store.store import open_store

MEBI = 1 << 20
SUBJECT = re.compile(r"(s|subject)(\d+)")
SUBJECTS_APART = 20  # more than any of the corpora has


def convert(raw: Path, out: Path) -> None:
    from hoidata.conversion.convert import convert_dataset
    from hoidata.datasets import get_adapter
    from hoidata.hands import load_embedded_hands

    jobs = int(os.environ.get("HOIDATA_BENCH_JOBS", "2"))
    convert_dataset(get_adapter(raw.name), raw, load_embedded_hands(), out / "clips", jobs, synthetic=True)


def annotate(raw: Path, out: Path) -> None:
    from hoidata.annotation.stage import annotate_store

    annotate_store(out / "clips", out / "annotation", encoder="hash")


def contact(raw: Path, out: Path) -> None:
    from hoidata.contact.stage import contact_store

    contact_store(out / "clips", out / "contact")


STAGES: dict[str, Callable[[Path, Path], None]] = {"convert": convert, "annotate": annotate, "contact": contact}
OUTPUTS = {"convert": "clips", "annotate": "annotation", "contact": "contact"}


class Cost(NamedTuple):
    """The cost of one stage."""

    wall_s: float
    processor_s: float  # of all its processes
    peak_bytes: int  # of its largest process
    output_bytes: int


def replicate(source: Path, target: Path, copies: int) -> None:
    """Link the files of a raw folder; files of a subject appear ``copies`` times, each under another subject."""
    for path in sorted(source.rglob("*")):
        if path.is_dir():
            continue
        parts = path.relative_to(source).parts
        numbers = range(copies) if any(SUBJECT.fullmatch(part) for part in parts) else range(1)
        for copy in numbers:
            link = target.joinpath(*(SUBJECT.sub(partial(_renamed, copy), part) for part in parts))
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.exists():
                os.link(path, link)


def _renamed(copy: int, name: re.Match[str]) -> str:
    """The folder name of a subject in a copy: ``s05`` becomes ``s25`` in the first; other names stay."""
    if name.group() != name.string:
        return name.group()
    return f"{name[1]}{int(name[2]) + SUBJECTS_APART * copy:0{len(name[2])}d}"


def measured(stage: str, raw: Path, out: Path) -> Cost:
    """Run one stage of one dataset in a separate process."""
    command = [sys.executable, "-m", "bench.scale", stage, str(raw), str(out)]
    environment, end = {**os.environ, "OMP_NUM_THREADS": "1"}, partial(end_with_parent, os.getpid())
    start = time.perf_counter()
    process = subprocess.Popen(command, env=environment, stdout=sys.stderr, preexec_fn=end)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{stage} of {raw.name} ended with exit code {process.returncode}")
    size = sum(path.stat().st_size for path in (out / OUTPUTS[stage]).rglob("*") if path.is_file())
    return Cost(time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024, size)


def total(parts: list[Cost]) -> Cost:
    """The cost of datasets run one after another: times and bytes add up, the memory peak is the largest."""
    wall_s, processor_s, peaks, sizes = zip(*parts, strict=True)
    return Cost(sum(wall_s), sum(processor_s), max(peaks), sum(sizes))


def run_size(source: Path, folder: Path, copies: int) -> tuple[int, int, dict[str, Cost]]:
    """Run all stages on copies of the corpora; returns clips, frames, and the cost of each stage."""
    costs_by_stage: dict[str, list[Cost]] = {stage: [] for stage in STAGES}
    clips = frames = 0
    for name in CORPORA:
        raw, out = folder / "raw" / name, folder / "out" / name
        replicate(source / name, raw, copies)
        for stage, costs in costs_by_stage.items():
            costs.append(measured(stage, raw, out))
        store = open_store(out / "clips")
        clips, frames = clips + len(store), frames + int(store.sequences["n_frames"].sum())
    return clips, frames, {stage: total(costs) for stage, costs in costs_by_stage.items()}


def rows(sizes: list[tuple[int, int, dict[str, Cost]]]) -> list[list[str]]:
    """The table by stage and size: costs, and processor time and bytes per clip beyond the previous size."""
    table = []
    for stage in STAGES:
        previous_clips, previous = 0, Cost(0, 0, 0, 0)
        for clips, frames, costs in sizes:
            cost, further_clips = costs[stage], max(clips - previous_clips, 1)
            further = (
                (cost.processor_s - previous.processor_s) / further_clips,
                (cost.output_bytes - previous.output_bytes) / further_clips,
            )
            table.append(
                [
                    f"{stage}, {clips:,} clips",
                    f"{cost.wall_s:.1f}",
                    f"{cost.processor_s:.1f}",
                    f"{frames / cost.wall_s:,.0f}",
                    f"{cost.peak_bytes / MEBI:,.0f}",
                    f"{1e3 * further[0]:.1f}",
                    f"{further[1] / 1024:.1f}",
                ]
            )
            previous_clips, previous = clips, cost
    return table


def main() -> None:
    corpora = embedded_root()
    copies = [int(number) for number in os.environ.get("HOIDATA_BENCH_COPIES", "1,4,16").split(",")]
    # Next to the corpora, because hard links need the same file system.
    with tempfile.TemporaryDirectory(prefix="bench-scale-", dir=corpora.parent) as folder:
        sizes = [run_size(corpora, Path(folder) / f"{number}", number) for number in copies]
    columns = ["", "s", "processor s", "frames/s", "peak MiB", "processor ms per further clip", "KiB per further clip"]
    show("Growth with the number of clips", columns, rows(sizes))
    print(json.dumps([[clips, frames, costs] for clips, frames, costs in sizes]))


if __name__ == "__main__":
    STAGES[sys.argv[1]](Path(sys.argv[2]), Path(sys.argv[3]))
