"""Derives the verb of an unlabelled clip from the motion of the object and of its hinge.

The verb describes the motion, not its purpose: a bottle that is shaken to sprinkle gets "shake". The first rule of
``derive_verb`` that applies decides.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from hoidata.clips import FPS, SIDES, Clip
from hoidata.geometry.rotations import rotation_angle, rotvec_to_rotmat
from hoidata.store.hand_evidence import HandEvidence

# All thresholds are ours. A smaller hinge rotation can be a side effect of the grasp.
HINGE_RAD = np.deg2rad(15)
MIN_NET_HINGE_FRACTION = 0.5  # net rotation over range: above it the verb is open or close, below it both
LEVERS = frozenset({"espressomachine"})  # objects whose hinged part is a lever: it neither opens nor closes them
# Higher than LIFTED_M is a lift; below RAISED_M the object has not left its support (ManipNet's 1.5 cm).
LIFTED_M, RAISED_M = 0.10, 0.015
LOWERED_M = 0.05
TURNED_RAD, MOVED_M = np.deg2rad(30), 0.05
# Shaking: three oscillations of 1.5 cm peak to peak, each half period within a third of a second, over a fifth of the
# clip or more. Motion slower than about 1.5 Hz is subtracted first.
SHAKE_M, SHAKE_HALF_PERIODS, SHAKE_GAP_FRAMES, MIN_SHAKE_FRACTION = 0.015, 6, FPS // 3, 0.2
SLOW_FRAMES = FPS // 2
MIN_HOLD_FRACTION = 0.8  # of frames with contact: above it an object is held, below it touched
# An object rests on its support if its lowest point rises and sinks by less than STILL_M: a hand may slide or turn it
# there, but cannot carry it as steadily. Without gravity, the whole motion has to be that small.
STILL_M, STILL_RAD = 0.003, np.deg2rad(2)
REST_FRAMES, REST_M = FPS // 6, 0.015  # a placed object moves by less in its last frames


class Derived(NamedTuple):
    """A derived verb."""

    verb: str  # base form
    evidence: str  # the measured motion, as text


@dataclass(frozen=True)
class ObjectMotion:
    """Measures of one clip that the rules use."""

    hinge_rad: np.ndarray | None  # (frame,); None for a rigid object
    height_m: np.ndarray | None  # (frame,) height of the object's centre above the first frame; None without gravity
    travelled_m: float  # greatest distance from the first position, without the rise if gravity is known
    turned_rad: float  # greatest angle to the first orientation
    shakes: int  # number of whole oscillations
    shaken_frames: int  # number of frames that they take
    touched: float  # fraction of frames in which a hand is close
    is_supported: bool  # the object rests on its support in all frames
    ends_at_rest: bool  # the object hardly moves in the last frames
    n_frames: int


def derive_verb(clip: Clip, evidence: HandEvidence) -> Derived:
    """Derive the verb from the motion of a clip. The first rule that applies decides:

    - open, close: the hinge rotates by 15 degrees or more, away from or towards zero (closed, in ARCTIC).
    - open and close, close and open: the hinge rotates as far and returns.
    - operate: as the rules above, if the hinged part is a lever (``LEVERS``).
    - shake: three fast oscillations or more.
    - place: the object ends 5 cm lower than it starts, at rest. Needs ``clip.gravity``, like lift and grasp.
    - lift: the object rises by 10 cm or more.
    - turn: it rotates by 30 degrees or more.
    - move: it moves by 5 cm or more.
    - grasp: it rises by 1.5 cm or more.
    - hold, or touch if the object stays on its support or hands are close in less than 80 % of the frames.

    evidence: hand distances of the same clip, at the threshold of its hand type.
    """
    motion = object_motion(clip, evidence)
    height_m, hinge = motion.height_m, _hinge(motion, clip.object.model.name)
    highest_m, last_m = (0.0, 0.0) if height_m is None else (float(height_m.max()), float(height_m[-1]))
    if hinge is not None:
        return hinge
    if motion.shaken_frames >= MIN_SHAKE_FRACTION * motion.n_frames:
        return Derived("shake", f"{motion.shakes} swings in {motion.shaken_frames / FPS:.1f} s")
    if last_m <= -LOWERED_M and motion.ends_at_rest:
        return Derived("place", f"ends {-last_m * 100:.1f} cm lower")
    if highest_m >= LIFTED_M:
        return Derived("lift", f"rises {highest_m * 100:.1f} cm")
    if motion.turned_rad >= TURNED_RAD:
        return Derived("turn", f"turns {np.rad2deg(motion.turned_rad):.0f} degrees")
    if motion.travelled_m >= MOVED_M:
        return Derived("move", f"moves {motion.travelled_m * 100:.1f} cm")
    if highest_m >= RAISED_M:
        return Derived("grasp", f"rises {highest_m * 100:.1f} cm, and does not leave its place")
    verb = "hold" if motion.touched >= MIN_HOLD_FRACTION and not motion.is_supported else "touch"
    return Derived(verb, f"at rest; near in {motion.touched:.0%} of frames")


def object_motion(clip: Clip, evidence: HandEvidence) -> ObjectMotion:
    """Measure one clip. The object's centre is that of its bounding box at hinge angle zero, so lids do not move it."""
    track, vertices_m = clip.object, clip.object.model.vertices_m
    local_centre_m = (vertices_m.min(axis=0) + vertices_m.max(axis=0)) / 2
    rotation = rotvec_to_rotmat(track.rotvec.astype(np.float64))
    centre_m = rotation @ local_centre_m + track.translation_m.astype(np.float64)
    shift_m = centre_m - centre_m[0]
    up = None if clip.gravity is None else -np.asarray(clip.gravity, np.float64)
    height_m = None if up is None else shift_m @ up
    travel_m = shift_m if up is None or height_m is None else shift_m - np.maximum(height_m, 0)[:, None] * up
    shakes, shaken = _shakes(centre_m)
    turned_rad = float(rotation_angle(rotation[0].T @ rotation).max())
    angle_rad = track.joint_angle_rad
    hinge_range_rad = 0.0 if angle_rad is None else float(np.ptp(angle_rad))
    is_still = np.ptp(centre_m, axis=0).max() < STILL_M and max(turned_rad, hinge_range_rad) < STILL_RAD
    touched = np.any([evidence.near(side) for side in SIDES], axis=0)
    return ObjectMotion(
        hinge_rad=None if angle_rad is None else angle_rad.astype(np.float64),
        height_m=height_m,
        travelled_m=float(np.linalg.norm(travel_m, axis=1).max()),
        turned_rad=turned_rad,
        shakes=shakes,
        shaken_frames=shaken,
        touched=float(touched.mean()),
        is_supported=bool(is_still or (up is not None and np.ptp(track.lowest_m(up)) < STILL_M)),
        ends_at_rest=bool(np.ptp(centre_m[-REST_FRAMES:], axis=0).max() < REST_M),
        n_frames=clip.n_frames,
    )


def _hinge(motion: ObjectMotion, object_name: str) -> Derived | None:
    angle = motion.hinge_rad
    if angle is None or np.ptp(angle) < HINGE_RAD:
        return None
    opened = abs(angle[-1]) - abs(angle[0])
    facts = f"hinge from {angle[0]:.2f} to {angle[-1]:.2f} rad, between {angle.min():.2f} and {angle.max():.2f}"
    if object_name in LEVERS:
        return Derived("operate", facts)
    if abs(opened) < MIN_NET_HINGE_FRACTION * np.ptp(angle):
        middle = abs(angle[np.abs(angle - angle[0]).argmax()])
        return Derived("open and close" if middle > abs(angle[0]) else "close and open", facts)
    return Derived("open" if opened > 0 else "close", facts)


def _shakes(centre_m: np.ndarray) -> tuple[int, int]:
    """Return the number of oscillations in the longest run of fast ones, and its frames; (0, 0) below three."""
    fast = centre_m - uniform_filter1d(centre_m, SLOW_FRAMES, axis=0, mode="nearest")
    axis = np.linalg.svd(fast - fast.mean(axis=0), full_matrices=False)[2][0]
    turning_frames = turning_points(fast @ axis, SHAKE_M)
    best = run = turning_frames[:1]
    for frame in turning_frames[1:]:
        run = [*run, frame] if frame - run[-1] <= SHAKE_GAP_FRAMES else [frame]
        best = max(best, run, key=len)
    half_periods = len(best) - 1
    return (half_periods // 2, best[-1] - best[0] + 1) if half_periods >= SHAKE_HALF_PERIODS else (0, 0)


def turning_points(signal: np.ndarray, least: float) -> list[int]:
    """Return the frames at which a signal (frame,) reverses; between two reversals it changes by ``least`` or more."""
    reversals: list[int] = []
    low = high = 0  # frames of the extremes since the last reversal
    rising: bool | None = None
    for frame, value in enumerate(signal):
        low = frame if value < signal[low] else low
        high = frame if value > signal[high] else high
        if rising is not False and signal[high] - value >= least:
            reversals.append(high)
            rising, low = False, frame
        elif rising is not True and value - signal[low] >= least:
            reversals.append(low)
            rising, high = True, frame
    return reversals
