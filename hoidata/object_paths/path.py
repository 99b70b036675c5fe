"""Smooth object motions at 30 frames per second, with checks of hinge angle, speed, acceleration and table height.

World: metres, z up, the table at height 0, x to the right and y away from the person. The object starts on the table at
hinge angle 0, with the centre of its bounding box above the world's origin. It rotates about that centre.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BPoly, PchipInterpolator
from scipy.spatial import ConvexHull, QhullError

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.objects.model import ObjectModel, articulate

MAX_S = 120.0
# Unit of a speed: the largest speed and acceleration of a hand that carries an object.
LIMITS = {
    "m/s": (2.5, 40.0),
    "rad/s": (12.0, 200.0),
    "rad/s of the hinge": (12.0, 200.0),
    "m/s of the slide": (2.5, 40.0),
}
# Minimum-jerk motion from stop to stop: peak speed x time / distance, and peak acceleration x time^2 / distance.
MINIMUM_JERK_PEAKS = 15 / 8, 10 / math.sqrt(3)
ANY_HINGE_RAD, ANY_SLIDE_M = (-math.pi, math.pi), (-2.0, 2.0)  # of joints without known limits
TABLE_TOLERANCE_M = 0.003  # meshes do not stand on the table exactly
ANGLE_TOLERANCE_RAD, SLIDE_TOLERANCE_M = np.radians(0.5), 0.001
_CHUNK_FRAMES = 64


@dataclass(frozen=True)
class PathStep:
    """A time interval of a path, and its description for messages and pages."""

    words: str
    start_s: float
    end_s: float


@dataclass(frozen=True, eq=False)
class ObjectPath:
    """A checked object motion."""

    track: ObjectTrack
    steps: tuple[PathStep, ...]
    limits_rad: tuple[float, float] | None = None  # smallest and largest joint position, if known


def smooth(time_s: np.ndarray, values: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Interpolate keys by a quintic spline with continuous velocity and acceleration.

    The acceleration is zero at the keys. The velocity at a key is that of a monotone cubic (Fritsch and Carlson 1980),
    so that the curve does not overshoot. Between two stops this is the minimum-jerk motion (Flash and Hogan 1985).
    time_s: (key,) ascending. values: (key, ...). at_s: (frame,) times of the result.
    Returns (frame, ...) interpolated values.
    """
    slope = np.zeros_like(values)
    if len(time_s) > 2:
        slope = PchipInterpolator(time_s, values).derivative()(time_s)
        slope[[0, -1]] = 0.0
    return BPoly.from_derivatives(time_s, np.stack((values, slope, np.zeros_like(values)), axis=1))(at_s)


def frame_times(end_s: float) -> np.ndarray:
    """(frame,) times in seconds from 0 to ``end_s``, 30 per second."""
    return np.arange(round(end_s * FPS) + 1) / FPS


def checked_path(
    model: ObjectModel,
    shift_m: np.ndarray,
    rotmats: np.ndarray,
    hinge_rad: np.ndarray,
    steps: Sequence[PathStep],
    limits_rad: tuple[float, float] | None = None,
    standing: np.ndarray | None = None,
) -> ObjectPath:
    """Build the path of an object and check it.

    Args:
        shift_m: (frame, 3) translation from the start.
        rotmats: (frame, 3, 3) rotation from the start, about the centre of the bounding box.
        hinge_rad: (frame,) joint position as in ``ObjectTrack``.
        steps: time intervals, for error messages.
        limits_rad: smallest and largest joint position, if known.
        standing: (3, 3) world-from-object at the start, if the object's z axis is not up.

    Raises BadInput: the angle is outside the limits, a speed or acceleration is beyond a hand's, or the object is below
    the table.
    """
    standing = np.eye(3) if standing is None else standing
    standing_m = model.vertices_m @ standing.T
    low, high = standing_m.min(axis=0), standing_m.max(axis=0)
    centre, rotmats = standing.T @ (low + high) / 2, rotmats @ standing
    centre_world_m = shift_m + np.array([0.0, 0.0, (high[2] - low[2]) / 2])
    translation = (centre_world_m - rotmats @ centre).astype(np.float32)
    hinge = hinge_rad.astype(np.float32) if model.is_articulated else None
    track = ObjectTrack(model, rotmat_to_rotvec(rotmats).astype(np.float32), translation, hinge)
    path = ObjectPath(track, tuple(steps), limits_rad)
    check_joint_range(model, hinge_rad, limits_rad or _any_range(model), "object path", steps)
    _check_rates(path, shift_m, rotmats, hinge_rad)
    _check_table(path, translation.astype(np.float64), rotmats)
    return path


def _step_at(steps: Sequence[PathStep], frame: int) -> str:
    """Time of a frame and the steps it belongs to, for messages."""
    words = [step.words for step in _steps_at(steps, frame)]
    return f"{frame / FPS:.2f} s" + (f" ({'; '.join(words)})" if words else "")


def _steps_at(steps: Sequence[PathStep], frame: int) -> list[PathStep]:
    return [step for step in steps if step.start_s - 1e-6 <= frame / FPS <= step.end_s + 1e-6]


def check_joint_kind(model: ObjectModel, is_slide: bool, source: str | Path) -> None:
    """Raise BadInput if a motion of a slide is for an object that turns, or the other way round.

    source: the motion, for the message.
    """
    if model.hinge is None or model.hinge.is_prismatic == is_slide:
        return
    kinds = ("a hinge angle in radians", "a slide in metres")
    verb, column = ("slides", "slide_cm") if model.hinge.is_prismatic else ("turns", "hinge_deg")
    expected = f"{kinds[model.hinge.is_prismatic]}: {model.name!r} {verb}"
    remedy = f"give the object of this motion, or --keyframes with a column {column}"
    raise BadInput(source, expected, kinds[is_slide], remedy)


def check_joint_range(
    model: ObjectModel,
    hinge_rad: np.ndarray | None,
    limits_rad: tuple[float, float] | None,
    source: str | Path,
    steps: Sequence[PathStep] = (),
) -> None:
    """Raise BadInput if a joint leaves its limits; nothing is checked if positions or limits are None.

    Args:
        hinge_rad: (frame,) joint positions, radians or metres.
        limits_rad: smallest and largest joint position.
        source: the motion, for the message.
        steps: time intervals, for the message.
    """
    if hinge_rad is None or limits_rad is None or not len(hinge_rad):
        return
    slides = model.hinge is not None and model.hinge.is_prismatic
    beyond = np.maximum(hinge_rad - limits_rad[1], limits_rad[0] - hinge_rad)
    outside, frame = beyond > (SLIDE_TOLERANCE_M if slides else ANGLE_TOLERANCE_RAD), int(beyond.argmax())
    if not outside.any():
        return
    expected = f"{'a slide' if slides else 'a hinge angle'} of {joint_range_words(limits_rad, slides)}"
    if model.hinge is not None and (rest := model.hinge.file_position):
        expected += f", counted from the URDF's limit of {_position_words(rest, slides)}, where the mesh rests"
    got = f"{_position_words(hinge_rad[frame], slides)}, from {_step_at(steps, int(outside.argmax()))} on"
    raise BadInput(source, expected, got, "keep the joint within, or give its range (--hinge-range)")


def _any_range(model: ObjectModel) -> tuple[float, float]:
    """The limits of a joint without known limits."""
    return ANY_SLIDE_M if model.hinge is not None and model.hinge.is_prismatic else ANY_HINGE_RAD


def _position_words(position: float, slides: bool) -> str:
    return f"{100 * position:.1f} cm" if slides else f"{np.degrees(position):.0f} deg"


def joint_range_words(limits: tuple[float, float], slides: bool) -> str:
    """A range of joint positions, such as "0 to 110 deg" or "0.0 to 30.0 cm"."""
    if slides:
        return f"{100 * limits[0]:.1f} to {100 * limits[1]:.1f} cm"
    return f"{np.degrees(limits[0]):.0f} to {np.degrees(limits[1]):.0f} deg"


def joint_rate(model: ObjectModel) -> str:
    """The key of ``LIMITS`` for the joint of an object."""
    return "m/s of the slide" if model.hinge is not None and model.hinge.is_prismatic else "rad/s of the hinge"


def check_mean_rate(step: PathStep, change: np.ndarray, unit: str) -> None:
    """Raise BadInput if the mean speed of a step is too high, as a step between two frames escapes other checks.

    change: (n,) from the start to the end of the step, metres or radians.
    """
    size, duration_s = float(np.linalg.norm(change)), step.end_s - step.start_s
    speed_limit, acceleration_limit = LIMITS[unit]
    if size > speed_limit * duration_s:
        needed_s = max(
            MINIMUM_JERK_PEAKS[0] * size / speed_limit, math.sqrt(MINIMUM_JERK_PEAKS[1] * size / acceleration_limit)
        )
        got = f"{size / duration_s:.3g} in {step.words!r}"
        raise BadInput("object path", f"at most {speed_limit:g} {unit}", got, _slower(step, needed_s))


def _check_rates(path: ObjectPath, shift_m: np.ndarray, rotmats: np.ndarray, hinge_rad: np.ndarray) -> None:
    rates = list(_rates(path.track.model, shift_m, rotmats, hinge_rad))
    for rate in rates:
        frame = int(rate.size.argmax())
        if rate.size[frame] > rate.limit:
            steps = _steps_at(path.steps, frame) or [PathStep("it", 0.0, (len(shift_m) - 1) / FPS)]
            longest = max(steps, key=lambda step: step.end_s - step.start_s)
            frames = slice(math.floor(longest.start_s * FPS), math.ceil(longest.end_s * FPS) + 1)
            factor = max(other.slowdown(frames) for other in rates)
            remedy = _slower(longest, factor * (longest.end_s - longest.start_s))
            got = f"{rate.size[frame]:.3g} at {_step_at(path.steps, frame)}"
            raise BadInput("object path", rate.expected, got, remedy)


def check_pace(track: ObjectTrack, pace: float, source: str) -> None:
    """Raise BadInput if a motion slowed down by the factor ``pace`` is still too fast for a hand.

    source: where the motion is from, for the message.
    """
    centre = (track.model.vertices_m.min(axis=0) + track.model.vertices_m.max(axis=0)) / 2
    hinge = np.zeros(track.n_frames) if track.hinge_rad is None else track.hinge_rad.astype(np.float64)
    pose = track.world_from_object
    rates = list(_rates(track.model, (pose @ centre[None])[:, 0], pose.rotation, hinge))
    for rate in rates:
        largest = float(rate.size.max()) / pace**rate.order
        if largest > rate.limit:
            seconds = (track.n_frames - 1) / FPS * max(other.slowdown(slice(None)) for other in rates)
            raise BadInput(source, rate.expected, f"{largest:.3g}", f"ask for {_rounded_up(seconds):.1f} s or more")


class _Rate(NamedTuple):
    """Norm of a time derivative in every frame, and the largest that a hand reaches."""

    unit: str
    order: int  # 1: speed, 2: acceleration
    size: np.ndarray  # (frame,)
    limit: float

    @property
    def expected(self) -> str:
        """The limit with its unit, for messages."""
        return f"at most {self.limit:g} {self.unit.replace('/s', '/s²') if self.order == 2 else self.unit}"

    def slowdown(self, frames: slice) -> float:
        """The factor by which these frames must be slowed down to stay within the limit."""
        return (float(self.size[frames].max(initial=0.0)) / self.limit) ** (1 / self.order)


def _rates(model: ObjectModel, position_m: np.ndarray, rotmats: np.ndarray, hinge_rad: np.ndarray) -> Iterator[_Rate]:
    """Speed and acceleration of translation, rotation and joint, if there are enough frames."""
    angular = rotmat_to_rotvec(rotmats[1:] @ rotmats[:-1].swapaxes(1, 2)) * FPS
    velocities = np.diff(position_m, axis=0) * FPS, angular, np.diff(hinge_rad)[:, None] * FPS
    for unit, velocity in zip(("m/s", "rad/s", joint_rate(model)), velocities, strict=True):
        for order, values in ((1, velocity), (2, np.diff(velocity, axis=0) * FPS)):
            if len(values):
                yield _Rate(unit, order, np.linalg.norm(values, axis=1), LIMITS[unit][order - 1])


def _slower(step: PathStep, needed_s: float) -> str:
    """The remedy for a step that is too fast."""
    times = f"{_rounded_up(needed_s / (step.end_s - step.start_s)):.1f} times as long"
    return f"give {step.words!r} {_rounded_up(needed_s):.1f} s or more ({times}), or check the units"


def _rounded_up(value: float) -> float:
    """Rounded up to a tenth."""
    return (math.floor(10 * value) + 1) / 10


def _check_table(path: ObjectPath, translation_m: np.ndarray, rotmats: np.ndarray) -> None:
    """Raise BadInput if the lowest point of a frame, from the convex hulls of the parts, is below the table."""
    track = path.track
    points, part = _hull(track.model)
    height = np.empty(len(rotmats))
    for start in range(0, len(rotmats), _CHUNK_FRAMES):
        frames = slice(start, start + _CHUNK_FRAMES)
        hinge = None if track.hinge_rad is None else track.hinge_rad[frames]
        posed = articulate(points, part, track.model.hinge, hinge)
        height[frames] = (posed @ rotmats[frames, 2, :, None])[..., 0].min(axis=1) + translation_m[frames, 2]
    frame = int(height.argmin())
    if height[frame] < -TABLE_TOLERANCE_M:
        first = int((height < -TABLE_TOLERANCE_M).argmax())
        got = f"{-height[frame] * 100:.1f} cm under it, from {_step_at(path.steps, first)} on"
        remedy = f"lift it by {np.ceil(-height[frame] * 100):.0f} cm more before, or lower it less"
        raise BadInput("object path", "an object above the table", got, remedy)


def _hull(model: ObjectModel) -> tuple[np.ndarray, np.ndarray]:
    """Hull vertices (point, 3) of each part, and the part of each; all vertices of a part without volume."""
    hulls = []
    for part in np.unique(model.part):
        vertices = np.flatnonzero(model.part == part)
        with suppress(QhullError, ValueError):
            vertices = vertices[ConvexHull(model.vertices_m[vertices]).vertices]
        hulls.append(vertices)
    vertices = np.concatenate(hulls)
    return model.vertices_m[vertices], model.part[vertices]
