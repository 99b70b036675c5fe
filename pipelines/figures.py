"""Leading figures and training curves in the forms ``dvc metrics``, ``dvc plots`` and ``dvc exp`` read."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hoidata.files.written import read_json
from hoidata.metrics.unmeasured import reasons_in_words
from pipelines.stages.base import write_json

# action_named needs an evaluator, so that it is not everywhere.
LEADING = ("action_named", "contact_f1", "joint_error_mm", "deep_share", "jitter_m_s3")
DIGITS = 6


def write_figures(
    out: Path, metrics: Path, checkpoints: Path, datasets: Sequence[str], families: Sequence[str]
) -> None:
    """``figures.json`` (dataset, family, metric), ``bars/<dataset>.csv`` (the same, a row per family) and
    ``losses/<dataset>-<network>.csv`` (validation loss by step) in the folder ``out``.

    metrics, checkpoints: folders with an entry per dataset. What was not trained is left out. Of metrics that could
    not be measured, ``figures.json`` has the reasons with counts under ``not measured`` (dataset, family, metric).
    """
    measured = {dataset: _read(metrics / dataset, families) for dataset in datasets}
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


def _read(folder: Path, families: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What was evaluated of each family."""
    return {name: read_json(folder / f"{name}.json") for name in families if (folder / f"{name}.json").is_file()}


def _leading(read: dict[str, dict[str, Any]]) -> dict[str, dict[str, float]]:
    """The leading figures of every family that was measured, rounded: floats of another machine differ in the last."""
    found = {family: _rounded(values.get("figures") or {}) for family, values in read.items()}
    return {family: figures for family, figures in found.items() if figures}


def _unmeasured(read: dict[str, dict[str, Any]]) -> dict[str, dict[str, str]]:
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
