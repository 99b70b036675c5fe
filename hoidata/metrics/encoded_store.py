"""What encoders say of a predicted store beside an annotated one, in the form ``evaluate_store`` gives."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hoidata.metrics.encoded import Asked, Encoder, encode_sets, recorded, stored_motion
from hoidata.metrics.feature_measures import confusion
from hoidata.metrics.feature_metrics import FeatureFigure, feature_findings
from hoidata.metrics.pair import acting_sides
from hoidata.metrics.paths import PathEncoder
from hoidata.metrics.unmeasured import Unmeasured
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.store import Store

DIGITS = 6


def encoder_summary(
    encoders: Sequence[Encoder],
    annotated: AnnotatedStore,
    store: Store,
    samples: Mapping[str, Sequence[tuple[int, str]]],
) -> dict[str, Any]:
    """Figures of features of the clips in ``samples``: reference id to number and id of each of its predictions.

    Gives figures, intervals, counts, notes and unmeasured (how many clips lack a value, by reason) by name of the
    figure, and evaluators: by name the digest of its weights
    ("path" learnt
    nothing) and, of a classifier, its labels with how many motions of each were taken for which.
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
