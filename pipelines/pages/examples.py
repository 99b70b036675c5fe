"""Examples on the report: held-out clips and the motions that families generated for them."""

from pathlib import Path

import numpy as np

from hoidata.clips.clip import Clip
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import HandPair, track_joints
from hoidata.objects.sampling import SampledPoints
from hoidata.store.annotated import SUBSETS, AnnotatedStore
from hoidata.store.store import open_store
from pipelines.pages.surface import ContactPaint


def shown_subset(annotated: AnnotatedStore) -> str:
    """The subset of the examples: test, else validation, else train; "" without clips."""
    return next((subset for subset in reversed(SUBSETS) if annotated.ids(subset)), "")


def shown_ids(annotated: AnnotatedStore, count: int, samples: Path | None = None) -> list[str]:
    """Up to ``count`` clips of ``shown_subset``, one per object first.

    samples: a family's folder; if it has motions, only clips with a motion are shown (``sample.clips`` may skip some).
    """
    subset = shown_subset(annotated)
    ids = annotated.ids(subset) if subset else []
    if samples is not None and (samples / "clips" / "meta" / "info.json").is_file():
        sampled = {name.rpartition("~")[0] for name in open_store(samples / "clips").ids}
        ids = [clip_id for clip_id in ids if clip_id in sampled] or ids
    first_of_object = list({annotated.object_key(clip_id): clip_id for clip_id in reversed(ids)}.values())[::-1]
    rest = [clip_id for clip_id in ids if clip_id not in first_of_object]
    return (first_of_object + rest)[:count]


def true_contact(annotated: AnnotatedStore, clip_id: str) -> ContactPaint:
    """The recorded contact map: points that any hand touches in any frame of the clip."""
    points = annotated.points(annotated.object_key(clip_id))
    return ContactPaint(points.points_m, points.part, annotated.contact(clip_id).astype(np.float64))


def first_motion(samples: Path, clip_id: str, hands: HandPair) -> Clip | None:
    """The first motion in a family's folder ``samples`` for a clip, or None."""
    if not (samples / "clips" / "meta" / "info.json").is_file():
        return None
    store = open_store(samples / "clips", hands)
    name = f"{clip_id}~0"
    return store.clip(name) if name in store.sequences.index else None


def touched_points(clip: Clip, hands: HandPair, points: SampledPoints, threshold_m: float) -> np.ndarray:
    """(point,) bool: closer than the threshold to a joint of a hand in any valid frame, as in the contact stage."""
    index, touched = ProximityIndex(points), np.zeros(len(points), dtype=bool)
    for side, track in clip.hands.items():
        if track.valid.any():
            entries = index.entries(track_joints(track, hands[side]), track.valid, clip.object, threshold_m)
            touched[entries["point"]] = True
    return touched


def motion_contact(annotated: AnnotatedStore, clip_id: str, motion: Clip, hands: HandPair) -> ContactPaint:
    """The ``touched_points`` of ``motion`` at the contact threshold of the dataset."""
    points = annotated.points(annotated.object_key(clip_id))
    touched = touched_points(motion, hands, points, annotated.contact_threshold_m)
    return ContactPaint(points.points_m, points.part, touched.astype(np.float64))
