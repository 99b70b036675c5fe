"""Stage tables: BimArt's Tables 1 and 3 from the rows of all runs, and Table 6 from recorded clips, as Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.files import write_whole
from hoidata.files.written import Facts, read_json
from hoidata.metrics.unmeasured import reasons_in_words
from models.bimart_tables.rows import ROWS
from models.bimart_tables.variants import variant_of
from pipelines.markdown import markdown_text
from pipelines.promises import PROMISES, Promise
from pipelines.stages.base import EMPTY, StagePaths, empty_reason, load_hands

RIVALS = ("nearest-window", "nearest-window-refined", "nearest-windows", "random-window", "mean-pose-at-object")
TABLES: Mapping[str, Sequence[str]] = {
    "Table 1: baselines": ("ground-truth", "cams-b", "mdm-b", "omomo-b", "bimart", *RIVALS),
    "Table 3: representations": ("unscaled", "whole", "mano", "stateless", "map"),
    "Table 3: contact": ("no-map", "map", "map-guided", "bimart"),
    "Controls": (
        *("ground-truth", "hands-still", "hands-shifted", "pressed-deep", "bimart", "other-path", "other-object"),
        "zero-map",
    ),
}
# Column, then the figures in it: as released / corrected.
COLUMNS = {
    "Mul, cm": ("bimart_mul_cm",),
    "Accel, cm/frame2 / m/s2": ("bimart_accel_paper", "bimart_accel_corrected"),
    "Pen 1 cm, %": ("bimart_pen_1cm_paper", "bimart_pen_1cm_corrected"),
    "Pen 5 mm, %": ("bimart_pen_5mm_paper", "bimart_pen_5mm_corrected"),
    "Con, %": ("bimart_con_paper", "bimart_con_corrected"),
    "Art, %": ("bimart_art_paper", "bimart_art_corrected"),
    "CM, cm": ("bimart_cm_paper", "bimart_cm_corrected"),
    "contact F1": ("contact_f1",),
    "joints, best sample, mm": ("joint_error_mm",),
}
NOTE = (
    "Figures as BimArt's release has them / corrected (hoidata/metrics/README.md); contact F1 and joints see where "
    "hands are. As released: of the first motion of each clip alone. Of several seeds the mean, in brackets the "
    "standard deviation. A best sample is the best of as many motions as a clip has: the more, the nearer."
)


def run(paths: StagePaths) -> None:
    """Write the tables; of a dataset without clips the reason alone."""
    if reason := empty_reason(paths.clips):
        write_whole(paths.tables, f"{markdown_text(reason)}\n")
        return
    found = read_rows(paths)
    lines = [f"# BimArt's tables on {paths.profile}/{paths.dataset}", "", NOTE]
    for title, names in TABLES.items():
        if rows := [_row(found[name]) for name in names if name in found]:
            lines += ["", f"## {title}", "", *_table(("row", "seeds", "motions", *COLUMNS), rows)]
            lines += unmeasured_lines([seed for name in names for seed in found.get(name, ())])
    lines += controls_lines(paths) + maps_lines(found)
    lines += ["", "## Table 6: error of contact maps seen by basis points, cm", "", *_mapping(paths)]
    write_whole(paths.tables, "\n".join(lines) + "\n")
    print(f"{paths}: {len(found)} rows, {paths.tables}")


def read_rows(paths: StagePaths) -> dict[str, list[Facts]]:
    """What was measured of each row, by its name, seed by seed."""
    known = [name for rows in ROWS.values() for name in rows]
    files = [file for folder in _runs(paths) for file in sorted(folder.glob("*.json")) if file.name != EMPTY]
    rows = [(file.stem, read_row(file)) for file in files]
    return {name: own for name in known if (own := [row for stem, row in rows if stem == name])}


def read_row(path: Path) -> Facts:
    """What was measured of one row. Raises BadInput."""
    measured = {"figures": dict, "motions": int, "by_clip": dict, "diagnostics": dict, "empty": (str, type(None))}
    return read_json(path, {"title": str}).check_given(measured)


def _runs(paths: StagePaths) -> list[Path]:
    """The folder of each run's rows, without what a killed one left beside them."""
    return sorted(paths.table_rows.glob("[!.]*"))


def _row(seeds: list[Facts]) -> list[str]:
    """Title, how many seeds and motions, and the cells of a row."""
    measured = [seed for seed in seeds if "figures" in seed]
    if not measured:
        return [seeds[0]["title"], "0", seeds[0]["empty"], *["-"] * len(COLUMNS)]
    cells = [
        " / ".join(mean_and_spread(seed["figures"].get(name) for seed in measured) for name in own)
        for own in COLUMNS.values()
    ]
    return [seeds[0]["title"], str(len(measured)), str(sum(seed["motions"] for seed in measured)), *cells]


def unmeasured_lines(seeds: Iterable[Facts]) -> list[str]:
    """Below a table: why rows have no figure of a metric, or of some clips only."""
    lines = dict[str, None]()  # a reason that all seeds of a row share is given once
    for seed in seeds:
        for name in (name for own in COLUMNS.values() for name in own):
            if reasons := seed.get("unmeasured", {}).get(name):
                lines[f"- {seed['title']}: {name} not measured, {reasons_in_words(reasons)}"] = None
    return ["", *lines] if lines else []


def controls_lines(paths: StagePaths) -> list[str]:
    """What every control must do, clip by clip beside the row it is compared with, and in how many runs it does."""
    found: dict[Promise, list[Compared]] = {}
    for folder in _runs(paths):
        rows = _rows_by_family(folder)
        for promise in PROMISES:
            if (one := compared(promise, rows)) is not None:
                found.setdefault(promise, []).append(one)
    lines = []
    for promise, own in found.items():
        means = mean_and_spread(one.beside for one in own), mean_and_spread(one.control for one in own)
        apart = ", ".join(f"{one.low:.3g} to {one.high:.3g}" for one in own)
        holds = f"{sum(one.holds(promise.must) for one in own)} of {len(own)}"
        lines.append(
            [promise.control, promise.metric, f"{promise.must}, beside {promise.beside}", *means, apart, holds]
        )
    title = "## What controls must do beyond the 95 % interval over clips"
    columns = (
        "control",
        "figure",
        "must",
        "beside",
        "control's",
        "difference, 95 % in each run",
        "runs in which it does",
    )
    return ["", title, "", *_table(columns, lines)] if lines else []


@dataclass(frozen=True)
class Compared:
    """The figures of a control and of the row beside it over the clips of both, and their difference's interval."""

    beside: float
    control: float
    low: float
    high: float

    def holds(self, must: str) -> bool:
        return {"fall": self.high < 0, "rise": self.low > 0, "stay": self.high >= 0}[must]


def compared(promise: Promise, rows: Mapping[str, Facts]) -> Compared | None:
    """A promise of rows by family, over the clips that have a value in both; None where it cannot be told."""
    if promise.must not in ("fall", "rise", "stay") or not {promise.control, promise.beside} <= set(rows):
        return None
    if not _as_many_chances(promise, rows):
        return None
    from hoidata.metrics.intervals import bootstrap_interval

    clips, others = (rows[name]["by_clip"] for name in (promise.beside, promise.control))
    shared = [
        clip
        for clip in clips
        if clip in others and all(promise.metric in own[clip]["parts"] for own in (clips, others))
    ]
    parts = np.array(
        [[*clips[clip]["parts"][promise.metric], *others[clip]["parts"][promise.metric]] for clip in shared]
    )
    interval = bootstrap_interval(parts, [clips[clip]["group"] for clip in shared], _difference) if shared else None
    if interval is None:
        return None
    total, count, other, counted = parts.sum(axis=0)
    return Compared(total / count, other / counted, *interval)


def _difference(parts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(draw,) of control less the row beside it; parts (clip, 4): both sums and counts; weights (draw, clip)."""
    total, count, other, counted = (weights @ parts).T
    return other / counted - total / count


def _rows_by_family(folder: Path) -> dict[str, Facts]:
    """The measured rows of a run that are a family as it stands in the registry, by its name."""
    found: dict[str, Facts] = {}
    for name, row in ROWS[variant_of(folder.name)[0]].items():
        path = folder / f"{name}.json"
        if not row.settings and path.is_file() and "by_clip" in (facts := read_row(path)):
            found.setdefault(row.family, facts)  # the first of a family, not the same with more motions
    return found


def _as_many_chances(promise: Promise, rows: Mapping[str, Facts]) -> bool:
    """Whether a figure of both rows can be compared: the best of few motions is worse than the best of many."""
    from hoidata.metrics.registry import METRICS

    best_of = {metric.name for metric in METRICS if metric.reduction == "best of a clip's samples"}
    return promise.metric not in best_of or rows[promise.control]["motions"] == rows[promise.beside]["motions"]


def maps_lines(found: Mapping[str, list[Facts]]) -> list[str]:
    """How far drawn contact maps lie from the recorded ones, beside the object's mean map of training."""
    inside = [row["diagnostics"]["bimart-contact"] for row in found.get("bimart", []) if row.get("diagnostics")]
    rows = [[name, mean_and_spread(one[name] for one in inside)] for name in sorted(inside[0])] if inside else []
    return ["", "## Contact maps: error, mm", "", *_table(("of", "mm"), rows)] if rows else []


def mean_and_spread(values: Iterable[float | None]) -> str:
    """The mean, in brackets the standard deviation of several; a dash for none."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    spread = f" ({np.std(known, ddof=1):.2g})" if len(known) > 1 else ""
    return f"{np.mean(known):.3g}{spread}"


def _mapping(paths: StagePaths) -> list[str]:
    from hoidata.batches.dataset import HoiDataset
    from hoidata.store.annotated import load_annotated
    from models.bimart_tables.mapping import VARIANTS as SEEN
    from models.bimart_tables.mapping import WHERE, mapping_errors_cm

    hands = load_hands(paths.profile)
    found = mapping_errors_cm(list(HoiDataset(load_annotated(paths.data, hands), "test", crop="start")), hands)
    if not found:
        return ["No test clips."]
    found["mean"] = {kind: np.nanmean([own[kind] for own in found.values()], axis=0).tolist() for kind in SEEN}
    columns = [f"{where}: {kind}" for where in WHERE for kind in SEEN]
    rows = [
        [markdown_text(name), *(f"{own[kind][place]:.3f}" for place in range(len(WHERE)) for kind in SEEN)]
        for name, own in found.items()
    ]
    return _table(("object", *columns), rows)


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(own)} |" for own in (columns, ["---"] * len(columns), *rows)]
