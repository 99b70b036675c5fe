"""The list of metrics as README.md beside this file: ``python -m hoidata.metrics.describe > .../README.md``."""

from hoidata.metrics.registry import METRICS, Metric

_HEAD = """# Metrics

Figures of predicted clips beside the clips they were made for. This file is generated from `registry.py` by
`python -m hoidata.metrics.describe`; a test keeps it equal. `hoidata evaluate STORE --reference DATASET` prints them
for any store of clips; `hoidata.metrics.evaluate.evaluate_store` gives them to code.

To add a metric: a function of (pair, every) that gives the values of one motion as an array, and a row in `METRICS`.

- *nearer the truth*: the figure of the recorded clips themselves is best (family `ground-truth`), not more, not less.
- *mean over motions*: of each motion's mean; *mean over frames*: of all values of all motions; *best of a clip's
  samples*: of each motion's mean the best of a clip, then the mean over clips. Motions without a value (an object
  without an inside, unknown gravity, nothing lifted) are left out; a file says how many clips, motions, values count.
- Acting hands and the frames they are seen in are those of the reference; other hands are not looked at.

| name | figure | unit | better | reduction | frames | every n-th | samples of a clip | thresholds | source |
|---|---|---|---|---|---|---|---|---|---|
"""


def readme() -> str:
    """The text of README.md."""
    return _HEAD + "".join(f"| {' | '.join(_cells(metric))} |\n" for metric in METRICS)


def _cells(metric: Metric) -> tuple[str, ...]:
    return (
        f"`{metric.name}`",
        metric.title,
        metric.unit or "-",
        f"floor of `{metric.floor_of}`" if metric.floor_of else metric.direction,
        metric.reduction,
        metric.frames,
        str(metric.every),
        "all" if metric.samples is None else f"first {metric.samples}",
        metric.thresholds or "-",
        metric.source,
    )


if __name__ == "__main__":
    print(readme(), end="")
