"""The list of metrics as README.md beside this file: ``python -m hoidata.metrics.describe > .../README.md``."""

from hoidata.metrics.asked_metrics import ASKED_LISTS
from hoidata.metrics.feature_metrics import FEATURE_METRICS, FeatureMetric
from hoidata.metrics.registry import METRICS, Metric

_HEAD = """# Metrics

Figures of predicted clips beside the clips they were made for. This file is generated from `registry.py` by
`python -m hoidata.metrics.describe`; a test keeps it equal. `hoidata evaluate STORE --reference DATASET` prints them
for any store of clips, whatever made it; ten lines that write one stand in docs/measure.md, and a test runs them.
`hoidata.metrics.evaluate.evaluate_store` gives the figures to code.

To add a metric: a function of (pair, every) that gives the values of one motion as an array, or `Unmeasured` with the
reason, and a row in `METRICS`.

- *nearer the truth*: the figure of the recorded clips themselves is best (family `ground-truth`), not more, not less.
- *mean over motions*: of each motion's mean; *mean over frames*: of all values of all motions; *best of a clip's
  samples*: of each motion's mean the best of a clip, then the mean over clips. A file says how many clips, motions and
  values went into each figure (`counts`).
- A clip without a value of a metric is not counted as 0. `unmeasured` gives, for each metric, the reasons (the object
  has no inside, gravity is not known, no such frame) and how many clips have each. A metric without a value in any clip
  has no figure, and tables and pages list it as not measured, with reasons and counts. Clips that could not be compared
  at all are in `left_out`.
- Acting hands and the frames they are seen in are those of the reference; other hands are not looked at.
- Two 95 % intervals stand beside a figure. `repetitions`: Student's, over repetitions of the experiment, of which the
  k-th is motion k of every clip; it says what another run of the sampler would give. `clips`: a bootstrap that draws
  clips again by source sequence, with all their motions; it says what other clips would give. Neither covers training.
- `asked.npz` beside the folder of clips holds the contact maps that were asked for (`asked.py`); without it there is no
  adherence. `hoidata/actions` lists the numbers of what an object does, and the limits of verbs (`actions.toml`).
- A store whose info says `"length": "own"` holds motions of lengths the family chose. Its hands are seen where it has
  them, and what is compared frame by frame has no figure. Rows of given and of own length are never one row.

"""
_COLUMNS = """\
| name | figure | unit | better | reduction | frames | every n-th | samples | frame by frame | thresholds | source |
|---|---|---|---|---|---|---|---|---|---|---|
"""
_ASKED = """
## Figures of the list `{}`

Computed where it is asked for: `evaluate: {metrics: [{}]}` in `params.yaml`, `hoidata evaluate ... --metrics {}`.

"""

_FEATURES = """
## Figures of features

What the networks of `models/evaluator` see; generated from `feature_metrics.py`. They are handed to `evaluate_store`
as `encoders`, trained on recorded clips of the training part alone, and every file of figures names the digest of
their weights: rows of different digests are not compared. *paper*: 42 joints, no object, as Text2HOI left it;
*corrected*: the object's motion and how near it is, not its shape; *text-motion*: sentences and motions in one space.
Every figure is that of one motion per clip, the mean over repetitions. Besides a Student interval over repetitions
there is one over clips: whole source sequences drawn again 2,000 times, the networks as they are.

| name | figure | better | reduction | thresholds | source | note |
|---|---|---|---|---|---|---|
"""


def readme() -> str:
    """The text of README.md."""
    asked = ((_ASKED.replace("{}", name) + _COLUMNS, map(_cells, rows)) for name, rows in ASKED_LISTS.items())
    tables = (_HEAD + _COLUMNS, map(_cells, METRICS)), *asked, (_FEATURES, map(_feature_cells, FEATURE_METRICS))
    return "".join(head + "".join(f"| {' | '.join(cells)} |\n" for cells in rows) for head, rows in tables)


def _cells(metric: Metric) -> tuple[str, ...]:
    return (
        f"`{metric.name}`",
        metric.title,
        metric.unit or "-",
        _direction(metric),
        metric.reduction,
        metric.frames,
        str(metric.every),
        "all" if metric.samples is None else f"first {metric.samples}",
        "yes" if metric.aligned else "-",
        metric.thresholds or "-",
        metric.source,
    )


def _feature_cells(metric: FeatureMetric) -> tuple[str, ...]:
    texts = (metric.reduction, metric.thresholds or "-", metric.source, metric.note or "-")
    return f"`{metric.name}`", metric.title, _direction(metric), *texts


def _direction(metric: Metric | FeatureMetric) -> str:
    return f"floor of `{metric.floor_of}`" if metric.floor_of else metric.direction


if __name__ == "__main__":
    print(readme(), end="")
