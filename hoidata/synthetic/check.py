"""Physical plausibility of an embedded corpus, with negative controls: shifted hands, and no hands."""

from typing import NamedTuple

import numpy as np
import pandas as pd
from rich.table import Table

from hoidata.hands import load_embedded_hands
from hoidata.physics.contact_forces import RESIDUAL_LIMIT
from hoidata.synthetic.corpus import AnySize, datasets_of, make_corpus
from hoidata.synthetic.soundness import measure, residuals_without_contact
from hoidata.synthetic.truth import TruthSequence
from hoidata.workers import map_in_workers

SHIFT_M = 0.010
_DIRECTIONS_SEED = 7


class SequenceMetrics(NamedTuple):
    """Counts over the lifted frames of one sequence; distances in metres over its frames."""

    dataset: str
    lifted: int
    feasible: int
    feasible_shifted: int
    feasible_without_contact: int
    largest_distance_m: float
    largest_penetration_m: float
    clip_frames: int
    verb: str


def sequence_metrics(truth: TruthSequence) -> SequenceMetrics:
    """Measure one sequence and its two negative controls: hands shifted by 10 mm, and no hands."""
    pair = load_embedded_hands()
    sound = measure(truth, pair)
    residuals = (sound.residual, measure(truth, pair, _shift(truth)).residual, residuals_without_contact(truth))
    feasible, shifted, without = (int((residual < RESIDUAL_LIMIT).sum()) for residual in residuals)
    return SequenceMetrics(
        dataset=truth.dataset,
        lifted=len(sound.residual),
        feasible=feasible,
        feasible_shifted=shifted,
        feasible_without_contact=without,
        largest_distance_m=float(sound.distance_m.max(initial=0)),
        largest_penetration_m=float(sound.penetration_m.max()),
        clip_frames=len(truth.clip_frames),
        verb=truth.verb,
    )


def _shift(truth: TruthSequence) -> np.ndarray:
    """Return a shift of 10 mm in a random direction, reproducible for each sequence."""
    seed = [_DIRECTIONS_SEED, *truth.source_key.encode(), truth.raw_start]
    direction = np.random.default_rng(seed).normal(size=3)
    return SHIFT_M * direction / np.linalg.norm(direction)


def explained_by_verb(verbs: list[str], lengths: list[int]) -> float:
    """Return the fraction of the variance of clip lengths that the means of the verbs explain."""
    names, values = np.array(verbs), np.array(lengths, dtype=np.float64)
    means = {verb: values[names == verb].mean() for verb in set(verbs)}
    residual = values - np.array([means[verb] for verb in verbs])
    return 1.0 - float((residual**2).sum() / ((values - values.mean()) ** 2).sum())


def check_sequences(sequences: list[TruthSequence], jobs: int = 1) -> pd.DataFrame:
    """Return one row per dataset: percentage of lifted frames that pass, extremes in mm, controls, clip lengths."""
    metrics: dict[str, list[SequenceMetrics]] = {truth.dataset: [] for truth in sequences}
    for _, item in map_in_workers(sequence_metrics, sequences, jobs):
        metrics[item.dataset].append(item)
    return pd.DataFrame([_dataset_metrics(dataset, items) for dataset, items in metrics.items()])


def _dataset_metrics(dataset: str, sequences: list[SequenceMetrics]) -> dict[str, str | int | float]:
    lifted, lengths = sum(item.lifted for item in sequences), [item.clip_frames for item in sequences]
    return {
        "dataset": dataset,
        "sequences": len(sequences),
        "held frames": lifted,
        "pass %": 100 * sum(item.feasible for item in sequences) / lifted,
        "pass % shifted 10 mm": 100 * sum(item.feasible_shifted for item in sequences) / lifted,
        "pass % without contact": 100 * sum(item.feasible_without_contact for item in sequences) / lifted,
        "largest hand-object distance mm": 1000 * max(item.largest_distance_m for item in sequences),
        "largest penetration mm": 1000 * max(item.largest_penetration_m for item in sequences),
        "clip length explained by verb %": 100 * explained_by_verb([item.verb for item in sequences], lengths),
        "longest clip": max(lengths),
    }


def check_corpus(size: AnySize = "full", seed: int = 0, jobs: int = 2) -> pd.DataFrame:
    """Generate the corpora again and measure them."""
    sequences = [truth for dataset in datasets_of(size) for truth in make_corpus(dataset, seed, size, jobs)]
    return check_sequences(sequences, jobs)


def as_text(metrics: pd.DataFrame) -> Table:
    """Format the metrics for the terminal, one dataset per column."""
    table = Table("", *metrics["dataset"])
    for name in metrics.columns[1:]:
        table.add_row(name, *(f"{value:.4g}" if isinstance(value, float) else str(value) for value in metrics[name]))
    return table
