"""Stage evaluate: the metrics of all sampled motions of one dataset, one file per family."""

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
from pipelines.metrics_files import write_leading_metrics
from pipelines.params import read_params
from pipelines.stages.base import StagePaths, empty_reason, jobs, load_hands, load_settings, write_json
from pipelines.stages.families import families_of

if TYPE_CHECKING:
    from models.evaluator.encoders import MotionEvaluator

CODE = Path("code/evaluate.json")


@dataclass(frozen=True)
class EvaluateSettings:
    """The section ``evaluate`` of params.yaml."""

    metrics: tuple[str, ...] = ()  # lists of ``hoidata/metrics/optional_metrics.py`` to compute as well


def run(paths: StagePaths) -> None:
    """Write ``<family>.json`` and ``controls/<name>.json`` for each family and control, and their leading metrics.

    The file of a dataset or family without motions has the reason instead. Metrics of an earlier run are reused if
    their inputs have not changed, so that a new family does not measure the others again.
    """
    settings = load_settings(EvaluateSettings, "evaluate")
    families = families_of(read_params(Path()), paths.dataset)
    runs = {name: replace(paths, family=name) for name in families} | dict(_controls(paths))
    if missing := [str(family_paths.samples) for family_paths in runs.values() if not family_paths.samples.is_dir()]:
        remedy = "correct params.yaml: families, or add stages that sample it"
        raise BadInput(", ".join(missing), "motions of every family of params.yaml", "no folder", remedy)
    shared = [settings.metrics, *map(path_digest, (CODE, *_inputs(paths), paths.evaluators))]
    metrics = {name: _cached_or_measured(family_paths, settings, shared) for name, family_paths in runs.items()}
    with atomic_folder(paths.metrics) as partial:
        for name, values in metrics.items():
            write_json(partial / f"{name}.json", values)
    write_leading_metrics(paths.leading_metrics, paths.metrics, families)


def _controls(paths: StagePaths) -> Iterator[tuple[str, StagePaths]]:
    """The samples of the stages ``controls``, with the names of their metric files."""
    for folder in sorted(replace(paths, family="").samples.glob("controls*")):
        for method in sorted(folder.iterdir()):
            if method.is_dir():
                yield f"controls/{method.name}", replace(paths, family=f"{folder.name}/{method.name}")


def _inputs(paths: StagePaths) -> tuple[Path, ...]:
    return paths.clips, paths.annotation, paths.contact, paths.splits


def _cached_or_measured(paths: StagePaths, settings: EvaluateSettings, shared: list[Any]) -> dict[str, Any]:
    """The metrics of one family, from the cache of an earlier or interrupted run if the inputs are equal."""
    digest = value_digest([*shared, path_digest(paths.samples)])
    with suppress(BadInput, FileNotFoundError):
        cached = read_json(paths.measured)
        if cached.get("made_from") == digest:
            return cached["metrics"]
    metrics = _measured(paths, settings)
    write_whole(paths.measured, canonical_json({"made_from": digest, "metrics": metrics}))
    return metrics


def _measured(paths: StagePaths, settings: EvaluateSettings) -> dict[str, Any]:
    if reason := next(filter(None, map(empty_reason, (*_inputs(paths), paths.samples))), None):
        return {"empty": reason, "held_out_clips": 0}
    from hoidata.metrics.evaluate import evaluate_store
    from hoidata.metrics.optional_metrics import select_metrics

    print(f"{paths}: measuring", flush=True)
    metrics = evaluate_store(
        paths.samples / "clips",
        paths.data,
        load_hands(paths.profile),
        metrics=select_metrics(settings.metrics),
        encoders=trained_encoders(paths.evaluators),
        jobs=jobs(),
        progress=True,
    )
    metrics["left_out"] = _with_reasons(metrics["left_out"], paths.samples / "left_out.json")
    return metrics | {"diagnostics": read_json(paths.samples / "diagnostics.json")}


def _with_reasons(left_out: list[dict[str, str]], path: Path) -> list[dict[str, str]]:
    """The skipped clips, with the family's reason if it gave no motion for a clip."""
    entries = read_json_rows(path, {"clip_id": str, "reason": str}) if path.is_file() else []
    reasons = {item["clip_id"].rpartition("~")[0]: item["reason"] for item in entries}
    return [{**item, "reason": reasons.get(item["clip_id"], item["reason"])} for item in left_out]


def trained_encoders(folder: Path) -> list["MotionEvaluator"]:
    """The networks of the stage evaluator; empty, without importing torch, if that stage is off."""
    if not (folder / "info.json").is_file():
        return []
    from models.evaluator.encoders import load_evaluators

    return load_evaluators(folder)
