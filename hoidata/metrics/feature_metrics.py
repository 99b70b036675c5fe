"""The registry of feature metrics, and their evaluation on a predicted store.

To add a metric: a function in ``feature_measures.py`` and an entry in ``FEATURE_METRICS``. Tables and README.md are
generated from it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hoidata.metrics.encoded import EncodedSet, Encoder, EncoderInput, encode_sets, recorded_motions, stored_motion
from hoidata.metrics.feature_measures import (
    FRECHET_RESAMPLES,
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
    frechet,
    frechet_train,
    kernel_distance,
    lower_bound,
    matching_distance,
    memorised,
    multimodality_by_label,
    multimodality_by_prompt,
    multimodality_released,
    paired,
    r_precision,
    r_precision_chance,
)
from hoidata.metrics.feature_sets import TOO_SMALL, Comparison, FeatureMetricResult, fid_frechet, kid
from hoidata.metrics.pair import acting_sides
from hoidata.metrics.paths import PathEncoder
from hoidata.metrics.registry import OWN, RankedMetric
from hoidata.metrics.unmeasured import Unmeasured
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.store import Store

DIGITS = 6


@dataclass(frozen=True, kw_only=True)
class FeatureMetric(RankedMetric):
    """A metric of the features of one encoder; ``measure`` maps a ``Comparison`` to one result."""

    encoder: str  # its name
    reduction: str  # how values become one result, in words
    note: str = ""  # a remark for readers of the value

    @property
    def topic(self) -> str:
        """The title of the table that has all metrics of the encoder."""
        return f"Features of the evaluator {self.encoder!r}"


def feature_results(
    predicted: EncodedSet, reference: EncodedSet, train: EncodedSet | None = None
) -> dict[str, FeatureMetricResult | Unmeasured]:
    """All metrics of the encoder that made the three sets, by name.

    Raises ValueError if the sets come from different encoders.
    """
    sets = [item for item in (predicted, reference, train) if item is not None]
    if len({(item.encoder, item.digest) for item in sets}) != 1:
        raise ValueError("features of different encoders are no distance apart")
    comparison = Comparison(predicted, reference, train)
    metrics = [metric for metric in FEATURE_METRICS if metric.encoder == predicted.encoder]
    return {metric.name: metric.measure(comparison) for metric in metrics}


def _for_encoders(
    name: str,
    measure: Measure,
    *,
    encoders: tuple[str, ...],
    title: str,
    floor_of: str = "",
    **fields: Any,
) -> Iterator[FeatureMetric]:
    """One metric per encoder, named ``<name>_<encoder>``; ``fields`` are those of ``FeatureMetric``."""
    for encoder in encoders:
        suffix = encoder.replace("-", "_")
        yield FeatureMetric(
            f"{name}_{suffix}",
            measure,
            title=f"{title}, {encoder}",
            encoder=encoder,
            floor_of=f"{floor_of}_{suffix}" if floor_of else "",
            **fields,
        )


BOTH, PAPER, PAIRS, PATHS = ("paper", "corrected"), ("paper",), ("text-motion",), ("path",)
MEAN, SETS = "mean over motions", "of all clips of a repetition, mean over repetitions"
IMOS = "IMoS (Ghosh et al. 2023), as released"
T2M = "T2M (Guo et al. 2022), Sec. 5"
ROWS_NEEDED = f"at least 4 clips per feature, else {TOO_SMALL!r}"
RESAMPLED = f"interval over clips: {FRECHET_RESAMPLES} resamples of one repetition, centred on the value"
DIVISIONS = f"mean of {HALVES} divisions"
WIDE, HARD = f"groups of {GROUP} distinct sentences", "sentences about the same object"
FEATURE_METRICS = (
    *_for_encoders(
        "accuracy_top1", accuracy(1), encoders=BOTH, title="top-1 accuracy", direction="higher", reduction=MEAN,
        source=IMOS,
    ),
    *_for_encoders(
        "accuracy_top3", accuracy(3), encoders=BOTH, title="top-3 accuracy", direction="higher", reduction=MEAN,
        source="Text2HOI (Cha et al. 2024), Sec. 4.3",
    ),
    *_for_encoders(
        "fid_paired", paired, encoders=BOTH, title="paired feature distance", direction="lower", reduction=MEAN,
        source=f"{IMOS}, called FID there", note="needs pairs; penalises diversity",
    ),
    *_for_encoders(
        "fid_frechet", frechet, encoders=BOTH, title="Frechet distance (FID)", direction="lower", reduction=SETS,
        source="Heusel et al. 2017", thresholds=ROWS_NEEDED, note=RESAMPLED,
    ),
    *_for_encoders(
        "fid_frechet_floor", lower_bound(fid_frechet), encoders=BOTH, direction="lower", reduction=DIVISIONS,
        title="Frechet distance between halves of the recorded clips", source=OWN, thresholds=ROWS_NEEDED,
        floor_of="fid_frechet",
    ),
    *_for_encoders(
        "fid_frechet_train", frechet_train, encoders=BOTH, title="Frechet distance from the training clips",
        direction="lower", reduction=SETS, source="Heusel et al. 2017", thresholds=ROWS_NEEDED, note=RESAMPLED,
    ),
    *_for_encoders(
        "kid", kernel_distance, encoders=BOTH, title="kernel distance (KID)", direction="lower", reduction=SETS,
        source="Binkowski et al. 2018, cubic kernel, unbiased",
    ),
    *_for_encoders(
        "kid_floor", lower_bound(kid), encoders=BOTH, title="kernel distance between halves of the recorded clips",
        direction="lower", reduction=DIVISIONS, source=OWN, floor_of="kid",
    ),
    *_for_encoders(
        "diversity", diversity, encoders=BOTH, title="diversity", direction="closer to recorded", reduction=SETS,
        source="all pairs of clips",
    ),
    *_for_encoders(
        "diversity_released", diversity_released, encoders=PAPER, title="diversity, as released",
        direction="closer to recorded", reduction=SETS, source=f"{IMOS}: {RELEASED_PAIRS} pairs with replacement",
    ),
    *_for_encoders(
        "multimodality_by_label", multimodality_by_label, encoders=BOTH, title="multimodality by label",
        direction="closer to recorded", reduction=SETS, source="all pairs within a true label",
        thresholds="labels of two clips or more",
    ),
    *_for_encoders(
        "multimodality_released", multimodality_released, encoders=PAPER, title="multimodality, as released",
        direction="higher", reduction=SETS, source=f"{IMOS}: {RELEASED_PAIRS_OF_LABEL} pairs per predicted label",
    ),
    *_for_encoders(
        "multimodality_by_prompt", multimodality_by_prompt, encoders=BOTH, title="multimodality by prompt",
        direction="higher", reduction="mean over clips", source=f"{T2M}: all pairs of motions for one prompt",
    ),
    *(
        metric for hard in (False, True) for k in (1, 2, 3) for metric in _for_encoders(
            f"r_precision_{'hard_' * hard}top{k}", r_precision(k, hard), encoders=PAIRS, direction="higher",
            title=f"R-precision top-{k}{', same object' * hard}", reduction=MEAN, source=T2M,
            thresholds=HARD if hard else WIDE,
        )
    ),
    *(
        metric for hard in (False, True) for k in (1, 2, 3) for metric in _for_encoders(
            f"r_precision_{'hard_' * hard}top{k}_floor", r_precision_chance(k, hard), encoders=PAIRS,
            title=f"R-precision top-{k}{', same object' * hard}, random guessing", direction="closer to recorded",
            reduction=MEAN, source=OWN, thresholds=HARD if hard else WIDE,
            floor_of=f"r_precision_{'hard_' * hard}top{k}",
        )
    ),
    *_for_encoders(
        "matching_distance", matching_distance, encoders=PAIRS, title="distance between motion and sentence",
        direction="lower", reduction=MEAN, source=T2M,
    ),
    *_for_encoders(
        "memorised_share", memorised, encoders=PATHS, title="fraction of motions close to a training clip",
        direction="lower", reduction=MEAN, source=f"{OWN}: root mean square over joints and object, 15 frames",
        thresholds=f"closer than {MEMORISED_BELOW:g} times the distance of the recorded clip",
    ),
)  # fmt: skip


# --- evaluation of a predicted store


def encoder_summary(
    encoders: Sequence[Encoder],
    annotated: AnnotatedStore,
    store: Store,
    samples: Mapping[str, Sequence[tuple[int, str]]],
) -> dict[str, Any]:
    """Feature metrics of the predictions of a store.

    Args:
        samples: by reference id, the number and id of each compared prediction.

    Returns:
        Entries of a metrics file: figures, intervals, counts, notes and unmeasured by metric; evaluators by encoder,
        with the digest of the weights and, for a classifier, labels and confusion matrix (label, predicted label).
    """
    summary: dict[str, Any] = {name: {} for name in _BY_METRIC} | {"evaluators": {}}
    clips, train = list(samples), annotated.ids("train")
    encoders = [*encoders, PathEncoder()]
    predicted = encode_sets(encoders, _predicted(annotated, store, samples), annotated, clips)
    reference = encode_sets(encoders, recorded_motions(annotated, clips), annotated, clips)
    training = encode_sets(encoders, recorded_motions(annotated, train), annotated, train) or [None] * len(encoders)
    for sets in zip(predicted, reference, training, strict=True):
        for name, result in feature_results(*sets).items():
            _add(summary, name, result, len(clips))
        encoded = sets[0]
        summary["evaluators"][encoded.encoder] = {"digest": encoded.digest}
        if encoded.labels:
            table = {"labels": list(encoded.labels), "confusion": confusion(encoded).tolist()}
            summary["evaluators"][encoded.encoder] |= table
    return summary


def _predicted(
    annotated: AnnotatedStore, store: Store, samples: Mapping[str, Sequence[tuple[int, str]]]
) -> Iterator[EncoderInput]:
    """Predicted motions, with the acting hands and the gravity direction of their references."""
    for number, (clip_id, predictions) in enumerate(samples.items()):
        sides, gravity = acting_sides(annotated.hand_type(clip_id)), annotated.store.clip(clip_id).gravity
        for sample, name in predictions:
            motion = stored_motion(store, name)
            yield EncoderInput(replace(motion, clip=replace(motion.clip, gravity=gravity)), sides, number, sample)


_BY_METRIC = ("figures", "intervals", "counts", "notes", "unmeasured")


def _add(summary: dict[str, Any], name: str, figure: FeatureMetricResult | Unmeasured, clips: int) -> None:
    """clips: how many are compared."""
    if isinstance(figure, Unmeasured):
        summary["unmeasured"][name] = {figure.reason: clips}
        return
    if figure.value is None:
        summary["unmeasured"][name] = {figure.note: clips}
    elif figure.without:
        summary["unmeasured"][name] = {figure.without: clips - figure.clips}
    if figure.value is not None:
        summary["figures"][name] = round(figure.value, DIGITS) + 0.0  # no minus zero
        summary["counts"][name] = figure.counts
    intervals = {"repetitions": figure.repetitions, "clips": figure.bootstrap}
    if rounded := {kind: [round(end, DIGITS) for end in ends] for kind, ends in intervals.items() if ends is not None}:
        summary["intervals"][name] = rounded
    if figure.note:
        summary["notes"][name] = figure.note
