"""Hands against the object and each other: contact, slip, penetration. Each function gives the values of one motion.

Penetration has one meaning everywhere: the depth of a hand's deepest vertex inside the solid the object's mesh
encloses, by the exact surface (``hoidata.objects.surface_index``); penetrating volume is what both fill.
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
from hoidata.surface.contact import PlacedHand, deepest_m, placed_hand
from hoidata.surface.solid_overlap import SolidOverlap

DEEP_MM = 10.0
TOO_LARGE = Unmeasured("the object is too large for a lattice of lines")
CELL_M = 0.002  # of the lattice of lines that volumes are measured along: off by 1 % of the volume


def contact_f1(pair: Pair, every: int) -> np.ndarray:
    """(1,) F1 of the contact map the motion makes against that of the reference; 1 where both are empty."""
    del every  # a map is over all frames
    return np.array([f1_score(*_maps(pair))])


def contact_precision(pair: Pair, every: int) -> np.ndarray:
    """(1,) of the points the motion touches the share that the reference touches; as ``contact_f1`` where one is empty.

    So it is 0, not unknown, for a motion that touches nothing though the reference does.
    """
    del every
    made, true = _maps(pair)
    return _share(made & true, made, true)


def contact_recall(pair: Pair, every: int) -> np.ndarray:
    """(1,) of the points the reference touches the share that the motion touches, as in ``contact_precision``."""
    del every
    made, true = _maps(pair)
    return _share(made & true, true, made)


def adherence(pair: Pair, every: int) -> Values:
    """(1,) F1 of the contact map the motion makes against the one it was asked for; none where none was asked for."""
    del every
    if pair.asked is None:
        return Unmeasured("the motion was made without a target contact map")
    return np.array([f1_score(touched_points(pair), pair.asked)])


def _maps(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """(point,) bool, what the motion touches and what the reference does."""
    return touched_points(pair), pair.contact.touched


def _share(hits: np.ndarray, of: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.array([hits.sum() / of.sum() if of.any() else float(not other.any())])


def touched_points(pair: Pair) -> np.ndarray:
    """(point,) bool: nearer than the contact threshold to a joint of an acting hand of the prediction in any frame."""
    touched = np.zeros(pair.contact.index.count, dtype=bool)
    for near in made_entries(pair).values():
        touched[near["point"]] = True
    return touched


@lru_cache(maxsize=1)
def made_entries(pair: Pair) -> dict[Side, np.ndarray]:
    """By acting hand, ``ENTRY`` rows of every joint of the prediction near a sampled point. Kept for one pair."""
    contact, motion = pair.contact, pair.predicted
    return {
        side: contact.index.entries(motion.joints_m[side], pair.valid(side), motion.clip.object, contact.threshold_m)
        for side in pair.sides
    }


def slip_cm_s(pair: Pair, every: int) -> np.ndarray:
    """(joint and frame,) cm/s: ``joint_slips_cm_s`` of the acting hands."""
    del every  # a speed needs every frame
    clip, each = pair.predicted.clip, [np.zeros(0)]
    for side, near in made_entries(pair).items():
        part = pair.contact.part[near["point"]]
        touched = touched_parts(clip.n_frames, near["frame"], near["joint"], near["distance_m"], part)
        each.append(joint_slips_cm_s(clip.object, pair.predicted.joints_m[side], touched))
    return np.concatenate(each)


def contact_distance_mm(pair: Pair, every: int) -> np.ndarray:
    """(joint that touches in the truth,) its distance from the surface in the prediction, either side, millimetres."""
    each = []
    for side in pair.sides:
        frames = pair.frames(side, every)
        touching = _surface_distances_m(pair.reference, side, frames) < pair.contact.threshold_m
        each.append(_surface_distances_m(pair.predicted, side, frames)[touching])
    return 1000 * np.concatenate([np.zeros(0), *each])


def penetration_mm(pair: Pair, every: int) -> Values:
    """(hand and frame,) depth of the deepest vertex, millimetres, 0 outside; none for an object without an inside."""
    found = _deepest_m(pair, every)
    return found if isinstance(found, Unmeasured) else 1000 * found


def deep_share(pair: Pair, every: int) -> Values:
    """(hand and frame,) 1 where the deepest vertex is deeper than ``DEEP_MM``, else 0."""
    found = penetration_mm(pair, every)
    return found if isinstance(found, Unmeasured) else (found > DEEP_MM).astype(np.float64)


def penetration_volume_cm3(pair: Pair, every: int) -> Values:
    """(hand and frame,) volume that the hand and the solid object both fill, cubic centimetres.

    None for an object without an inside, or too large for a lattice of ``CELL_M``.
    """
    overlap = _overlap(surface_index(pair.predicted.clip.object.model))
    if isinstance(overlap, Unmeasured):
        return overlap
    hands = _hands(pair, every)
    return 1e6 * np.concatenate(
        [np.zeros(0)] + [overlap.volume_m3(hand.vertices_m, hand.faces, hand.hinge_rad) for hand in hands]
    )


@lru_cache(maxsize=1)
def _deepest_m(pair: Pair, every: int) -> Values:
    """Kept for one pair: two metrics ask for it, and meshes are what costs."""
    index = surface_index(pair.predicted.clip.object.model)
    if not index.is_solid:
        return NO_INSIDE
    return np.concatenate([np.zeros(0)] + [deepest_m(hand, index)[hand.frames] for hand in _hands(pair, every)])


@lru_cache(maxsize=1)
def _hands(pair: Pair, every: int) -> list[PlacedHand]:
    """The acting hands in every n-th frame in which they are looked at."""
    clip = pair.predicted.clip
    return [_at(placed_hand(clip, side, pair.predicted.hands), pair.frames(side, every)) for side in pair.sides]


@lru_cache(maxsize=64)
def _overlap(index: SurfaceIndex) -> SolidOverlap | Unmeasured:
    try:
        return SolidOverlap(index, CELL_M) if index.is_solid else NO_INSIDE
    except BadInput:  # a lattice of millimetres over metres
        return TOO_LARGE


def _at(hand: PlacedHand, frames: np.ndarray) -> PlacedHand:
    """The hand in some of the frames in which it is valid."""
    rows = np.searchsorted(hand.frames, frames)
    hinge = None if hand.hinge_rad is None else hand.hinge_rad[rows]
    return replace(hand, vertices_m=hand.vertices_m[rows], frames=frames, hinge_rad=hinge)


def _surface_distances_m(motion: Motion, side: Side, frames: np.ndarray) -> np.ndarray:
    """(frame, 21) distance of joints from the surface, metres, never negative."""
    index = surface_index(motion.clip.object.model)
    return index.distance_m(motion.joints_in_object(side, frames), motion.hinge_rad(frames))


# --- one hand against the other


def hand_hand_mm(pair: Pair, every: int) -> Values:
    """(frame,) depth of the deepest capsule of one hand in one of the other, millimetres, 0 where they are apart.

    None where one hand acts alone.
    """
    frames = np.flatnonzero(pair.valid("left") & pair.valid("right"))[::every]
    if pair.sides != SIDES:
        return Unmeasured("one hand acts alone")
    if not len(frames):
        return np.zeros(0)
    clip, hands = pair.predicted.clip.take(frames), pair.predicted.hands
    left, right = (hand_capsules(clip.hands[side], hands[side]) for side in SIDES)
    return 1000 * depth_m(left, right)


def depth_m(one: Capsules, other: Capsules) -> np.ndarray:
    """(frame,) how deep two sets of capsules overlap at most: the sum of two radii less the distance of their axes."""
    apart = _axis_distances_m(*(ends[:, :, None] for ends in one[:2]), *(ends[:, None] for ends in other[:2]))
    depth = one.radius_m[:, None] + other.radius_m - apart
    return np.maximum(depth.max(axis=(1, 2)), 0.0)


def _axis_distances_m(
    start: np.ndarray, stop: np.ndarray, other_start: np.ndarray, other_stop: np.ndarray
) -> np.ndarray:
    """Least distance of segments by their ends (..., 3), as in Ericson 2005, Real-Time Collision Detection, 5.1.9."""
    way, other_way, between = stop - start, other_stop - other_start, start - other_start
    a, e, b = (way * way).sum(-1), (other_way * other_way).sum(-1), (way * other_way).sum(-1)
    c, f = (way * between).sum(-1), (other_way * between).sum(-1)
    cross = a * e - b * b
    along = np.clip(np.where(cross > 0, (b * f - c * e) / np.where(cross > 0, cross, 1), 0), 0, 1)
    beside = np.clip((b * along + f) / np.where(e > 0, e, 1), 0, 1)
    along = np.clip((b * beside - c) / np.where(a > 0, a, 1), 0, 1)
    return np.linalg.norm(between + along[..., None] * way - beside[..., None] * other_way, axis=-1)
