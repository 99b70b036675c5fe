"""What evaluation found, as tables: rows are families, columns the metrics of both lists, of geometry and features."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from hoidata.errors import BadInput
from hoidata.metrics.feature_metrics import FEATURE_METRICS, FeatureMetric
from hoidata.metrics.registry import METRICS, Metric, is_better

COLUMNS: tuple[Metric | FeatureMetric, ...] = (*METRICS, *FEATURE_METRICS)
TRUTH, LOOKUP = "ground-truth", "nearest-clip"
NO_FIGURE = "-"
INTERVALS = {"clips": "95 %, clips", "repetitions": "95 %, repetitions"}


@dataclass(frozen=True)
class Cell:
    """A figure in text. mark: "good" for the best of all families, "bad" where it loses to nearest-clip, else ""."""

    text: str
    mark: str = ""


@dataclass(frozen=True)
class Row:
    """One family. loses: titles of the metrics in which it loses to nearest-clip. empty: why it has no figures.

    diagnostics: what the family says of its own networks, as (name, value).
    """

    family: str
    cells: list[Cell] = field(default_factory=list)
    loses: list[str] = field(default_factory=list)
    empty: str = ""
    note: str = ""
    diagnostics: list[tuple[str, str]] = field(default_factory=list)

    @property
    def words(self) -> str:
        return f"loses to {LOOKUP}: {', '.join(self.loses)}" if self.loses else ""


@dataclass(frozen=True)
class MetricsTable:
    """All families of one dataset. columns: (title, unit, which figures are better)."""

    columns: list[tuple[str, str, str]]
    rows: list[Row]


def metrics_tables(folder: str | Path, families: Sequence[str]) -> MetricsTable:
    """The table of ``folder/<family>.json``, families in the order given; metrics that none has are not shown."""
    folder = Path(folder)
    found = {family: _read(folder / f"{family}.json") for family in families}
    figures = {family: values["figures"] for family, values in found.items() if "figures" in values}
    _refuse_other_evaluators(folder, found)
    shown = [metric for metric in COLUMNS if any(metric.name in values for values in figures.values())]
    columns = [(metric.title, metric.unit, _better(metric)) for metric in shown]
    return MetricsTable(columns, [_row(family, found[family], shown, figures) for family in families])


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {"empty": "not evaluated"}


def _refuse_other_evaluators(folder: Path, found: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise BadInput where two rows have figures of the same network with other weights: they say nothing together."""
    digests: dict[str, dict[str, list[str]]] = {}
    for family, values in found.items():
        for name, known in values.get("evaluators", {}).items():
            digests.setdefault(name, {}).setdefault(known["digest"], []).append(family)
    for name, families in digests.items():
        if len(families) > 1:
            got = "; ".join(f"{digest[:8]} of {', '.join(rows)}" for digest, rows in families.items())
            raise BadInput(folder, f"one {name} evaluator behind all rows", got, "evaluate them again with one")


def _row(
    family: str,
    values: dict[str, Any],
    shown: Sequence[Metric | FeatureMetric],
    figures: Mapping[str, Mapping[str, float]],
) -> Row:
    if "figures" not in values:
        return Row(family, empty=str(values["empty"]))
    cells, loses = [], []
    for metric in shown:
        column = {name: own[metric.name] for name, own in figures.items() if metric.name in own}
        if family not in column:
            cells.append(Cell(values.get("notes", {}).get(metric.name, NO_FIGURE)))
            continue
        worse = loses_to_lookup(metric, family, column)
        loses += [metric.title] if worse else []
        mark = "bad" if worse else "good" if family in best_families(metric, column) else ""
        cells.append(Cell(number(column[family]), mark))
    diagnostics = [(name, number(value)) for name, value in _flat(values.get("diagnostics", {})).items()]
    left_out = len(values.get("left_out", []))
    note = f"{values['motions']:,} motions of {values['held_out_clips']:,} clips"
    note += f", {left_out:,} left out" if left_out else ""
    return Row(family, cells, loses, note=note, diagnostics=diagnostics)


def best_families(metric: Metric | FeatureMetric, column: Mapping[str, float]) -> list[str]:
    """Families that no other beats in a metric; the truth itself does not compete."""
    truth = column.get(TRUTH)
    rivals = {name: value for name, value in column.items() if name != TRUTH}
    if metric.floor_of or (metric.direction == "nearer the truth" and truth is None):
        return []
    return [
        name
        for name, value in rivals.items()
        if not any(is_better(metric, other, value, truth) for other in rivals.values())
    ]


def loses_to_lookup(metric: Metric | FeatureMetric, family: str, column: Mapping[str, float]) -> bool:
    """Whether looking up the nearest training clip gives a better figure than this family."""
    if family in (TRUTH, LOOKUP) or LOOKUP not in column:
        return False
    return bool(is_better(metric, column[LOOKUP], column[family], column.get(TRUTH)))


def printed_table(found: Mapping[str, Any]) -> Table:
    """One system's figures for a terminal. found: what ``evaluate_store`` gives."""
    title = f"{found['motions']:,} motions of {found['held_out_clips']:,} clips, {found['length']} length"
    table = Table(title=title + (", synthetic" if found["synthetic"] else ""), box=box.SIMPLE)
    table.add_column("metric", min_width=32)
    for name in ("figure", *INTERVALS.values(), "unit", "better", "clips"):
        table.add_column(name, justify="left" if name in ("unit", "better") else "right")
    for metric in COLUMNS:
        if metric.name in found["figures"]:
            clips, spread = found["counts"][metric.name]["clips"], found["intervals"].get(metric.name, {})
            ends = [" to ".join(map(number, spread.get(name, ()))) for name in INTERVALS]
            figure = number(found["figures"][metric.name])
            better = "a floor" if metric.floor_of else metric.direction
            table.add_row(metric.title, figure, *ends, metric.unit, better, f"{clips:,}")
    return table


def _better(metric: Metric | FeatureMetric) -> str:
    if metric.floor_of:
        return "a floor"
    return metric.direction if metric.direction == "nearer the truth" else f"{metric.direction} is better"


def number(value: object) -> str:
    """A figure as text: whole numbers as they are, others with three significant digits or more."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "" if value is None else str(value)
    if isinstance(value, int):
        return f"{int(value):,}"
    return f"{value:,.1f}" if abs(value) >= 100 else f"{value:#.3g}"


def _flat(figures: Mapping[str, Any], before: str = "") -> dict[str, object]:
    flat: dict[str, object] = {}
    for key, value in figures.items():
        name = f"{before}{key}".replace("_", " ")
        flat |= _flat(value, f"{name} ") if isinstance(value, Mapping) else {name: value}
    return flat
