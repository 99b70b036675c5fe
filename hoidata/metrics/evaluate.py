"""Evaluation: compares a store of predicted clips with an annotated dataset by all metrics of the registry.

A predicted clip is named ``<reference id>~<k>`` with k = 0, 1, ..., or just ``<reference id>``. Motion k of every clip
belongs to repetition k of the experiment. A prediction is in the world frame of its reference. It has all frames of the
reference or a contiguous part, identified by ``source_frames``.

If ``meta/info.json`` has ``windows``, the references are windows of the clips (``hoidata.store.annotated``).

If it has ``"length": "own"``, the family chose the length of every motion of the store. Then nothing is
compared frame by frame, hands are measured where the prediction has them, and the length itself is measured.

Target contact maps may be stored next to the clips (``hoidata.metrics.target_contact``). Predictions that cannot be
compared are skipped, counted and listed with the reason.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress

from hoidata.actions.action import Actions, training_actions
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.contact.proximity import ProximityIndex
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.metrics.encoded import Encoder, stored_motion
from hoidata.metrics.feature_metrics import encoder_summary
from hoidata.metrics.intervals import bootstrap_interval, t_interval
from hoidata.metrics.pair import Motion, Pair, TrueContact, acting_sides
from hoidata.metrics.registry import METRICS, Metric, count_unmeasured, sum_and_count, summarise
from hoidata.metrics.target_contact import TargetDistances, read_target_contact, read_target_distances
from hoidata.metrics.unmeasured import CHOSEN_LENGTH, Values
from hoidata.objects.model import ObjectModel
from hoidata.physics.scene import TABLE_PERCENTILE, object_scene
from hoidata.settings import build_config
from hoidata.store.annotated import AnnotatedStore, WindowedStore, WindowProtocol, load_annotated
from hoidata.store.distances import DistanceEntries
from hoidata.store.store import Store, open_store
from hoidata.workers import map_in_workers

SAME_MESH_M = 1e-5  # above the float32 rounding of metres
DIGITS = 6
RECORDING = ["subject", "sequence", "object"]  # clips with equal values are parts of one recording of an object
WORKERS_PAY_FROM = 1000  # motions: starting a worker process takes as long as measuring 200


class SkippedPair(NamedTuple):
    """A prediction or reference that was not measured, with the reason."""

    clip_id: str
    reason: str


class Sample(NamedTuple):
    """The values of one measured motion."""

    number: int  # among the motions of the clip
    values: dict[str, Values]  # by metric


class ClipResult(NamedTuple):
    """The measured motions of one clip."""

    group: str  # the source sequence that the clip was cut from
    samples: list[Sample]
    skipped: list[SkippedPair]

    def of(self, metric: Metric, number: int | None = None) -> list[Values]:
        """The values of one metric per measured motion, or only of motion ``number``."""
        chosen = [sample.values for sample in self.samples if number is None or sample.number == number]
        return [values[metric.name] for values in chosen if metric.name in values]


def evaluate_store(
    predicted: str | Path,
    reference: str | Path,
    hands: HandPair | None = None,
    *,
    split: str = "test",
    metrics: tuple[Metric, ...] = METRICS,
    encoders: Sequence[Encoder] = (),
    jobs: int = 1,
    progress: bool = False,
) -> dict[str, Any]:
    """Evaluate the store ``predicted`` against the annotated dataset ``reference``.

    Args:
        reference: folder with clips, annotation, contact and splits (``load_annotated``).
        hands: the hand model of both, as in ``open_store``.
        split: the part of the chosen split whose clips are the references.
        encoders: their features are compared too.
        jobs: worker processes, used from ``WORKERS_PAY_FROM`` motions on; results do not depend on it.

    Returns:
        The content of a metrics file:

        - held_out_clips, motions: how many references and compared predictions
        - synthetic: whether a reference is generated
        - length: "given" or "own"
        - figures: the value of every metric that has one
        - intervals: 95 % intervals over repetitions and over clips (bootstrap of source sequences)
        - counts: the number of clips, motions and values of each metric
        - unmeasured: per metric, the number of compared clips without a value, by reason
        - actions: where the limits of verbs come from
        - left_out: clip id and reason of everything that could not be compared
        - with encoders also notes and evaluators (``encoder_summary``)

    Raises:
        BadInput: no clip of the two stores can be compared.
    """
    whole, store = load_annotated(reference, hands), open_store(predicted, hands)
    annotated = training = whole
    if protocol := store.info.get("windows"):
        windows = build_config(WindowProtocol, protocol, f"{predicted}/meta/info.json: windows")
        annotated, training = WindowedStore(whole, windows, split), WindowedStore(whole, windows, "train")
    clip_ids = annotated.ids(split)
    samples, skipped = match_predictions(store.ids, clip_ids)
    evaluator = _Evaluator(
        annotated=annotated,
        recordings=whole.store,
        store=store,
        metrics=metrics,
        samples=samples,
        target_contact=read_target_contact(predicted),
        target_distances=read_target_distances(predicted),
        actions=training_actions(training),
    )
    results = _measured(evaluator, clip_ids, jobs, progress)
    skipped += [item for clip_id in clip_ids for item in results[clip_id].skipped]
    measured = {clip_id: results[clip_id] for clip_id in clip_ids if results[clip_id].samples}
    if not measured:
        got = f"{len(store)} clips, none of which can be compared"
        reason = f"; {skipped[0].clip_id}: {skipped[0].reason}" if skipped else ""
        remedy = "name predictions after their reference and store them in its world frame with its frames"
        raise BadInput(predicted, f"clips named <id>~<k> after the {split} clips of {reference}", got + reason, remedy)
    summary = _summary(metrics, list(measured.values()))
    if encoders:
        skipped_ids = {item.clip_id for item in skipped}
        compared = {
            clip_id: [(number, sample) for number, sample in samples[clip_id] if sample not in skipped_ids]
            for clip_id in measured
        }
        of_features = encoder_summary(encoders, annotated, store, compared)
        summary = of_features | {name: summary[name] | of_features[name] for name in summary}
    return {
        "held_out_clips": len(clip_ids),
        "motions": sum(len(clip.samples) for clip in measured.values()),
        "synthetic": bool(annotated.store.sequences.loc[clip_ids, "synthetic"].any()),
        "length": "own" if evaluator.own_length else "given",
        **summary,
        "actions": evaluator.actions.facts,
        "left_out": [item._asdict() for item in skipped],
    }


def _measured(evaluator: "_Evaluator", clip_ids: Sequence[str], jobs: int, progress: bool) -> dict[str, ClipResult]:
    """The result of each reference clip by its id."""
    jobs = jobs if sum(map(len, evaluator.samples.values())) >= WORKERS_PAY_FROM else 1
    with Progress(console=Console(stderr=True), disable=not progress) as bar:
        results = map_in_workers(evaluator.measure, clip_ids, jobs)
        return dict(bar.track(results, len(clip_ids), description="evaluate"))


def _summary(metrics: Sequence[Metric], measured: list[ClipResult]) -> dict[str, dict[str, Any]]:
    """The entries figures, intervals, counts and unmeasured of a metrics file, each by metric."""
    summary: dict[str, dict[str, Any]] = {"figures": {}, "intervals": {}, "counts": {}, "unmeasured": {}}
    for metric in metrics:
        values = [clip.of(metric) for clip in measured]
        if reasons := count_unmeasured(metric, values):
            summary["unmeasured"][metric.name] = reasons
        result = summarise(metric, values)
        if result is not None:
            summary["figures"][metric.name] = round(result.value, DIGITS)
            summary["counts"][metric.name] = result.counts
            if intervals := intervals_of(metric, measured):
                summary["intervals"][metric.name] = intervals
    return summary


def intervals_of(metric: Metric, measured: list[ClipResult]) -> dict[str, list[float]]:
    """The 95 % intervals of a metric over ``repetitions`` and over ``clips``; an interval needs at least two.

    The best of all repetitions has no interval over repetitions.
    """
    numbers = sorted({sample.number for clip in measured for sample in clip.samples})
    numbers = [] if metric.reduction == "best of a clip's samples" else numbers
    repetitions = [summarise(metric, [clip.of(metric, number) for clip in measured]) for number in numbers]
    terms = [(sum_and_count(metric, clip.of(metric)), clip.group) for clip in measured]
    terms = [(term, group) for term, group in terms if term[1]]
    intervals = {
        "repetitions": t_interval([result.value for result in repetitions if result is not None]),
        "clips": bootstrap_interval([term for term, _ in terms], [group for _, group in terms], _ratio),
    }
    return {name: [round(end, DIGITS) for end in ends] for name, ends in intervals.items() if ends is not None}


def _ratio(terms: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(resample,) weighted sums over weighted counts, of terms (clip, 2) under weights (resample, clip)."""
    total, count = (weights @ terms).T
    return total / count


def match_predictions(
    predicted_ids: list[str], reference_ids: list[str]
) -> tuple[dict[str, list[tuple[int, str]]], list[SkippedPair]]:
    """Number and id of the predictions of each reference, in that order, and predictions without a reference."""
    references = set(reference_ids)
    samples: dict[str, list[tuple[int, str]]] = {}
    skipped: list[SkippedPair] = []
    for predicted_id in predicted_ids:
        base, _, number = predicted_id.rpartition("~")
        if predicted_id in references:
            samples.setdefault(predicted_id, []).append((0, predicted_id))
        elif base in references and number.isdecimal():
            samples.setdefault(base, []).append((int(number), predicted_id))
        else:
            skipped.append(SkippedPair(predicted_id, "no clip of this part of the split is its reference"))
    return {reference: sorted(numbered) for reference, numbered in samples.items()}, skipped


@dataclass(frozen=True)
class _Reference:
    """A clip of the annotated dataset, not yet cut to the frames of a prediction."""

    motion: Motion
    sides: tuple[Side, ...]
    entries: DistanceEntries
    index: ProximityIndex
    part: np.ndarray
    threshold_m: float
    table_m: float | None
    verb: str | None

    def cut(self, start: int, stop: int) -> tuple[Motion, TrueContact]:
        """The recorded motion and its contact from frame ``start`` to ``stop`` (exclusive)."""
        whole = self.motion
        joints: dict[Side, np.ndarray] = {side: whole.joints_m[side][start:stop] for side in SIDES}
        touched = np.zeros(self.index.count, dtype=bool)
        near, clip = self.entries.window(start, stop), whole.clip.take(slice(start, stop))
        measured = np.stack([clip.hands[side].valid & clip.recorded & (side in self.sides) for side in SIDES])
        touched[near.point[measured[near.side, near.frame]]] = True
        motion = Motion(clip, joints, whole.hands)
        return motion, TrueContact(self.index, self.part, touched, self.threshold_m)


@dataclass
class _Evaluator:
    """Measures all predictions of a reference clip."""

    annotated: AnnotatedStore
    recordings: Store  # its clips, whole also if windows are evaluated
    store: Store  # of the predictions
    metrics: tuple[Metric, ...]
    samples: dict[str, list[tuple[int, str]]]  # number and id of the predictions, by reference id
    target_contact: dict[str, np.ndarray]  # by predicted id
    target_distances: dict[str, TargetDistances]  # by predicted id
    actions: Actions
    indices: dict[str, ProximityIndex] = field(default_factory=dict)  # cache by object
    tables_m: dict[tuple[object, ...], float] = field(default_factory=dict)  # cache by recording and frame

    @property
    def own_length(self) -> bool:
        return self.store.info.get("length") == "own"

    def measure(self, clip_id: str) -> ClipResult:
        """The values of all predictions of one clip that can be compared, and the skipped ones."""
        group = str(self.annotated.store.sequences.at[clip_id, "sequence"])
        if clip_id not in self.samples:
            return ClipResult(group, [], [SkippedPair(clip_id, "no prediction of this clip")])
        reference = self._reference(clip_id)
        measured: list[Sample] = []
        skipped: list[SkippedPair] = []
        pairs: list[Pair] = []
        together = [metric for metric in self.metrics if metric.together]
        for number, sample in self.samples[clip_id]:
            pair = self._pair(reference, sample)
            if isinstance(pair, str):
                skipped.append(SkippedPair(sample, pair))
                continue
            metrics = [
                metric
                for metric in self.metrics
                if (metric.samples is None or len(measured) < metric.samples) and not metric.together
            ]
            values = {metric.name: _values(metric, pair) for metric in metrics}
            measured.append(Sample(number, values))
            pairs += [pair] if together else []  # pairs hold meshes: keep them only for metrics that need all samples
        for metric in together if pairs else ():
            measured[0].values[metric.name] = (
                CHOSEN_LENGTH if self.own_length else metric.measure(pairs, metric.frame_step)
            )
        return ClipResult(group, measured, skipped)

    def _pair(self, reference: _Reference, sample: str) -> Pair | str:
        """A prediction and its reference, or why they cannot be compared."""
        predicted = stored_motion(self.store, sample)
        target, distances = self.target_contact.get(sample), self.target_distances.get(sample)
        model = predicted.clip.object.model
        if not _is_same_mesh(model, reference.motion.clip.object.model):
            return f"its object {model.name!r} has another mesh, parts or hinge than the reference's"
        find_window = whole_window if self.own_length else window_of
        window = find_window(predicted.clip, reference.motion.clip, reference.sides)
        if isinstance(window, str):
            return window
        if target is not None and target.shape != reference.part.shape:
            return f"the target contact map has {len(target)} points, {len(reference.part)} expected"
        n_frames = predicted.clip.n_frames
        if distances is not None and len(distances.distance_m) != n_frames:
            return f"the target distance map has {len(distances.distance_m)} frames, not {n_frames}"
        motion, contact = reference.cut(*window)
        return Pair(
            predicted=predicted,
            reference=motion,
            sides=reference.sides,
            contact=contact,
            table_m=reference.table_m,
            aligned=not self.own_length,
            target_contact=target,
            verb=reference.verb,
            actions=self.actions,
            target_distances=distances,
        )

    def _reference(self, clip_id: str) -> _Reference:
        annotated, motion = self.annotated, stored_motion(self.annotated.store, clip_id)
        name = annotated.object_key(clip_id)
        points = annotated.points(name)
        if name not in self.indices:
            self.indices[name] = ProximityIndex(points)
        return _Reference(
            motion=motion,
            sides=acting_sides(annotated.hand_type(clip_id)),
            entries=annotated.distances(clip_id),
            index=self.indices[name],
            part=points.part,
            threshold_m=annotated.contact_threshold_m,
            table_m=self._table_m(motion.clip),
            verb=annotated.verb(clip_id),
        )

    def _table_m(self, clip: Clip) -> float | None:
        """Height of the table above the world's origin, from all clips of the recording; None without gravity.

        One clip is not enough: it may be cut from frames in which the object is held throughout.
        """
        if clip.gravity is None:
            return None
        key, world = self.annotated.store.sequences.loc[clip.clip_id, RECORDING], _world(clip)
        recording = *key, *world
        if recording not in self.tables_m:
            rows = self.recordings.sequences[RECORDING]
            clips = (self.recordings.clip(name, motion_only=True) for name in rows.index[(rows == key).all(axis=1)])
            lowest_m = [object_scene(other).lowest_m[other.recorded] for other in clips if _world(other) == world]
            self.tables_m[recording] = float(np.percentile(np.concatenate(lowest_m), TABLE_PERCENTILE))
        return self.tables_m[recording]


def _world(clip: Clip) -> tuple[bytes, bytes]:
    """The frame and gravity of a clip, to compare with those of another."""
    return clip.source_from_world.tobytes(), b"" if clip.gravity is None else clip.gravity.tobytes()


def _values(metric: Metric, pair: Pair) -> Values:
    return CHOSEN_LENGTH if metric.aligned and not pair.aligned else metric.measure(pair, metric.frame_step)


def whole_window(predicted: Clip, reference: Clip, sides: tuple[Side, ...]) -> tuple[int, int] | str:
    """All frames of the reference, for a prediction of estimated length; or why they cannot be compared."""
    absent = [side for side in sides if not predicted.hands[side].valid.any()]
    return f"the {absent[0]} hand acts and is never valid" if absent else (0, reference.n_frames)


def window_of(predicted: Clip, reference: Clip, sides: tuple[Side, ...]) -> tuple[int, int] | str:
    """The frames [start, stop) of the reference that a prediction covers; or why they cannot be compared."""
    start = 0
    if predicted.n_frames != reference.n_frames:
        start = _start_in(predicted.source_frames, reference.source_frames)
    if start < 0:
        expected = f"{reference.n_frames} expected, or source_frames that are a contiguous part of the reference's"
        return f"{predicted.n_frames} frames, {expected}"
    window = start, start + predicted.n_frames
    for side in sides:
        if (reference.hands[side].valid[slice(*window)] & ~predicted.hands[side].valid).any():
            return f"the {side} hand acts and is not valid in all frames in which the reference has it"
    return window


def _start_in(part: np.ndarray, whole: np.ndarray) -> int:
    """The index at which ``whole (m,)`` contains ``part (n,)`` contiguously; -1 if it does not.

    A part numbered from 0 on that a longer recording does not contain starts at 0.
    """
    for start in np.flatnonzero(whole == part[0]):
        if np.array_equal(whole[start : start + len(part)], part):
            return int(start)
    return 0 if len(part) < len(whole) and np.array_equal(part, np.arange(len(part))) else -1


def _is_same_mesh(one: ObjectModel, other: ObjectModel) -> bool:
    arrays, others = (
        (model.vertices_m, model.faces, model.part, *(model.hinge.arrays if model.hinge else ()))
        for model in (one, other)
    )
    return len(arrays) == len(others) and all(
        array.shape == like.shape and np.allclose(array, like, rtol=0, atol=SAME_MESH_M)
        for array, like in zip(arrays, others, strict=True)
    )
