"""The one list of figures of features, as ``registry.METRICS`` is for geometry: tables and docs are made from it; and
what encoders say of a predicted store, in the form ``evaluate_store`` gives.

To add one: a function in ``feature_measures.py`` and a row in ``FEATURE_METRICS``.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hoidata.metrics.encoded import Asked, EncodedSet, Encoder, encode_sets, recorded, stored_motion
from hoidata.metrics.feature_measures import (
    FRECHET_DRAWS,
    GROUP,
    HALVES,
    MEMORISED_BELOW,
    RELEASED_PAIRS,
    RELEASED_PAIRS_OF_LABEL,
    Measure,
    accuracy,
    confusion,
    diversity,
    diversity_released,
    floor,
    frechet,
    frechet_train,
    kernel_distance,
    matching_distance,
    memorised,
    multimodality_by_label,
    multimodality_by_prompt,
    multimodality_released,
    paired,
    r_precision,
    r_precision_chance,
)
from hoidata.metrics.feature_sets import TOO_SMALL, Comparison, FeatureFigure, fid_frechet, kid
from hoidata.metrics.pair import acting_sides
from hoidata.metrics.paths import PathEncoder
from hoidata.metrics.registry import Direction
from hoidata.metrics.unmeasured import Unmeasured
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.store import Store

DIGITS = 6


@dataclass(frozen=True)
class FeatureMetric:
    """What one figure is; fields as in ``registry.Metric``. encoder: whose features it looks at.

    note: what a reader must know beside the figure.
    """

    name: str
    title: str
    unit: str
    direction: Direction
    encoder: str
    measure: Measure
    reduction: str
    source: str
    thresholds: str = ""
    floor_of: str = ""
    note: str = ""

    @property
    def topic(self) -> str:
        """What tables put together: the figures of one encoder."""
        return f"Features of the evaluator {self.encoder!r}"


def feature_findings(
    predicted: EncodedSet, reference: EncodedSet, train: EncodedSet | None = None
) -> dict[str, FeatureFigure | Unmeasured]:
    """Every figure of the encoder that made the three sets, by name; for one that could not be measured the reason.

    Raises ValueError where the sets come from different encoders.
    """
    sets = [item for item in (predicted, reference, train) if item is not None]
    if len({(item.encoder, item.digest) for item in sets}) != 1:
        raise ValueError("features of different encoders are no distance apart")
    comparison = Comparison(predicted, reference, train)
    own = [metric for metric in FEATURE_METRICS if metric.encoder == predicted.encoder]
    return {metric.name: metric.measure(comparison) for metric in own}


def _of_each(
    name: str, title: str, direction: Direction, measure: Measure, encoders: tuple[str, ...], *told: str, **more: str
) -> Iterator[FeatureMetric]:
    """A metric for each of some encoders. told: reduction, source and what follows; fields as in ``FeatureMetric``."""
    for encoder in encoders:
        suffix = encoder.replace("-", "_")
        own = FeatureMetric(f"{name}_{suffix}", f"{title}, {encoder}", "", direction, encoder, measure, *told, **more)
        yield replace(own, floor_of=f"{own.floor_of}_{suffix}" if own.floor_of else "")


BOTH, PAPER, PAIRS, PATHS = ("paper", "corrected"), ("paper",), ("text-motion",), ("path",)
MEAN, SETS = "mean over motions", "of all clips of a repetition, mean over repetitions"
IMOS = "IMoS (Ghosh et al. 2023), as released"
T2M = "T2M (Guo et al. 2022), Sec. 5"
ROWS_NEEDED = f"at least 4 clips per feature, else {TOO_SMALL!r}"
DRAWN = f"over clips: {FRECHET_DRAWS} draws of one repetition, their middle moved to the figure"
WIDE, HARD = f"groups of {GROUP} distinct sentences", "sentences about the same object"
FEATURE_METRICS = (
    *_of_each("accuracy_top1", "top-1 accuracy", "higher", accuracy(1), BOTH, MEAN, IMOS),
    *_of_each(
        "accuracy_top3", "top-3 accuracy", "higher", accuracy(3), BOTH, MEAN, "Text2HOI (Cha et al. 2024), Sec. 4.3"
    ),
    *_of_each(
        "fid_paired", "paired feature distance", "lower", paired, BOTH, MEAN, f"{IMOS}, called FID there",
        note="needs pairs; punishes diversity",
    ),
    *_of_each(
        "fid_frechet", "Frechet distance", "lower", frechet, BOTH, SETS, "Heusel et al. 2017", ROWS_NEEDED, note=DRAWN
    ),
    *_of_each(
        "fid_frechet_floor", "Frechet distance, half of the truth against half", "lower", floor(fid_frechet), BOTH,
        f"mean of {HALVES} divisions", "this project", ROWS_NEEDED, "fid_frechet",
    ),
    *_of_each(
        "fid_frechet_train", "Frechet distance from the training clips", "lower", frechet_train, BOTH, SETS,
        "Heusel et al. 2017", ROWS_NEEDED, note=DRAWN,
    ),
    *_of_each(
        "kid", "kernel distance", "lower", kernel_distance, BOTH, SETS,
        "Binkowski et al. 2018, cubic kernel, unbiased",
    ),
    *_of_each(
        "kid_floor", "kernel distance, half of the truth against half", "lower", floor(kid), BOTH,
        f"mean of {HALVES} divisions", "this project", "", "kid",
    ),
    *_of_each("diversity", "diversity", "nearer the truth", diversity, BOTH, SETS, "all pairs of clips"),
    *_of_each(
        "diversity_released", "diversity, as released", "nearer the truth", diversity_released, PAPER, SETS,
        f"{IMOS}: {RELEASED_PAIRS} pairs with replacement",
    ),
    *_of_each(
        "multimodality_by_label", "multimodality by label", "nearer the truth", multimodality_by_label, BOTH, SETS,
        "all pairs within a true label", "labels of two clips or more",
    ),
    *_of_each(
        "multimodality_released", "multimodality, as released", "higher", multimodality_released, PAPER, SETS,
        f"{IMOS}: {RELEASED_PAIRS_OF_LABEL} pairs per predicted label",
    ),
    *_of_each(
        "multimodality_by_prompt", "multimodality by prompt", "higher", multimodality_by_prompt, BOTH,
        "mean over clips", f"{T2M}: all pairs of the motions made for one prompt",
    ),
    *(
        metric for hard in (False, True) for k in (1, 2, 3) for metric in _of_each(
            f"r_precision_{'hard_' * hard}top{k}", f"R-precision top-{k}{', same object' * hard}", "higher",
            r_precision(k, hard), PAIRS, MEAN, T2M, HARD if hard else WIDE,
        )
    ),
    *(
        metric for hard in (False, True) for k in (1, 2, 3) for metric in _of_each(
            f"r_precision_{'hard_' * hard}top{k}_floor", f"R-precision top-{k}{', same object' * hard}, by guessing",
            "nearer the truth", r_precision_chance(k, hard), PAIRS, MEAN, "this project", HARD if hard else WIDE,
            f"r_precision_{'hard_' * hard}top{k}",
        )
    ),
    *_of_each("matching_distance", "distance from the own sentence", "lower", matching_distance, PAIRS, MEAN, T2M),
    *_of_each(
        "memorised_share", "share of motions near a training clip", "lower", memorised, PATHS, MEAN,
        "this project: root mean square over joints and object, 15 frames",
        f"nearer than {MEMORISED_BELOW:g} of what the recorded clip is from its own nearest",
    ),
)  # fmt: skip


# --- a predicted store beside an annotated one


def encoder_summary(
    encoders: Sequence[Encoder],
    annotated: AnnotatedStore,
    store: Store,
    samples: Mapping[str, Sequence[tuple[int, str]]],
) -> dict[str, Any]:
    """Figures of features of the clips in ``samples``: reference id to number and id of each of its predictions.

    Gives figures, intervals, counts, notes and unmeasured (how many clips lack a value, by reason) by name of the
    figure, and evaluators: by name the digest of its weights ("path" learnt nothing) and, of a classifier, its labels
    with how many motions of each were taken for which.
    """
    found: dict[str, Any] = {name: {} for name in _BY_FIGURE} | {"evaluators": {}}
    clips, train = list(samples), annotated.ids("train")
    encoders = [*encoders, PathEncoder()]
    predicted = encode_sets(encoders, _predicted(annotated, store, samples), annotated, clips)
    reference = encode_sets(encoders, recorded(annotated, clips), annotated, clips)
    learnt = encode_sets(encoders, recorded(annotated, train), annotated, train) or [None] * len(encoders)
    for sets in zip(predicted, reference, learnt, strict=True):
        for name, figure in feature_findings(*sets).items():
            _add(found, name, figure, len(clips))
        own = sets[0]
        found["evaluators"][own.encoder] = {"digest": own.digest}
        if own.labels:
            table = {"labels": list(own.labels), "confusion": confusion(own).tolist()}
            found["evaluators"][own.encoder] |= table
    return found


def _predicted(
    annotated: AnnotatedStore, store: Store, samples: Mapping[str, Sequence[tuple[int, str]]]
) -> Iterator[Asked]:
    """Predicted motions; which hands act and where down is are what the reference says."""
    for number, (clip_id, own) in enumerate(samples.items()):
        sides, gravity = acting_sides(annotated.hand_type(clip_id)), annotated.store.clip(clip_id).gravity
        for sample, name in own:
            motion = stored_motion(store, name)
            yield Asked(replace(motion, clip=replace(motion.clip, gravity=gravity)), sides, number, sample)


_BY_FIGURE = ("figures", "intervals", "counts", "notes", "unmeasured")


def _add(found: dict[str, Any], name: str, figure: FeatureFigure | Unmeasured, clips: int) -> None:
    """clips: how many are compared."""
    if isinstance(figure, Unmeasured):
        found["unmeasured"][name] = {figure.reason: clips}
        return
    if figure.value is None:
        found["unmeasured"][name] = {figure.note: clips}
    elif figure.without:
        found["unmeasured"][name] = {figure.without: clips - figure.clips}
    if figure.value is not None:
        found["figures"][name] = round(figure.value, DIGITS) + 0.0  # no minus zero
        found["counts"][name] = figure.counts
    intervals = {"repetitions": figure.repetitions, "clips": figure.bootstrap}
    if known := {kind: [round(end, DIGITS) for end in ends] for kind, ends in intervals.items() if ends is not None}:
        found["intervals"][name] = known
    if figure.note:
        found["notes"][name] = figure.note
