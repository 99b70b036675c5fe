"""A motion of an object that nobody recorded, 30 frames per second, and whether it can be.

World: metres, z up, the table at height 0, x to the right and y away from the person. The object begins where it stands
on the table at hinge angle 0, the middle of its bounding box above the world's origin, and turns about that middle.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BPoly, PchipInterpolator
from scipy.spatial import ConvexHull, QhullError

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotation_angle, rotmat_to_rotvec
from hoidata.objects.model import ObjectModel, articulate

MOST_S = 120.0
MOST_SPEED_M_S, MOST_ACCELERATION_M_S2 = 2.5, 40.0  # a hand with something in it; both are rarely reached
MOST_TURN_RAD_S, MOST_TURN_RAD_S2 = 12.0, 200.0
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
    """(frame,) seconds, 30 in each, up to ``end_s``. Raises BadInput for a path that is too long."""
    if end_s > MOST_S:
        raise BadInput("object path", f"at most {MOST_S:g} s", f"{end_s:.4g} s", "shorten it, or make two of it")
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
    _check_speeds(path, shift_m, rotmats, hinge_rad)
    _check_table(path, translation.astype(np.float64), rotmats)
    return path


def _step_at(path: ObjectPath, frame: int) -> str:
    """Which step the frame belongs to, and its time, in words."""
    time_s = frame / FPS
    inside = [step.words for step in path.steps if step.start_s - 1e-6 <= time_s <= step.end_s + 1e-6]
    return f"{time_s:.2f} s" + (f" ({'; '.join(inside)})" if inside else "")


def _check_angle(path: ObjectPath, hinge_rad: np.ndarray) -> None:
    if path.limits_rad is None:
        return
    low, high = path.limits_rad
    beyond = np.maximum(hinge_rad - high, low - hinge_rad)
    frame = int(beyond.argmax())
    if beyond[frame] > ANGLE_RAD:
        expected = f"a hinge angle of {np.degrees(low):.0f} to {np.degrees(high):.0f} deg"
        first = int((beyond > ANGLE_RAD).argmax())
        got = f"{np.degrees(hinge_rad[frame]):.0f} deg, from {_step_at(path, first)} on"
        raise BadInput(
            "object path", expected, got, "ask for an angle within, or tell the hinge's range (--hinge-range)"
        )


def _check_speeds(path: ObjectPath, shift_m: np.ndarray, rotmats: np.ndarray, hinge_rad: np.ndarray) -> None:
    turns = rotmat_to_rotvec(rotmats[1:] @ rotmats[:-1].swapaxes(1, 2)) * FPS
    speed = np.diff(shift_m, axis=0) * FPS
    swing = np.diff(hinge_rad) * FPS
    for rate, most, most_change, unit in (
        (speed, MOST_SPEED_M_S, MOST_ACCELERATION_M_S2, "m/s"),
        (turns, MOST_TURN_RAD_S, MOST_TURN_RAD_S2, "rad/s"),
        (swing[:, None], MOST_TURN_RAD_S, MOST_TURN_RAD_S2, "rad/s of the hinge"),
    ):
        for order, values, limit in ((1, rate, most), (2, np.diff(rate, axis=0) * FPS, most_change)):
            size = np.linalg.norm(values, axis=1)
            if len(size) and size.max() > limit:
                frame = int(size.argmax())
                slower = (size[frame] / limit) ** (1 / order)
                expected = f"at most {limit:g} {unit.replace('/s', '/s²') if order == 2 else unit}"
                remedy = f"give it {slower:.1f} times as long or more, or check the units"
                raise BadInput("object path", expected, f"{size[frame]:.3g} at {_step_at(path, frame)}", remedy)


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


def largest_turn(rotmats: np.ndarray) -> float:
    """The largest turn between neighbours of (key, 3, 3), radians."""
    return float(rotation_angle(rotmats[1:] @ rotmats[:-1].swapaxes(1, 2)).max(initial=0.0))
