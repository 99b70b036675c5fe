"""What evaluation costs: every metric of the registry, in processor time per motion, and 256 clips x 20 motions of it.

``python -m bench evaluate``. The annotated dataset of HOIDATA_BENCH_DATA (data/embedded/grab if not given); its
test clips stand in for predictions, HOIDATA_BENCH_SAMPLES (20 if not given) of each, every one a little off.
"""

import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.harness import show
from hoidata.clips.clip import Clip
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.pair import Pair
from hoidata.metrics.registry import METRICS
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.store import write_store

CLIPS, REPETITIONS, LIMIT_MS = 256, 20, 230  # E6 of the issue: 10 minutes on two cores


def main() -> None:
    root = Path(os.environ.get("HOIDATA_BENCH_DATA", "data/embedded/grab"))
    samples = int(os.environ.get("HOIDATA_BENCH_SAMPLES", REPETITIONS))
    annotated, seconds = load_annotated(root), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        write_store(Path(folder) / "clips", predictions(annotated, samples), annotated.info)
        evaluate_store(Path(folder) / "clips", root, metrics=METRICS[:1])  # compiles and warms up
        start = time.process_time()
        timed = tuple(replace(item, measure=counted(item.name, item.measure, seconds)) for item in METRICS)
        found = evaluate_store(Path(folder) / "clips", root, metrics=timed)
        seconds["reading, intervals, limits of verbs"] = time.process_time() - start - sum(seconds.values())
    motions, total = found["motions"], sum(seconds.values())
    rows = [[name, f"{value:.2f}", f"{1e3 * value / motions:.2f}"] for name, value in seconds.most_common()]
    rows.append(["all", f"{total:.2f}", f"{1e3 * total / motions:.2f}"])
    frames = np.mean([annotated.clip(clip_id).n_frames for clip_id in annotated.ids("test")])
    title = f"{motions} motions of {found['held_out_clips']} clips of {frames:.0f} frames, processor time"
    show(title, ["metric (what two share counts for the first)", "s", "ms per motion"], rows)
    minutes = total / motions * CLIPS * REPETITIONS / 60
    print(f"{CLIPS} clips x {REPETITIONS}: {minutes:.1f} minutes of processor time, half on two cores; "
          f"{LIMIT_MS} ms per motion would be {LIMIT_MS * CLIPS * REPETITIONS / 6e4:.1f}")  # fmt: skip


def predictions(annotated: AnnotatedStore, samples: int) -> Iterator[Clip]:
    """Recorded test clips with their hands moved by millimetres, ``samples`` of each."""
    draw = np.random.default_rng(0)
    for clip_id in annotated.ids("test"):
        clip = annotated.clip(clip_id)
        for number in range(samples):
            shift = draw.normal(0, 0.01, 3).astype(np.float32)
            hands = {side: replace(hand, wrist_m=hand.wrist_m + shift) for side, hand in clip.hands.items()}
            yield replace(clip, clip_id=f"{clip_id}~{number}", hands=hands)


def counted(name: str, measure: Callable, seconds: Counter[str]) -> Callable[[Pair, int], np.ndarray]:
    """The metric's function, its processor time added up under its name."""

    def measured(pair: Pair, every: int) -> np.ndarray:
        start = time.process_time()
        values = measure(pair, every)
        seconds[name] += time.process_time() - start
        return values

    return measured


if __name__ == "__main__":
    main()
