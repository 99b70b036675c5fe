"""Object motion of each verb: keyframes over the phase of the action, joined by minimum-jerk curves.

Shifts are metres from the start position, in the world (z up, person at -y, x to the person's right). Rotations are
degrees about world axes through the object's centre. Defined for the right hand; left hands use the mirror image.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import FPS


class Key(NamedTuple):
    """A keyframe."""

    phase: float  # 0 to 1
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rotation vector
    hinge: float = 0.0  # radians; a fraction of the range in the corpus ``study``


class Swing(NamedTuple):
    """A sine added to the path between two phases."""

    start: float
    stop: float
    cycles: int
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # amplitude
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # amplitude


@dataclass(frozen=True)
class Motion:
    """The motion of an object during an action."""

    keys: tuple[Key, ...]
    swing: Swing | None = None
    lifted_before: int = 0  # frames at 30 fps to lift the object to the first key; 0: the action starts on the table
    lowered_after: int = 0  # frames at 30 fps to lower it after the last key; 0: the action ends on the table


class ObjectPath(NamedTuple):
    """The motion of an object, frame by frame."""

    shift_m: np.ndarray  # (frame, 3)
    rotation_rad: np.ndarray  # (frame, 3) rotation vectors
    hinge_rad: np.ndarray  # (frame,)


UP = (0.0, 0.0, 0.16)
_WAVES = 4


def still(start: float, stop: float, *pose) -> tuple[Key, Key]:
    """Two keys with the same pose: shift, rotation and hinge of ``Key``."""
    return Key(start, *pose), Key(stop, *pose)


def there_and_back(*middle: Key, start: float = 0.08, stop: float = 0.96, swing: Swing | None = None) -> Motion:
    """A motion that rests at its first pose up to the phase ``start`` and from ``stop`` on."""
    return Motion((Key(0), Key(start), *middle, Key(stop), Key(1)), swing)


_REST = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
MOTIONS: dict[str, Motion] = {
    "grab": Motion((Key(0), Key(0.25), *still(0.9, 1, (0, 0, 0.15))), lowered_after=18),
    "grasp": Motion((Key(0), Key(0.35), *still(0.95, 1, (0, 0, 0.06))), lowered_after=14),
    "lift": there_and_back(*still(0.5, 0.62, (0, 0, 0.21), (22, 0, 0)), start=0.15, stop=0.95),
    "place": Motion((Key(0, (0, -0.03, 0.13), (20, 0, 0)), Key(0.55, (0.1, 0.08, 0.1), (0, 14, 0)),
        *still(0.92, 1, (0.1, 0.08, 0))), lifted_before=18),
    "put in": Motion((Key(0), Key(0.1), Key(0.4, (0, 0.04, 0.19)), Key(0.65, (-0.12, 0.12, 0.18)),
        *still(0.95, 1, (-0.12, 0.12, 0)))),
    "take out": Motion((Key(0), Key(0.1), Key(0.4, (0, 0, 0.22)), Key(0.65, (0.14, -0.08, 0.15)),
        *still(0.95, 1, (0.14, -0.08, 0)))),
    "close rigid": there_and_back(Key(0.3, (0, -0.04, 0.09)), Key(0.6, (0, -0.04, 0.09), (18, 0, -12)), start=0.1,
        stop=0.95),
    "open rigid": there_and_back(Key(0.28, (0, -0.08, 0.13)), Key(0.5, (0, -0.08, 0.13), (0, 0, 28)),
        Key(0.72, (0, -0.08, 0.13), (0, 0, -28)), start=0.1, stop=0.95),
    "spray": there_and_back(Key(0.3, (0, 0.06, 0.17)), Key(0.45, (0.05, 0.1, 0.17), (0, 0, -30)),
        Key(0.7, (-0.08, 0.1, 0.17), (0, 0, 30)), start=0.1, stop=0.95),
    "apply": there_and_back(Key(0.28, (-0.06, -0.12, 0.15)), *still(0.4, 0.75, (-0.06, -0.12, 0.15), (40, 0, 0)),
        stop=0.95, swing=Swing(0.4, 0.75, 3, (0.02, 0, 0))),
    "squeeze": there_and_back(Key(0.28, (0, 0, 0.17)), *still(0.42, 0.72, (0, 0.05, 0.19), (-85, 0, 0)), stop=0.95),
    "pour": there_and_back(Key(0.26, UP), *still(0.45, 0.7, (-0.1, 0.05, 0.2), (0, -75, 0)), Key(0.84, (0, 0, 0.12)),
        stop=0.97),
    "read": there_and_back(*still(0.24, 0.78, (0, -0.14, 0.2), (-30, 0, 0)), start=0.07),
    "pass": Motion((Key(0), Key(0.12), Key(0.5, (0, 0.14, 0.13)), *still(0.92, 1, (0, 0.25, 0)))),
    "toast": there_and_back(Key(0.32, (0, 0.02, 0.2)), Key(0.5, (-0.08, 0.16, 0.26), (0, -14, 0)),
        Key(0.7, (0, 0.02, 0.18)), start=0.1),
    "shake": there_and_back(*still(0.25, 0.8, (0, -0.03, 0.17), (0, -30, 0)), stop=0.97,
        swing=Swing(0.25, 0.8, 5, (0, 0, 0.03))),
    "hand over": Motion((Key(0), Key(0.1), Key(0.35, (0.1, -0.02, 0.14)), Key(0.65, (-0.1, 0.08, 0.15)),
        *still(0.95, 1, (-0.1, 0.16, 0)))),
    "eat": there_and_back(Key(0.3, (0, -0.2, 0.27)), Key(0.45, (0, -0.12, 0.2)),
        Key(0.62, (0, -0.2, 0.27), (20, 0, 0))),
    "use": there_and_back(*still(0.26, 0.8, (0, 0.08, 0.14)), stop=0.97,
        swing=Swing(0.26, 0.8, 3, (0, 0, 0.03), (0, 22, 0))),
    "drink": there_and_back(Key(0.28, (0, -0.13, 0.24)), *still(0.42, 0.65, (0, -0.2, 0.27), (50, 0, 0)),
        Key(0.78, (0, -0.13, 0.2)), stop=0.97),
    "inspect": there_and_back(Key(0.2, (0, -0.12, 0.18)), Key(0.35, (0, -0.12, 0.18), (20, 0, 38)),
        Key(0.58, (0, -0.12, 0.18), (20, 0, -38)), Key(0.75, (0, -0.12, 0.18), (-10, 20, 0)), start=0.07, stop=0.97),
    "sprinkle": there_and_back(Key(0.25, (0, 0, 0.18)), *still(0.4, 0.76, (-0.05, 0.06, 0.2), (-95, 0, 0)), stop=0.97,
        swing=Swing(0.4, 0.76, 4, (0, 0, 0.015))),
    "type": there_and_back(*still(0.24, 0.8, (0, -0.14, 0.16), (28, 0, 0)), start=0.07, stop=0.97,
        swing=Swing(0.24, 0.8, 6, (0, 0, 0.004))),
    "open": Motion((*still(0, 0.1, *_REST, 0.4), Key(0.4, (0, 0, 0.09), (-22, 0, 0), 0.4),
        Key(0.54, (0, 0, 0.09), (-22, 0, 0), 0.85), *still(0.97, 1, *_REST, 0.85))),
    "close": Motion((*still(0, 0.1, *_REST, 0.85), Key(0.42, (0, -0.02, 0.07), (-18, 0, 0), 0.85),
        Key(0.58, (0, -0.02, 0.07), (-18, 0, 0), 0.4), *still(0.97, 1, *_REST, 0.4))),
    "operate": Motion((*still(0, 0.1, *_REST, 0.4), Key(0.28, (0, -0.03, 0.05), (-14, 0, 0), 0.4),
        *still(0.38, 0.6, (0, -0.03, 0.05), (-14, 0, 0), 0.85), Key(0.7, (0, -0.03, 0.05), (-14, 0, 0), 0.4),
        *still(0.97, 1, *_REST, 0.4))),
}  # fmt: skip
# Sway of a carried object: rates, standard deviations of shift and rotation, and the height from which it is full.
_SWAY_HZ, SWAY_M, SWAY_DEG, _CARRIED_M = (0.2, 0.6), 0.005, 4.0, 0.06
_MIRRORED_SHIFT = np.array([-1.0, 1.0, 1.0])
_MIRRORED_ROTATION = np.array([1.0, -1.0, -1.0])


def minimum_jerk(fraction: np.ndarray) -> np.ndarray:
    """Map 0..1 to 0..1 with zero velocity and acceleration at both ends; clipped outside."""
    x = np.clip(fraction, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def follow_path(
    motion: Motion, frames: np.ndarray, start: float, length: float, mirrored: bool, size: float, rotation_scale: float
) -> ObjectPath:
    """Evaluate the path of an action, with lifting before and lowering after it.

    frames: (frame,) times in frames at 30 fps, possibly fractions; start and length of the action in the same unit.
    mirrored: a left hand acts. size, rotation_scale: scales of shifts and rotations.
    """
    times = [start + key.phase * length for key in motion.keys]
    keys = np.array([(*key.shift_m, *np.deg2rad(key.rotation_deg), key.hinge) for key in motion.keys], dtype=np.float64)
    if motion.lifted_before:
        times, keys = [start - motion.lifted_before, *times], np.concatenate([_rest(keys[0], at_start=True), keys])
    if motion.lowered_after:
        times.append(start + length + motion.lowered_after)
        keys = np.concatenate([keys, _rest(keys[-1], at_start=False)])
    values = _between(np.array(times), keys, frames)
    if motion.swing is not None:
        values[:, :6] += _swinging(motion.swing, (frames - start) / length)
    shift_m, rotation_rad = values[:, :3] * size, values[:, 3:6] * rotation_scale
    if mirrored:
        shift_m, rotation_rad = shift_m * _MIRRORED_SHIFT, rotation_rad * _MIRRORED_ROTATION
    return ObjectPath(shift_m, rotation_rad, values[:, 6])


def with_sway(
    path: ObjectPath, times: np.ndarray, rng: np.random.Generator, sway_m: float = SWAY_M, sway_deg: float = SWAY_DEG
) -> ObjectPath:
    """Add a slow sway to a carried object."""
    sway = minimum_jerk(path.shift_m[:, 2:] / _CARRIED_M) * waves(times, _SWAY_HZ, 6, rng)
    shift_m, rotation_rad = path.shift_m + sway_m * sway[:, :3], np.deg2rad(sway_deg) * sway[:, 3:]
    return path._replace(shift_m=shift_m, rotation_rad=path.rotation_rad + rotation_rad)


def waves(times: np.ndarray, rates_hz: tuple[float, float], width: int, rng: np.random.Generator) -> np.ndarray:
    """Return (time, width) smooth random numbers of variance 1, sums of sines. times: frames at 30 fps."""
    rate, phase = rng.uniform(*rates_hz, (_WAVES, width)), rng.uniform(0, 2 * np.pi, (_WAVES, width))
    return np.sin(2 * np.pi * times[:, None, None] / FPS * rate + phase).sum(axis=1) * np.sqrt(2 / _WAVES)


def _rest(key: np.ndarray, at_start: bool) -> np.ndarray:
    """Return the key on the table before or after an action: the start position, or straight below the last key."""
    down = key.copy()
    down[0:2] = 0.0 if at_start else key[0:2]
    down[2:6] = 0.0
    return down[None]


def _between(times: np.ndarray, keys: np.ndarray, frames: np.ndarray) -> np.ndarray:
    segment = np.clip(np.searchsorted(times, frames, side="right") - 1, 0, len(times) - 2)
    fraction = minimum_jerk((frames - times[segment]) / (times[segment + 1] - times[segment]))
    return keys[segment] + fraction[:, None] * (keys[segment + 1] - keys[segment])


def _swinging(swing: Swing, phase: np.ndarray) -> np.ndarray:
    fraction = np.clip((phase - swing.start) / (swing.stop - swing.start), 0.0, 1.0)
    envelope = minimum_jerk(5 * fraction) * minimum_jerk(5 * (1 - fraction))
    amplitude = np.array([*swing.shift_m, *np.deg2rad(swing.rotation_deg)])
    return (envelope * np.sin(2 * np.pi * swing.cycles * fraction))[:, None] * amplitude
