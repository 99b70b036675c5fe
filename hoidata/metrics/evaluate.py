"""A predicted store beside an annotated one: every metric of the registry over the clips of one part of the split.

A predicted clip is called ``<reference id>~<k>``, k = 0, 1, ... for several motions of one reference, or just by the
reference's id. It lies in the reference's world and has its frames, or some of them in a row: those that its
``source_frames`` name. Predictions that cannot be compared are left out, counted and listed with the reason.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress

from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.contact.proximity import ProximityIndex
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.metrics.pair import Motion, Pair, TrueContact, acting_sides
from hoidata.metrics.registry import METRICS, Metric, reduced
from hoidata.objects.model import ObjectModel
from hoidata.physics.scene import clip_scene
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.distances import DistanceEntries
from hoidata.store.store import Store, open_store

SAME_MESH_M = 1e-5  # float32 of a metre, with room
DIGITS = 6
Values = dict[str, np.ndarray]


class Unlike(NamedTuple):
    """A prediction or reference that was not measured, and why."""

    clip_id: str
    reason: str


def evaluate_store(
    predicted: str | Path,
    reference: str | Path,
    hands: HandPair | None = None,
    *,
    split: str = "test",
    metrics: tuple[Metric, ...] = METRICS,
    progress: bool = False,
) -> dict[str, Any]:
    """Figures of the store ``predicted`` against the annotated dataset ``reference``.

    reference: a folder with clips, annotation, contact and splits (``load_annotated``). hands: as in ``open_store``, of
    both. split: the part of the chosen split that is asked for. progress: a bar on stderr.
    Gives held_out_clips, motions, synthetic, figures (one number per metric that has any value), counts (how many
    clips, motions and values went into each) and left_out (clip id and reason).
    Raises BadInput where no clip of the two stores can be compared.
    """
    annotated, store = load_annotated(reference, hands), open_store(predicted, hands)
    asked = annotated.ids(split)
    samples, left_out = matched(store.ids, asked)
    bench, measured = _Bench(annotated, store, metrics), list[list[Values]]()
    with Progress(console=Console(stderr=True), disable=not progress) as bar:
        for clip_id in bar.track(asked, description="evaluate"):
            found, others = bench.measure(clip_id, samples.get(clip_id, []))
            left_out += others
            measured += [found] if found else []
    if not measured:
        got = f"{len(store)} clips, none of which can be compared"
        why = f"; {left_out[0].clip_id}: {left_out[0].reason}" if left_out else ""
        remedy = "name them so, in the world and with the frames of their reference"
        raise BadInput(predicted, f"clips named <id>~<k> after the {split} clips of {reference}", got + why, remedy)
    figures = {item.name: reduced(item, [_of(item, found) for found in measured]) for item in metrics}
    known = {name: figure for name, figure in figures.items() if figure is not None}
    rows = annotated.store.sequences.loc[asked, "synthetic"]
    return {
        "held_out_clips": len(asked),
        "motions": sum(map(len, measured)),
        "synthetic": bool(rows.any()),
        "figures": {name: round(figure.value, DIGITS) for name, figure in known.items()},
        "counts": {name: figure.counts for name, figure in known.items()},
        "left_out": [item._asdict() for item in left_out],
    }


def _of(metric: Metric, found: list[Values]) -> list[np.ndarray]:
    """The values of one metric, one array per motion it looked at."""
    return [values[metric.name] for values in found if metric.name in values]


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
    threshold_m: float
    table_m: float | None

    def beside(self, predicted: Motion, start: int, stop: int) -> Pair:
        """The pair over the frames ``start`` to ``stop`` (exclusive) of the reference."""
        whole = self.motion
        joints: dict[Side, np.ndarray] = {side: whole.joints_m[side][start:stop] for side in SIDES}
        touched = np.zeros(self.index.count, dtype=bool)
        near = self.entries.window(start, stop)
        touched[near.point[np.isin(near.side, [SIDES.index(side) for side in self.sides])]] = True
        contact = TrueContact(self.index, touched, self.threshold_m)
        own = Motion(whole.clip.take(slice(start, stop)), joints, whole.hands)
        return Pair(predicted, own, self.sides, contact, self.table_m)


class _Bench:
    """Both stores, and what is built once per object."""

    def __init__(self, annotated: AnnotatedStore, store: Store, metrics: tuple[Metric, ...]) -> None:
        self.annotated, self.store, self.metrics = annotated, store, metrics
        self.indices: dict[str, ProximityIndex] = {}

    def measure(self, clip_id: str, samples: list[str]) -> tuple[list[Values], list[Unlike]]:
        """Of every sample that can be compared the values of the metrics that look at it; and the others."""
        if not samples:
            return [], [Unlike(clip_id, "no prediction of this clip")]
        reference, found, left_out = self._reference(clip_id), list[Values](), list[Unlike]()
        for sample in samples:
            predicted = _motion(self.store, sample)
            window = window_of(predicted.clip, reference.motion.clip, reference.sides)
            if isinstance(window, str):
                left_out.append(Unlike(sample, window))
                continue
            pair, number = reference.beside(predicted, *window), len(found)
            looking = [metric for metric in self.metrics if metric.samples is None or number < metric.samples]
            found.append({metric.name: metric.measure(pair, metric.every) for metric in looking})
        return found, left_out

    def _reference(self, clip_id: str) -> _Reference:
        annotated, motion = self.annotated, _motion(self.annotated.store, clip_id)
        name = annotated.object_key(clip_id)
        if name not in self.indices:
            self.indices[name] = ProximityIndex(annotated.points(name))
        return _Reference(
            motion,
            acting_sides(annotated.hand_type(clip_id)),
            annotated.distances(clip_id),
            self.indices[name],
            float(annotated.contact_info["threshold_m"]),
            None if motion.clip.gravity is None else clip_scene(motion.clip, motion.hands).table_height_m,
        )


def _motion(store: Store, clip_id: str) -> Motion:
    joints: dict[Side, np.ndarray] = {side: store.joints(clip_id, side) for side in SIDES}
    return Motion(store.clip(clip_id, motion_only=True), joints, store.hand_pair())


def window_of(predicted: Clip, reference: Clip, sides: tuple[Side, ...]) -> tuple[int, int] | str:
    """First and one past the last frame of the reference that a prediction is of; or why it cannot be compared."""
    if not _is_same(predicted.object.model, reference.object.model):
        return f"its object {predicted.object.model.name!r} has another mesh, parts or hinge than the reference's"
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
