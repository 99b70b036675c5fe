"""Evaluation figures as tables: one per model, every figure beside its baselines."""

from dataclasses import dataclass

LABELS = {
    "f1": "F1 of the contact map",
    "threshold": "threshold, chosen on validation",
    "mae_frames": "mean absolute error of the length, frames",
    "joint_error_mm": "mean joint error, mm",
    "best_of_8_mm": "mean joint error of the best of 8 samples, mm",
    "penetration_mm": "penetration, mm",
    "clips": "held-out clips",
}


@dataclass(frozen=True)
class Table:
    """columns: names; rows: cells as text, the first one the row's name."""

    title: str
    columns: list[str]
    rows: list[list[str]]


def metrics_tables(values: dict) -> list[Table]:
    """One table per model of a metrics file; nested figures become rows named by their path."""
    return [_model_table(model, figures) for model, figures in values.items() if isinstance(figures, dict)]


def _model_table(model: str, figures: dict) -> Table:
    compared = {name: row for name, row in figures.items() if isinstance(row, dict) and _is_flat(row)}
    columns = list(dict.fromkeys(key for row in compared.values() for key in row))
    rows = [[label(name), *(number(row.get(key)) for key in columns)] for name, row in compared.items()]
    for name, value in figures.items():
        if name not in compared and not isinstance(value, dict):
            rows.append([label(name), number(value), *[""] * (len(columns) - 1)])
    return Table(model, ["", *([label(key) for key in columns] or ["value"])], rows)


def label(name: str) -> str:
    """The words for a figure's key."""
    return LABELS.get(name, name.replace("_", " "))


def number(value: object) -> str:
    """A figure as text: whole numbers as they are, others with three significant digits or more."""
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if isinstance(value, int) or float(value).is_integer():
        return f"{int(value):,}"
    return f"{value:.1f}" if abs(value) >= 100 else f"{value:.3g}"


def _is_flat(row: dict) -> bool:
    return not any(isinstance(value, dict | list) for value in row.values())
