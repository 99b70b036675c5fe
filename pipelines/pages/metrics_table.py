"""What evaluation found, as tables and charts: rows are families and controls, columns the registered metrics."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from hoidata.errors import BadInput
from hoidata.metrics.asked_metrics import ASKED_LISTS
from hoidata.metrics.feature_metrics import FEATURE_METRICS, FeatureMetric
from hoidata.metrics.registry import METRICS, Metric, is_better
from pipelines.figures import read_metrics
from pipelines.promises import TRUTH

AnyMetric = Metric | FeatureMetric
ALL_METRICS: tuple[AnyMetric, ...] = (
    *METRICS,
    *FEATURE_METRICS,
    *(row for rows in ASKED_LISTS.values() for row in rows),
)
LOOKUPS = ("nearest-clip", "verb-lookup", "verb-lookup-held", "prompt-lookup", "prompt-lookup-held")
CONTROLS = "controls"
NO_FIGURE = "-"
OTHER_EVALUATOR = "another evaluator"
INTERVALS = {"clips": "95 %, clips", "repetitions": "95 %, repetitions"}


@dataclass(frozen=True)
class Cell:
    """A figure in text. mark: "good" for the best of all families, "bad" where it loses to a lookup, else "".

    spread: its 95 % interval over clips, in text; note: why there is no figure, or what it leaves out.
    """

    text: str
    mark: str = ""
    spread: str = ""
    note: str = ""


@dataclass(frozen=True)
class Bar:
    """One row of a chart, in percent of its width. clips, repetitions: ends of intervals; kind: for the colour."""

    family: str
    kind: str
    at: float
    clips: tuple[float, float] | None
    repetitions: tuple[float, float] | None
    text: str


@dataclass(frozen=True)
class Chart:
    """One metric with a bar for every row that has a figure. ends: what 0 and 100 percent stand for, in text."""

    title: str
    better: str
    ends: tuple[str, str]
    bars: list[Bar]


@dataclass(frozen=True)
class Topic:
    """Metrics that belong together. columns: (title, unit, which are better); cells: a list for each row."""

    title: str
    columns: list[tuple[str, str, str]]
    cells: list[list[Cell]]
    charts: list[Chart]


@dataclass(frozen=True)
class Row:
    """One family. kind: "truth", "lookup", "control" or "family". words: how often it loses to which lookup.

    lost: by lookup, titles of the metrics in which it loses, in words. empty: why it has no figures.
    diagnostics: what the family says of its own networks, as (name, value).
    """

    family: str
    kind: str = "family"
    words: str = ""
    lost: list[str] = field(default_factory=list)
    empty: str = ""
    note: str = ""
    diagnostics: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True)
class MetricsTable:
    """All families and controls of one dataset."""

    rows: list[Row]
    topics: list[Topic]


@dataclass(frozen=True)
class _Found:
    """What evaluation wrote of every row: the JSON files, by family; which of them are controls."""

    values: Mapping[str, Mapping[str, Any]]
    controls: frozenset[str] = frozenset()

    def kind(self, family: str) -> str:
        """What a row is: "truth", "lookup", "control" or "family"."""
        if family == TRUTH:
            return "truth"
        return "lookup" if family in LOOKUPS else "control" if family in self.controls else "family"

    def column(self, metric: AnyMetric) -> dict[str, float]:
        """The figure of every family that has one and whose evaluator is the one of the others."""
        found = {name: own["figures"][metric.name] for name, own in self.values.items() if self.has(name, metric)}
        return {name: value for name, value in found.items() if not self.is_foreign(name, metric)}

    def has(self, family: str, metric: AnyMetric) -> bool:
        return self.values[family].get("figures", {}).get(metric.name) is not None

    def is_foreign(self, family: str, metric: AnyMetric) -> bool:
        """Whether the figure comes from other weights than the first family's: they are not to be compared."""
        if not isinstance(metric, FeatureMetric):
            return False
        digests = {name: self._digest(name, metric.encoder) for name in self.values if self.has(name, metric)}
        return digests[family] != next(iter(digests.values())) if family in digests else False

    def _digest(self, family: str, encoder: str) -> str:
        return self.values[family].get("evaluators", {}).get(encoder, {}).get("digest", "")

    def interval(self, family: str, metric: AnyMetric, kind: str) -> tuple[float, float] | None:
        ends = self.values[family].get("intervals", {}).get(metric.name, {}).get(kind)
        return (ends[0], ends[1]) if ends else None

    def note(self, family: str, metric: AnyMetric) -> str:
        return str(self.values[family].get("notes", {}).get(metric.name, ""))


def metrics_tables(folder: str | Path, families: Sequence[str]) -> MetricsTable:
    """``folder/<family>.json``, families in the order given, then ``folder/controls``; empty topics are left out."""
    found = _found(Path(folder), families)
    shown = [metric for metric in ALL_METRICS if any(found.has(name, metric) for name in found.values)]
    titles = dict.fromkeys(metric.topic for metric in shown)
    topics = [_topic(title, [metric for metric in shown if metric.topic == title], found) for title in titles]
    return MetricsTable([_row(name, found, shown) for name in found.values], topics)


def markdown_table(folder: str | Path, families: Sequence[str], names: Sequence[str]) -> str:
    """The metrics ``names`` of every row that has one, as Markdown; what loses to a lookup says so in its cell.

    Raises BadInput for a name no metric has.
    """
    found, known = _found(Path(folder), families), {metric.name: metric for metric in ALL_METRICS}
    if unknown := [name for name in names if name not in known]:
        raise BadInput("metric", f"one of {', '.join(known)}", ", ".join(unknown), "correct the name")
    metrics = [known[name] for name in names]
    heads = [f"{own.title}{', ' * bool(own.unit)}{own.unit} ({_better(own)})" for own in metrics]
    lines = [f"| row | {' | '.join(heads)} |", "|---" * (len(metrics) + 1) + "|"]
    for name in found.values:
        cells = [_cell(name, metric, found) for metric in metrics]
        if any(cell.text != NO_FIGURE for cell in cells):
            lines.append(f"| {name} | {' | '.join(_marked(cell, found.kind(name)) for cell in cells)} |")
    return "\n".join(lines) + "\n"


def _marked(cell: Cell, kind: str) -> str:
    return f"{cell.text} (loses)" if cell.mark == "bad" and kind == "family" else cell.text


def _found(folder: Path, families: Sequence[str]) -> _Found:
    controls = sorted(path.stem for path in (folder / CONTROLS).glob("*.json") if path.stem != "empty")
    paths = {name: folder / f"{name}.json" for name in families}
    paths |= {name: folder / CONTROLS / f"{name}.json" for name in controls if name not in paths}
    return _Found({name: _read(path) for name, path in paths.items()}, frozenset(controls))


def _read(path: Path) -> dict[str, Any]:
    return read_metrics(path) if path.is_file() else {"empty": "not evaluated"}


def _row(family: str, found: _Found, shown: list[AnyMetric]) -> Row:
    values, kind = found.values[family], found.kind(family)
    if "figures" not in values:
        return Row(family, kind, empty=str(values["empty"]))
    columns = [(metric, found.column(metric)) for metric in shown]
    lost = {name: [own.title for own, column in columns if loses_to(name, own, family, column)] for name in LOOKUPS}
    lost = {name: titles for name, titles in lost.items() if titles and kind == "family"}
    own = {name: sum(family in column and name in column for _, column in columns) for name in lost}
    words = [f"loses to {name} in {len(titles)} of {own[name]} figures" for name, titles in lost.items()]
    told = [f"to {name}: {', '.join(titles)}" for name, titles in lost.items()]
    diagnostics = [(name, number(value)) for name, value in _flat(values.get("diagnostics", {})).items()]
    left_out = len(values.get("left_out", []))
    note = f"{values['motions']:,} motions of {values['held_out_clips']:,} clips"
    note += f", {left_out:,} left out" if left_out else ""
    note += ", of lengths it chose itself" if values.get("length") == "own" else ""
    return Row(family, kind, "; ".join(words), told, "", note, diagnostics)


def _topic(title: str, metrics: list[AnyMetric], found: _Found) -> Topic:
    cells = [[_cell(name, metric, found) for metric in metrics] for name in found.values]
    columns = [(metric.title, metric.unit, _better(metric)) for metric in metrics]
    return Topic(title, columns, cells, [chart for metric in metrics if (chart := _chart(metric, found))])


def _cell(family: str, metric: AnyMetric, found: _Found) -> Cell:
    note = found.note(family, metric)
    if not found.has(family, metric):
        return Cell(note or NO_FIGURE)
    if found.is_foreign(family, metric):
        return Cell(OTHER_EVALUATOR)
    column = found.column(metric)
    loses = any(loses_to(lookup, metric, family, column) for lookup in LOOKUPS)
    mark = "bad" if loses else "good" if family in best_families(metric, column) else ""
    ends = found.interval(family, metric, "clips")
    return Cell(number(column[family]), mark, f"{number(ends[0])} to {number(ends[1])}" if ends else "", note)


def _chart(metric: AnyMetric, found: _Found) -> Chart | None:
    """All rows of one metric beside each other; None where there is nothing to set beside another."""
    column = found.column(metric)
    if len(column) < 2:
        return None
    spreads = {kind: {name: found.interval(name, metric, kind) for name in column} for kind in INTERVALS}
    ends = [end for by_name in spreads.values() for pair in by_name.values() if pair for end in pair]
    low, high = min(0.0, *column.values(), *ends), max(*column.values(), *ends)
    width = (high - low) or 1.0

    def percent(value: float) -> float:
        return round(100 * (value - low) / width, 2)

    def span(kind: str, name: str) -> tuple[float, float] | None:
        pair = spreads[kind][name]
        return (percent(pair[0]), percent(pair[1])) if pair else None

    bars = [
        Bar(name, found.kind(name), percent(value), span("clips", name), span("repetitions", name), number(value))
        for name, value in column.items()
    ]
    unit = f", {metric.unit}" if metric.unit else ""
    return Chart(f"{metric.title}{unit}", _better(metric), (number(low), number(high)), bars)


def best_families(metric: AnyMetric, column: Mapping[str, float]) -> list[str]:
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


def loses_to(lookup: str, metric: AnyMetric, family: str, column: Mapping[str, float]) -> bool:
    """Whether a training clip that was looked up gives a better figure than this family."""
    if family in (TRUTH, *LOOKUPS) or lookup not in column or family not in column:
        return False
    return bool(is_better(metric, column[lookup], column[family], column.get(TRUTH)))


def printed_table(found: Mapping[str, Any]) -> Table:
    """One system's figures for a terminal. found: what ``evaluate_store`` gives."""
    title = f"{found['motions']:,} motions of {found['held_out_clips']:,} clips, {found.get('length', 'given')} length"
    table = Table(title=title + (", synthetic" if found["synthetic"] else ""), box=box.SIMPLE)
    table.add_column("metric", min_width=32)
    for name in ("figure", *INTERVALS.values(), "unit", "better", "clips"):
        table.add_column(name, justify="left" if name in ("unit", "better") else "right")
    for row in _printed_rows(found):
        table.add_row(*row)
    return table


def _printed_rows(found: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    own = _Found({"": found})
    for metric in ALL_METRICS:
        if not own.has("", metric):
            if note := own.note("", metric):
                yield metric.title, note, "", "", metric.unit, _better(metric), ""
            continue
        ends = [" to ".join(map(number, own.interval("", metric, kind) or ())) for kind in INTERVALS]
        clips = found["counts"][metric.name]["clips"]
        figure = number(found["figures"][metric.name])
        yield metric.title, figure, *ends, metric.unit, _better(metric), f"{clips:,}"


def _better(metric: AnyMetric) -> str:
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
