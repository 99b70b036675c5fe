"""Stage evaluate: every metric of all motions of one dataset, a file per family. It knows no family."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoidata.errors import BadInput
from hoidata.files import write_whole
from hoidata.files.atomic import atomic_folder, canonical_json
from hoidata.files.written import read_json, read_json_rows
from pipelines.lineage.digests import path_digest, value_digest
from pipelines.params import read_params
from pipelines.stages.base import StagePaths, empty_reason, jobs, load_hands, load_settings, write_json
from pipelines.stages.families import families_of

if TYPE_CHECKING:
    from models.evaluator.encoders import MotionEvaluator

CODE = Path("code/evaluate.json")


@dataclass(frozen=True)
class EvaluateSettings:
    """metrics: lists of ``hoidata/metrics/asked_metrics.py`` that are computed beside the one that always is."""

    metrics: tuple[str, ...] = ()


def run(paths: StagePaths) -> None:
    """Write ``<family>.json`` for each family of params.yaml and ``controls/<name>.json`` for each control.

    A dataset or family without motions gets the reason instead. What an earlier run measured is taken over where
    nothing that it was made from has changed, so that a further family measures that family alone.
    """
    settings = load_settings(EvaluateSettings, "evaluate")
    families = families_of(read_params(Path()), paths.dataset)
    runs = {name: replace(paths, family=name) for name in families} | dict(_controls(paths))
    if missing := [str(own.samples) for own in runs.values() if not own.samples.is_dir()]:
        remedy = "correct params.yaml: families, or add stages that sample it"
        raise BadInput(", ".join(missing), "motions of every family of params.yaml", "no folder", remedy)
    shared = [settings.metrics, *map(path_digest, (CODE, *_inputs(paths), paths.evaluators))]
    found = {name: _kept_or_measured(own, settings, shared) for name, own in runs.items()}
    with atomic_folder(paths.metrics) as partial:
        for name, values in found.items():
            write_json(partial / f"{name}.json", values)


def _controls(paths: StagePaths) -> Iterator[tuple[str, StagePaths]]:
    """The rows of the stages ``controls``, by the name of their metrics."""
    for folder in sorted(replace(paths, family="").samples.glob("controls*")):
        for row in sorted(folder.iterdir()):
            if row.is_dir():
                yield f"controls/{row.name}", replace(paths, family=f"{folder.name}/{row.name}")


def _inputs(paths: StagePaths) -> tuple[Path, ...]:
    return paths.clips, paths.annotation, paths.contact, paths.splits


def _kept_or_measured(paths: StagePaths, settings: EvaluateSettings, shared: list[Any]) -> dict[str, Any]:
    """The metrics of one family; of an earlier run, also one that was stopped, where it measured the same."""
    made_from = value_digest([*shared, path_digest(paths.samples)])
    with suppress(BadInput, FileNotFoundError):
        kept = read_json(paths.measured)
        if kept.get("made_from") == made_from:
            return kept["metrics"]
    found = _measured(paths, settings)
    write_whole(paths.measured, canonical_json({"made_from": made_from, "metrics": found}))
    return found


def _measured(paths: StagePaths, settings: EvaluateSettings) -> dict[str, Any]:
    if reason := next(filter(None, map(empty_reason, (*_inputs(paths), paths.samples))), None):
        return {"empty": reason, "held_out_clips": 0}
    from hoidata.metrics.asked_metrics import with_lists
    from hoidata.metrics.evaluate import evaluate_store

    print(f"{paths}: measuring", flush=True)
    found = evaluate_store(
        paths.samples / "clips",
        paths.data,
        load_hands(paths.profile),
        metrics=with_lists(settings.metrics),
        encoders=_encoders(paths.evaluators),
        jobs=jobs(),
        progress=True,
    )
    found["left_out"] = _with_reasons(found["left_out"], paths.samples / "left_out.json")
    return found | {"diagnostics": read_json(paths.samples / "diagnostics.json")}


def _with_reasons(left_out: list[dict[str, str]], told: Path) -> list[dict[str, str]]:
    """What was left out, with the reason of the family itself where it had no motion for a clip."""
    known = read_json_rows(told, {"clip_id": str, "reason": str}) if told.is_file() else []
    reasons = {item["clip_id"].rpartition("~")[0]: item["reason"] for item in known}
    return [{**item, "reason": reasons.get(item["clip_id"], item["reason"])} for item in left_out]


def _encoders(folder: Path) -> list["MotionEvaluator"]:
    """The networks of the stage evaluator; none, and no torch either, where that is off."""
    if not (folder / "info.json").is_file():
        return []
    from models.evaluator.encoders import load_evaluators

    return load_evaluators(folder)
