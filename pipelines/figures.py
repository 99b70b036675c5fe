"""Leading figures and training curves in the forms ``dvc metrics``, ``dvc plots`` and ``dvc exp`` read."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.written import NUMBER, NUMBER_OR_NONE, REMEDY, Facts, read_json
from hoidata.metrics.unmeasured import reasons_in_words
from pipelines.stages.base import write_json

# action_named needs an evaluator, so that it is not everywhere.
LEADING = ("action_named", "contact_f1", "joint_error_mm", "deep_share", "jitter_m_s3")
DIGITS = 6


def write_figures(out: Path, metrics: Path, checkpoints: Path, families: Mapping[str, Sequence[str]]) -> None:
    """``figures.json`` (dataset, family, metric), ``bars/<dataset>.csv`` (the same, a row per family) and
    ``losses/<dataset>-<network>.csv`` (validation loss by step) in the folder ``out``.

    metrics, checkpoints: folders with an entry per dataset. families: by dataset, in the order of rows. What was not
    trained is left out. Of metrics that could not be measured, ``figures.json`` has the reasons with counts under
    ``not measured`` (dataset, family, metric).
    """
    measured = {dataset: _read(metrics / dataset, own) for dataset, own in families.items()}
    figures = {dataset: _leading(rows) for dataset, rows in measured.items()}
    missing = {dataset: rows for dataset, found in measured.items() if (rows := _unmeasured(found))}
    named = {dataset: rows for dataset, rows in figures.items() if rows}
    write_json(out / "figures.json", named | ({"not measured": missing} if missing else {}))
    for folder in ("bars", "losses"):
        (out / folder).mkdir()
    for dataset, rows in figures.items():
        if rows:
            names = [name for name in LEADING if any(name in row for row in rows.values())]
            table = [{"family": family, **row} for family, row in rows.items()]
            _write_csv(out / "bars" / f"{dataset}.csv", ["family", *names], table)
        for log in sorted((checkpoints / dataset).glob("*/log.csv")):
            with open(log, newline="") as stream:
                table = [row for row in csv.DictReader(stream) if row.get("validation")]
            _write_csv(out / "losses" / f"{dataset}-{log.parent.name}.csv", ["step", "validation"], table)


def read_metrics(path: Path) -> Facts:
    """What the stage evaluate wrote of one family: its ``figures``, or the reason ``empty``. Raises BadInput."""
    found = read_json(path)
    if "figures" not in found:
        return found.check({"empty": str})
    found.check_present({"motions": int, "held_out_clips": int, "left_out": list})
    found.check_present(dict.fromkeys(("figures", "intervals", "notes", "evaluators", "diagnostics", "unmeasured"), dict))
    found["figures"].check(dict.fromkeys(found["figures"], NUMBER_OR_NONE))
    for name in ("intervals", "evaluators"):
        found.get(name, Facts(path, {})).check(dict.fromkeys(found.get(name, ()), dict))
    for intervals in found.get("intervals", {}).values():
        intervals.check(dict.fromkeys(intervals, (list, type(None))))
        for name, ends in intervals.items():
            if ends and not (len(ends) == 2 and all(isinstance(end, NUMBER) for end in ends)):
                raise BadInput(path, f"two numbers as the entry {intervals.key + name!r}", repr(ends)[:80], REMEDY)
    for evaluator in found.get("evaluators", {}).values():
        evaluator.check_present({"labels": list, "confusion": list, "digest": str})
    return found


def _read(folder: Path, families: Sequence[str]) -> dict[str, Facts]:
    """What was evaluated of each family."""
    return {name: read_metrics(folder / f"{name}.json") for name in families if (folder / f"{name}.json").is_file()}


def _leading(read: dict[str, Facts]) -> dict[str, dict[str, float]]:
    """The leading figures of every family that was measured, rounded: floats of another machine differ in the last."""
    found = {family: _rounded(values.get("figures") or {}) for family, values in read.items()}
    return {family: figures for family, figures in found.items() if figures}


def _unmeasured(read: dict[str, Facts]) -> dict[str, dict[str, str]]:
    """The leading metrics without a figure, by family, with reasons and counts in words."""
    rows = {
        family: {
            name: reasons_in_words(values["unmeasured"][name])
            for name in LEADING
            if name in values.get("unmeasured", {}) and name not in values.get("figures", {})
        }
        for family, values in read.items()
    }
    return {family: words for family, words in rows.items() if words}


def _rounded(figures: dict[str, Any]) -> dict[str, float]:
    numbers = {name: figures[name] for name in LEADING if isinstance(figures.get(name), int | float)}
    return {name: float(f"{number:.{DIGITS}g}") for name, number in numbers.items()}


def _write_csv(path: Path, names: list[str], rows: list[dict[str, Any]]) -> None:
    with open(path, "w", newline="") as stream:
        writer = csv.DictWriter(stream, names, restval="", extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
