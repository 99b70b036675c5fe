"""A predicted store beside an annotated one: every metric of the registry over the clips of one part of the split.

A predicted clip is called ``<reference id>~<k>``, k = 0, 1, ... for several motions of one reference, or just by the
reference's id: motion k of every clip is repetition k of the experiment. It lies in the reference's world and has its
frames, or some of them in a row: those that its ``source_frames`` name. Where ``meta/info.json`` says ``"length":
"own"``, the family chose how long every motion is; then nothing is compared frame by frame, hands are looked at where
the prediction has them, and the length itself is measured. A store is all of one kind, so no row mixes the two. Beside
the clips may lie the contact maps that were asked for (``hoidata.metrics.asked``). Predictions that cannot be compared
are left out, counted and listed with the reason.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress

from hoidata.actions.action import Actions, training_actions, verb_of
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.contact.proximity import ProximityIndex
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.metrics.asked import AskedDistances, read_asked, read_asked_distances
from hoidata.metrics.encoded import Encoder, stored_motion
from hoidata.metrics.feature_metrics import encoder_summary
from hoidata.metrics.intervals import bootstrap_interval, t_interval
from hoidata.metrics.pair import Motion, Pair, TrueContact, acting_sides
from hoidata.metrics.registry import METRICS, Metric, reduced, sum_and_count, unmeasured
from hoidata.metrics.unmeasured import CHOSEN_LENGTH, Values
from hoidata.objects.model import ObjectModel
from hoidata.physics.scene import object_scene
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.distances import DistanceEntries
from hoidata.store.store import Store, open_store
from hoidata.workers import in_workers

SAME_MESH_M = 1e-5  # float32 of a metre, with room
DIGITS = 6
WORKERS_PAY_FROM = 1000  # motions: a worker takes longer to start than 200 of them take


class Unlike(NamedTuple):
    """A prediction or reference that was not measured, and why."""

    clip_id: str
    reason: str


class Sample(NamedTuple):
    """One motion that was measured: its number among those of the clip, and its values by metric."""

    number: int
    values: dict[str, Values]


class Measured(NamedTuple):
    """What was found of one clip. group: the source sequence it was cut from."""

    group: str
    samples: list[Sample]
    left_out: list[Unlike]

    def of(self, metric: Metric, number: int | None = None) -> list[Values]:
        """The values of one metric, or the reason for none, per motion it looked at, or those of one number."""
        chosen = [own.values for own in self.samples if number is None or own.number == number]
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
    """Figures of the store ``predicted`` against the annotated dataset ``reference``.

    reference: a folder with clips, annotation, contact and splits (``load_annotated``). hands: as in ``open_store``, of
    both. split: the part of the chosen split that is asked for. encoders: whose features are compared too. jobs: worker
    processes, used from ``WORKERS_PAY_FROM`` motions on; they change no figure. progress: a bar on stderr.
    Gives held_out_clips, motions, synthetic, length ("given" or "own"), figures (one number per metric that has any
    value), intervals (95 %, over repetitions and over clips drawn by source sequence, where there are two or more),
    counts (how many clips, motions and values went into each), unmeasured (of each metric without a value of some clip
    that could be compared, how many such clips there are by reason), actions (where the limits of verbs come from) and
    left_out (clip id and reason); with encoders also notes and evaluators (``encoder_summary``). Raises BadInput where
    no clip of the two stores can be compared.
    """
    annotated, store = load_annotated(reference, hands), open_store(predicted, hands)
    asked = annotated.ids(split)
    samples, left_out = matched(store.ids, asked)
    maps = read_asked(predicted), read_asked_distances(predicted)
    bench = _Bench(annotated, store, metrics, samples, *maps, training_actions(annotated))
    jobs = jobs if sum(map(len, samples.values())) >= WORKERS_PAY_FROM else 1
    found = dict[str, Measured]()
    with Progress(console=Console(stderr=True), disable=not progress) as bar:
        for clip_id, own in bar.track(in_workers(bench.measure, asked, jobs), len(asked), description="evaluate"):
            found[clip_id] = own
    clips = [found[clip_id] for clip_id in asked]
    left_out += [item for own in clips for item in own.left_out]
    measured = [own for own in clips if own.samples]
    if not measured:
        got = f"{len(store)} clips, none of which can be compared"
        why = f"; {left_out[0].clip_id}: {left_out[0].reason}" if left_out else ""
        remedy = "name them so, in the world and with the frames of their reference"
        raise BadInput(predicted, f"clips named <id>~<k> after the {split} clips of {reference}", got + why, remedy)
    summary = _summary(metrics, measured)
    if encoders:
        left = {item.clip_id for item in left_out}
        ids = ((clip_id, samples[clip_id]) for clip_id in asked if found[clip_id].samples)
        kept = {clip_id: [(_number(own, clip_id), own) for own in row if own not in left] for clip_id, row in ids}
        learnt = encoder_summary(encoders, annotated, store, kept)
        summary = learnt | {name: summary[name] | learnt[name] for name in summary}
    return {
        "held_out_clips": len(asked),
        "motions": sum(len(own.samples) for own in measured),
        "synthetic": bool(annotated.store.sequences.loc[asked, "synthetic"].any()),
        "length": "own" if bench.own_length else "given",
        **summary,
        "actions": bench.actions.facts,
        "left_out": [item._asdict() for item in left_out],
    }


def _summary(metrics: Sequence[Metric], measured: list[Measured]) -> dict[str, dict[str, Any]]:
    """figures, intervals and counts of the metrics that have any value; unmeasured: reasons of those that lack some."""
    figures, intervals, counts = dict[str, float](), dict[str, dict[str, list[float]]](), dict[str, dict[str, int]]()
    without = dict[str, dict[str, int]]()
    for metric in metrics:
        if reasons := unmeasured(metric, [own.of(metric) for own in measured]):
            without[metric.name] = reasons
        figure = reduced(metric, [own.of(metric) for own in measured])
        if figure is not None:
            figures[metric.name] = round(figure.value, DIGITS)
            counts[metric.name] = figure.counts
            if spread := intervals_of(metric, measured):
                intervals[metric.name] = spread
    return {"figures": figures, "intervals": intervals, "counts": counts, "unmeasured": without}


def intervals_of(metric: Metric, measured: list[Measured]) -> dict[str, list[float]]:
    """repetitions and clips: ends of the 95 % intervals of a figure; none where there are fewer than two to compare.

    The best of all repetitions has no spread over them.
    """
    numbers = sorted({own.number for clip in measured for own in clip.samples})
    numbers = [] if metric.reduction == "best of a clip's samples" else numbers
    repeated = [reduced(metric, [clip.of(metric, number) for clip in measured]) for number in numbers]
    parts = [(sum_and_count(metric, clip.of(metric)), clip.group) for clip in measured]
    known = [(part, group) for part, group in parts if part[1]]
    found = {
        "repetitions": t_interval([figure.value for figure in repeated if figure is not None]),
        "clips": bootstrap_interval([part for part, _ in known], [group for _, group in known], _ratio),
    }
    return {name: [round(end, DIGITS) for end in ends] for name, ends in found.items() if ends is not None}


def _ratio(parts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(draw,) figures: sums over counts, parts (clip, 2), under weights (draw, clip)."""
    total, count = (weights @ parts).T
    return total / count


def matched(predicted_ids: list[str], asked: list[str]) -> tuple[dict[str, list[str]], list[Unlike]]:
    """Predicted ids of each reference in the order of their numbers, and predictions without a reference."""
    known, samples, left_out = set(asked), dict[str, list[tuple[int, str]]](), list[Unlike]()
    for predicted_id in predicted_ids:
        base, _, number = predicted_id.rpartition("~")
        if predicted_id in known:
            samples.setdefault(predicted_id, []).append((0, predicted_id))
        elif base in known and number.isdecimal():
            samples.setdefault(base, []).append((int(number), predicted_id))
        else:
            left_out.append(Unlike(predicted_id, "no clip of this part of the split is its reference"))
    return {key: [own for _, own in sorted(rows)] for key, rows in samples.items()}, left_out


@dataclass(frozen=True)
class _Reference:
    """A clip of the annotated dataset, before it is cut to the frames of a prediction."""

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
        near = self.entries.window(start, stop)
        touched[near.point[np.isin(near.side, [SIDES.index(side) for side in self.sides])]] = True
        own = Motion(whole.clip.take(slice(start, stop)), joints, whole.hands)
        return own, TrueContact(self.index, self.part, touched, self.threshold_m)


@dataclass
class _Bench:
    """Both stores, and what is built once per object. samples: predicted ids by reference.

    asked, asked_distances: maps by motion id.
    """

    annotated: AnnotatedStore
    store: Store
    metrics: tuple[Metric, ...]
    samples: dict[str, list[str]]
    asked: dict[str, np.ndarray]
    asked_distances: dict[str, AskedDistances]
    actions: Actions
    indices: dict[str, ProximityIndex] = field(default_factory=dict)

    @property
    def own_length(self) -> bool:
        return self.store.info.get("length") == "own"

    def measure(self, clip_id: str) -> Measured:
        """The values of every sample that can be compared, of the metrics that look at it; and the others."""
        group = str(self.annotated.store.sequences.at[clip_id, "sequence"])
        if clip_id not in self.samples:
            return Measured(group, [], [Unlike(clip_id, "no prediction of this clip")])
        reference, found, left_out, pairs = self._reference(clip_id), list[Sample](), list[Unlike](), list[Pair]()
        together = [metric for metric in self.metrics if metric.together]
        for sample in self.samples[clip_id]:
            pair = self._pair(reference, sample)
            if isinstance(pair, str):
                left_out.append(Unlike(sample, pair))
                continue
            looking = [
                metric
                for metric in self.metrics
                if (metric.samples is None or len(found) < metric.samples) and not metric.together
            ]
            values = {metric.name: _values(metric, pair) for metric in looking}
            found.append(Sample(_number(sample, clip_id), values))
            pairs += [pair] if together else []  # a motion and its meshes are kept no longer than they are asked for
        for metric in together if pairs else ():
            every_motion = CHOSEN_LENGTH if self.own_length else metric.measure(pairs, metric.every)
            found[0].values[metric.name] = every_motion
        return Measured(group, found, left_out)

    def _pair(self, reference: _Reference, sample: str) -> Pair | str:
        """A prediction beside its reference, or why it cannot be compared."""
        predicted = stored_motion(self.store, sample)
        asked, distances = self.asked.get(sample), self.asked_distances.get(sample)
        check = own_window_of if self.own_length else window_of
        window = check(predicted.clip, reference.motion.clip, reference.sides)
        if isinstance(window, str):
            return window
        if asked is not None and asked.shape != reference.part.shape:
            return f"the contact map asked for has {len(asked)} points, {len(reference.part)} expected"
        if distances is not None and (why := _no_map_of(distances, predicted.clip)):
            return why
        own, contact = reference.cut(*window)
        aligned = not self.own_length
        given = aligned, asked, reference.verb, self.actions, distances
        return Pair(predicted, own, reference.sides, contact, reference.table_m, *given)

    def _reference(self, clip_id: str) -> _Reference:
        annotated, motion = self.annotated, stored_motion(self.annotated.store, clip_id)
        name = annotated.object_key(clip_id)
        points = annotated.points(name)
        if name not in self.indices:
            self.indices[name] = ProximityIndex(points)
        return _Reference(
            motion,
            acting_sides(annotated.hand_type(clip_id)),
            annotated.distances(clip_id),
            self.indices[name],
            points.part,
            annotated.contact_threshold_m,
            None if motion.clip.gravity is None else object_scene(motion.clip).table_height_m,
            verb_of(annotated, clip_id),
        )


def _values(metric: Metric, pair: Pair) -> Values:
    return CHOSEN_LENGTH if metric.aligned and not pair.aligned else metric.measure(pair, metric.every)


def _no_map_of(distances: AskedDistances, clip: Clip) -> str:
    """Why a map of distances is not one of this clip; nothing where it is."""
    count = len(distances.distance_m)
    return "" if count == clip.n_frames else f"the map of distances asked for has {count} frames, not {clip.n_frames}"


def _number(sample: str, clip_id: str) -> int:
    """Of a predicted clip: k of ``<reference id>~<k>``, 0 for the bare id."""
    return int(sample.removeprefix(clip_id).lstrip("~") or 0)


def own_window_of(predicted: Clip, reference: Clip, sides: tuple[Side, ...]) -> tuple[int, int] | str:
    """All frames of the reference, for a prediction of a length its family chose; or why it cannot be compared."""
    if why := _other_object(predicted, reference):
        return why
    absent = [side for side in sides if not predicted.hands[side].valid.any()]
    return f"the {absent[0]} hand acts and is never valid" if absent else (0, reference.n_frames)


def window_of(predicted: Clip, reference: Clip, sides: tuple[Side, ...]) -> tuple[int, int] | str:
    """First and one past the last frame of the reference that a prediction is of; or why it cannot be compared."""
    if why := _other_object(predicted, reference):
        return why
    start = 0
    if predicted.n_frames != reference.n_frames:
        start = _start_of(predicted.source_frames, reference.source_frames)
    if start < 0:
        expected = f"{reference.n_frames} expected, or source_frames that stand in a row in the reference's"
        return f"{predicted.n_frames} frames, {expected}"
    window = start, start + predicted.n_frames
    for side in sides:
        if (reference.hands[side].valid[slice(*window)] & ~predicted.hands[side].valid).any():
            return f"the {side} hand acts and is not valid in all frames in which the reference has it"
    return window


def _other_object(predicted: Clip, reference: Clip) -> str:
    name = predicted.object.model.name
    same = _is_same(predicted.object.model, reference.object.model)
    return "" if same else f"its object {name!r} has another mesh, parts or hinge than the reference's"


def _start_of(part: np.ndarray, whole: np.ndarray) -> int:
    """Where ``part (n,)`` stands in a row in ``whole (m,)``, 0 where it counts from 0 itself; -1 elsewhere."""
    if len(part) < len(whole) and np.array_equal(part, np.arange(len(part))) and part[-1] not in whole:
        return 0
    for start in np.flatnonzero(whole == part[0]):
        if np.array_equal(whole[start : start + len(part)], part):
            return int(start)
    return -1


def _is_same(one: ObjectModel, other: ObjectModel) -> bool:
    if one.faces.shape != other.faces.shape or one.vertices_m.shape != other.vertices_m.shape:
        return False
    if (one.hinge is None) != (other.hinge is None):
        return False
    if one.hinge is not None and other.hinge is not None:
        axis = np.abs(one.hinge.axis - other.hinge.axis).max()
        if max(axis, np.abs(one.hinge.origin_m - other.hinge.origin_m).max()) > SAME_MESH_M:
            return False
    same = np.array_equal(one.faces, other.faces) and np.array_equal(one.part, other.part)
    return same and float(np.abs(one.vertices_m - other.vertices_m).max()) <= SAME_MESH_M
