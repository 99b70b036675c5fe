"""Finds unusable intervals and interactions in a ManipNet recording, and classifies the object's motion.

Pure functions on arrays. *Source frames* are at 120 fps, where faults are visible. *Frames* are at 30 fps. All
intervals are half-open, ``start`` to ``stop``.
"""

import re
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hoidata.geometry.intervals import Interval, bridged, runs, split_evenly, sudden_steps
from hoidata.geometry.rotations import rotation_angle

SIZES = {"small": "small", "med": "medium", "large": "large"}
NOUNS = {
    "cyl": "cylinder", "hemi": "hemisphere", "tetra": "tetrahedron", "tri prism": "triangular prism",
    "wineglass": "wine glass",
}  # fmt: skip


def object_words(name: str) -> str:
    """An object's file name in words: ``cyl_med`` -> "medium cylinder", ``teapot2`` -> "teapot"."""
    words = [re.sub(r"\d+$", "", word) for word in name.split("_")]
    sizes = [SIZES[word] for word in words if word in SIZES]
    noun = " ".join(word for word in words if word not in SIZES and word not in ("body", "old", "simplified"))
    return " ".join([*sizes, NOUNS.get(noun, noun)])


FROZEN_SOURCE_FRAMES = 12
FAR_WRIST_M = 1.0
# A step is a jump if it is large, or if it is notable and several times larger than the steps around it.
LARGE_STEP_M, LARGE_STEP_RAD = 0.10, np.deg2rad(30)
NOTABLE_STEP_M, NOTABLE_STEP_RAD = 0.01, np.deg2rad(8)
JUMP_RATIO = 4.0
JUMP_NEIGHBOURS = 5

LIFTED_M = 0.015
TOUCH_M = 0.02
MAX_CONTACT_GAP_FRAMES = 10
APPROACH_FRAMES = 15
SHORTEST_FRAMES = 45
LONGEST_FRAMES = 150

MIN_PHASE_FRAMES = 5
MOVED_M, TURNED_RAD = 0.03, np.deg2rad(30)
CARRIED_M, SPUN_RAD = 0.15, np.deg2rad(60)


class Cut(NamedTuple):
    """An excluded interval of source frames with the reason."""

    start: int
    stop: int
    expected: str
    got: str


@dataclass(frozen=True)
class BodyMotion:
    """One tracked body at the source's rate."""

    name: str
    position_m: np.ndarray  # (frame, 3)
    rotation: np.ndarray  # (frame, 3, 3)
    raw: np.ndarray  # (frame, channel) all numbers of the file, which distinguish a frozen tracker from a body at rest


def find_cuts(left: BodyMotion, right: BodyMotion, object_motion: BodyMotion) -> list[Cut]:
    """Sorted disjoint unusable intervals: frozen trackers, wrists far from the object, jumps of any body."""
    used = np.zeros(len(object_motion.raw), dtype=bool)
    cuts: list[Cut] = []
    for interval in _frozen(left, right, object_motion):
        got = f"{interval.stop - interval.start} exactly equal frames"
        cuts.append(Cut(*interval, "hands and object that move", got))
        used[slice(*interval)] = True
    away = [np.linalg.norm(hand.position_m - object_motion.position_m, axis=1) for hand in (left, right)]
    farthest = np.maximum(*away)
    for interval in runs((farthest > FAR_WRIST_M) & ~used):
        got = f"a wrist {farthest[slice(*interval)].max():.2f} m away"
        cuts.append(Cut(*interval, f"both wrists within {FAR_WRIST_M:g} m of the object", got))
        used[slice(*interval)] = True
    for body in (left, right, object_motion):
        for cut in _jumps(body):
            for interval in runs(_mask(cut, len(used)) & ~used):
                cuts.append(Cut(*interval, cut.expected, cut.got))
                used[slice(*interval)] = True
    return sorted(cuts)


def interactions(usable: np.ndarray, touched: np.ndarray, lifted: np.ndarray) -> list[Interval]:
    """Split contact into intervals of at most 150 frames, each with at most one lift.

    Gaps in contact of at most 10 frames are ignored. Each lift forms an interval with up to 15 frames of contact before
    and after it. The remaining contact forms an interval, or joins the lift if it is shorter than 45 frames. Long
    intervals are split evenly. usable, touched (a hand is at the object), lifted (above the table): (frame,) bool.
    """
    pieces: list[Interval] = []
    for touch in runs(bridged(touched, MAX_CONTACT_GAP_FRAMES) & usable):
        windows = _lift_windows(touch, bridged(lifted & _mask(touch, len(lifted)), MAX_CONTACT_GAP_FRAMES))
        edges = [touch.start, *(edge for window in windows for edge in window), touch.stop]
        for start, stop in pairwise(edges):
            if stop > start:
                pieces += split_evenly(Interval(start, stop), LONGEST_FRAMES)
    return pieces


def motion_verb(lift_m: np.ndarray, centre_m: np.ndarray, rotation: np.ndarray) -> str | None:
    """Classify the object's motion in a clip.

    - It leaves the table: "lift".
    - It returns to the table: "place".
    - It is in the air throughout: "turn" from 60 degrees, else "move" from 15 cm, else "hold".
    - It is on the table throughout: "turn" from 30 degrees, else "move" from 3 cm, else None.

    Phases of fewer than 5 frames in the air or on the table are ignored.
    lift_m: (frame,) height of its lowest point above the table. centre_m: (frame, 3). rotation: (frame, 3, 3).
    """
    lifted = _without_brief(lift_m > LIFTED_M)
    moved_m = np.linalg.norm(centre_m - centre_m[0], axis=1).max()
    turned_rad = rotation_angle(rotation[:1].transpose(0, 2, 1) @ rotation).max()
    if lifted.any() and not lifted.all():
        return "place" if lifted[0] and not lifted[-1] else "lift"
    min_rotation_rad, min_distance_m = (SPUN_RAD, CARRIED_M) if lifted.all() else (TURNED_RAD, MOVED_M)
    if turned_rad >= min_rotation_rad:
        return "turn"
    if moved_m >= min_distance_m:
        return "move"
    return "hold" if lifted.all() else None


def height_above_table(lowest_m: np.ndarray) -> np.ndarray:
    """(frame,) height of the lowest object point above the table, which is its 3rd percentile over the sequence."""
    return lowest_m - np.percentile(lowest_m, 3)


def _frozen(*bodies: BodyMotion) -> list[Interval]:
    same = np.all([(body.raw[1:] == body.raw[:-1]).all(axis=1) for body in bodies], axis=0)
    return [Interval(a, b + 1) for a, b in runs(same) if b + 1 - a >= FROZEN_SOURCE_FRAMES]


def _jumps(body: BodyMotion) -> list[Cut]:
    """Four frames around each jump; overlapping intervals are merged."""
    step_m = np.linalg.norm(np.diff(body.position_m, axis=0), axis=1)
    step_rad = rotation_angle(body.rotation[:-1].transpose(0, 2, 1) @ body.rotation[1:])
    sudden = sudden_steps(step_m, NOTABLE_STEP_M, LARGE_STEP_M, JUMP_RATIO, JUMP_NEIGHBOURS)
    sudden |= sudden_steps(step_rad, NOTABLE_STEP_RAD, LARGE_STEP_RAD, JUMP_RATIO, JUMP_NEIGHBOURS)
    bad = np.zeros(len(body.position_m), dtype=bool)
    for step in np.flatnonzero(sudden):
        bad[max(0, step - 1) : step + 3] = True
    cuts = []
    for start, stop in runs(bad):
        steps = slice(start, stop - 1)
        got = f"{body.name} jumps {step_m[steps].max() * 100:.1f} cm, {np.rad2deg(step_rad[steps].max()):.0f} degrees"
        cuts.append(Cut(start, stop, "steady motion from frame to frame", got))
    return cuts


def _without_brief(lifted: np.ndarray) -> np.ndarray:
    """Replace phases of fewer than 5 frames in total by the majority."""
    if min(lifted.sum(), (~lifted).sum()) >= MIN_PHASE_FRAMES:
        return lifted
    return np.full_like(lifted, lifted.mean() > 0.5)


def _mask(interval: tuple, length: int) -> np.ndarray:
    mask = np.zeros(length, dtype=bool)
    mask[interval[0] : interval[1]] = True
    return mask


def _lift_windows(touch: Interval, lifted: np.ndarray) -> list[Interval]:
    """One interval per lift inside ``touch``, widened. It includes rests of contact that are too short for a clip."""
    lifts = runs(lifted)
    bounds = [touch.start]
    for before, after in pairwise(lifts):
        if after.start - before.stop - 2 * APPROACH_FRAMES < SHORTEST_FRAMES:
            bounds += [(before.stop + after.start) // 2] * 2
        else:
            bounds += [before.stop + APPROACH_FRAMES, after.start - APPROACH_FRAMES]
    bounds.append(touch.stop)
    windows = [Interval(bounds[2 * i], bounds[2 * i + 1]) for i in range(len(lifts))]
    if lifts and lifts[0].start - APPROACH_FRAMES - touch.start >= SHORTEST_FRAMES:
        windows[0] = Interval(lifts[0].start - APPROACH_FRAMES, windows[0].stop)
    if lifts and touch.stop - lifts[-1].stop - APPROACH_FRAMES >= SHORTEST_FRAMES:
        windows[-1] = Interval(windows[-1].start, lifts[-1].stop + APPROACH_FRAMES)
    return windows
