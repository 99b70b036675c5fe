"""How objects move under each verb: a few keyframes over the phase of the action, joined by minimum-jerk curves.

Offsets are metres from where the object stood, in the world (z up, person at -y, x to the person's right), rotations
degrees about world axes through the object's middle. Written for the right hand; a left hand's is the mirror image.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class Key(NamedTuple):
    """phase in 0..1; shift (x, y, z) in m; turn (x, y, z) rotation vector in degrees; hinge angle in rad."""

    phase: float
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hinge: float = 0.0


class Swing(NamedTuple):
    """A sine on top of the path between two phases: whole cycles, amplitude of shift (m) and turn (degrees)."""

    start: float
    stop: float
    cycles: int
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Motion:
    """keys: path while the action lasts. lifted_before, lowered_after: 30 fps frames in which the hands, in contact,
    bring the object to the first key before the action and back to the table after it (0: it starts or ends there)."""

    keys: tuple[Key, ...]
    swing: Swing | None = None
    lifted_before: int = 0
    lowered_after: int = 0


class ObjectPath(NamedTuple):
    """shift_m (frame, 3), turn_rad (frame, 3) rotation vectors, hinge_rad (frame,)."""

    shift_m: np.ndarray
    turn_rad: np.ndarray
    hinge_rad: np.ndarray


UP = (0.0, 0.0, 0.16)

MOTIONS: dict[str, Motion] = {
    "grab": Motion((Key(0), Key(0.25), Key(0.9, (0, 0, 0.15)), Key(1, (0, 0, 0.15))), lowered_after=18),
    "grasp": Motion((Key(0), Key(0.35), Key(0.95, (0, 0, 0.06)), Key(1, (0, 0, 0.06))), lowered_after=14),
    "lift": Motion((Key(0), Key(0.15), Key(0.5, (0, 0, 0.21)), Key(0.62, (0, 0, 0.21)), Key(0.95), Key(1))),
    "place": Motion(
        (Key(0, (0, -0.03, 0.13)), Key(0.55, (0.1, 0.08, 0.1)), Key(0.92, (0.1, 0.08, 0)), Key(1, (0.1, 0.08, 0))),
        lifted_before=18,
    ),
    "put in": Motion(
        (Key(0), Key(0.1), Key(0.4, (0, 0.04, 0.19)), Key(0.65, (-0.12, 0.12, 0.18)), Key(0.95, (-0.12, 0.12, 0)),
         Key(1, (-0.12, 0.12, 0)))
    ),
    "take out": Motion(
        (Key(0), Key(0.1), Key(0.4, (0, 0, 0.22)), Key(0.65, (0.14, -0.08, 0.15)), Key(0.95, (0.14, -0.08, 0)),
         Key(1, (0.14, -0.08, 0)))
    ),
    "close rigid": Motion(
        (Key(0), Key(0.1), Key(0.3, (0, -0.04, 0.09)), Key(0.6, (0, -0.04, 0.09), (18, 0, -12)), Key(0.95), Key(1))
    ),
    "open rigid": Motion(
        (Key(0), Key(0.1), Key(0.28, (0, -0.08, 0.13)), Key(0.5, (0, -0.08, 0.13), (0, 0, 28)),
         Key(0.72, (0, -0.08, 0.13), (0, 0, -28)), Key(0.95), Key(1))
    ),
    "spray": Motion(
        (Key(0), Key(0.1), Key(0.3, (0, 0.06, 0.17)), Key(0.45, (0.05, 0.1, 0.17), (0, 0, -30)),
         Key(0.7, (-0.08, 0.1, 0.17), (0, 0, 30)), Key(0.95), Key(1))
    ),
    "apply": Motion(
        (Key(0), Key(0.08), Key(0.28, (-0.06, -0.12, 0.15)), Key(0.4, (-0.06, -0.12, 0.15), (40, 0, 0)),
         Key(0.75, (-0.06, -0.12, 0.15), (40, 0, 0)), Key(0.95), Key(1)),
        Swing(0.4, 0.75, 3, (0.02, 0, 0)),
    ),
    "squeeze": Motion(
        (Key(0), Key(0.08), Key(0.28, (0, 0, 0.17)), Key(0.42, (0, 0.05, 0.19), (-85, 0, 0)),
         Key(0.72, (0, 0.05, 0.19), (-85, 0, 0)), Key(0.95), Key(1))
    ),
    "pour": Motion(
        (Key(0), Key(0.08), Key(0.26, UP), Key(0.45, (-0.1, 0.05, 0.2), (0, -75, 0)),
         Key(0.7, (-0.1, 0.05, 0.2), (0, -75, 0)), Key(0.84, (0, 0, 0.12)), Key(0.97), Key(1))
    ),
    "read": Motion(
        (Key(0), Key(0.07), Key(0.24, (0, -0.14, 0.2), (-30, 0, 0)), Key(0.78, (0, -0.14, 0.2), (-30, 0, 0)),
         Key(0.96), Key(1))
    ),
    "pass": Motion((Key(0), Key(0.12), Key(0.5, (0, 0.14, 0.13)), Key(0.92, (0, 0.25, 0)), Key(1, (0, 0.25, 0)))),
    "toast": Motion(
        (Key(0), Key(0.1), Key(0.32, (0, 0.02, 0.2)), Key(0.5, (-0.08, 0.16, 0.26), (0, -14, 0)),
         Key(0.7, (0, 0.02, 0.18)), Key(0.96), Key(1))
    ),
    "shake": Motion(
        (Key(0), Key(0.08), Key(0.25, (0, -0.03, 0.17)), Key(0.8, (0, -0.03, 0.17)), Key(0.97), Key(1)),
        Swing(0.25, 0.8, 5, (0, 0, 0.03)),
    ),
    "hand over": Motion(
        (Key(0), Key(0.1), Key(0.35, (0.1, -0.02, 0.14)), Key(0.65, (-0.1, 0.08, 0.15)), Key(0.95, (-0.1, 0.16, 0)),
         Key(1, (-0.1, 0.16, 0)))
    ),
    "eat": Motion(
        (Key(0), Key(0.08), Key(0.3, (0, -0.2, 0.27)), Key(0.45, (0, -0.12, 0.2)),
         Key(0.62, (0, -0.2, 0.27), (20, 0, 0)), Key(0.96), Key(1))
    ),
    "use": Motion(
        (Key(0), Key(0.08), Key(0.26, (0, 0.08, 0.14)), Key(0.8, (0, 0.08, 0.14)), Key(0.97), Key(1)),
        Swing(0.26, 0.8, 3, (0, 0, 0.03), (0, 22, 0)),
    ),
    "drink": Motion(
        (Key(0), Key(0.08), Key(0.28, (0, -0.13, 0.24)), Key(0.42, (0, -0.2, 0.27), (50, 0, 0)),
         Key(0.65, (0, -0.2, 0.27), (50, 0, 0)), Key(0.78, (0, -0.13, 0.2)), Key(0.97), Key(1))
    ),
    "inspect": Motion(
        (Key(0), Key(0.07), Key(0.2, (0, -0.12, 0.18)), Key(0.35, (0, -0.12, 0.18), (20, 0, 38)),
         Key(0.58, (0, -0.12, 0.18), (20, 0, -38)), Key(0.75, (0, -0.12, 0.18), (-10, 20, 0)), Key(0.97), Key(1))
    ),
    "sprinkle": Motion(
        (Key(0), Key(0.08), Key(0.25, (0, 0, 0.18)), Key(0.4, (-0.05, 0.06, 0.2), (-95, 0, 0)),
         Key(0.76, (-0.05, 0.06, 0.2), (-95, 0, 0)), Key(0.97), Key(1)),
        Swing(0.4, 0.76, 4, (0, 0, 0.015)),
    ),
    "type": Motion(
        (Key(0), Key(0.07), Key(0.24, (0, -0.14, 0.16), (28, 0, 0)), Key(0.8, (0, -0.14, 0.16), (28, 0, 0)),
         Key(0.97), Key(1)),
        Swing(0.24, 0.8, 6, (0, 0, 0.004)),
    ),
    "open": Motion(
        (Key(0, hinge=0.4), Key(0.1, hinge=0.4), Key(0.3, (0, 0, 0.09), hinge=0.4),
         Key(0.75, (0, 0, 0.09), hinge=0.85), Key(0.97, hinge=0.85), Key(1, hinge=0.85))
    ),
    "close": Motion(
        (Key(0, hinge=0.85), Key(0.1, hinge=0.85), Key(0.3, (0, -0.02, 0.07), hinge=0.85),
         Key(0.72, (0, -0.02, 0.07), hinge=0.4), Key(0.97, hinge=0.4), Key(1, hinge=0.4))
    ),
    "operate": Motion(
        (Key(0, hinge=0.4), Key(0.1, hinge=0.4), Key(0.25, (0, -0.03, 0.05), hinge=0.4),
         Key(0.42, (0, -0.03, 0.05), hinge=0.85), Key(0.58, (0, -0.03, 0.05), hinge=0.85),
         Key(0.78, (0, -0.03, 0.05), hinge=0.4), Key(0.97, hinge=0.4), Key(1, hinge=0.4))
    ),
}  # fmt: skip
_MIRRORED_SHIFT = np.array([-1.0, 1.0, 1.0])
_MIRRORED_TURN = np.array([1.0, -1.0, -1.0])


def minimum_jerk(share: np.ndarray) -> np.ndarray:
    """0 to 1 with zero velocity and acceleration at both ends; clipped outside."""
    x = np.clip(share, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def follow_path(
    motion: Motion, frames: np.ndarray, start: float, length: float, mirrored: bool, size: float, turn_size: float
) -> ObjectPath:
    """The path at times ``frames`` (30 fps units, may be fractions) of an action from ``start`` lasting ``length``.

    Before and after it the object is lifted and lowered as the motion says. size, turn_size scale shifts and turns.
    """
    times = [start + key.phase * length for key in motion.keys]
    keys = np.array([(*key.shift, *np.deg2rad(key.turn), key.hinge) for key in motion.keys], dtype=np.float64)
    if motion.lifted_before:
        times, keys = [start - motion.lifted_before, *times], np.concatenate([_rest(keys[0], at_start=True), keys])
    if motion.lowered_after:
        times.append(start + length + motion.lowered_after)
        keys = np.concatenate([keys, _rest(keys[-1], at_start=False)])
    values = _between(np.array(times), keys, frames)
    if motion.swing is not None:
        values[:, :6] += _swinging(motion.swing, (frames - start) / length)
    shift, turn = values[:, :3] * size, values[:, 3:6] * turn_size
    if mirrored:
        shift, turn = shift * _MIRRORED_SHIFT, turn * _MIRRORED_TURN
    return ObjectPath(shift, turn, values[:, 6])


def _rest(key: np.ndarray, at_start: bool) -> np.ndarray:
    """The table below a key: where the object started, or straight down from where it is."""
    down = key.copy()
    down[0:2] = 0.0 if at_start else key[0:2]
    down[2:6] = 0.0
    return down[None]


def _between(times: np.ndarray, keys: np.ndarray, frames: np.ndarray) -> np.ndarray:
    segment = np.clip(np.searchsorted(times, frames, side="right") - 1, 0, len(times) - 2)
    share = minimum_jerk((frames - times[segment]) / (times[segment + 1] - times[segment]))
    return keys[segment] + share[:, None] * (keys[segment + 1] - keys[segment])


def _swinging(swing: Swing, phase: np.ndarray) -> np.ndarray:
    share = np.clip((phase - swing.start) / (swing.stop - swing.start), 0.0, 1.0)
    envelope = minimum_jerk(5 * share) * minimum_jerk(5 * (1 - share))
    amplitude = np.array([*swing.shift, *np.deg2rad(swing.turn)])
    return (envelope * np.sin(2 * np.pi * swing.cycles * share))[:, None] * amplitude
