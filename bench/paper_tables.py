"""Text2HOI's Tables 1 and 2, and presets `paper` and `ours`, on this project's corpora: every row is a project setting,
trained, sampled and measured.

``python -m bench table1 CORPUS``, likewise ``table2`` and ``presets``; ``table1.yaml`` and the others have settings,
runs, rows and columns. CORPUS: embedded (a quick check), study, or arctic (recordings in HOIDATA_ARCTIC, MANO files in
HOIDATA_MANO); ``presets`` also has composition and object, other splits of study. HOIDATA_BENCH_OUT: the project folder
(.hoidata/table1-CORPUS), which all runs use in turn; ``presets`` in the folder of ``table1`` does not train again.
Finished runs are in its ``table1.json``, so a killed command continues. ``table1.md`` has the tables.
"""

import json
import os
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from bench.project import markdown_lines, open_project, reproduce, results_of, stage_runs
from hoidata.errors import BadInput
from hoidata.files import write_whole
from hoidata.files.atomic import canonical_json
from hoidata.metrics.registry import is_better
from hoidata.settings import merge_settings
from models.registry import family_module
from pipelines.expected_orderings import EXPECTED_ORDERINGS, RECORDED, check_orderings
from pipelines.lineage.digests import value_digest
from pipelines.pages.metrics_table import ALL_METRICS, NOT_MEASURED, AnyMetric, number
from pipelines.params import load_yaml

FOLDER = Path(__file__).parent
METRIC = {metric.name: metric for metric in ALL_METRICS}
ORDERED_BY = {
    "Order by top-3 accuracy": "accuracy_top3_paper",
    "By that of the corrected evaluator": "accuracy_top3_corrected",
}
STATIC = [ordering for ordering in EXPECTED_ORDERINGS if ordering.control == "static"]
LEGEND = "In parentheses: 95 % interval over clips. ±: "
REPETITIONS_LEGEND = "95 % interval over repetitions of sampling, of one training; 0 for a method without randomness."
SEEDS_LEGEND = "standard deviation over {} trainings, of which values and intervals are means."
# ``table1.json``: by ``<run> <seed>`` the digest of its settings, processor seconds by stage, and metrics by method.
Results = Mapping[str, Mapping[str, Any]]
# By seed: ``value``, and its intervals ``repetitions`` and ``clips`` if there are any.
Seeds = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Row:
    """A line of a table: a family of one run."""

    title: str
    run: str
    family: str
    reference: str = ""  # the title of the line that this one is compared with

    def of(self, results: Results) -> list[Mapping[str, Any]]:
        """The results of the run by seed."""
        return [content for name, content in results.items() if name.rpartition(" ")[0] == self.run]

    def values(self, results: Results, metric: str) -> Seeds:
        contents = [content["methods"].get(self.family, {}) for content in self.of(results)]
        return [
            {"value": content["figures"][metric], **content["intervals"].get(metric, {})}
            for content in contents
            if metric in content.get("figures", {})
        ]

    def reason(self, results: Results, metric: str) -> str:
        """Why no seed has a value, from the first."""
        contents = [content["methods"].get(self.family, {}) for content in self.of(results)] or [{}]
        unmeasured = next(iter(contents[0].get("unmeasured", {}).get(metric, ())), NOT_MEASURED)
        return contents[0].get("empty") or contents[0].get("notes", {}).get(metric) or unmeasured


@dataclass(frozen=True)
class PaperTable:
    """One of the YAML files, for a corpus."""

    name: str  # table1, table2 or presets
    corpus: str

    @cached_property
    def content(self) -> dict[str, Any]:
        return load_yaml((FOLDER / f"{self.name}.yaml").read_bytes())

    @cached_property
    def settings(self) -> Mapping[str, Any]:
        """The settings of all runs: sections of params.yaml. Raises BadInput for an unknown corpus."""
        if self.corpus not in self.content["corpora"]:
            names = ", ".join(self.content["corpora"])
            raise BadInput(f"bench {self.name}", f"one of {names}", self.corpus or "no corpus", "name one of them")
        recordings = load_yaml((FOLDER / "recordings.yaml").read_bytes()) if self.corpus == "arctic" else {}
        settings = {name: recordings[name] for name in ("profile", "datasets", "convert", "split") if recordings}
        base = [PaperTable(self.content["settings_of"], self.corpus)] if "settings_of" in self.content else []
        for content in (table.content for table in (*base, self)):
            settings = merge_settings(settings, content["settings"])
            settings = merge_settings(settings, content["corpora"].get(self.corpus, {}))
        return settings

    @property
    def dataset(self) -> str:
        return self.settings["datasets"][0]

    @property
    def metrics(self) -> set[str]:
        """All metrics of the columns and of the negative control."""
        of_columns = {name for columns in self.content["columns"].values() for name in columns.values()}
        return of_columns | {ordering.metric for ordering in STATIC}

    @property
    def rows(self) -> list[Row]:
        return [Row(title, *of.split("/")) for title, of in self.content["rows"].items()]

    def runs(self) -> dict[str, Mapping[str, Any]]:
        """The settings of every run, by ``<run> <seed>``."""
        return {
            f"{name} {seed}": merge_settings(merge_settings(self.settings, changes), {"train": {"seed": seed}})
            for seed in self.content["seeds"][self.corpus]
            for name, changes in self.content["runs"].items()
        }

    def fill(self, project: Path) -> Results:
        """Make every run that ``table1.json`` of the project does not have with the same settings."""
        path, profile = project / f"{self.name}.json", self.settings["profile"]
        results = json.loads(path.read_text()) if path.is_file() else {}
        for name, settings in self.runs().items():
            digest = value_digest(settings)
            if results.get(name, {}).get("settings") == digest:
                continue
            print(f"{self.name}, {self.corpus}: {name}", flush=True)
            open_project(project, settings)
            reproduce(project, f"evaluate@{profile}-{self.dataset}")
            seconds = {run["stage"]: round(run["processor_seconds"]) for run in stage_runs(project)}
            methods = results_of(project / "metrics" / profile / self.dataset, self.metrics)
            results[name] = {"settings": digest, "seconds": seconds, "methods": methods}
            write_whole(path, canonical_json(results))
        return {name: results[name] for name in self.runs()}

    def markdown(self, results: Results, hidden: Collection[str] = ()) -> str:
        """The tables of the runs, their order, and the paper's numbers.

        hidden: titles of tables, metrics, and ``texts`` for the text that is the same for every corpus.
        """
        n_seeds = len(self.rows[0].of(results))
        spread = SEEDS_LEGEND.format(n_seeds) if n_seeds > 1 else REPETITIONS_LEGEND
        parts = [] if "texts" in hidden else [f"{self.content['budget']} {LEGEND}{spread}"]
        minutes = {line: self.minutes(line, results) for line in self.rows}
        for title, columns in self.content["columns"].items():
            if title not in hidden:
                shown = {header: name for header, name in columns.items() if name not in hidden}
                parts.append(f"{title}:\n\n{self.table(shown, results, minutes)}")
                minutes = {}
        if any(line.reference for line in self.rows):
            parts.append(f"Difference from the reference row:\n\n{self.differences(results)}")
        if paper := self.content.get("paper"):
            methods = paper["methods"][self.dataset]
            orders = {title: self.order(results, metric) for title, metric in ORDERED_BY.items()}
            orders["In the paper"] = sorted(methods, key=lambda name: -methods[name][0])
            parts.append(" ".join(f"{title}: {' > '.join(names)}." for title, names in orders.items() if names))
            lines = [[name, *map(str, values)] for name, values in methods.items()]
            parts += [] if "texts" in hidden else [paper["reasons"]]
            parts.append(markdown_lines(["paper", *paper["columns"]], lines))
        return "\n\n".join(part.rstrip() for part in parts) + "\n"

    def table(self, columns: Mapping[str, str], results: Results, minutes: Mapping[Row, str]) -> str:
        """One table of all rows, with any ``minutes`` in the last column; a column without value is a line below it."""
        empty = {
            title: self.rows[0].reason(results, name).partition(":")[0]
            for title, name in columns.items()
            if not any(line.values(results, name) for line in self.rows)
        }
        shown = {title: METRIC[name] for title, name in columns.items() if title not in empty}
        lines = [[line.title, *(cell(line, results, metric) for metric in shown.values())] for line in self.rows]
        head = ["method", *shown]
        if minutes:
            head.append("processor minutes, training + sampling")
            lines = [[*cells, minutes[line]] for cells, line in zip(lines, self.rows, strict=True)]
        table = markdown_lines(head, lines)
        notes = "; ".join(f"{title}: {reason}" for title, reason in empty.items())
        return table + (f"\n\nMeasured in no row: {notes}." if empty else "")

    def order(self, results: Results, metric: str) -> list[str]:
        """The titles of the lines with a value, the highest first."""
        values = {line.title: seeds for line in self.rows if (seeds := line.values(results, metric))}
        return sorted(values, key=lambda title: -mean_value(values[title]))

    def minutes(self, line: Row, results: Results) -> str:
        """Processor minutes of all trainings of the row's package and of its sampling, mean over seeds."""
        graph, sums = f"models/{family_module(line.family).split('.')[1]}/dvc.yaml", []
        sample = f"{graph}:sample@{self.settings['profile']}-{self.dataset}"
        for seconds in (content["seconds"] for content in line.of(results)):
            trained = sum(value for stage, value in seconds.items() if stage.startswith(f"{graph}:train"))
            sampled = seconds.get(f"{sample}-{line.family}", seconds.get(sample, 0))  # a sole family has no suffix
            sums += [(trained / 60, sampled / 60)] if trained else []
        return "+".join(f"{mean(values):.1f}" for values in zip(*sums, strict=True)) or "–"

    def differences(self, results: Results) -> str:
        """Per row and column of the first table, the difference from the reference row."""
        columns, rows = next(iter(self.content["columns"].values())), {line.title: line for line in self.rows}
        recorded = next(line for line in self.rows if line.family == RECORDED)
        lines = []
        for line in (line for line in self.rows if line.reference):
            lines.append([line.title, line.reference])
            for name in columns.values():
                seeds = [one.values(results, name) for one in (line, rows[line.reference], recorded)]
                lines[-1].append(difference(METRIC[name], *seeds))
        return markdown_lines(["row", "reference", *columns], lines)


def mean_value(seeds: Seeds) -> float:
    return mean(seed["value"] for seed in seeds)


def half_width(seeds: Seeds, kind: str) -> float | None:
    """Half of the 95 % interval over repetitions or clips, mean over seeds."""
    intervals = [seed[kind] for seed in seeds if kind in seed]
    return mean((high - low) / 2 for low, high in intervals) if intervals else None


def cell(line: Row, results: Results, metric: AnyMetric) -> str:
    """Mean over seeds with the intervals of ``LEGEND``, or the reason for a missing value."""
    seeds = line.values(results, metric.name)
    if not seeds:
        return line.reason(results, metric.name).partition(":")[0]
    text, half = number(mean_value(seeds)), half_width(seeds, "repetitions")
    if len(seeds) > 1:
        text += f"±{number(stdev(seed['value'] for seed in seeds))}"
    elif half is not None:
        text += f"±{number(half)}"
    if ends := [seed["clips"] for seed in seeds if "clips" in seed]:
        text += " ({}–{})".format(*(number(mean(end)) for end in zip(*ends, strict=True)))
    return text


def difference(metric: AnyMetric, seeds: Seeds, others: Seeds, recorded: Seeds) -> str:
    """``-0.120±0.030, worse``: the difference of two rows and its 95 % interval; no word if the interval has 0.

    Intervals are over repetitions, or over clips for metrics that are measured on one repetition.
    """
    if not (seeds and others):
        return NOT_MEASURED
    halves = [half_width(line, "repetitions") or half_width(line, "clips") or 0.0 for line in (seeds, others)]
    value, other, half = mean_value(seeds), mean_value(others), sum(one**2 for one in halves) ** 0.5
    better = is_better(metric, value, other, mean_value(recorded) if recorded else None)
    verdict = "" if abs(value - other) <= half or better is None else ", better" if better else ", worse"
    return f"{value - other:+.3f}±{half:.3f}{verdict}"


def make(name: str, corpus: str) -> int:
    """Compute and print a table; 1 if the static control does not lose where it must, else 0."""
    table = PaperTable(name, corpus)
    project = Path(os.environ.get("HOIDATA_BENCH_OUT", f".hoidata/{name}-{corpus}")).resolve()
    results = table.fill(project)
    text = f"# {table.content['title']}: {corpus}, {table.dataset}\n\n{table.markdown(results)}"
    (project / f"{name}.md").write_text(text)
    print(text)
    checked = {run: check_orderings(content["methods"], STATIC) for run, content in results.items()}
    failed = [(run, one.ordering) for run, orderings in checked.items() for one in orderings if one.holds is False]
    for run, ordering in failed:
        print(f"{run}: the control static does not {ordering.must} in {ordering.metric}", file=sys.stderr)
    return int(bool(failed))
