"""Examples on the report: held-out clips and the motions that families generated for them."""

from pathlib import Path

import numpy as np

from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.contact.maps import contact_maps, distance_entries
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import HandPair, track_joints
from hoidata.store.annotated import SUBSETS, AnnotatedStore
from hoidata.store.store import open_store
from pipelines.pages.surface import ContactPaint


def shown_subset(annotated: AnnotatedStore) -> str:
    """The subset of the examples: test, else validation, else train; "" without clips."""
    return next((subset for subset in reversed(SUBSETS) if annotated.ids(subset)), "")


def shown_ids(annotated: AnnotatedStore, count: int) -> list[str]:
    """Up to ``count`` clips of ``shown_subset``, one per object first."""
    subset = shown_subset(annotated)
    ids = annotated.ids(subset) if subset else []
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


def motion_contact(annotated: AnnotatedStore, clip_id: str, motion: Clip, hands: HandPair) -> ContactPaint:
    """Points that any hand of ``motion`` touches in any frame, by the rule of the contact stage."""
    points = annotated.points(annotated.object_key(clip_id))
    index = ProximityIndex(points)
    joints: dict[Side, np.ndarray] = {side: track_joints(motion.hands[side], hands[side]) for side in SIDES}
    threshold_m = annotated.contact_threshold_m
    maps = contact_maps(distance_entries(motion, joints, index, threshold_m), len(points.points_m))
    return ContactPaint(points.points_m, points.part, np.maximum(*maps.values()).astype(np.float64))
