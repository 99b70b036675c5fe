"""Tables of README.md and docs/results.md, from the metrics in docs/results: `python -m docs.make.results` writes them.

`python -m docs.make.results arctic=PROJECT/metrics/own/arctic` first replaces docs/results/arctic.json by those of a
run, and `table1-arctic=PROJECT/table1.json` copies the results of `bench/paper_tables.py`. Their table is written in
place of `<!--results:table1-arctic-->` to `<!--end-->`. A test compares the pages with the files.
"""

import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.paper_tables import PaperTable
from bench.project import Methods, markdown_lines, results_of
from hoidata.errors import BadInput
from hoidata.files import write_whole
from hoidata.metrics.registry import is_better
from pipelines.expected_orderings import RECORDED
from pipelines.pages.metrics_table import ALL_METRICS

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs/results"
PAGES = (ROOT / "README.md", ROOT / "docs/results.md")
# What only the benchmark prints of the papers' tables: tables, metrics, and texts that another table has.
CORRECTED = tuple(
    f"{name}_corrected" for name in ("accuracy_top1", "fid_paired", "diversity", "multimodality_by_label")
)
HIDDEN = {
    "table1-study": CORRECTED,
    # Recorded test clips are farther from training clips than generated motions are (docs/results.md).
    "table1-arctic": (*CORRECTED, "texts", "fid_frechet_train_paper", "fid_frechet_train_corrected"),
    "table2-grab": ("This project's metrics",),
}
PLACE = re.compile(r"<!--results:(?P<name>[\w-]+)-->\n.*?<!--end-->", re.DOTALL)
MEASURED_SHARE = 0.95  # below, a cell has the number of measured clips
METRIC = {metric.name: metric for metric in ALL_METRICS}
# Header of a column: its metric and the number of decimals.
COLUMNS = {
    "verb success": ("action_followed", 2),
    "verb accuracy": ("action_named", 2),
    "contact F1": ("contact_f1", 2),
    "adherence": ("adherence", 2),
    "Con": ("bimart_con_corrected", 0),
    "Art": ("bimart_art_corrected", 0),
    "Pen": ("bimart_pen_1cm_corrected", 1),
    "CM": ("bimart_cm_corrected", 1),
    "Mul": ("bimart_mul_cm", 2),
    "acceleration": ("bimart_accel_corrected", 1),
    "deep": ("deep_share", 3),
    "slip": ("slip_cm_s", 1),
    "realism": ("realism_si", 2),
    "jitter": ("jitter_m_s3", 0),
    "joints": ("joint_error_mm", 0),
    # As BimArt's release defines them.
    "Con, released": ("bimart_con_paper", 1),
    "Art, released": ("bimart_art_paper", 1),
    "Pen, released": ("bimart_pen_1cm_paper", 1),
    "acceleration, released": ("bimart_accel_paper", 3),
}
PAPER = {"paper/text2hoi-coarse": "`paper`, networks alone", "paper/text2hoi": "`paper`"}
TEXT = {
    "ground-truth": "recorded",
    "text2hoi-coarse": "networks alone",
    "text2hoi": "**ours**",
    "prompt-retrieval": "retrieval",
    "prompt-retrieval-refined": "retrieval, refined",
    "nearest-clip": "nearest sentence",
    "mean-motion": "mean motion",
    "other-prompt": "other prompt",
}
PRESETS = {
    "ground-truth": "recorded",
    **PAPER,
    "text2hoi-coarse": "`ours`, networks alone",
    "text2hoi": "**`ours`**",
    "text2hoi-contact": "`ours`, contact refinement",
    "best-of-5/text2hoi": "`ours`, best of 5",
    "prompt-retrieval": "retrieval",
    "verb-retrieval": "retrieval by verb",
    "mean-motion": "mean motion",
    "other-prompt": "other prompt",
    "static": "first frame, repeated",
}
CONTROLS = {
    "ground-truth": "recorded",
    "random-clip": "random training clip",
    "static": "first frame, repeated",
    "reversed": "played backwards",
    "object-moved": "object moved away",
    "swapped-hands": "hands swapped",
    "hands-away": "hands moved away",
    "pressed": "hands pressed in by 10 mm",
    "noise": "noise on hands",
}
# Rows of BimArt's Tables 1 and 3 (bench/bimart_tables.py).
WINDOWS = {
    "ground-truth": "recorded",
    "paper": "**BimArt, `paper`**",
    "paper-guided": "`paper`, unrefined",
    "paper-with-contact": "`paper`, unguided",
    "paper-without-contact": "`paper`, no maps",
    "ours": "**BimArt, `ours`**",
    "ours-unrefined": "`ours`, unrefined",
    "nearest-window": "nearest window",
    "nearest-window-refined": "nearest window, refined",
    "mdm-b": "MDM-B",
    "omomo-b": "OMOMO-B",
    "cams-b": "CAMS-B",
    "mean-pose": "mean pose at the object",
    "hands-shifted": "hands 3 cm aside",
    "pressed-deep": "hands 3 cm deeper",
}
NOT_RANKED = frozenset({RECORDED, "mean-pose", "hands-shifted", "pressed-deep", "cams-b"})  # cams-b sees recorded hands
OF_TEXT = ("verb success", "verb accuracy", "contact F1", "adherence", "deep", "slip", "realism", "jitter", "joints")


@dataclass(frozen=True)
class Table:
    """One table of a page."""

    files: Mapping[str, str]  # by file of docs/results, its title in a first column; "" for a single file
    methods: Mapping[str, str]  # by family, its title
    columns: Sequence[str]
    intervals: bool = True  # show intervals over clips and the number of measured clips
    unranked: frozenset[str] = frozenset({RECORDED})  # methods that do not compete for the best value of a column


TABLES = {
    "arctic-short": Table(
        {"arctic": ""},
        {"ground-truth": "recorded", "paper/text2hoi": "`paper`"}
        | {family: TEXT[family] for family in ("text2hoi", "prompt-retrieval", "mean-motion")},
        ("verb accuracy", "contact F1", "deep", "jitter", "joints"),
        intervals=False,
    ),
    "arctic-text": Table(
        {"arctic": ""},
        {"ground-truth": "recorded", **PAPER}
        | {family: title for family, title in TEXT.items() if family != "nearest-clip"},
        OF_TEXT,
    ),
    "arctic-hands": Table(
        {"arctic-hands": ""},
        {
            "ground-truth": "recorded",
            "bimart": "**BimArt**",
            "bimart-unrefined": "BimArt without refinement",
            "nearest-window": "nearest training window",
            "nearest-window-refined": "nearest training window, refined",
            "mean-pose-at-object": "mean pose at the object",
            "manipnet": "ManipNet",
        },
        ("contact F1", "Con", "Art", "Pen", "acceleration", "slip", "jitter", "joints"),
        unranked=frozenset({RECORDED, "mean-pose-at-object", "manipnet"}),  # manipnet is given the wrists
    ),
    "arctic-windows": Table(
        {"arctic-windows": ""},
        WINDOWS,
        ("Mul", "acceleration", "Pen", "Con", "Art", "CM", "contact F1"),
        unranked=NOT_RANKED,
    ),
    "arctic-windows-released": Table(
        {"arctic-windows": ""},
        {family: WINDOWS[family] for family in ("ground-truth", "paper", "ours", "cams-b", "mdm-b", "omomo-b")},
        ("acceleration, released", "Pen, released", "Con, released", "Art, released"),
        intervals=False,
        unranked=frozenset(WINDOWS),
    ),
    "arctic-controls": Table(
        {"arctic": ""},
        CONTROLS,
        ("verb success", "contact F1", "deep", "slip", "realism", "jitter"),
        intervals=False,
        unranked=frozenset(CONTROLS),
    ),
    "presets": Table(
        {
            "presets-study": "subjects",
            "presets-composition": "composition",
            "presets-object": "unseen object",
            "presets-arctic": "recorded ARCTIC",
        },
        PRESETS,
        ("verb accuracy", "contact F1", "adherence", "deep", "slip", "realism", "joints"),
        intervals=False,
        unranked=frozenset({RECORDED, "mean-motion", "static"}),
    ),
    "embedded": Table(
        {"embedded-h2o": "H2O", "embedded-grab": "GRAB", "embedded-arctic": "ARCTIC"},
        {family: title for family, title in TEXT.items() if family not in ("prompt-retrieval-refined", "mean-motion")},
        OF_TEXT,
        intervals=False,
    ),
}


def metrics_of_file(name: str) -> set[str]:
    """The metrics that the tables show of a file."""
    return {COLUMNS[column][0] for table in TABLES.values() if name in table.files for column in table.columns}


def collect(name: str, metrics: Path) -> None:
    """Write docs/results/<name>.json from the metrics of a dataset, one line per method."""
    if metrics.is_file():  # of a table of the paper
        write_whole(RESULTS / f"{name}.json", metrics.read_text())
        return
    shown = {family for table in TABLES.values() if name in table.files for family in table.methods}
    if not shown:
        files = sorted({file for table in TABLES.values() for file in table.files})
        raise BadInput("docs.make.results", f"one of {', '.join(files)}", name, "correct the name before =")
    methods = {
        family: values for family, values in results_of(metrics, metrics_of_file(name)).items() if family in shown
    }
    lines = (f"{json.dumps(family)}: {json.dumps(methods[family], sort_keys=True)}" for family in sorted(methods))
    write_whole(RESULTS / f"{name}.json", "{\n" + ",\n".join(lines) + "\n}\n")


def read(name: str) -> Methods:
    """Metrics by method; of `bench presets` by ``<run>/<family>``, those of its run `ours` by family."""
    content = json.loads((RESULTS / f"{name}.json").read_text())
    if not name.startswith("presets-"):
        return content
    runs = {run.rpartition(" ")[0]: run_content["methods"] for run, run_content in content.items()}
    others = {f"{run}/{family}": values for run, methods in runs.items() for family, values in methods.items()}
    return others | runs["ours"]


def markdown(table: Table) -> str:
    """The table from its files."""
    first = [] if "" in table.files.values() else ["data, clips"]
    head = [*first, "method", *table.columns]
    lines = []
    for name, title in table.files.items():
        methods = {family: content for family, content in read(name).items() if family in table.methods}
        ranked = {family: content for family, content in methods.items() if family not in table.unranked}
        best = {column: best_methods(ranked, column, methods[RECORDED]) for column in table.columns}
        label = f"{title}, {methods[RECORDED]['counts']['joint_error_mm']['clips']}" if first else ""
        for family in (family for family in table.methods if family in methods):
            cells = [cell(methods[family], column, table.intervals, family in best[column]) for column in table.columns]
            lines.append([*([label] * len(first)), table.methods[family], *cells])
            label = ""
    return markdown_lines(head, lines)


def paper_table(name: str) -> str:
    """A table of a paper, such as ``table1-study``."""
    table = PaperTable(*name.split("-"))
    return table.markdown(read(name), HIDDEN.get(name, ())).rstrip()


def best_methods(methods: Methods, column: str, recorded: Mapping[str, Any]) -> set[str]:
    """The methods that no other beats in a column, by the numbers shown."""
    name, decimals = COLUMNS[column]
    values = {family: content["figures"].get(name) for family, content in methods.items()}
    shown = {family: round(value, decimals) for family, value in values.items() if value is not None}
    true = recorded["figures"].get(name)
    beaten = {one for one in shown for other in shown if is_better(METRIC[name], shown[other], shown[one], true)}
    return set(shown) - beaten


def cell(content: Mapping[str, Any], column: str, intervals: bool, is_best: bool) -> str:
    """The value, its 95 % interval over clips, and in brackets the number of measured clips if it is below 95 %."""
    name, decimals = COLUMNS[column]
    value = content["figures"].get(name)
    if value is None:
        return "–"
    text = f"**{number(value, decimals)}**" if is_best else number(value, decimals)
    low, high = (number(end, decimals) for end in content["intervals"].get(name, {}).get("clips", (value, value)))
    if intervals and (low, high) != (number(value, decimals),) * 2:
        text += f" ({low}–{high})"
    clips, missing = content["counts"][name]["clips"], sum(content["unmeasured"].get(name, {}).values())
    return text + (f" [{clips}]" if clips < MEASURED_SHARE * (clips + missing) else "")


def number(value: float, decimals: int) -> str:
    """A number without leading zero; 0 and 1 without decimals if exact."""
    text = f"{value:.{decimals}f}"
    if float(text) == 0 or value == 1:
        return f"{value:.0f}"
    return text.removeprefix("0") if text.startswith("0.") else text


def filled(text: str) -> str:
    """The text of a page with all its tables written again."""

    def table(match: re.Match[str]) -> str:
        name = match["name"]
        return f"<!--results:{name}-->\n{markdown(TABLES[name]) if name in TABLES else paper_table(name)}\n<!--end-->"

    return PLACE.sub(table, text)


def main() -> None:
    for word in sys.argv[1:]:
        name, _, folder = word.partition("=")
        collect(name, Path(folder))
    for path in PAGES:
        path.write_text(filled(path.read_text()))


if __name__ == "__main__":
    main()
