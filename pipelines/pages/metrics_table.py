"""Metrics files as tables and charts: one line per method (family or control), one column per registered metric."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rich import box
from rich.table import Table

from hoidata.errors import BadInput
from hoidata.metrics.feature_metrics import FEATURE_METRICS, FeatureMetric
from hoidata.metrics.optional_metrics import OPTIONAL_LISTS
from hoidata.metrics.registry import METRICS, Metric, is_better
from hoidata.metrics.unmeasured import reasons_in_words
from pipelines.expected_orderings import RECORDED
from pipelines.metrics_files import read_metrics

AnyMetric = Metric | FeatureMetric
ALL_METRICS: tuple[AnyMetric, ...] = (
    *METRICS,
    *FEATURE_METRICS,
    *(metric for metrics in OPTIONAL_LISTS.values() for metric in metrics),
)
RETRIEVAL_BASELINES = (
    "nearest-clip",
    "verb-retrieval",
    "verb-retrieval-refined",
    "prompt-retrieval",
    "prompt-retrieval-refined",
)
# What each method is, for readers of a table.
METHODS = {
    "text2hoi": "our networks: contact map, motion, refined hands, from sentence and object",
    "text2hoi-coarse": "the same without the refiner",
    "text2hoi-contact": "the same with contact refinement by optimisation",
    "text2hoi-estimated": "the same with lengths that the network predicts",
    "other-prompt": "the same with the sentence of another clip: control",
    "nearest-clip": "the training clip of the same hands with the most similar sentence: retrieval",
    "mean-motion": "the mean of all training motions",
    "mean-pose": "the mean pose of all training clips, in every frame",
    "ground-truth": "the recorded test clip itself",
    "mdm": "MDM, adapted to hands and objects: diffusion without contact map",
    "imos": "IMoS, adapted: autoregressive, from the first frames of a retrieved clip",
    "imos-true-start": "IMoS from four recorded frames",
    "t2m": "T2M, adapted: autoregressive variational network with its own lengths",
    "manipnet": "our network: fingers for recorded wrists and object",
    "bimart": "our networks: both hands for the recorded object motion",
    "bimart-unrefined": "the same without refinement",
    "nearest-window": "the training frames with the most similar object motion: retrieval",
    "nearest-window-refined": "the same with refinement",
    "verb-retrieval": "a training clip of the same verb and hands, of any object: retrieval",
    "verb-retrieval-refined": "the same with contact refinement",
    "prompt-retrieval": "a training clip of the same verb, object and hands: retrieval",
    "prompt-retrieval-refined": "the same with contact refinement",
}
ZERO = 1e-4  # smaller values are zero: no method wins by them
# The columns of Text2HOI's Table 1, in its order, as IMoS and ManipNet released them.
PAPER_TABLE = "The five columns of Text2HOI's Table 1"
PAPER_COLUMNS = (
    "accuracy_top3_paper",
    "fid_paired_paper",
    "diversity_released_paper",
    "multimodality_released_paper",
    "realism_released",
)
CONTROLS = "controls"
NOT_COMPUTED = "-"
NOT_MEASURED = "not measured"
OTHER_EVALUATOR = "another evaluator"
INTERVALS = {"clips": "95 %, clips", "repetitions": "95 %, repetitions"}


@dataclass(frozen=True)
class Cell:
    """The value of a metric for one method, as text."""

    text: str
    mark: str = ""  # "good": the best of all methods; "bad": worse than a retrieval baseline
    spread: str = ""  # 95 % interval over clips
    note: str = ""  # a remark, or why the value is missing
    coverage: str = ""  # "25 of 28": clips with a value; "" for all


@dataclass(frozen=True)
class Bar:
    """One method in a chart; positions are in percent of the width."""

    family: str
    kind: str  # of the method, selects the colour
    at: float
    clips: tuple[float, float] | None  # interval over clips
    repetitions: tuple[float, float] | None  # interval over repetitions
    text: str


@dataclass(frozen=True)
class Chart:
    """One metric with a bar for every method that has a value."""

    title: str
    better: str
    ends: tuple[str, str]  # the values at 0 and 100 percent, as text
    bars: list[Bar]
    missing: str = ""  # the methods without a value, in words


@dataclass(frozen=True)
class Topic:
    """The table of the metrics of one topic."""

    title: str
    columns: list[tuple[str, str, str]]  # (title, unit, which values are better)
    cells: list[list[Cell]]  # by method, by column
    charts: list[Chart]
    unmeasured: list[tuple[str, str]]  # (titles, reasons and counts) of metrics without a value for any method


@dataclass(frozen=True)
class Method:
    """One evaluated family or control."""

    family: str
    kind: str = "family"  # "recorded", "retrieval", "control" or "family"
    summary: str = ""  # in how many metrics it is worse than which retrieval baseline
    worse_in: list[str] = field(default_factory=list)  # per retrieval baseline, the titles of these metrics
    empty: str = ""  # why there are no metrics
    note: str = ""  # number of motions and clips
    diagnostics: list[tuple[str, str]] = field(default_factory=list)  # (name, value) of the family's own networks


@dataclass(frozen=True)
class MetricsTable:
    """All methods of one dataset."""

    methods: list[Method]
    topics: list[Topic]

    @property
    def meanings(self) -> list[tuple[str, str]]:
        """(method, what it is), without controls, whose names say what they change."""
        return [(method.family, METHODS[method.family]) for method in self.methods if method.family in METHODS]


@dataclass(frozen=True)
class _Files:
    """The metrics files of all methods."""

    contents: Mapping[str, Mapping[str, Any]]  # by family
    controls: frozenset[str] = frozenset()

    def kind(self, family: str) -> str:
        """The kind of a method: "recorded", "retrieval", "control" or "family"."""
        if family == RECORDED:
            return "recorded"
        return "retrieval" if family in RETRIEVAL_BASELINES else "control" if family in self.controls else "family"

    def column(self, metric: AnyMetric) -> dict[str, float]:
        """The comparable values of a metric by family."""
        measured = [family for family in self.contents if self.has(family, metric)]
        comparable = [family for family in measured if not self.is_foreign(family, metric)]
        return {family: self.contents[family]["figures"][metric.name] for family in comparable}

    def has(self, family: str, metric: AnyMetric) -> bool:
        return self.contents[family].get("figures", {}).get(metric.name) is not None

    def is_foreign(self, family: str, metric: AnyMetric) -> bool:
        """Whether the value comes from other evaluator weights than the first family's, so they cannot be compared."""
        if not isinstance(metric, FeatureMetric):
            return False
        evaluators = {
            name: content.get("evaluators", {}).get(metric.encoder, {}).get("digest", "")
            for name, content in self.contents.items()
            if self.has(name, metric)
        }
        return family in evaluators and evaluators[family] != next(iter(evaluators.values()))

    def interval(self, family: str, metric: AnyMetric, kind: str) -> tuple[float, float] | None:
        ends = self.contents[family].get("intervals", {}).get(metric.name, {}).get(kind)
        return (ends[0], ends[1]) if ends else None

    def note(self, family: str, metric: AnyMetric) -> str:
        return str(self.contents[family].get("notes", {}).get(metric.name, ""))

    def unmeasured(self, family: str, metric: AnyMetric) -> dict[str, int]:
        """The number of clips of a method without a value of a metric, by reason."""
        return self.contents[family].get("unmeasured", {}).get(metric.name, {})

    def coverage(self, family: str, metric: AnyMetric) -> str:
        """``25 of 28``: clips with a value of the compared clips; "" if all have one."""
        missing = sum(self.unmeasured(family, metric).values())
        clips = self.contents[family].get("counts", {}).get(metric.name, {}).get("clips", 0)
        return f"{clips:,} of {clips + missing:,}" if missing else ""


def metrics_tables(folder: str | Path, families: Sequence[str]) -> MetricsTable:
    """The tables of ``folder/<family>.json`` in the given order, then ``folder/controls``.

    With an evaluator, the columns of Text2HOI's Table 1 come first. A topic has a column for each metric with a value
    and a line for each unmeasured one. Empty topics are skipped.
    """
    files = _read_files(Path(folder), families)
    shown = [metric for metric in ALL_METRICS if any(files.has(family, metric) for family in files.contents)]
    never = [metric for metric in ALL_METRICS if metric not in shown and _reasons(metric, files)]
    titles = dict.fromkeys(metric.topic for metric in ALL_METRICS if metric in shown or metric in never)
    topics = []
    for title in titles:
        columns, missing = ([one for one in metrics if one.topic == title] for metrics in (shown, never))
        topics.append(_topic(title, columns, missing, files))
    if any(metric.name == PAPER_COLUMNS[0] for metric in shown):
        by_name = {metric.name: metric for metric in ALL_METRICS}
        topics.insert(0, _topic(PAPER_TABLE, [by_name[name] for name in PAPER_COLUMNS], [], files))
    return MetricsTable([_method(family, files, shown) for family in files.contents], topics)


def markdown_table(
    folder: str | Path, families: Sequence[str], names: Sequence[str], stale: Mapping[str, str] = MappingProxyType({})
) -> str:
    """The metrics ``names`` of every evaluated method as a Markdown table.

    A cell has its 95 % interval over clips, and says if it is worse than a retrieval baseline. Reasons of methods that
    were not evaluated and of unmeasured metrics follow below the table. Raises BadInput for an unknown metric.
    """
    files, by_name = _read_files(Path(folder), families), {metric.name: metric for metric in ALL_METRICS}
    if unknown := [name for name in names if name not in by_name]:
        raise BadInput("metric", f"one of {', '.join(by_name)}", ", ".join(unknown), "correct the name")
    metrics = [by_name[name] for name in names]
    heads = [f"{metric.title}{', ' * bool(metric.unit)}{metric.unit} ({_better(metric)})" for metric in metrics]
    lines = [f"| method | {' | '.join(heads)} |", "|---" * (len(metrics) + 1) + "|"]
    below = []
    for family, content in files.contents.items():
        if "figures" in content:
            cells = [_cell(family, metric, files) for metric in metrics]
            name = f"{family} (stale)" if family in stale else family
            lines.append(f"| {name} | {' | '.join(_marked(cell, files.kind(family)) for cell in cells)} |")
        else:
            below.append(f"- {family}: not evaluated, {content['empty']}")
    below += [f"- {family}: stale, {cause} has changed since" for family, cause in stale.items() if family in families]
    below += [f"- {metric.title}: not measured, {words}" for metric in metrics if (words := _reasons(metric, files))]
    return "\n".join([*lines, *([""] if below else []), *below]) + "\n"


def _marked(cell: Cell, kind: str) -> str:
    is_worse = cell.mark == "bad" and kind == "family"
    remarks = [cell.spread, cell.coverage and f"{cell.coverage} clips", "worse than retrieval" if is_worse else ""]
    words = "; ".join(filter(None, remarks))
    return f"{cell.text} ({words})" if words else cell.text


def _reasons(metric: AnyMetric, files: _Files) -> str:
    """Why clips have no value of a metric, in words; methods with the same reasons and counts together."""
    families_by_words = defaultdict[str, list[str]](list)
    for family in files.contents:
        if reasons := files.unmeasured(family, metric):
            families_by_words[reasons_in_words(reasons)].append(family)
    measured = [family for family, content in files.contents.items() if "figures" in content]
    return "; ".join(
        words if families == measured else f"{', '.join(families)}: {words}"
        for words, families in families_by_words.items()
    )


def _read_files(folder: Path, families: Sequence[str]) -> _Files:
    controls = sorted(path.stem for path in (folder / CONTROLS).glob("*.json") if path.stem != "empty")
    paths = {family: folder / f"{family}.json" for family in families}
    paths |= {control: folder / CONTROLS / f"{control}.json" for control in controls if control not in paths}
    absent = {"empty": "not evaluated"}
    contents = {family: read_metrics(path) if path.is_file() else absent for family, path in paths.items()}
    return _Files(contents, frozenset(controls))


def _method(family: str, files: _Files, shown: list[AnyMetric]) -> Method:
    content, kind = files.contents[family], files.kind(family)
    if "figures" not in content:
        return Method(family, kind, empty=str(content["empty"]))
    columns = [(metric, files.column(metric)) for metric in shown]
    summary, worse_in = [], []
    for baseline in RETRIEVAL_BASELINES if kind == "family" else ():
        titles = [metric.title for metric, column in columns if is_worse_than(baseline, metric, family, column)]
        if titles:
            compared = sum(family in column and baseline in column for _, column in columns)
            summary.append(f"worse than {baseline} in {len(titles)} of {compared} metrics")
            worse_in.append(f"worse than {baseline}: {', '.join(titles)}")
    flat = _flat(content.get("diagnostics", {}))
    diagnostics = [(name, NOT_MEASURED if value is None else number(value)) for name, value in flat.items()]
    skipped = len(content.get("left_out", []))
    note = f"{content['motions']:,} motions of {content['held_out_clips']:,} clips"
    note += f", {skipped:,} skipped" if skipped else ""
    note += ", of estimated length" if content.get("length") == "own" else ""
    return Method(family, kind, "; ".join(summary), worse_in, note=note, diagnostics=diagnostics)


def _topic(title: str, metrics: list[AnyMetric], never: list[AnyMetric], files: _Files) -> Topic:
    """The table of one topic: metrics with a value for some method, and metrics ``never`` measured for any."""
    titles = defaultdict[str, list[str]](list)
    for metric in never:
        titles[_reasons(metric, files)].append(metric.title)
    return Topic(
        title=title,
        columns=[(metric.title, metric.unit, _better(metric)) for metric in metrics],
        cells=[[_cell(family, metric, files) for metric in metrics] for family in files.contents],
        charts=[chart for metric in metrics if (chart := _chart(metric, files))],
        unmeasured=[("; ".join(same_reason), words) for words, same_reason in titles.items()],
    )


def _cell(family: str, metric: AnyMetric, files: _Files) -> Cell:
    note, reasons = files.note(family, metric), reasons_in_words(files.unmeasured(family, metric))
    if not files.has(family, metric):
        return Cell(note or (NOT_MEASURED if reasons else NOT_COMPUTED), note=reasons)
    if files.is_foreign(family, metric):
        return Cell(OTHER_EVALUATOR)
    column = files.column(metric)
    is_worse = any(is_worse_than(baseline, metric, family, column) for baseline in RETRIEVAL_BASELINES)
    ends = files.interval(family, metric, "clips")
    return Cell(
        text=number(column[family]),
        mark="bad" if is_worse else "good" if family in best_families(metric, column) else "",
        spread=f"{number(ends[0])} to {number(ends[1])}" if ends else "",
        note="; ".join(filter(None, (note, reasons and f"{NOT_MEASURED}: {reasons}"))),
        coverage=files.coverage(family, metric),
    )


def _chart(metric: AnyMetric, files: _Files) -> Chart | None:
    """All methods compared in one metric; None for fewer than two values."""
    column = files.column(metric)
    if len(column) < 2:
        return None
    spreads = {kind: {family: files.interval(family, metric, kind) for family in column} for kind in INTERVALS}
    ends = [end for by_family in spreads.values() for pair in by_family.values() if pair for end in pair]
    low, high = min(0.0, *column.values(), *ends), max(*column.values(), *ends)
    width = (high - low) or 1.0

    def percent(value: float) -> float:
        return round(100 * (value - low) / width, 2)

    def span(kind: str, family: str) -> tuple[float, float] | None:
        pair = spreads[kind][family]
        return (percent(pair[0]), percent(pair[1])) if pair else None

    bars = []
    for family, value in column.items():
        clips, repetitions = span("clips", family), span("repetitions", family)
        bars.append(Bar(family, files.kind(family), percent(value), clips, repetitions, number(value)))
    missing = [family for family in files.contents if family not in column and files.unmeasured(family, metric)]
    return Chart(
        title=f"{metric.title}, {metric.unit}" if metric.unit else metric.title,
        better=_better(metric),
        ends=(number(low), number(high)),
        bars=bars,
        missing=f"{NOT_MEASURED}: {', '.join(missing)}" if missing else "",
    )


def best_families(metric: AnyMetric, column: Mapping[str, float]) -> list[str]:
    """Families that no other beats in a metric; the recorded clips do not compete, and zeros are not marked.

    A method that does not move has no jitter, and one that does not touch has no penetration.
    """
    recorded = column.get(RECORDED)
    rivals = {family: value for family, value in column.items() if family != RECORDED}
    if metric.floor_of or (metric.direction == "closer to recorded" and recorded is None):
        return []
    return [
        family
        for family, value in rivals.items()
        if abs(value) >= ZERO and not any(is_better(metric, other, value, recorded) for other in rivals.values())
    ]


def is_worse_than(baseline: str, metric: AnyMetric, family: str, column: Mapping[str, float]) -> bool:
    """Whether a retrieval baseline has a better value than this family."""
    if family in (RECORDED, *RETRIEVAL_BASELINES) or baseline not in column or family not in column:
        return False
    return bool(is_better(metric, column[baseline], column[family], column.get(RECORDED)))


def printed_table(content: Mapping[str, Any]) -> Table:
    """The result of ``evaluate_store`` as a table for a terminal."""
    title = f"{content['motions']:,} motions of {content['held_out_clips']:,} clips, "
    title += "estimated length" if content.get("length") == "own" else "given length"
    table = Table(title=title + (", synthetic" if content["synthetic"] else ""), box=box.SIMPLE)
    table.add_column("metric", min_width=32)
    for name in ("value", *INTERVALS.values(), "unit", "better", "clips"):
        table.add_column(name, justify="left" if name in ("unit", "better") else "right")
    for cells in _printed_rows(content):
        table.add_row(*cells)
    return table


def _printed_rows(content: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    files = _Files({"": content})
    for metric in ALL_METRICS:
        if not files.has("", metric):
            missing = sum(files.unmeasured("", metric).values())
            if text := files.note("", metric) or (NOT_MEASURED if missing else ""):
                yield metric.title, text, "", "", metric.unit, _better(metric), f"0 of {missing:,}" if missing else ""
            continue
        ends = [" to ".join(map(number, files.interval("", metric, kind) or ())) for kind in INTERVALS]
        clips = files.coverage("", metric) or f"{content['counts'][metric.name]['clips']:,}"
        yield metric.title, number(content["figures"][metric.name]), *ends, metric.unit, _better(metric), clips


def unmeasured_lines(content: Mapping[str, Any]) -> list[str]:
    """Lines for a terminal: per metric without a value for some clip, the reasons and their numbers of clips."""
    reasons = {metric: _Files({"": content}).unmeasured("", metric) for metric in ALL_METRICS}
    return [f"{NOT_MEASURED}: {metric.title}: {reasons_in_words(count)}" for metric, count in reasons.items() if count]


def _better(metric: AnyMetric) -> str:
    return "lower bound" if metric.floor_of else f"{metric.direction} is better"


def number(value: object) -> str:
    """A value as text: whole numbers exactly, others with three significant digits or more, 0 below ``ZERO``."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "" if value is None else str(value)
    if isinstance(value, int):
        return f"{int(value):,}"
    if abs(value) < ZERO:
        value = 0.0
    return f"{value:,.1f}" if abs(value) >= 100 else f"{value:#.3g}"


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    """Nested values by their path in words."""
    flat: dict[str, object] = {}
    for key, value in values.items():
        name = f"{prefix}{key}".replace("_", " ")
        flat |= _flat(value, f"{name} ") if isinstance(value, Mapping) else {name: value}
    return flat
