"""Hands against the object: contact, penetration. Each function gives the values of one motion.

Penetration has one meaning everywhere: the depth of a hand's deepest vertex inside the solid the object's mesh
encloses, by the exact surface (``hoidata.objects.surface_index``).
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from hoidata.clips.clip import Side
from hoidata.metrics.pair import Motion, Pair
from hoidata.objects.surface_index import surface_index
from hoidata.surface.contact import PlacedHand, deepest_m, placed_hand

DEEP_MM = 10.0


def contact_f1(pair: Pair, every: int) -> np.ndarray:
    """(1,) F1 of the contact map the motion makes against that of the reference; 1 where both are empty."""
    del every  # a map is over all frames
    made, true = touched_points(pair), pair.contact.touched
    total = int(made.sum()) + int(true.sum())
    return np.array([2 * int((made & true).sum()) / total if total else 1.0])


def touched_points(pair: Pair) -> np.ndarray:
    """(point,) bool: nearer than the contact threshold to a joint of an acting hand of the prediction in any frame."""
    contact, motion = pair.contact, pair.predicted
    touched = np.zeros(contact.index.count, dtype=bool)
    for side in pair.sides:
        valid = pair.reference.clip.hands[side].valid
        entries = contact.index.entries(motion.joints_m[side], valid, motion.clip.object, contact.threshold_m)
        touched[entries["point"]] = True
    return touched


def contact_distance_mm(pair: Pair, every: int) -> np.ndarray:
    """(joint that touches in the truth,) its distance from the surface in the prediction, either side, millimetres."""
    each = []
    for side in pair.sides:
        frames = pair.frames(side, every)
        touching = _surface_distances_m(pair.reference, side, frames) < pair.contact.threshold_m
        each.append(_surface_distances_m(pair.predicted, side, frames)[touching])
    return 1000 * np.concatenate([np.zeros(0), *each])


def penetration_mm(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) depth of the deepest vertex, millimetres, 0 outside; none for an object without an inside."""
    return 1000 * _deepest_m(pair, every)


def deep_share(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) 1 where the deepest vertex is deeper than ``DEEP_MM``, else 0."""
    return (penetration_mm(pair, every) > DEEP_MM).astype(np.float64)


@lru_cache(maxsize=1)
def _deepest_m(pair: Pair, every: int) -> np.ndarray:
    """Kept for one pair: two metrics ask for it, and meshes are what costs."""
    clip, each = pair.predicted.clip, [np.zeros(0)]
    index = surface_index(clip.object.model)
    for side in pair.sides if index.is_solid else ():
        frames = pair.frames(side, every)
        hand = _at(placed_hand(clip, side, pair.predicted.hands), frames)
        each.append(deepest_m(hand, index)[frames])
    return np.concatenate(each)


def _at(hand: PlacedHand, frames: np.ndarray) -> PlacedHand:
    """The hand in some of the frames in which it is valid."""
    rows = np.searchsorted(hand.frames, frames)
    hinge = None if hand.hinge_rad is None else hand.hinge_rad[rows]
    return replace(hand, vertices_m=hand.vertices_m[rows], frames=frames, hinge_rad=hinge)


def _surface_distances_m(motion: Motion, side: Side, frames: np.ndarray) -> np.ndarray:
    """(frame, 21) distance of joints from the surface, metres, never negative."""
    index = surface_index(motion.clip.object.model)
    return index.distance_m(motion.joints_in_object(side, frames), motion.hinge_rad(frames))
