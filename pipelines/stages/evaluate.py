"""Stage evaluate: held-out figures of the four models of one dataset, each beside its baselines."""

from pathlib import Path
from typing import Any

from pipelines.lineage.graph import read_params
from pipelines.stages.base import Place, empty_reason, load_hands, write_json


def run(place: Place) -> None:
    """Write the metrics; a dataset without clips gets the reason in their place."""
    params = read_params(Path())["evaluate"]
    if reason := empty_reason(place.clips):
        write_json(place.metrics, {"empty": reason, "held_out_clips": 0})
        return
    evaluate(place, params)


def evaluate(place: Place, params: dict[str, Any]) -> None:
    """Measure on the test split; the evaluation checks its own settings."""
    from models.common.evaluation import evaluate_dataset

    evaluate_dataset(place.data, place.checkpoints, place.metrics, params, hands=load_hands(place.profile))
