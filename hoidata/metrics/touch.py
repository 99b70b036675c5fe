"""Metrics of contact, slip and penetration. Each function returns the values of one motion.

Penetration is the depth of the hand's deepest vertex inside the solid that the object's mesh encloses, by the exact
surface (``hoidata.objects.surface_index``). Intersection volume is the volume that hand and object both fill.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from hoidata.clips.clip import SIDES, Side
from hoidata.clips.slip import joint_slips_cm_s, touched_parts
from hoidata.contact.maps import f1_score
from hoidata.errors import BadInput
from hoidata.metrics.pair import Motion, Pair
from hoidata.metrics.unmeasured import NO_INSIDE, Unmeasured, Values
from hoidata.objects.surface_index import SurfaceIndex, surface_index
from hoidata.physics.capsules import Capsules
from hoidata.physics.mano_capsules import hand_capsules
from hoidata.surface.contact import HandInObjectFrame, deepest_m, hand_in_object_frame
from hoidata.surface.solid_overlap import SolidOverlap

DEEP_MM = 10.0
TOO_LARGE = Unmeasured("the object is too large for a lattice of lines")
CELL_M = 0.002  # spacing of the lines along which volumes are integrated: an error of about 1 % of the volume


def contact_f1(pair: Pair, _frame_step: int) -> np.ndarray:
    """(1,) F1 of the generated contact map against that of the reference; 1 if both are empty."""
    return np.array([f1_score(*_maps(pair))])


def contact_precision(pair: Pair, _frame_step: int) -> np.ndarray:
    """(1,) fraction of the generated contact points that the reference touches too.

    A motion without contact scores 0 if the reference has contact and 1 if it has none.
    """
    touched, reference = _maps(pair)
    return _fraction(touched & reference, touched, reference)


def contact_recall(pair: Pair, _frame_step: int) -> np.ndarray:
    """(1,) fraction of the reference's contact points that the motion touches too; empty maps as in precision."""
    touched, reference = _maps(pair)
    return _fraction(touched & reference, reference, touched)


def adherence(pair: Pair, _frame_step: int) -> Values:
    """(1,) F1 of the generated contact map against the target map; unmeasured without a target."""
    if pair.target_contact is None:
        return Unmeasured("the motion was made without a target contact map")
    return np.array([f1_score(touched_points(pair), pair.target_contact)])


def _maps(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """(point,) bool contact maps of the motion and of the reference."""
    return touched_points(pair), pair.contact.touched


def _fraction(hits: np.ndarray, total: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.array([hits.sum() / total.sum() if total.any() else float(not other.any())])


def touched_points(pair: Pair) -> np.ndarray:
    """(point,) bool: within the contact threshold of a joint of an acting hand of the prediction in any frame."""
    touched = np.zeros(pair.contact.index.count, dtype=bool)
    for near in contact_entries(pair).values():
        touched[near["point"]] = True
    return touched


@lru_cache(maxsize=1)
def contact_entries(pair: Pair) -> dict[Side, np.ndarray]:
    """Per acting hand, ``ENTRY`` rows of the joints of the prediction near a sampled point. Cached for one pair."""
    contact, motion = pair.contact, pair.predicted
    return {
        side: contact.index.entries(motion.joints_m[side], pair.valid(side), motion.clip.object, contact.threshold_m)
        for side in pair.sides
    }


def slip_cm_s(pair: Pair, _frame_step: int) -> np.ndarray:
    """(joint and frame,) slip speed of touching joints of the acting hands, cm/s (``joint_slips_cm_s``)."""
    clip, slips = pair.predicted.clip, [np.zeros(0)]
    for side, near in contact_entries(pair).items():
        part = pair.contact.part[near["point"]]
        touched = touched_parts(clip.n_frames, near["frame"], near["joint"], near["distance_m"], part)
        slips.append(joint_slips_cm_s(clip.object, pair.predicted.joints_m[side], touched))
    return np.concatenate(slips)


def contact_distance_mm(pair: Pair, frame_step: int) -> np.ndarray:
    """(joint in contact in the recording,) its unsigned distance to the surface in the prediction, millimetres."""
    distances_m = []
    for side in pair.sides:
        frames = pair.frames(side, frame_step)
        touching = _surface_distances_m(pair.reference, side, frames) < pair.contact.threshold_m
        distances_m.append(_surface_distances_m(pair.predicted, side, frames)[touching])
    return 1000 * np.concatenate([np.zeros(0), *distances_m])


def penetration_mm(pair: Pair, frame_step: int) -> Values:
    """(hand and frame,) depth of the deepest vertex, millimetres, 0 outside; unmeasured if the object is not solid."""
    depth_m = _deepest_m(pair, frame_step)
    return depth_m if isinstance(depth_m, Unmeasured) else 1000 * depth_m


def deep_share(pair: Pair, frame_step: int) -> Values:
    """(hand and frame,) 1 if the deepest vertex is deeper than ``DEEP_MM``, else 0."""
    depth_mm = penetration_mm(pair, frame_step)
    return depth_mm if isinstance(depth_mm, Unmeasured) else (depth_mm > DEEP_MM).astype(np.float64)


def penetration_volume_cm3(pair: Pair, frame_step: int) -> Values:
    """(hand and frame,) intersection volume of the hand and the solid object, cubic centimetres.

    Unmeasured for an object that is not solid or is too large for a lattice of ``CELL_M``.
    """
    overlap = _overlap(surface_index(pair.predicted.clip.object.model))
    if isinstance(overlap, Unmeasured):
        return overlap
    hands = _hands(pair, frame_step)
    return 1e6 * np.concatenate(
        [np.zeros(0)] + [overlap.volume_m3(hand.vertices_m, hand.faces, hand.hinge_rad) for hand in hands]
    )


@lru_cache(maxsize=1)
def _deepest_m(pair: Pair, frame_step: int) -> Values:
    """(hand and frame,) depth of the deepest vertex, metres. Cached for one pair: two metrics use it."""
    index = surface_index(pair.predicted.clip.object.model)
    if not index.is_solid:
        return NO_INSIDE
    return np.concatenate([np.zeros(0)] + [deepest_m(hand, index)[hand.frames] for hand in _hands(pair, frame_step)])


@lru_cache(maxsize=1)
def _hands(pair: Pair, frame_step: int) -> list[HandInObjectFrame]:
    """The acting hands in every n-th frame in which they are measured."""
    clip = pair.predicted.clip
    return [
        _at(hand_in_object_frame(clip, side, pair.predicted.hands), pair.frames(side, frame_step))
        for side in pair.sides
    ]


@lru_cache(maxsize=64)
def _overlap(index: SurfaceIndex) -> SolidOverlap | Unmeasured:
    try:
        return SolidOverlap(index, CELL_M) if index.is_solid else NO_INSIDE
    except BadInput:  # a lattice of millimetres over metres
        return TOO_LARGE


def _at(hand: HandInObjectFrame, frames: np.ndarray) -> HandInObjectFrame:
    """The hand in a subset of the frames in which it is valid."""
    chosen = np.searchsorted(hand.frames, frames)
    hinge_rad = None if hand.hinge_rad is None else hand.hinge_rad[chosen]
    return replace(hand, vertices_m=hand.vertices_m[chosen], frames=frames, hinge_rad=hinge_rad)


def _surface_distances_m(motion: Motion, side: Side, frames: np.ndarray) -> np.ndarray:
    """(frame, 21) distance of joints from the surface, metres, never negative."""
    index = surface_index(motion.clip.object.model)
    return index.distance_m(motion.joints_in_object(side, frames), motion.hinge_rad(frames))


# --- one hand against the other


def hand_hand_mm(pair: Pair, frame_step: int) -> Values:
    """(frame,) largest overlap of a capsule of one hand with one of the other, millimetres, 0 if they are apart.

    Unmeasured if one hand acts alone.
    """
    frames = np.flatnonzero(pair.valid("left") & pair.valid("right"))[::frame_step]
    if pair.sides != SIDES:
        return Unmeasured("one hand acts alone")
    if not len(frames):
        return np.zeros(0)
    clip, hands = pair.predicted.clip.take(frames), pair.predicted.hands
    left, right = (hand_capsules(clip.hands[side], hands[side]) for side in SIDES)
    return 1000 * depth_m(left, right)


def depth_m(one: Capsules, other: Capsules) -> np.ndarray:
    """(frame,) largest overlap of two sets of capsules: sum of the radii minus the distance of the axes, metres."""
    apart = _axis_distances_m(*(ends[:, :, None] for ends in one[:2]), *(ends[:, None] for ends in other[:2]))
    depth = one.radius_m[:, None] + other.radius_m - apart
    return np.maximum(depth.max(axis=(1, 2)), 0.0)


def _axis_distances_m(
    start: np.ndarray, stop: np.ndarray, other_start: np.ndarray, other_stop: np.ndarray
) -> np.ndarray:
    """Least distance (...) between segments with ends (..., 3); Ericson 2005, Real-Time Collision Detection, 5.1.9."""
    direction, other_direction, offset = stop - start, other_stop - other_start, start - other_start
    a, e, b = (
        (direction * direction).sum(-1),
        (other_direction * other_direction).sum(-1),
        (direction * other_direction).sum(-1),
    )
    c, f = (direction * offset).sum(-1), (other_direction * offset).sum(-1)
    cross = a * e - b * b  # 0 for parallel segments, which keep along = 0
    along = np.clip(np.where(cross > 0, (b * f - c * e) / np.where(cross > 0, cross, 1), 0), 0, 1)
    other_along = np.clip((b * along + f) / np.where(e > 0, e, 1), 0, 1)
    along = np.clip((b * other_along - c) / np.where(a > 0, a, 1), 0, 1)
    return np.linalg.norm(offset + along[..., None] * direction - other_along[..., None] * other_direction, axis=-1)
