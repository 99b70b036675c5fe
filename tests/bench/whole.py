"""The whole corpus on one core: raw files of three datasets to the annotated store, seconds of the processor by stage.

``python -m tests.bench.whole [SHARE ...]`` (0.01, 0.1 and 1, the paper's 6,592 clips, when none is given). One process
per stage and dataset, one worker. Imports are not counted, nor is compiling: a tiny share goes before, unmeasured.
"checksums and files": digests of the raw files and reading them, done once more by themselves, which can be taken off
conversion. HOIDATA_BENCH_CORPORA as in ``corpus``.
"""

import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hoidata.store.store import open_store
from tests.bench.corpus import PAPER, embedded_root, replicate
from tests.bench.growth import show_growth
from tests.bench.harness import show
from tests.bench.scale import annotate, contact

GOAL_S, GOAL_MIB = 90, 2048
SMALLEST = 0.001
DISK = "checksums and files"


def convert(name: str, raw: Path, out: Path) -> None:
    from hoidata.conversion.convert import convert_dataset
    from hoidata.datasets import get_adapter
    from hoidata.hands import load_embedded_hands

    adapter, clips = get_adapter(name), out / name / "clips"
    convert_dataset(adapter, raw / name, load_embedded_hands(), clips, 1, synthetic=True, progress=False)


def read_and_digest(name: str, raw: Path, out: Path) -> None:
    for path in sorted((raw / name).rglob("*")):
        if path.is_file():
            hashlib.sha256(path.read_bytes())


STAGES: dict[str, Callable[[str, Path, Path], None]] = {
    DISK: read_and_digest,
    "convert": convert,
    "annotate": annotate,
    "contact": contact,
}


def run_stage(stage: str, name: str, raw: Path, out: Path) -> None:
    """In a process of its own: print seconds of the processor and peak memory as the last line."""
    start = time.process_time()
    STAGES[stage](name, raw, out)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"processor_s": time.process_time() - start, "peak_mib": peak_mib}))


def measured(stage: str, name: str, raw: Path, out: Path) -> dict[str, float]:
    command = [sys.executable, "-m", "tests.bench.whole", "--stage", stage, name, str(raw), str(out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    print(f"{stage} of {name}: {found}", file=sys.stderr, flush=True)
    return found


@dataclass(frozen=True)
class ShareFigures:
    """One share. clips, seconds (by stage): per dataset, in the order of ``PAPER``; peak_mib: by stage."""

    share: float
    clips: list[int]
    frames: int
    seconds: dict[str, list[float]]
    peak_mib: dict[str, float]

    @property
    def counted_s(self) -> float:
        """All stages, without checksums and reading files."""
        return sum(sum(own) * (-1 if stage == DISK else 1) for stage, own in self.seconds.items())

    def rows(self) -> list[list[str]]:
        rows = [
            [stage, *(f"{value:.1f}" for value in own), f"{sum(own):.1f}", f"{self.peak_mib[stage]:.0f}"]
            for stage, own in self.seconds.items()
        ]
        counts = [f"{count:,}" for count in (*self.clips, sum(self.clips))]
        goal = f"all without {DISK} (goal {GOAL_S * self.share:g} s, {GOAL_MIB} MiB)"
        highest = max(self.peak_mib.values())
        rows.append([f"share {self.share:g}: clips; {self.frames:,} frames", *counts, ""])
        return [*rows, [goal, "", "", "", f"{self.counted_s:.1f}", f"{highest:.0f}"]]


def run_share(source: Path, folder: Path, share: float) -> ShareFigures:
    raw, out = folder / "raw", folder / "out"
    replicate(source, raw, share)
    found = {stage: [measured(stage, name, raw, out) for name in PAPER] for stage in STAGES}
    stores = [open_store(out / name / "clips") for name in PAPER]
    return ShareFigures(
        share,
        [len(store) for store in stores],
        sum(int(store.sequences["n_frames"].to_numpy().sum()) for store in stores),
        {stage: [item["processor_s"] for item in items] for stage, items in found.items()},
        {stage: max(item["peak_mib"] for item in items) for stage, items in found.items()},
    )


def main(shares: tuple[float, ...] = (0.01, 0.1, 1.0)) -> None:
    corpora = embedded_root()
    # Beside the corpora: hard links do not leave a file system.
    with tempfile.TemporaryDirectory(prefix="bench-whole-", dir=corpora.parent) as folder:
        run_share(corpora, Path(folder) / "compile", SMALLEST)
        figures = [run_share(corpora, Path(folder) / f"share-{share:g}", share) for share in shares]
    rows = [row for figure in figures for row in figure.rows()]
    show("Raw files to annotated store, one core", ["processor s", *PAPER, "all", "peak MiB"], rows)
    lines = {f"{stage}, processor s": [sum(figure.seconds[stage]) for figure in figures] for stage in STAGES}
    lines["all without " + DISK + ", processor s"] = [figure.counted_s for figure in figures]
    lines["peak memory, MiB"] = [max(figure.peak_mib.values()) for figure in figures]
    show_growth("Growth with the number of clips", [sum(figure.clips) for figure in figures], lines)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--stage"]:
        run_stage(sys.argv[2], sys.argv[3], Path(sys.argv[4]), Path(sys.argv[5]))
    else:
        main(*([tuple(map(float, sys.argv[1:]))] if sys.argv[1:] else []))
