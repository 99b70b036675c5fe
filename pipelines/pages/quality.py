"""The report's section on quality control: tables, a histogram per measure, and the excluded clips of one dataset."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hoidata.files.written import NUMBER_OR_NONE, read_json, read_table
from hoidata.quality.thresholds import CLIP_MEASURES, MESH_MEASURES, Measure
from pipelines.pages.curves import COLOURS, figure_svg
from pipelines.pages.metrics_table import number

COLUMNS = 5
BINS = 24
WARN_COLOUR, LEAVE_OUT_COLOUR = "#c98a00", "#b5371f"
# A limit beyond this multiple of the largest value is not drawn: it would leave the chart empty.
FARTHEST = 2.5
# Entries of ``counts`` in the stage's info.json.
COUNTS = ("clips", "ok", "warned", "left_out", "objects", "objects_warned", "objects_left_out")


@dataclass(frozen=True)
class MeasureRow:
    """One measure over the clips or meshes of a dataset."""

    words: str
    unit: str
    median: str
    worst: str
    worst_id: str  # the clip or object with the worst value
    warn: str  # limit of warnings, "" for none
    leave_out: str  # limit of exclusion, "" for none
    warned: int
    left_out: int


@dataclass(frozen=True)
class QualityFacts:
    """The results of quality control for one dataset."""

    summary: str
    clips: list[MeasureRow]
    meshes: list[MeasureRow]
    chart: Markup
    failed: list[tuple[str, str]]  # (clip, reason)
    warned: list[tuple[str, str]]  # (clip, reason)
    unsound: list[list[str]]  # object, verdict, reason
    notes: list[tuple[str, int]]  # (note, clips)
    unmeasured: list[tuple[str, str, int]]  # (measure, reason, clips)


def read_quality(folder: Path, dataset: str) -> QualityFacts | None:
    """The results in the stage's ``folder``; None if it has not run or there are no clips."""
    if not (folder / "clips.parquet").is_file():
        return None
    info = read_json(folder / "info.json", {"counts": dict.fromkeys(COUNTS, int)})
    clips, meshes = (read_table(folder / f"{name}.parquet") for name in ("clips", "meshes"))
    if not len(clips):
        return None
    limits, judged = read_limits(folder), clips[["clip_id", "verdict", "reasons"]].to_numpy().tolist()
    missing = {measure: int(np.isnan(_values(clips, measure)).sum()) for measure in CLIP_MEASURES}
    return QualityFacts(
        summary=_summary(info["counts"]),
        clips=[_row(clips, "clip_id", measure, limits[measure.name]) for measure in CLIP_MEASURES],
        meshes=[_row(meshes, "object", measure, limits[measure.name]) for measure in MESH_MEASURES],
        chart=Markup(measures_svg(clips, CLIP_MEASURES, limits, f"{dataset} quality")),
        failed=[(name, why) for name, verdict, why in judged if verdict == "left out"],
        warned=[(name, why) for name, verdict, why in judged if verdict == "warned"],
        unsound=[mesh for mesh in meshes[["object", "verdict", "reasons"]].to_numpy().tolist() if mesh[1] != "ok"],
        notes=sorted(Counter(note for note in clips["note"].tolist() if note).items()),
        unmeasured=[(measure.words, measure.unmeasured, count) for measure, count in missing.items() if count],
    )


def read_limits(folder: Path) -> dict[str, dict[str, float | None]]:
    """The limits ``warn`` and ``leave_out`` of every measure that the stage used. Raises BadInput."""
    limit = {"warn": NUMBER_OR_NONE, "leave_out": NUMBER_OR_NONE}
    names = [measure.name for measure in (*CLIP_MEASURES, *MESH_MEASURES)]
    info = read_json(folder / "info.json", {"thresholds": {"limits": dict.fromkeys(names, limit)}})
    return info["thresholds"]["limits"]


def measures_svg(
    table: pd.DataFrame, measures: Sequence[Measure], limits: Mapping[str, dict[str, float | None]], salt: str
) -> str:
    """A histogram over the clips with limits as lines, for every measure with a value."""
    sizes = {measure.name: np.abs(_values(table, measure)) for measure in measures}
    shown = [measure for measure in measures if np.isfinite(sizes[measure.name]).any()]
    rows = -(-len(shown) // COLUMNS)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
        for axes, measure in zip(grid, shown, strict=False):
            values = sizes[measure.name]
            _draw_measure(axes, measure, values[np.isfinite(values)], limits[measure.name])
        for axes in grid[len(shown) :]:
            axes.set_axis_off()

    return figure_svg((2.35 * COLUMNS, 1.55 * rows), salt, draw)


def _draw_measure(axes: Axes, measure: Measure, values: np.ndarray, limit: dict[str, float | None]) -> None:
    warn, leave_out = limit["warn"], limit["leave_out"]
    highest = max(float(values.max()), warn or 0.0) or 1.0
    right = highest if leave_out is None or leave_out > FARTHEST * highest else max(highest, leave_out)
    axes.hist(values, bins=np.linspace(0, right * 1.04, BINS + 1).tolist(), color=COLOURS[0])
    axes.set_xlim(0, right * 1.04)
    for limit_value, colour in ((warn, WARN_COLOUR), (leave_out, LEAVE_OUT_COLOUR)):
        if limit_value is not None and limit_value <= right:
            axes.axvline(limit_value, color=colour, linewidth=1.4)
    if leave_out is not None and leave_out > right:
        axes.set_xlim(0, right * 1.3)
        axes.annotate(f"{leave_out:g} →", (1, 0.86), xycoords="axes fraction", ha="right", color=LEAVE_OUT_COLOUR)
    name = measure.name.removesuffix("_m_s2").removesuffix("_m").removesuffix("_frames").replace("_", " ")
    axes.set_title(f"{name}, {measure.unit}" if measure.unit else name, loc="left", fontsize=8, color="#6a6f76")
    axes.tick_params(labelsize=7, length=2)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_locator(MaxNLocator(3, integer=True))


def _row(table: pd.DataFrame, key: str, measure: Measure, limit: dict[str, float | None]) -> MeasureRow:
    values = _values(table, measure)
    sizes = np.abs(values[np.isfinite(values)])
    warn, leave_out = limit["warn"], limit["leave_out"]
    left_out = int((sizes > leave_out).sum()) if leave_out is not None else 0
    above = int((sizes > warn).sum()) if warn is not None else 0
    return MeasureRow(
        words=measure.words,
        unit=measure.unit,
        median=_text(float(np.median(sizes))) if len(sizes) else "not measured",
        worst=_text(values[np.nanargmax(np.abs(values))]) if len(sizes) else "",
        # Equal values have no worst one.
        worst_id=str(table[key].tolist()[np.nanargmax(np.abs(values))]) if len(set(sizes)) > 1 else "",
        warn="" if warn is None else f"{warn:g}",
        leave_out="" if leave_out is None else f"{leave_out:g}",
        warned=max(above - left_out, 0),
        left_out=left_out,
    )


def _values(table: pd.DataFrame, measure: Measure) -> np.ndarray:
    """(row,) values of a measure; NaN if not measured."""
    return np.array(table[measure.name].tolist(), dtype=np.float64)


def _text(value: float) -> str:
    rounded = round(value, 4)
    return f"{rounded:g}" if rounded == round(rounded) else number(value)


def _summary(counts: Mapping[str, int]) -> str:
    return (
        f"Of {counts['clips']:,} clips {counts['ok']:,} pass, {counts['warned']:,} have warnings and "
        f"{counts['left_out']:,} are excluded from annotation, training and evaluation. Of {counts['objects']:,} "
        f"meshes {counts['objects_warned']:,} have warnings and {counts['objects_left_out']:,} are excluded with their "
        "clips."
    )
