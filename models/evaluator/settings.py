"""Settings of the evaluator; importing them loads no torch."""

from dataclasses import dataclass
from typing import Literal

NetworkName = Literal["paper", "corrected", "text-motion"]


@dataclass(frozen=True)
class EvaluatorSettings:
    """networks: which are trained; none turns the evaluator off. labels: what the classifiers tell apart.

    seeds: a training each, of which the one with the middle validation accuracy is kept. paper_loss: of ``paper``,
    the released sigmoid with cross-entropy or softmax. most_steps: of the optimiser, per training.
    """

    networks: tuple[NetworkName, ...] = ()
    labels: Literal["verb", "verb_object"] = "verb"
    seeds: tuple[int, ...] = (0,)
    paper_loss: Literal["sigmoid", "softmax"] = "sigmoid"
    most_steps: int = 3_000
