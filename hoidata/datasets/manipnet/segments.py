"""Which stretches of a ManipNet recording are unusable, which show an interaction, and what the object does in them.

Pure functions on arrays. Two clocks: *source frames* (120 per second, where faults show) and *frames* (30 per second).
All stretches are half-open, ``start`` to ``stop``.
"""

import re
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hoidata.geometry.intervals import Interval, bridged, runs, sudden_steps
from hoidata.geometry.rotations import rotation_angle

SIZES = {"small": "small", "med": "medium", "large": "large"}
NOUNS = {
    "cyl": "cylinder",
    "hemi": "hemisphere",
    "tetra": "tetrahedron",
    "tri prism": "triangular prism",
    "wineglass": "wine glass",
}


def object_words(name: str) -> str:
    """A released object's file name in words: ``cyl_med`` -> "medium cylinder", ``teapot2`` -> "teapot"."""
    words = [re.sub(r"\d+$", "", word) for word in name.split("_")]
    sizes = [SIZES[word] for word in words if word in SIZES]
    noun = " ".join(word for word in words if word not in SIZES and word not in ("body", "old", "simplified"))
    return " ".join([*sizes, NOUNS.get(noun, noun)])


FROZEN_SOURCE_FRAMES = 12
FAR_WRIST_M = 1.0
# A step is a jump when it is large for any motion, or notable and several times what the motion around it does.
LARGE_STEP_M, LARGE_STEP_RAD = 0.10, np.deg2rad(30)
NOTABLE_STEP_M, NOTABLE_STEP_RAD = 0.01, np.deg2rad(8)
JUMP_RATIO = 4.0
JUMP_NEIGHBOURS = 5

LIFTED_M = 0.015
TOUCH_M = 0.02
BRIDGE_FRAMES = 10
APPROACH_FRAMES = 15
SHORTEST_FRAMES = 45
LONGEST_FRAMES = 150

BRIEF_FRAMES = 5
MOVED_M, TURNED_RAD = 0.03, np.deg2rad(30)
CARRIED_M, SPUN_RAD = 0.15, np.deg2rad(60)


class Cut(NamedTuple):
    """Source frames ``start`` to ``stop`` that are left out, what was expected of them and what came."""

    start: int
    stop: int
    expected: str
    got: str


@dataclass(frozen=True)
class BodyMotion:
    """One tracked body at the source's rate. position_m: (frame, 3); rotation: (frame, 3, 3); raw: (frame, channel).

    raw: every number of the file, so that a frozen tracker can be told from a body at rest.
    """

    name: str
    position_m: np.ndarray
    rotation: np.ndarray
    raw: np.ndarray


def find_cuts(left: BodyMotion, right: BodyMotion, thing: BodyMotion) -> list[Cut]:
    """Disjoint unusable stretches in order: frozen trackers, wrists far from the object, jumps of any body."""
    used = np.zeros(len(thing.raw), dtype=bool)
    cuts: list[Cut] = []
    for stretch in _frozen(left, right, thing):
        got = f"{stretch.stop - stretch.start} exactly equal frames"
        cuts.append(Cut(*stretch, "hands and object that move", got))
        used[slice(*stretch)] = True
    away = [np.linalg.norm(hand.position_m - thing.position_m, axis=1) for hand in (left, right)]
    farthest = np.maximum(*away)
    for stretch in runs((farthest > FAR_WRIST_M) & ~used):
        got = f"a wrist {farthest[slice(*stretch)].max():.2f} m away"
        cuts.append(Cut(*stretch, f"both wrists within {FAR_WRIST_M:g} m of the object", got))
        used[slice(*stretch)] = True
    for body in (left, right, thing):
        for cut in _jumps(body):
            for stretch in runs(_mask(cut, len(used)) & ~used):
                cuts.append(Cut(*stretch, cut.expected, cut.got))
                used[slice(*stretch)] = True
    return sorted(cuts)


def interactions(usable: np.ndarray, touched: np.ndarray, lifted: np.ndarray) -> list[Interval]:
    """Stretches of at most 150 frames in which a hand is at the object, each with at most one lift; booleans (frame,).

    Touches with gaps of at most 10 frames count as one. Each lift forms a stretch with 15 frames of touch before and
    after, where there are any; what is left of the touch forms its own, or joins the lift when it is shorter than 45
    frames. Long stretches are divided evenly.
    """
    pieces: list[Interval] = []
    for touch in runs(bridged(touched, BRIDGE_FRAMES) & usable):
        windows = _lift_windows(touch, bridged(lifted & _mask(touch, len(lifted)), BRIDGE_FRAMES))
        edges = [touch.start, *(edge for window in windows for edge in window), touch.stop]
        for start, stop in pairwise(edges):
            if stop > start:
                pieces += _divided(Interval(start, stop))
    return pieces


def motion_verb(lift_m: np.ndarray, centre_m: np.ndarray, rotation: np.ndarray) -> str | None:
    """What the object's motion in a clip shows, or None when it neither leaves the table nor moves.

    lift_m: (frame,) height of its lowest point above the table; centre_m: (frame, 3); rotation: (frame, 3, 3).
    Leaves the table: "lift". Comes back to it: "place". In the air throughout: "turn" from 60 degrees on, else "move"
    from 15 cm on, else "hold". On the table throughout: "turn" from 30 degrees on, "move" from 3 cm on. Fewer than
    5 frames in the air, or on the table, do not count.
    """
    lifted = _without_brief(lift_m > LIFTED_M)
    moved_m = np.linalg.norm(centre_m - centre_m[0], axis=1).max()
    turned_rad = rotation_angle(rotation[:1].transpose(0, 2, 1) @ rotation).max()
    if lifted.any() and not lifted.all():
        return "place" if lifted[0] and not lifted[-1] else "lift"
    enough_turn, enough_way = (SPUN_RAD, CARRIED_M) if lifted.all() else (TURNED_RAD, MOVED_M)
    if turned_rad >= enough_turn:
        return "turn"
    if moved_m >= enough_way:
        return "move"
    return "hold" if lifted.all() else None


def height_above_table(lowest_m: np.ndarray) -> np.ndarray:
    """(frame,) lowest object point above its 3rd percentile over the sequence, which stands for the table."""
    return lowest_m - np.percentile(lowest_m, 3)


def _frozen(*bodies: BodyMotion) -> list[Interval]:
    same = np.all([(body.raw[1:] == body.raw[:-1]).all(axis=1) for body in bodies], axis=0)
    return [Interval(a, b + 1) for a, b in runs(same) if b + 1 - a >= FROZEN_SOURCE_FRAMES]


def _jumps(body: BodyMotion) -> list[Cut]:
    """Four frames around each jump, merged where they overlap."""
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
    """All alike where fewer than 5 frames differ from the rest."""
    if min(lifted.sum(), (~lifted).sum()) >= BRIEF_FRAMES:
        return lifted
    return np.full_like(lifted, lifted.mean() > 0.5)


def _mask(stretch: tuple, length: int) -> np.ndarray:
    mask = np.zeros(length, dtype=bool)
    mask[stretch[0] : stretch[1]] = True
    return mask


def _lift_windows(touch: Interval, lifted: np.ndarray) -> list[Interval]:
    """One stretch per lift inside ``touch``, widened, with the rests of touch too short for a clip of their own."""
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


def _divided(stretch: Interval) -> list[Interval]:
    parts = -(-(stretch.stop - stretch.start) // LONGEST_FRAMES)
    edges = np.linspace(stretch.start, stretch.stop, parts + 1).round().astype(int).tolist()
    return [Interval(a, b) for a, b in pairwise(edges)]
