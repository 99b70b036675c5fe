"""A motion of an object that nobody recorded, 30 frames per second, and whether it can be.

World: metres, z up, the table at height 0, x to the right and y away from the person. The object begins where it stands
on the table at hinge angle 0, the middle of its bounding box above the world's origin, and turns about that middle.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BPoly, PchipInterpolator
from scipy.spatial import ConvexHull, QhullError

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.objects.model import ObjectModel, articulate

MOST_S = 120.0
MOST_SPEED_M_S, MOST_ACCELERATION_M_S2 = 2.5, 40.0  # a hand with something in it; both are rarely reached
MOST_TURN_RAD_S, MOST_TURN_RAD_S2 = 12.0, 200.0
LIMITS = {
    "m/s": (MOST_SPEED_M_S, MOST_ACCELERATION_M_S2),
    "rad/s": (MOST_TURN_RAD_S, MOST_TURN_RAD_S2),
    "rad/s of the hinge": (MOST_TURN_RAD_S, MOST_TURN_RAD_S2),
}
LEAST_JERK = 15 / 8, 10 / math.sqrt(3)  # greatest speed x time / way, and acceleration x time^2 / way, stop to stop
ANY_HINGE_RAD = (-math.pi, math.pi)  # where nobody says how far it opens
TABLE_M = 0.003  # that an object may sink in: meshes do not stand on it exactly
ANGLE_RAD = np.radians(0.5)  # that an angle may pass the stop by
_CHUNK = 64


@dataclass(frozen=True)
class PathStep:
    """One step of a path: its words, and when it begins and ends, seconds."""

    words: str
    start_s: float
    end_s: float


@dataclass(frozen=True, eq=False)
class ObjectPath:
    """track: the motion. steps: what happens when. limits_rad: the stops of the hinge, as far as they are known."""

    track: ObjectTrack
    steps: tuple[PathStep, ...]
    limits_rad: tuple[float, float] | None = None


def smooth(time_s: np.ndarray, values: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """(frame, ...) values at ``at_s`` of a curve through ``values (key, ...)`` at ``time_s (key,)``.

    Velocity and acceleration are continuous: quintic pieces whose acceleration is zero at the keys and whose velocity
    there is that of a monotone curve (Fritsch and Carlson 1980), so that nothing overshoots. Between two stops it is
    the motion of least jerk (Flash and Hogan 1985).
    """
    slope = np.zeros_like(values)
    if len(time_s) > 2:
        slope = PchipInterpolator(time_s, values).derivative()(time_s)
        slope[[0, -1]] = 0.0
    return BPoly.from_derivatives(time_s, np.stack((values, slope, np.zeros_like(values)), axis=1))(at_s)


def frame_times(end_s: float) -> np.ndarray:
    """(frame,) seconds, 30 in each, up to ``end_s``."""
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
    """The path of an object, once it is found possible.

    shift_m: (frame, 3) way from the start; rotmats: (frame, 3, 3) of the object against its start; hinge_rad: (frame,).
    standing: (3, 3) world from object at the start, where the object's own z is not up.
    Raises BadInput for an angle beyond the stop, a speed or acceleration no hand has, or an object under the table.
    """
    standing = np.eye(3) if standing is None else standing
    stood = model.vertices_m @ standing.T
    low, high = stood.min(axis=0), stood.max(axis=0)
    middle, rotmats = standing.T @ (low + high) / 2, rotmats @ standing
    place = shift_m + np.array([0.0, 0.0, (high[2] - low[2]) / 2])
    translation = (place - rotmats @ middle).astype(np.float32)
    hinge = hinge_rad.astype(np.float32) if model.is_articulated else None
    track = ObjectTrack(model, rotmat_to_rotvec(rotmats).astype(np.float32), translation, hinge)
    path = ObjectPath(track, tuple(steps), limits_rad)
    _check_angle(path, hinge_rad)
    _check_rates(path, shift_m, rotmats, hinge_rad)
    _check_table(path, translation.astype(np.float64), rotmats)
    return path


def _step_at(path: ObjectPath, frame: int) -> str:
    """Which step the frame belongs to, and its time, in words."""
    inside = [step.words for step in _steps_at(path, frame)]
    return f"{frame / FPS:.2f} s" + (f" ({'; '.join(inside)})" if inside else "")


def _steps_at(path: ObjectPath, frame: int) -> list[PathStep]:
    return [step for step in path.steps if step.start_s - 1e-6 <= frame / FPS <= step.end_s + 1e-6]


def _check_angle(path: ObjectPath, hinge_rad: np.ndarray) -> None:
    low, high = path.limits_rad or ANY_HINGE_RAD
    beyond = np.maximum(hinge_rad - high, low - hinge_rad)
    frame = int(beyond.argmax())
    if beyond[frame] > ANGLE_RAD:
        expected = f"a hinge angle of {np.degrees(low):.0f} to {np.degrees(high):.0f} deg"
        first = int((beyond > ANGLE_RAD).argmax())
        got = f"{np.degrees(hinge_rad[frame]):.0f} deg, from {_step_at(path, first)} on"
        raise BadInput(
            "object path", expected, got, "ask for an angle within, or tell the hinge's range (--hinge-range)"
        )


def check_mean_rate(step: PathStep, way: np.ndarray, unit: str) -> None:
    """Raise BadInput for a step that is too fast on the mean: frames do not see what happens between them.

    way: (n,) metres, or a turn in radians, from its begin to its end.
    """
    size, span, (limit, most_change) = float(np.linalg.norm(way)), step.end_s - step.start_s, LIMITS[unit]
    if size > limit * span:
        enough = max(LEAST_JERK[0] * size / limit, math.sqrt(LEAST_JERK[1] * size / most_change))
        got = f"{size / span:.3g} in {step.words!r}"
        raise BadInput("object path", f"at most {limit:g} {unit}", got, _slower(step, enough))


def _check_rates(path: ObjectPath, shift_m: np.ndarray, rotmats: np.ndarray, hinge_rad: np.ndarray) -> None:
    kinds = list(_rates(shift_m, rotmats, hinge_rad))
    for kind in kinds:
        frame = int(kind.size.argmax())
        if kind.size[frame] > kind.limit:
            inside = _steps_at(path, frame) or [PathStep("it", 0.0, (len(shift_m) - 1) / FPS)]
            longest = max(inside, key=lambda step: step.end_s - step.start_s)
            own = slice(math.floor(longest.start_s * FPS), math.ceil(longest.end_s * FPS) + 1)
            factor = max(other.factor(own) for other in kinds)
            remedy = _slower(longest, factor * (longest.end_s - longest.start_s))
            raise BadInput("object path", kind.expected, f"{kind.size[frame]:.3g} at {_step_at(path, frame)}", remedy)


def check_pace(track: ObjectTrack, pace: float, where: str) -> None:
    """Raise BadInput where a motion that lasts ``pace`` times as long is faster than a hand."""
    middle = (track.model.vertices_m.min(axis=0) + track.model.vertices_m.max(axis=0)) / 2
    hinge = np.zeros(track.n_frames) if track.hinge_rad is None else track.hinge_rad.astype(np.float64)
    pose = track.world_from_object
    kinds = list(_rates((pose @ middle[None])[:, 0], pose.rotation, hinge))
    for kind in kinds:
        most = float(kind.size.max()) / pace**kind.order
        if most > kind.limit:
            seconds = (track.n_frames - 1) / FPS * max(other.factor(slice(None)) for other in kinds)
            raise BadInput(where, kind.expected, f"{most:.3g}", f"ask for {_rounded_up(seconds):.1f} s or more")


class _Rate(NamedTuple):
    """size: (frame,) of the first or second derivative (order). limit: the most a hand does."""

    unit: str
    order: int
    size: np.ndarray
    limit: float

    @property
    def expected(self) -> str:
        return f"at most {self.limit:g} {self.unit.replace('/s', '/s²') if self.order == 2 else self.unit}"

    def factor(self, frames: slice) -> float:
        """How many times as long these frames must last to keep within the limit."""
        return (float(self.size[frames].max(initial=0.0)) / self.limit) ** (1 / self.order)


def _rates(place_m: np.ndarray, rotmats: np.ndarray, hinge_rad: np.ndarray) -> Iterator[_Rate]:
    """Of every kind there is, where there are frames enough."""
    turns = rotmat_to_rotvec(rotmats[1:] @ rotmats[:-1].swapaxes(1, 2)) * FPS
    each = np.diff(place_m, axis=0) * FPS, turns, np.diff(hinge_rad)[:, None] * FPS
    for (unit, limits), rate in zip(LIMITS.items(), each, strict=True):
        for order, values in ((1, rate), (2, np.diff(rate, axis=0) * FPS)):
            if len(values):
                yield _Rate(unit, order, np.linalg.norm(values, axis=1), limits[order - 1])


def _slower(step: PathStep, enough_s: float) -> str:
    """What to do about a step that is too fast."""
    times = f"{_rounded_up(enough_s / (step.end_s - step.start_s)):.1f} times as long"
    return f"give {step.words!r} {_rounded_up(enough_s):.1f} s or more ({times}), or check the units"


def _rounded_up(value: float) -> float:
    """To the next tenth above, so that it is enough."""
    return (math.floor(10 * value) + 1) / 10


def _check_table(path: ObjectPath, translation_m: np.ndarray, rotmats: np.ndarray) -> None:
    """The lowest point of every frame, from the convex hulls of the parts."""
    track = path.track
    points, part = _hull(track.model)
    height = np.empty(len(rotmats))
    for start in range(0, len(rotmats), _CHUNK):
        rows = slice(start, start + _CHUNK)
        hinge = None if track.hinge_rad is None else track.hinge_rad[rows]
        placed = articulate(points, part, track.model.hinge, hinge)
        height[rows] = (placed @ rotmats[rows, 2, :, None])[..., 0].min(axis=1) + translation_m[rows, 2]
    frame = int(height.argmin())
    if height[frame] < -TABLE_M:
        first = int((height < -TABLE_M).argmax())
        got = f"{-height[frame] * 100:.1f} cm under it, from {_step_at(path, first)} on"
        remedy = f"lift it by {np.ceil(-height[frame] * 100):.0f} cm more before, or lower it less"
        raise BadInput("object path", "an object above the table", got, remedy)


def _hull(model: ObjectModel) -> tuple[np.ndarray, np.ndarray]:
    """Points (point, 3) that span each part, and the part of each; all vertices where they span no volume."""
    kept = []
    for part in np.unique(model.part):
        own = np.flatnonzero(model.part == part)
        with suppress(QhullError, ValueError):
            own = own[ConvexHull(model.vertices_m[own]).vertices]
        kept.append(own)
    rows = np.concatenate(kept)
    return model.vertices_m[rows], model.part[rows]
