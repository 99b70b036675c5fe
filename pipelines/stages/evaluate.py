"""Stage evaluate: every metric of one family's motions of one dataset. It knows no family."""

import json
from typing import TYPE_CHECKING

from pipelines.stages.base import Place, empty_reason, jobs, load_hands, write_json

if TYPE_CHECKING:
    from models.evaluator.encoders import MotionEvaluator


def run(place: Place) -> None:
    """Write the metrics; a dataset or family without motions gets the reason in their place."""
    folders = (place.clips, place.annotation, place.contact, place.splits, place.samples)
    if reason := next(filter(None, map(empty_reason, folders)), None):
        write_json(place.metrics, {"empty": reason, "held_out_clips": 0})
        return
    from hoidata.metrics.evaluate import evaluate_store

    hands, encoders = load_hands(place.profile), _encoders(place)
    samples = place.samples / "clips"
    found = evaluate_store(samples, place.data, hands, encoders=encoders, jobs=jobs(), progress=True)
    diagnostics = json.loads((place.samples / "diagnostics.json").read_text(encoding="utf-8"))
    write_json(place.metrics, found | {"diagnostics": diagnostics})


def _encoders(place: Place) -> list["MotionEvaluator"]:
    """The networks of the stage evaluator; none, and no torch either, where that is off."""
    if not (place.evaluators / "info.json").is_file():
        return []
    from models.evaluator.encoders import load_evaluators

    return load_evaluators(place.evaluators)
