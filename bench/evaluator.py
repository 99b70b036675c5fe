"""What the evaluator costs: its training on annotated datasets, and the figures of features of 256 clips x 20 motions.

``python -m bench evaluator``. HOIDATA_BENCH_ANNOTATED: annotated datasets (``data/study/grab``), parted by ":";
without it training is left out. Nothing is run twice: a training takes its minute.
"""

import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.harness import show
from hoidata.metrics.encoded import EncodedSet
from hoidata.metrics.feature_metrics import FEATURE_METRICS, feature_figures
from models.evaluator.settings import EvaluatorSettings, NetworkName
from models.evaluator.stage import train_evaluators

CLIPS, REPETITIONS, TRAIN, LABELS = 256, 20, 600, 11
SIZES = {"paper": 128, "corrected": 32, "text-motion": 64, "path": 2070}
NETWORKS: tuple[NetworkName, ...] = ("paper", "corrected", "text-motion")


def main() -> None:
    roots = [Path(root) for root in os.environ.get("HOIDATA_BENCH_ANNOTATED", "").split(":") if root]
    rows = [_training_row(root, (name,), (0,), 1) for root in roots for name in NETWORKS]
    rows += [_training_row(root, NETWORKS, (0, 1, 2), len(os.sched_getaffinity(0))) for root in roots]
    show("Training", ["dataset", "networks", "seeds", "at once", "clips", "processor s", "clock s"], rows)
    heads = ["encoder", "features", "figures", "processor s", "clock s"]
    show(f"Figures of {CLIPS} clips x {REPETITIONS} motions", heads, [_figures_row(name) for name in SIZES])


def _training_row(root: Path, names: tuple[NetworkName, ...], seeds: tuple[int, ...], jobs: int) -> list[str]:
    start = _spent()
    with tempfile.TemporaryDirectory() as out:
        found = train_evaluators(root, out, EvaluatorSettings(names, seeds=seeds), jobs=jobs)
    clips = found if isinstance(found, str) else str(found["clips"]["train"])
    return [str(root), ", ".join(names), str(len(seeds)), str(jobs), clips, *_since(start)]


def _figures_row(name: str) -> list[str]:
    reference = random_set(name, CLIPS, 1, seed=0)
    predicted, train = random_set(name, CLIPS, REPETITIONS, seed=1), random_set(name, TRAIN, 1, seed=2)
    start = _spent()
    feature_figures(predicted, reference, train)
    count = sum(metric.encoder == name for metric in FEATURE_METRICS)
    return [name, str(SIZES[name]), str(count), *_since(start)]


def random_set(name: str, clips: int, repetitions: int, seed: int) -> EncodedSet:
    """Features and logits drawn at random; verbs, prompts and objects as crossed as the corpus study has them."""
    random, clip = np.random.default_rng(seed), np.tile(np.arange(clips), repetitions)
    words = np.array([f"{number}" for number in range(max(clips, LABELS))])
    classifies = name in ("paper", "corrected")
    made = EncodedSet(
        name, "", tuple(words[:LABELS]) if classifies else (),
        random.normal(size=(len(clip), SIZES[name])), random.normal(size=(len(clip), LABELS if classifies else 0)),
        clip % LABELS, clip, np.repeat(np.arange(repetitions), clips), words[clip % 96], words[clip % 12], words[clip],
    )  # fmt: skip
    return replace(made, text=random.normal(size=made.features.shape)) if name == "text-motion" else made


def _spent() -> tuple[float, float]:
    """Seconds of processor time, of processes that have ended too, and by the clock."""
    times = os.times()
    return sum(times[:4]), time.perf_counter()


def _since(start: tuple[float, float]) -> list[str]:
    return [f"{now - before:.1f}" for now, before in zip(_spent(), start, strict=True)]


if __name__ == "__main__":
    main()
