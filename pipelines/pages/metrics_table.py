"""Evaluation figures as tables: every figure beside its baselines, and which of the two is better."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Comparison:
    """How one figure of a metrics file is shown: its key, its words, and the keys and words of what it is held against.

    required: the baselines the figure has to beat, by ``margin`` (added) and ``factor`` (multiplied).
    """

    key: str
    words: str
    baselines: tuple[tuple[str, str], ...]
    required: tuple[str, ...]
    higher_is_better: bool = False
    margin: float = 0.0
    factor: float = 1.0

    def is_met(self, figures: dict) -> bool | None:
        """Whether the figure beats its baselines as required; None where one of them is missing."""
        if not {self.key, *self.required} <= figures.keys():
            return None
        value = figures[self.key]
        bounds = [figures[key] * self.factor + self.margin for key in self.required]
        return all(value >= bound if self.higher_is_better else value <= bound for bound in bounds)


COMPARISONS = {
    "contact": (
        Comparison(
            "f1",
            "F1 of the contact map",
            (
                ("f1_mean_map", "mean map of the training clips"),
                ("f1_mean_map_of_same_object", "mean map of the same object"),
            ),
            ("f1_mean_map",),
            higher_is_better=True,
            margin=0.05,
        ),
    ),
    "length": (
        Comparison(
            "mae_frames",
            "error of the length, frames",
            (("mae_mean_length_frames", "mean length"),),
            ("mae_mean_length_frames",),
            factor=0.85,
        ),
    ),
    "diffusion": (
        Comparison(
            "joint_error_mm",
            "joint error of the best sample, mm",
            (
                ("joint_error_mean_pose_mm", "mean pose"),
                ("joint_error_mean_motion_mm", "mean motion"),
                ("joint_error_shuffled_prompt_mm", "another clip's prompt"),
            ),
            ("joint_error_mean_pose_mm", "joint_error_shuffled_prompt_mm"),
        ),
    ),
    "refiner": (
        Comparison(
            "penetration_after_mm",
            "penetration, mm",
            (("penetration_before_mm", "before refinement"),),
            ("penetration_before_mm",),
        ),
        Comparison(
            "contact_distance_after_mm",
            "distance of contact joints, mm",
            (("contact_distance_before_mm", "before refinement"),),
            ("contact_distance_before_mm",),
        ),
    ),
}


@dataclass(frozen=True)
class Row:
    """One figure. verdict: "good", "bad" or "" (nothing to beat)."""

    name: str
    value: str
    baselines: list[tuple[str, str]]
    verdict: str


@dataclass(frozen=True)
class Table:
    """Figures of one model. notes: what else the metrics file says, as "name value"; empty: why there is no figure."""

    model: str
    rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    empty: str = ""


def metrics_tables(values: dict) -> list[Table]:
    """One table per model of a metrics file; figures without a known comparison become notes, nothing is dropped."""
    known = [name for name in COMPARISONS if name in values]
    others = [name for name, figures in values.items() if name not in known and isinstance(figures, dict)]
    return [_table(model, values[model]) for model in (*known, *others)]


def _table(model: str, figures: dict) -> Table:
    if "empty" in figures:
        return Table(model, empty=str(figures["empty"]))
    shown: set[str] = set()
    rows: list[Row] = []
    for comparison in COMPARISONS.get(model, ()):
        if comparison.key not in figures:
            continue
        found = [(words, number(figures[key])) for key, words in comparison.baselines if key in figures]
        shown |= {comparison.key, *(key for key, _ in comparison.baselines)}
        verdict = {True: "good", False: "bad", None: ""}[comparison.is_met(figures)]
        rows.append(Row(comparison.words, number(figures[comparison.key]), found, verdict))
    rest = {key: value for key, value in _flat(figures).items() if key not in shown}
    return Table(model, rows, [f"{key.replace('_', ' ')} {number(value)}" for key, value in rest.items()])


def number(value: object) -> str:
    """A figure as text: whole numbers as they are, others with three significant digits or more."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "" if value is None else str(value)
    if isinstance(value, int):
        return f"{int(value):,}"
    return f"{value:,.1f}" if abs(value) >= 100 else f"{value:#.3g}"


def _flat(figures: dict, before: str = "") -> dict[str, object]:
    flat: dict[str, object] = {}
    for key, value in figures.items():
        flat |= _flat(value, f"{before}{key} ") if isinstance(value, dict) else {f"{before}{key}": value}
    return flat
