"""A corpus of the papers' size: time, memory and bytes of conversion, annotation and contact, and how they grow.

``python -m bench.scale [SHARE ...]`` (0.01, 0.1 and 1 when none is given). The raw files are those of the
embedded corpora, repeated (see ``corpus``); nothing is read from a manifest. Each stage runs in processes of its own,
so that its memory can be told apart; conversion on HOIDATA_BENCH_JOBS workers (2 if not given), the others on one
process, as the graph runs them. "checksums and files": digests of the raw files and reading them, done once more by
themselves, which can be taken off conversion.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from bench.corpus import PAPER, embedded_root, replicate
from bench.growth import show_growth
from bench.harness import TreeMemory, show
from hoidata.lifetime import end_with_parent
from hoidata.store.mapped import map_npz
from hoidata.store.store import open_store

MEBI = 1 << 20
MEMORY = ("peak_at_once", "own_at_once", "sum_of_peaks")
DISK = "checksums and files"
PARTS = ("clips", "annotation", "contact")
# What a clip's motion is made of; all else in the arrays is what a source offers besides (contact labels, cameras).
PARAMETERS = (
    *(f"{side}_{name}" for side in ("left", "right") for name in ("wrist_m", "global_orient", "hand_pose", "valid")),
    *("left_betas", "right_betas", "source_frames", "object_rotvec", "object_translation_m", "object_hinge_rad"),
)


@dataclass(frozen=True)
class Measured:
    """One stage over all datasets. processor_s counts all processes; the rest is that of ``TreeMemory``."""

    wall_s: float
    processor_s: float
    peak_at_once: int
    own_at_once: int
    sum_of_peaks: int


def convert(name: str, raw: Path, out: Path) -> None:
    from hoidata.conversion.convert import convert_dataset
    from hoidata.datasets import get_adapter
    from hoidata.hands import load_embedded_hands

    jobs, clips = int(os.environ.get("HOIDATA_BENCH_JOBS", "2")), out / name / "clips"
    convert_dataset(get_adapter(name), raw / name, load_embedded_hands(), clips, jobs, synthetic=True)


def read_and_digest(name: str, raw: Path, out: Path) -> None:
    for path in sorted((raw / name).rglob("*")):
        if path.is_file():
            hashlib.sha256(path.read_bytes())


def annotate(name: str, raw: Path, out: Path) -> None:
    from hoidata.annotation.stage import annotate_store

    print(annotate_store(out / name / "clips", out / name / "annotation", encoder="hash"))


def contact(name: str, raw: Path, out: Path) -> None:
    from hoidata.contact.stage import contact_store

    print(contact_store(out / name / "clips", out / name / "contact"))


STAGES: dict[str, Callable[[str, Path, Path], None]] = {
    DISK: read_and_digest,
    "convert": convert,
    "annotate": annotate,
    "contact": contact,
}


def measured(stage: str, name: str, raw: Path, out: Path) -> Measured:
    """Run one stage of one dataset in a process of its own."""
    command = [sys.executable, "-m", "bench.scale", "--stage", stage, name, str(raw), str(out)]
    before, start = os.times(), time.perf_counter()
    environment, end = {**os.environ, "OMP_NUM_THREADS": "1"}, partial(end_with_parent, os.getpid())
    process = subprocess.Popen(command, env=environment, stdout=sys.stderr, preexec_fn=end)
    with TreeMemory(process.pid) as memory:
        code = process.wait()
    if code:
        raise RuntimeError(f"{stage} of {name} ended with exit code {code}")
    wall, after = time.perf_counter() - start, os.times()
    processor = after.children_user + after.children_system - before.children_user - before.children_system
    found = Measured(wall, processor, memory.peak_at_once, memory.own_at_once, memory.sum_of_peaks)
    print(f"{stage} of {name}: {found}", file=sys.stderr)
    return found


def total(parts: list[Measured]) -> Measured:
    """Datasets run one after another: times add up, peaks do not."""
    return Measured(
        sum(part.wall_s for part in parts),
        sum(part.processor_s for part in parts),
        max(part.peak_at_once for part in parts),
        max(part.own_at_once for part in parts),
        max(part.sum_of_peaks for part in parts),
    )


def run_share(source: Path, folder: Path, share: float, stages: tuple[str, ...] = tuple(STAGES)) -> dict:
    """Make, convert, annotate and measure one corpus below ``folder``; figures as JSON values."""
    raw, out = folder / "raw", folder / "out"
    start = time.perf_counter()
    wanted = replicate(source, raw, share)
    made_s = time.perf_counter() - start
    found = {stage: total([measured(stage, name, raw, out) for name in PAPER]) for stage in stages}
    stores = {name: open_store(out / name / "clips") for name in PAPER}
    clips = {name: len(store) for name, store in stores.items()}
    if clips != wanted:
        raise AssertionError(f"{clips} clips, wanted {wanted}")
    frames = sum(int(store.sequences["n_frames"].to_numpy().sum()) for store in stores.values())
    return {
        "share": share,
        "made_s": made_s,
        "clips": sum(clips.values()),
        "sequences": sum(store.sequences["sequence"].nunique() for store in stores.values()),
        "frames": frames,
        "parameter_bytes": sum(parameter_bytes(store.folder) for store in stores.values()),
        "bytes": {part: sum(folder_bytes(out / name / part) for name in PAPER) for part in PARTS},
        "stages": {stage: asdict(value) for stage, value in found.items()},
    }


def parameter_bytes(store: Path) -> int:
    """Bytes of the arrays a clip's motion is made of."""
    shards = sorted((store / "arrays").glob("frames-*.npz"))
    return sum(array.nbytes for path in shards for name, array in map_npz(path).items() if name in PARAMETERS)


def folder_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def report(figures: list[dict]) -> None:
    rows = [(name, *(line(figure) for figure in figures)) for name, line in LINES.items()]
    show("Paper scale", ["", *(f"share {figure['share']:g}" for figure in figures)], rows)
    lines = {name: [size(figure) for figure in figures] for name, size in GROWING.items()}
    show_growth("Growth with the number of clips", [figure["clips"] for figure in figures], lines)


def _stage(stage: str, key: str) -> Callable[[dict], float]:
    return lambda figure: figure["stages"][stage][key]


def _seconds(stage: str) -> Callable[[dict], str]:
    return lambda figure: f"{_stage(stage, 'wall_s')(figure):.1f} / {_stage(stage, 'processor_s')(figure):.1f} s"


def _peak(stage: str) -> Callable[[dict], str]:
    return lambda figure: " / ".join(f"{_stage(stage, kind)(figure) / MEBI:.0f}" for kind in MEMORY) + " MiB"


def _mebibytes(size: Callable[[dict], float]) -> Callable[[dict], str]:
    return lambda figure: f"{size(figure) / MEBI:,.1f} MiB"


BYTES: dict[str, Callable[[dict], float]] = {
    "bytes of parameters": lambda figure: figure["parameter_bytes"],
    **{f"bytes of {part}": lambda figure, part=part: figure["bytes"][part] for part in PARTS},
    "bytes of all": lambda figure: sum(figure["bytes"].values()),
}
GROWING: dict[str, Callable[[dict], float]] = {
    **{f"{name}, MiB": lambda figure, size=size: size(figure) / MEBI for name, size in BYTES.items()},
    **{
        f"{stage}, peak MiB": lambda figure, stage=stage: _stage(stage, "peak_at_once")(figure) / MEBI
        for stage in STAGES
    },
    **{f"{stage}, processor s": _stage(stage, "processor_s") for stage in STAGES},
    "all stages, processor s": lambda figure: sum(
        _stage(stage, "processor_s")(figure) for stage in STAGES if stage != DISK
    ),
}
LINES: dict[str, Callable[[dict], str]] = {
    "clips / sequences": lambda figure: f"{figure['clips']:,} / {figure['sequences']:,}",
    "frames": lambda figure: f"{figure['frames']:,}",
    "making the raw folder (links)": lambda figure: f"{figure['made_s']:.1f} s",
    **{f"{stage}: wall / processor": _seconds(stage) for stage in STAGES},
    "convert: frames per second": lambda figure: f"{figure['frames'] / _stage('convert', 'wall_s')(figure):,.0f}",
    **{f"{stage}: memory at once / no file's / sum of peaks": _peak(stage) for stage in STAGES},
    "parameters per frame": lambda figure: f"{figure['parameter_bytes'] / figure['frames']:.1f} bytes",
    **{name: _mebibytes(size) for name, size in BYTES.items()},
    "all per frame": lambda figure: f"{sum(figure['bytes'].values()) / figure['frames']:.1f} bytes",
}


def main(shares: tuple[float, ...] = (0.01, 0.1, 1.0)) -> None:
    """Measure each share, one after another, and show them side by side."""
    corpora = embedded_root()
    # Beside the corpora: hard links do not leave a file system.
    with tempfile.TemporaryDirectory(prefix="bench-scale-", dir=corpora.parent) as folder:
        figures = [run_share(corpora, Path(folder) / f"share-{share:g}", share) for share in shares]
    report(figures)
    print(json.dumps(figures))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--stage"]:
        STAGES[sys.argv[2]](sys.argv[3], Path(sys.argv[4]), Path(sys.argv[5]))
    else:
        main(*([tuple(map(float, sys.argv[1:]))] if sys.argv[1:] else []))
