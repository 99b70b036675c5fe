"""Memory of a conversion does not grow with the dataset: one sequence per worker, one shard of the store."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hoidata.store.writing import FRAMES_PER_SHARD
from tests.hoidata.conversion.killable import write_grab

FRAMES = 1000
CONVERT = """
import resource, sys
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.hands import load_embedded_hands

if __name__ == "__main__":
    raw, out, jobs = sys.argv[1:]
    summary = convert_dataset(GrabAdapter(), raw, load_embedded_hands(), out, int(jobs), progress=False)
    peaks = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(summary.clips, summary.frames, *peaks)
"""


def write_repeated(root: Path, hands, n_sequences: int) -> None:
    """Write ``n_sequences`` sequences: two files, linked under further names."""
    write_grab(root, hands, 2, FRAMES, 30)
    written = sorted((root / "grab").glob("*/*.npz"))
    for number in range(2, n_sequences):
        source = written[number % 2]
        os.link(source, source.with_stem(f"{source.stem}_{number:04d}"))


def peaks_mib(root: Path, out: Path, jobs: int, n_sequences: int) -> tuple[float, float]:
    """Highest resident memory of the parent and of its largest worker."""
    command = [sys.executable, "-c", CONVERT, str(root), str(out), str(jobs)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    clips, frames, parent, worker = map(int, done.stdout.split())
    assert (clips, frames) == (n_sequences, n_sequences * (FRAMES - 12))
    return parent / 1024, worker / 1024


@pytest.mark.long
def test_memory_does_not_grow_with_the_number_of_clips(tmp_path, hands):
    small, large = 70, 210
    assert small * (FRAMES - 12) > FRAMES_PER_SHARD  # both fill a shard; the larger one holds 60 MB more of clips
    for count in (small, large):
        write_repeated(tmp_path / f"raw{count}", hands, count)
    alone, _ = peaks_mib(tmp_path / f"raw{small}", tmp_path / "small", 1, small)
    parent, worker = peaks_mib(tmp_path / f"raw{large}", tmp_path / "large", 2, large)
    assert parent < alone + 25
    assert worker < alone + 25
