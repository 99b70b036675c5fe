"""Charts over the frames of one clip with a shared axis, and their positions for the cursor of the page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hoidata.clips.clip import Side
from hoidata.surface.contact import TOUCH_M
from pipelines.pages.clip_page_facts import ClipSeries
from pipelines.pages.curves import figure_svg

# Darker than the colours of the hands, because lines are thin. clip_page.js paints contact in these colours.
LEFT_COLOUR, RIGHT_COLOUR, BOTH_COLOUR, OBJECT_COLOUR = "#2f6fb0", "#c4571b", "#7b3f99", "#55595f"
SIDE_COLOURS = {"left": LEFT_COLOUR, "right": RIGHT_COLOUR}
LIMIT_COLOUR = "#8a8f96"
WIDTH_INCHES, ROW_INCHES, FOOT_INCHES = 11.2, 1.0, 0.35
FARTHEST_CM = 12.0


class Line(NamedTuple):
    """One line of a chart."""

    name: str
    colour: str
    values: np.ndarray  # (frame,), NaN if undefined


@dataclass(frozen=True)
class Chart:
    """Lines with the same unit."""

    title: str
    unit: str
    lines: list[Line]
    least: float  # smallest range of the axis, so that noise of a still object does not fill the chart
    limit: float | None = None  # value of a dashed line
    top: float | None = None  # end of the axis; larger values are cut off
    decimals: int = 1  # of the values under the cursor


class Timeline(NamedTuple):
    """The drawing of all charts."""

    svg: Markup
    left: float  # percent of the width at frame 0
    right: float  # percent of the width at the last frame
    charts: list[tuple[float, list[dict]]]  # (position in percent of the drawing's height, ``_readout`` of each line)


def clip_charts(series: ClipSeries, sides: Sequence[Side], point_count: int) -> list[Chart]:
    """The charts of a clip page for the hands ``sides``."""

    def lines(values: Mapping[Side, np.ndarray], factor: float = 1.0) -> list[Line]:
        return [Line(side, SIDE_COLOURS[side], factor * values[side]) for side in sides]

    touched = lines({side: series.touched[side].sum(axis=1) for side in sides})
    near = lines({side: np.where(np.isfinite(m), m, np.nan) for side, m in series.evidence.distance_m.items()}, 100)
    vertices = lines({side: series.surface[side].touched.sum(axis=1) for side in sides})
    title = f"hand vertices within {TOUCH_M * 1000:g} mm of the object's surface"
    limit_cm = series.evidence.threshold_m * 100
    charts = [
        Chart("touched sampled points", f"of {point_count:,}", touched, 10, decimals=0),
        Chart("distance of the closest joint to the object", "cm", near, 3, limit=limit_cm, top=FARTHEST_CM),
        Chart(title, "of 778", vertices, 10, decimals=0),
    ]
    if series.depth_m is not None:
        depths = lines(series.depth_m, 1000)
        charts.append(Chart("depth of the deepest hand vertex in the object", "mm", depths, 2))
    return [chart for chart in charts if chart.lines] + _object_charts(series)


def _object_charts(series: ClipSeries) -> list[Chart]:
    def line(values: np.ndarray) -> list[Line]:
        return [Line("object", OBJECT_COLOUR, values)]

    charts = [Chart("speed of the object", "cm/s", line(series.speed_m_s * 100), 5)]
    if series.lift_m is not None:
        charts.insert(0, Chart("height of the object above its first frame", "cm", line(series.lift_m * 100), 2))
    if series.hinge_rad is not None and series.is_prismatic:
        charts.append(Chart("slide", "cm", line(100.0 * series.hinge_rad), 1))
    elif series.hinge_rad is not None:
        charts.append(Chart("hinge angle", "degrees", line(np.degrees(1.0) * series.hinge_rad), 10))
    return charts


def draw_timeline(charts: Sequence[Chart], salt: str) -> Timeline:
    """All charts as one drawing; ``salt`` makes the SVG ids of several drawings different."""
    drawn: list[Axes] = []

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(charts), 1, squeeze=False, sharex=True)[:, 0]
        for axes, chart in zip(rows, charts, strict=True):
            _draw_chart(axes, chart)
        rows[-1].set_xlabel("frame, 30 per second")
        drawn.extend(rows)

    svg = figure_svg((WIDTH_INCHES, ROW_INCHES * len(charts) + FOOT_INCHES), salt, draw)
    boxes = [axes.get_position() for axes in drawn]
    readouts = [[_readout(line, chart.decimals) for line in chart.lines] for chart in charts]
    tops = [_percent(1 - box.y1) for box in boxes]
    return Timeline(Markup(svg), _percent(boxes[0].x0), _percent(boxes[0].x1), list(zip(tops, readouts, strict=True)))


def _draw_chart(axes: Axes, chart: Chart) -> None:
    frames = len(chart.lines[0].values)
    for line in chart.lines:
        axes.plot(np.arange(frames), line.values, color=line.colour, linewidth=1.4)
    lowest, highest = _range(chart)
    axes.set_ylim(lowest, highest)
    axes.set_xlim(0, max(frames - 1, 1))
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.grid(color="#ededea", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_title(f"{chart.title}, {chart.unit}", loc="left", fontsize=9, color="#6a6f76")
    if chart.limit:
        axes.axhline(chart.limit, color=LIMIT_COLOUR, linewidth=1.0, linestyle=(0, (4, 3)))


def _range(chart: Chart) -> tuple[float, float]:
    """The axis range: from the lowest value or 0 to the largest value, with the limit visible, up to ``top``."""
    values = np.concatenate([line.values for line in chart.lines])
    values = values[np.isfinite(values)]
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    high = max(high, (chart.limit or 0.0) * 1.5)
    high = min(high, chart.top) if chart.top is not None else high
    high = max(high, low + chart.least)
    margin = 0.06 * (high - low)
    return low - (margin if low < 0 else margin / 3), high + margin


def _readout(line: Line, decimals: int) -> dict:
    """Name, colour and rounded values of a line, as a JSON object."""
    rounded = [round(float(value), decimals) if np.isfinite(value) else None for value in line.values]
    return {"name": line.name, "colour": line.colour, "values": rounded, "decimals": decimals}


def _percent(fraction: float) -> float:
    return round(float(fraction) * 100, 3)
