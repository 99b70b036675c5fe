"""Stage evaluate: every metric of one family's motions of one dataset. It knows no network and no family."""

import json

from pipelines.stages.base import Place, empty_reason, jobs, load_hands, write_json


def run(place: Place) -> None:
    """Write the metrics; a dataset or family without motions gets the reason in their place."""
    folders = (place.clips, place.annotation, place.contact, place.splits, place.samples)
    if reason := next(filter(None, map(empty_reason, folders)), None):
        write_json(place.metrics, {"empty": reason, "held_out_clips": 0})
        return
    from hoidata.metrics.evaluate import evaluate_store

    hands = load_hands(place.profile)
    found = evaluate_store(place.samples / "clips", place.data, hands, jobs=jobs(), progress=True)
    diagnostics = json.loads((place.samples / "diagnostics.json").read_text(encoding="utf-8"))
    write_json(place.metrics, found | {"diagnostics": diagnostics})
