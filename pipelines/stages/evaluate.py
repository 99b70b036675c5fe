"""Stage evaluate: every metric of one family's motions of one dataset. It knows no family."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hoidata.files.written import read_json, read_json_rows
from pipelines.stages.base import StagePaths, empty_reason, jobs, load_hands, load_settings, write_json

if TYPE_CHECKING:
    from models.evaluator.encoders import MotionEvaluator


@dataclass(frozen=True)
class EvaluateSettings:
    """metrics: lists of ``hoidata/metrics/asked_metrics.py`` that are computed beside the one that always is."""

    metrics: tuple[str, ...] = ()


def run(paths: StagePaths) -> None:
    """Write the metrics; a dataset or family without motions gets the reason instead."""
    folders = (paths.clips, paths.annotation, paths.contact, paths.splits, paths.samples)
    if reason := next(filter(None, map(empty_reason, folders)), None):
        write_json(paths.metrics, {"empty": reason, "held_out_clips": 0})
        return
    from hoidata.metrics.asked_metrics import with_lists
    from hoidata.metrics.evaluate import evaluate_store

    hands, encoders = load_hands(paths.profile), _encoders(paths)
    samples, metrics = paths.samples / "clips", with_lists(load_settings(EvaluateSettings, "evaluate").metrics)
    found = evaluate_store(samples, paths.data, hands, metrics=metrics, encoders=encoders, jobs=jobs(), progress=True)
    found["left_out"] = _with_reasons(found["left_out"], paths.samples / "left_out.json")
    diagnostics = read_json(paths.samples / "diagnostics.json")
    write_json(paths.metrics, found | {"diagnostics": diagnostics})


def _with_reasons(left_out: list[dict[str, str]], told: Path) -> list[dict[str, str]]:
    """What was left out, with the reason of the family itself where it had no motion for a clip."""
    known = read_json_rows(told, {"clip_id": str, "reason": str}) if told.is_file() else []
    reasons = {item["clip_id"].rpartition("~")[0]: item["reason"] for item in known}
    return [{**item, "reason": reasons.get(item["clip_id"], item["reason"])} for item in left_out]


def _encoders(paths: StagePaths) -> list["MotionEvaluator"]:
    """The networks of the stage evaluator; none, and no torch either, where that is off."""
    if not (paths.evaluators / "info.json").is_file():
        return []
    from models.evaluator.encoders import load_evaluators

    return load_evaluators(paths.evaluators)
