"""A verb for a clip whose source names none, from how the object moves and how its hinge turns.

The verb says what the motion shows, never what it is for: a bottle that is tilted and shaken is shaken, whether it
sprinkles or not. The first rule of ``derive_verb`` that holds names the verb.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from hoidata.clips import FPS, SIDES, Clip
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.store.hand_evidence import HandEvidence

# All thresholds are ours. A hinge that turns by less may do so because the object is held.
HINGE_RAD = np.deg2rad(15)
# Of a hinge's range, the share between its first and last angle from which on it is opened or closed, not worked.
HINGE_NET = 0.5
# A place raised by more is a lift; raised by less than RAISED_M it has not left its support (ManipNet's 1.5 cm).
LIFTED_M, RAISED_M = 0.10, 0.015
LOWERED_M = 0.05
TURNED_RAD, MOVED_M = np.deg2rad(30), 0.05
# Shaking: three swings to and fro of 1.5 cm from end to end, each half of one within a third of a second, over a fifth
# of the clip or more. Motion slower than about 1.5 Hz is taken off first.
SHAKE_M, SHAKE_HALVES, SHAKE_GAP, SHAKE_SHARE = 0.015, 6, FPS // 3, 0.2
SLOW_FRAMES = FPS // 2
# Touched in so many frames an object at rest is held, in fewer touched.
HELD_SHARE = 0.8


class Derived(NamedTuple):
    """verb: base form. evidence: the measured motion it rests on, in words."""

    verb: str
    evidence: str


@dataclass(frozen=True)
class ObjectMotion:
    """What the rules look at, of one clip; metres and radians.

    hinge_rad: (frame,), None for a rigid object. height_m: (frame,) of the object's middle above its first, against
    gravity, None without it. travelled_m: farthest from the first place, not counting what it rises where gravity is
    known. turned_rad: the largest angle to the first orientation. shakes: whole swings to and fro, and
    shaken_frames: how many frames they take. touched: share of frames in which a hand is near.
    """

    hinge_rad: np.ndarray | None
    height_m: np.ndarray | None
    travelled_m: float
    turned_rad: float
    shakes: int
    shaken_frames: int
    touched: float
    n_frames: int


def derive_verb(clip: Clip, evidence: HandEvidence) -> Derived:
    """The verb the motion of a clip shows.

    open, close: the hinge turns by 15 degrees or more, and ends away from or towards zero, which is the object as its
    mesh is stored (closed, in ARCTIC); operate: it turns as far and comes back. shake: three fast swings or more.
    place: the object ends 5 cm lower than it began. lift: it rises by 10 cm or more. turn: by 30 degrees or more. move:
    by 5 cm or more. grasp: raised by 1.5 cm or more. Else hold, or touch where hands are near in under 80 % of frames.
    lift, place and grasp need ``clip.gravity``. evidence: of the same clip, at the threshold of its hand type.
    """
    motion = object_motion(clip, evidence)
    height_m, hinge = motion.height_m, _hinge(motion)
    highest_m, last_m = (0.0, 0.0) if height_m is None else (float(height_m.max()), float(height_m[-1]))
    if hinge is not None:
        return hinge
    if motion.shaken_frames >= SHAKE_SHARE * motion.n_frames:
        return Derived("shake", f"{motion.shakes} swings in {motion.shaken_frames / FPS:.1f} s")
    if last_m <= -LOWERED_M:
        return Derived("place", f"ends {-last_m * 100:.1f} cm lower")
    if highest_m >= LIFTED_M:
        return Derived("lift", f"rises {highest_m * 100:.1f} cm")
    if motion.turned_rad >= TURNED_RAD:
        return Derived("turn", f"turns {np.rad2deg(motion.turned_rad):.0f} degrees")
    if motion.travelled_m >= MOVED_M:
        return Derived("move", f"moves {motion.travelled_m * 100:.1f} cm")
    if highest_m >= RAISED_M:
        return Derived("grasp", f"rises {highest_m * 100:.1f} cm, and does not leave its place")
    verb = "hold" if motion.touched >= HELD_SHARE else "touch"
    return Derived(verb, f"at rest; near in {motion.touched:.0%} of frames")


def object_motion(clip: Clip, evidence: HandEvidence) -> ObjectMotion:
    """The measures of one clip. The object's middle is that of its bounding box at hinge angle zero: a lid that turns
    does not move it."""
    track, vertices_m = clip.object, clip.object.model.vertices_m
    middle_m = (vertices_m.min(axis=0) + vertices_m.max(axis=0)) / 2
    rotation = rotvec_to_rotmat(track.rotvec.astype(np.float64))
    centre_m = rotation @ middle_m + track.translation_m.astype(np.float64)
    shift_m = centre_m - centre_m[0]
    up = None if clip.gravity is None else -np.asarray(clip.gravity, np.float64)
    height_m = None if up is None else shift_m @ up
    way_m = shift_m if up is None or height_m is None else shift_m - np.maximum(height_m, 0)[:, None] * up
    shakes, shaken = _shakes(centre_m)
    touched = np.any([evidence.near(side) for side in SIDES], axis=0)
    return ObjectMotion(
        hinge_rad=None if track.hinge_rad is None else track.hinge_rad.astype(np.float64),
        height_m=height_m,
        travelled_m=float(np.linalg.norm(way_m, axis=1).max()),
        turned_rad=float(_angles(rotation[0].T @ rotation).max()),
        shakes=shakes,
        shaken_frames=shaken,
        touched=float(touched.mean()),
        n_frames=clip.n_frames,
    )


def _hinge(motion: ObjectMotion) -> Derived | None:
    angle = motion.hinge_rad
    if angle is None or np.ptp(angle) < HINGE_RAD:
        return None
    opened = abs(angle[-1]) - abs(angle[0])
    facts = f"hinge from {angle[0]:.2f} to {angle[-1]:.2f} rad, between {angle.min():.2f} and {angle.max():.2f}"
    if abs(opened) < HINGE_NET * np.ptp(angle):
        return Derived("operate", facts)
    return Derived("open" if opened > 0 else "close", facts)


def _shakes(centre_m: np.ndarray) -> tuple[int, int]:
    """Whole swings of the longest run of fast ones, and the frames it takes; (0, 0) where there are not three."""
    fast = centre_m - uniform_filter1d(centre_m, SLOW_FRAMES, axis=0, mode="nearest")
    axis = np.linalg.svd(fast - fast.mean(axis=0), full_matrices=False)[2][0]
    turns = turning_points(fast @ axis, SHAKE_M)
    best = run = turns[:1]
    for frame in turns[1:]:
        run = [*run, frame] if frame - run[-1] <= SHAKE_GAP else [frame]
        best = max(best, run, key=len)
    halves = len(best) - 1
    return (halves // 2, best[-1] - best[0] + 1) if halves >= SHAKE_HALVES else (0, 0)


def turning_points(signal: np.ndarray, least: float) -> list[int]:
    """Frames at which a signal turns round, in order: between two of them it goes by ``least`` or more. (frame,)."""
    turns: list[int] = []
    low = high = 0  # frames of the extremes since the last turn
    rising: bool | None = None
    for frame, value in enumerate(signal):
        low = frame if value < signal[low] else low
        high = frame if value > signal[high] else high
        if rising is not False and signal[high] - value >= least:
            turns.append(high)
            rising, low = False, frame
        elif rising is not True and value - signal[low] >= least:
            turns.append(low)
            rising, high = True, frame
    return turns


def _angles(rotation: np.ndarray) -> np.ndarray:
    """(frame,) radians of rotation matrices (frame, 3, 3)."""
    return np.arccos(np.clip((np.trace(rotation, axis1=1, axis2=2) - 1) / 2, -1, 1))
