"""Curves as inline SVG; equal numbers give equal markup."""

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

COLOURS = ("#3b6ea5", "#b5371f", "#5b8c5a", "#8a5a00", "#7a5195", "#6a6f76")
LOG_RATIO = 20.0
# Inches around and between the plots of a drawing.
LEFT, TOP = 0.55, 0.28
_RIGHT, _BOTTOM, _COLUMN_GAP, _ROW_GAP = 0.12, 0.42, 0.5, 0.42
_STYLE = {
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titley": 1.0,  # an automatic position takes an eighth of the time: it measures all labels
    "axes.edgecolor": "#b8b8b4",
    "axes.labelcolor": "#6a6f76",
    "xtick.color": "#6a6f76",
    "ytick.color": "#6a6f76",
}


class Curve(NamedTuple):
    """One line of a chart: x and y (point,)."""

    name: str
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class Panel:
    """One chart: curves over a shared x."""

    title: str
    curves: list[Curve]

    @property
    def is_logarithmic(self) -> bool:
        """Whether the axis is logarithmic: for positive values whose ratio exceeds 20."""
        values = np.concatenate([curve.y for curve in self.curves])
        return bool(values.min() > 0 and values.max() / values.min() > LOG_RATIO)


def panels_svg(panels: list[Panel], salt: str) -> str:
    """Charts next to each other as one ``<svg>``; ``salt`` makes the ids of several drawings on a page different."""

    def draw(figure: Figure) -> None:
        for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            for number, curve in enumerate(panel.curves):
                colour, width = COLOURS[number % len(COLOURS)], 1.7 if number == 0 else 1.0
                axes.plot(curve.x, curve.y, color=colour, linewidth=width, label=curve.name)
            if panel.is_logarithmic:
                axes.set_yscale("log")
            axes.set_xlabel("step")
            axes.set_title(panel.title, loc="left", fontsize=9, color="#6a6f76")
            axes.grid(axis="y", color="#ededea", linewidth=0.8)
            if len(panel.curves) > 1:
                axes.legend(frameon=False, fontsize=7.5)

    return figure_svg((2.9 * len(panels), 2.4), salt, draw)


def figure_svg(
    inches: tuple[float, float], salt: str, draw: Callable[[Figure], None], left: float = LEFT, top: float = TOP
) -> str:
    """Call ``draw`` on an empty Matplotlib canvas in the style of the pages and return one ``<svg>`` element.

    left, top: space in inches for the labels on these sides of the plots.
    """
    style: dict[Any, Any] = {**_STYLE, "svg.hashsalt": salt}
    with matplotlib.rc_context(style):
        figure = Figure(figsize=inches)
        FigureCanvasSVG(figure)
        draw(figure)
        _set_margins(figure, *inches, left, top)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    svg = re.sub(r"<metadata>.*?</metadata>", "", stream.getvalue(), flags=re.DOTALL)
    return re.sub(r' xmlns(:xlink)?="[^"]*"', "", svg[svg.index("<svg") :])


def _set_margins(figure: Figure, width: float, height: float, left: float, top: float) -> None:
    """Space for titles and tick labels in inches; a layout engine would draw everything twice."""
    grid = figure.axes[0].get_gridspec()
    assert grid is not None
    plot_width = (width - left - _RIGHT - _COLUMN_GAP * (grid.ncols - 1)) / grid.ncols
    plot_height = (height - top - _BOTTOM - _ROW_GAP * (grid.nrows - 1)) / grid.nrows
    figure.subplots_adjust(
        left=left / width,
        right=1 - _RIGHT / width,
        top=1 - top / height,
        bottom=_BOTTOM / height,
        wspace=_COLUMN_GAP / plot_width,
        hspace=_ROW_GAP / plot_height,
    )


def log_curves(path: str | Path) -> list[Curve]:
    """All loss columns of a training log over the step, without empty cells: validation is rarer."""
    table = pd.read_csv(path).apply(pd.to_numeric, errors="coerce").astype(np.float64)
    curves = []
    for name in table.filter(regex="loss|train|valid"):
        finite = np.isfinite(table[name])
        if "step" in table and finite.any():
            title = str(name).removeprefix("train_").replace("_", " ")
            curves.append(Curve(title, *(np.asarray(table.loc[finite, column]) for column in ("step", name))))
    return curves
