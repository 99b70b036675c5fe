"""What evaluation found, as tables and charts: rows are families and controls, columns the registered metrics."""

from collections import defaultdict
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
from hoidata.metrics.unmeasured import reasons_in_words
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
NO_FIGURE = "-"  # the metric was not computed of this row
NOT_MEASURED = "not measured"
OTHER_EVALUATOR = "another evaluator"
INTERVALS = {"clips": "95 %, clips", "repetitions": "95 %, repetitions"}


@dataclass(frozen=True)
class Cell:
    """A figure in text. mark: "good" for the best of all families, "bad" where it loses to a lookup, else "".

    spread: its 95 % interval over clips, in text; note: why there is no figure, or what it leaves out. share: how many
    of the clips it is of, in text; "" where it is of all.
    """

    text: str
    mark: str = ""
    spread: str = ""
    note: str = ""
    share: str = ""


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
    """One metric with a bar for every row that has a figure. ends: what 0 and 100 percent stand for, in text.

    missing: the rows of which it could not be measured, in words.
    """

    title: str
    better: str
    ends: tuple[str, str]
    bars: list[Bar]
    missing: str = ""


@dataclass(frozen=True)
class Topic:
    """Metrics that belong together. columns: (title, unit, which are better); cells: a list for each row.

    unmeasured: (titles, reasons and counts in words) of the metrics that no row has a figure of.
    """

    title: str
    columns: list[tuple[str, str, str]]
    cells: list[list[Cell]]
    charts: list[Chart]
    unmeasured: list[tuple[str, str]]


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

    def unmeasured(self, family: str, metric: AnyMetric) -> dict[str, int]:
        """How many clips of a row have no value of a metric, by reason."""
        return self.values[family].get("unmeasured", {}).get(metric.name, {})

    def share(self, family: str, metric: AnyMetric) -> str:
        """``25 of 28``: clips with a value of those that were compared; "" where all have one."""
        missing = sum(self.unmeasured(family, metric).values())
        clips = self.values[family].get("counts", {}).get(metric.name, {}).get("clips", 0)
        return f"{clips:,} of {clips + missing:,}" if missing else ""


def metrics_tables(folder: str | Path, families: Sequence[str]) -> MetricsTable:
    """``folder/<family>.json``, families in the order given, then ``folder/controls``.

    A topic has a column for each metric with a figure in some row, and a line for each that could not be measured in
    any; topics of which nothing was computed are left out.
    """
    found = _found(Path(folder), families)
    shown = [metric for metric in ALL_METRICS if any(found.has(name, metric) for name in found.values)]
    never = [metric for metric in ALL_METRICS if metric not in shown and _reasons(metric, found)]
    titles = dict.fromkeys(metric.topic for metric in ALL_METRICS if metric in shown or metric in never)
    topics = [_topic(title, *(_of_topic(title, some) for some in (shown, never)), found=found) for title in titles]
    return MetricsTable([_row(name, found, shown) for name in found.values], topics)


def _of_topic(title: str, metrics: list[AnyMetric]) -> list[AnyMetric]:
    return [metric for metric in metrics if metric.topic == title]


def markdown_table(folder: str | Path, families: Sequence[str], names: Sequence[str]) -> str:
    """The metrics ``names`` of every row that was evaluated, as Markdown; what loses to a lookup says so in its cell.

    Below the table: why rows were not evaluated, and why metrics could not be measured. Raises BadInput for a name no
    metric has.
    """
    found, known = _found(Path(folder), families), {metric.name: metric for metric in ALL_METRICS}
    if unknown := [name for name in names if name not in known]:
        raise BadInput("metric", f"one of {', '.join(known)}", ", ".join(unknown), "correct the name")
    metrics = [known[name] for name in names]
    heads = [f"{own.title}{', ' * bool(own.unit)}{own.unit} ({_better(own)})" for own in metrics]
    lines = [f"| row | {' | '.join(heads)} |", "|---" * (len(metrics) + 1) + "|"]
    below = []
    for name, values in found.values.items():
        if "figures" in values:
            cells = [_cell(name, metric, found) for metric in metrics]
            lines.append(f"| {name} | {' | '.join(_marked(cell, found.kind(name)) for cell in cells)} |")
        else:
            below.append(f"- {name}: not evaluated, {values['empty']}")
    below += [f"- {own.title}: not measured, {words}" for own in metrics if (words := _reasons(own, found))]
    return "\n".join([*lines, *([""] if below else []), *below]) + "\n"


def _marked(cell: Cell, kind: str) -> str:
    share = f" ({cell.share} clips)" if cell.share else ""
    return f"{cell.text}{share} (loses)" if cell.mark == "bad" and kind == "family" else f"{cell.text}{share}"


def _reasons(metric: AnyMetric, found: _Found) -> str:
    """Why clips have no value of a metric, in words; rows with the same reasons and counts together."""
    rows = defaultdict[str, list[str]](list)
    for name in found.values:
        if reasons := found.unmeasured(name, metric):
            rows[reasons_in_words(reasons)].append(name)
    measured = [name for name, values in found.values.items() if "figures" in values]
    return "; ".join(words if names == measured else f"{', '.join(names)}: {words}" for words, names in rows.items())


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
    flat = _flat(values.get("diagnostics", {}))
    diagnostics = [(name, NOT_MEASURED if value is None else number(value)) for name, value in flat.items()]
    left_out = len(values.get("left_out", []))
    note = f"{values['motions']:,} motions of {values['held_out_clips']:,} clips"
    note += f", {left_out:,} left out" if left_out else ""
    note += ", of lengths it chose itself" if values.get("length") == "own" else ""
    return Row(family, kind, "; ".join(words), told, "", note, diagnostics)


def _topic(title: str, metrics: list[AnyMetric], never: list[AnyMetric], found: _Found) -> Topic:
    """metrics: those with a figure in some row; never: those that could not be measured in any."""
    cells = [[_cell(name, metric, found) for metric in metrics] for name in found.values]
    columns = [(metric.title, metric.unit, _better(metric)) for metric in metrics]
    charts = [chart for metric in metrics if (chart := _chart(metric, found))]
    titles = defaultdict[str, list[str]](list)
    for metric in never:
        titles[_reasons(metric, found)].append(metric.title)
    return Topic(title, columns, cells, charts, [("; ".join(own), words) for words, own in titles.items()])


def _cell(family: str, metric: AnyMetric, found: _Found) -> Cell:
    note, reasons = found.note(family, metric), reasons_in_words(found.unmeasured(family, metric))
    if not found.has(family, metric):
        return Cell(note or (NOT_MEASURED if reasons else NO_FIGURE), note=reasons)
    if found.is_foreign(family, metric):
        return Cell(OTHER_EVALUATOR)
    column = found.column(metric)
    loses = any(loses_to(lookup, metric, family, column) for lookup in LOOKUPS)
    mark = "bad" if loses else "good" if family in best_families(metric, column) else ""
    ends = found.interval(family, metric, "clips")
    spread = f"{number(ends[0])} to {number(ends[1])}" if ends else ""
    note = "; ".join(filter(None, (note, reasons and f"{NOT_MEASURED}: {reasons}")))
    return Cell(number(column[family]), mark, spread, note, found.share(family, metric))


def _chart(metric: AnyMetric, found: _Found) -> Chart | None:
    """All rows of one metric compared; None for fewer than two figures."""
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
    missing = [name for name in found.values if name not in column and found.unmeasured(name, metric)]
    words = f"{NOT_MEASURED}: {', '.join(missing)}" if missing else ""
    return Chart(f"{metric.title}{unit}", _better(metric), (number(low), number(high)), bars, words)


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
            missing = sum(own.unmeasured("", metric).values())
            if text := own.note("", metric) or (NOT_MEASURED if missing else ""):
                yield metric.title, text, "", "", metric.unit, _better(metric), f"0 of {missing:,}" if missing else ""
            continue
        ends = [" to ".join(map(number, own.interval("", metric, kind) or ())) for kind in INTERVALS]
        clips = own.share("", metric) or f"{found['counts'][metric.name]['clips']:,}"
        figure = number(found["figures"][metric.name])
        yield metric.title, figure, *ends, metric.unit, _better(metric), clips


def unmeasured_lines(found: Mapping[str, Any]) -> list[str]:
    """For a terminal: of each metric without a value of some clip, the reasons and how many clips each has."""
    reasons = {metric: _Found({"": found}).unmeasured("", metric) for metric in ALL_METRICS}
    return [f"{NOT_MEASURED}: {metric.title}: {reasons_in_words(own)}" for metric, own in reasons.items() if own]


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
