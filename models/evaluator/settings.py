"""Settings of the evaluator. This module does not import torch."""

from dataclasses import dataclass
from typing import Literal

NetworkName = Literal["paper", "corrected", "text-motion"]


@dataclass(frozen=True)
class EvaluatorSettings:
    """Networks that measure generated motions: classifiers of verbs, and a text-motion encoder.

    networks: the networks to train; empty turns the evaluator off. seeds: one training per seed; the one with the
    median validation score is used. most_steps: optimiser steps per training; by
    default early stopping ends it.
    """

    networks: tuple[NetworkName, ...] = ()
    seeds: tuple[int, ...] = (0,)
    most_steps: int = 20_000
