"""Settings of the evaluator; importing them loads no torch."""

from dataclasses import dataclass
from typing import Literal

NetworkName = Literal["paper", "corrected", "text-motion"]


@dataclass(frozen=True)
class EvaluatorSettings:
    """networks: which are trained; none turns the evaluator off. Classifiers tell verbs apart.

    seeds: a training each, of which the one with the middle validation accuracy is kept. most_steps: of the optimiser,
    per training.
    """

    networks: tuple[NetworkName, ...] = ()
    seeds: tuple[int, ...] = (0,)
    most_steps: int = 1_500
