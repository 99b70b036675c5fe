"""Generates README.md of this folder: ``python -m hoidata.metrics.describe > hoidata/metrics/README.md``."""

from hoidata.metrics.feature_metrics import FEATURE_METRICS, FeatureMetric
from hoidata.metrics.optional_metrics import OPTIONAL_LISTS
from hoidata.metrics.registry import LIFTED, METRICS, Metric

_HEAD = """# Metrics

`hoidata evaluate --store STORE --reference DATASET` compares the clips of any store with recorded clips;
`hoidata.metrics.evaluate.evaluate_store` does it in Python ([example](../../docs/measure.md)). `python -m
hoidata.metrics.describe` generates this page from `registry.py` and `feature_metrics.py`.

To add a metric: a function of (pair, frame_step) that returns the values of one motion as an array, or `Unmeasured`
with the reason, and an entry in `METRICS`. The entry is the only place that names its direction, unit and title.

- *closer to recorded*: the value of the recorded clips (family `ground-truth`) is best.
- *floor of*: a lower bound of another metric. It is not ranked.
- *Hand frames*: frames in which the recorded clip has an active hand. *Lifted frames*: frames in which the object is
  more than 15 mm above the table, the 3rd percentile of its lowest vertex in all clips of the recording. Interpolated
  frames are never used.
- Values are means over motions unless the definition says otherwise. *Best sample*: the best motion of each clip.
  `counts` gives the number of clips, motions and values.
- A clip without a value is not counted as 0. `unmeasured` gives the reasons and the number of clips for each metric;
  tables and pages list a metric without any value as not measured.
- Two 95 % intervals. `repetitions`: Student's t over repetitions of sampling. `clips`: bootstrap over source
  sequences. Neither covers training.
- `asked.npz` next to the clips has the target contact maps. Without it adherence is not measured.
- A store with `"length": "own"` has motions of estimated length. Metrics that compare frame by frame are not measured
  for it.

"""
_COLUMNS = "| name | unit | better | definition | source |\n|---|---|---|---|---|\n"
_ON_REQUEST = """
## On request: `{}`

`evaluate: {metrics: [{}]}` in `params.yaml`, or `hoidata evaluate ... --metrics {}`.

"""
_FEATURES = """
## Features

The networks of `models/evaluator` provide features. They are trained on recorded training clips only. A metrics
file names the digest of their weights, and tables refuse to mix two. *paper*: 42 joints without object, as in
Text2HOI. *corrected*: object motion and distances, without shape. *text-motion*: sentences and motions in one
space.

"""
_SHORTER = {
    "frames in which the reference has the acting hand": "hand frames",
    LIFTED: "lifted frames",
    "distance and points of the contact stage (its info.json)": "threshold of the contact stage",
    "in the true clip": "in the recorded clip",
    "of all clips of a repetition, mean over repetitions": "over all clips",
    "BimArt (Zhang et al. 2025), this project: corrected": "BimArt, corrected",
    "BimArt (Zhang et al. 2025)": "BimArt",
    "ManipNet (Zhang et al. 2021)": "ManipNet",
    "this project: ": "",
    "this project": "hoidata",
}


def readme() -> str:
    """The text of README.md."""
    optional = (
        (_ON_REQUEST.replace("{}", name) + _COLUMNS, map(_cells, metrics)) for name, metrics in OPTIONAL_LISTS.items()
    )
    tables = (_HEAD + _COLUMNS, map(_cells, METRICS)), *optional, (_FEATURES + _COLUMNS, _feature_rows())
    return "".join(head + "".join(f"| {' | '.join(cells)} |\n" for cells in rows) for head, rows in tables)


def _cells(metric: Metric) -> tuple[str, ...]:
    reduction = {"mean over motions": "", "best of a clip's samples": "best sample"}.get(
        metric.reduction, metric.reduction
    )
    step = f"every {metric.frame_step}rd frame" if metric.frame_step > 1 else ""
    samples = f"first {metric.samples} sample(s)" if metric.samples else ""
    frames = "" if metric.frames == "all" else metric.frames
    parts = (metric.title, frames, metric.thresholds, reduction, step, samples)
    return f"`{metric.name}`", metric.unit, _direction(metric), _joined(parts), _shorter(metric.source)


def _feature_rows() -> list[tuple[str, ...]]:
    """One table row per feature metric; metrics that differ only in the encoder share a row."""
    rows: dict[str, tuple[str, ...]] = {}
    names = {metric.name for metric in FEATURE_METRICS}
    for metric in FEATURE_METRICS:
        paper = metric.name.replace("_corrected", "_paper")
        if metric.name != paper and paper in names:
            continue
        both = metric.name == paper and metric.name.replace("_paper", "_corrected") in names
        cells = _feature_cells(metric)
        rows[metric.name] = tuple(cell.replace("_paper", "_paper\\|corrected") for cell in cells) if both else cells
    return list(rows.values())


def _feature_cells(metric: FeatureMetric) -> tuple[str, ...]:
    reduction = "" if metric.reduction == "mean over motions" else metric.reduction
    definition = _joined((metric.title.removesuffix(", paper"), metric.thresholds, reduction, metric.note))
    return f"`{metric.name}`", metric.unit, _direction(metric), definition, _shorter(metric.source)


def _joined(parts: tuple[str, ...]) -> str:
    return _shorter("; ".join(filter(None, parts)))


def _shorter(text: str) -> str:
    for long, short in _SHORTER.items():
        text = text.replace(long, short)
    return text


def _direction(metric: Metric | FeatureMetric) -> str:
    return f"floor of `{metric.floor_of}`" if metric.floor_of else metric.direction


if __name__ == "__main__":
    print(readme(), end="")
