"""The whole corpus on one core: raw files of three datasets to the annotated store, seconds of the processor by stage.

``python -m tests.bench.whole [SHARE ...]`` (1, the paper's 6,592 clips, when none is given). One process per stage and
dataset, one worker. Imports are not counted. "checksums and files": digests of the raw files and reading them, done
once more by themselves, which can be taken off conversion. HOIDATA_BENCH_CORPORA as in ``corpus``.
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
from pathlib import Path

from hoidata.schema.store import open_store
from tests.bench.corpus import PAPER, embedded_root, replicate
from tests.bench.harness import show
from tests.bench.scale import annotate, contact

GOAL_S, GOAL_MIB = 90, 2048


def convert(name: str, raw: Path, out: Path) -> None:
    from hoidata.adapters import get_adapter
    from hoidata.adapters.convert import convert_dataset
    from hoidata.hands import load_embedded_hands

    adapter, clips = get_adapter(name), out / name / "clips"
    convert_dataset(adapter, raw / name, load_embedded_hands(), clips, 1, synthetic=True, progress=False)


def read_and_digest(name: str, raw: Path, out: Path) -> None:
    for path in sorted((raw / name).rglob("*")):
        if path.is_file():
            hashlib.sha256(path.read_bytes())


STAGES: dict[str, Callable[[str, Path, Path], None]] = {
    "checksums and files": read_and_digest,
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


def run_share(source: Path, folder: Path, share: float) -> list[list[str]]:
    """Rows of the table: a stage, its seconds per dataset and in all, its peak."""
    raw, out = folder / "raw", folder / "out"
    replicate(source, raw, share)
    rows, total, highest = [], 0.0, 0.0
    for stage in STAGES:
        found = [measured(stage, name, raw, out) for name in PAPER]
        seconds, peak = sum(item["processor_s"] for item in found), max(item["peak_mib"] for item in found)
        rows.append([stage, *(f"{item['processor_s']:.1f}" for item in found), f"{seconds:.1f}", f"{peak:.0f}"])
        total += -seconds if stage == "checksums and files" else seconds
        highest = max(highest, peak)
    stores = [open_store(out / name / "clips") for name in PAPER]
    counts = [str(len(store)) for store in stores]
    frames = sum(int(store.sequences["n_frames"].sum()) for store in stores)
    rows.append([f"share {share:g}: clips; {frames:,} frames", *counts, str(sum(map(len, stores))), ""])
    goal = f"all without checksums and files (goal {GOAL_S * share:g} s, {GOAL_MIB} MiB)"
    rows.append([goal, "", "", "", f"{total:.1f}", f"{highest:.0f}"])
    return rows


def main(shares: tuple[float, ...] = (1.0,)) -> None:
    corpora = embedded_root()
    rows = []
    # Beside the corpora: hard links do not leave a file system.
    with tempfile.TemporaryDirectory(prefix="bench-whole-", dir=corpora.parent) as folder:
        for share in shares:
            rows += run_share(corpora, Path(folder) / f"share-{share:g}", share)
    show("Raw files to annotated store, one core", ["processor s", *PAPER, "all", "peak MiB"], rows)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--stage"]:
        run_stage(sys.argv[2], sys.argv[3], Path(sys.argv[4]), Path(sys.argv[5]))
    else:
        main(*([tuple(map(float, sys.argv[1:]))] if sys.argv[1:] else []))
