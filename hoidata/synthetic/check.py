"""The figures of an embedded corpus: are its held frames physically possible, and would wrong ones be noticed?"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from rich.table import Table

from hoidata.hands import load_embedded_hands
from hoidata.physics.contact_forces import RESIDUAL_LIMIT
from hoidata.synthetic.corpus import AnySize, datasets_of, make_corpus
from hoidata.synthetic.soundness import measure, residuals_without_contact
from hoidata.synthetic.truth import TruthSequence
from hoidata.workers import in_workers

SHIFT_M = 0.010
_DIRECTIONS_SEED = 7


class SequenceFigures(NamedTuple):
    """Counts over the held frames of one sequence; distances in metres over its frames."""

    dataset: str
    held: int
    feasible: int
    feasible_shifted: int
    feasible_without_contact: int
    largest_distance_m: float
    largest_penetration_m: float
    clip_frames: int
    verb: str


def sequence_figures(truth: TruthSequence) -> SequenceFigures:
    """Figures of one sequence and of its two controls: hands moved by 10 mm, and no hands."""
    pair = load_embedded_hands()
    sound = measure(truth, pair)
    residuals = (sound.residual, measure(truth, pair, _shift(truth)).residual, residuals_without_contact(truth))
    feasible, shifted, without = (int((residual < RESIDUAL_LIMIT).sum()) for residual in residuals)
    return SequenceFigures(
        truth.dataset, len(sound.residual), feasible, shifted, without, float(sound.distance_m.max(initial=0)),
        float(sound.penetration_m.max()), len(truth.clip_frames), truth.verb,
    )  # fmt: skip


def _shift(truth: TruthSequence) -> np.ndarray:
    """10 mm in a direction that differs from sequence to sequence but not from run to run."""
    seed = [_DIRECTIONS_SEED, *truth.source_key.encode(), truth.raw_start]
    direction = np.random.default_rng(seed).normal(size=3)
    return SHIFT_M * direction / np.linalg.norm(direction)


def explained_by_verb(verbs: list[str], lengths: list[int]) -> float:
    """Share of the variance of clip lengths that the verb's mean explains."""
    names, values = np.array(verbs), np.array(lengths, dtype=np.float64)
    means = {verb: values[names == verb].mean() for verb in set(verbs)}
    residual = values - np.array([means[verb] for verb in verbs])
    return 1.0 - float((residual**2).sum() / ((values - values.mean()) ** 2).sum())


def check_sequences(sequences: list[TruthSequence], jobs: int = 1) -> pd.DataFrame:
    """One row per dataset: shares of held frames that pass, extremes in mm, controls, and what the verb explains."""
    figures: list[SequenceFigures] = [found for _, found in in_workers(sequence_figures, sequences, jobs)]
    datasets = dict.fromkeys(truth.dataset for truth in sequences)
    return pd.DataFrame([_row(dataset, [one for one in figures if one.dataset == dataset]) for dataset in datasets])


def _row(dataset: str, own: list[SequenceFigures]) -> dict[str, str | int | float]:
    held = sum(one.held for one in own)
    return {
        "dataset": dataset,
        "sequences": len(own),
        "held frames": held,
        "pass %": 100 * sum(one.feasible for one in own) / held,
        "pass % shifted 10 mm": 100 * sum(one.feasible_shifted for one in own) / held,
        "pass % without contact": 100 * sum(one.feasible_without_contact for one in own) / held,
        "largest hand-object distance mm": 1000 * max(one.largest_distance_m for one in own),
        "largest penetration mm": 1000 * max(one.largest_penetration_m for one in own),
        "clip length explained by verb %": 100
        * explained_by_verb([one.verb for one in own], [one.clip_frames for one in own]),
        "longest clip": max(one.clip_frames for one in own),
    }


def check_corpus(size: AnySize = "full", seed: int = 0, jobs: int = 2, datasets: tuple[str, ...] = ()) -> pd.DataFrame:
    """Make the corpora again and measure them. datasets: some of those that have this size; none named: all."""
    made = [truth for dataset in datasets or datasets_of(size) for truth in make_corpus(dataset, seed, size, jobs)]
    return check_sequences(made, jobs)


def as_text(figures: pd.DataFrame) -> Table:
    """The figures for the terminal, one dataset per column."""
    table = Table("", *figures["dataset"])
    for name in figures.columns[1:]:
        table.add_row(name, *(f"{value:.4g}" if isinstance(value, float) else str(value) for value in figures[name]))
    return table
