"""Where the camera of a player starts: it must see the whole motion, with hand and object beside each other."""

from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import FPS, Clip, ObjectTrack
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandPair, track_joints
from pipelines.pages.glb import upright_rotation
from pipelines.pages.surface import ContactPaint

ASIDE_RAD = np.radians(40.0)  # looking past the touched side shows where the contact ends
_POINTS_FOR_VIEW = 400
_HAND_MARGIN_M = 0.015
_NEAR_M = 0.10


@dataclass(frozen=True)
class View:
    """Where the camera starts, in the GLB's upright world (y up), metres and radians; ground_m None: no ground."""

    centre: tuple[float, float, float]
    radius_m: float
    ground_m: float | None
    azimuth_rad: float
    elevation_rad: float
    frames: int
    fps: int = FPS


def view_of(clip: Clip, hands: HandPair) -> View:
    """A camera that sees the whole motion of the object and of the hands that come near it, from the side.

    The ground lies under the lowest point of all objects (a table too) and of all hands.
    """
    upright = upright_rotation(clip.gravity).as_matrix()
    object_points = _object_points(clip.object) @ upright.T
    others = [_object_points(track) @ upright.T for track in clip.other_objects]
    seen = [(track, hands[side]) for side, track in clip.hands.items() if track.valid.any()]
    everyone = [(track.valid, track_joints(track, model) @ upright.T) for track, model in seen]
    hand_points = [joints[valid] for valid, joints in everyone if _comes_near(joints, valid, object_points)]
    shown = np.concatenate([object_points.reshape(-1, 3), *(points.reshape(-1, 3) for points in hand_points)])
    centre = (shown.min(axis=0) + shown.max(axis=0)) / 2
    radius = float(np.linalg.norm(shown - centre, axis=1).max()) + _HAND_MARGIN_M
    things = [points[..., 1].min() for points in (object_points, *others)]
    lowest = min(*things, *(joints[valid, :, 1].min() for valid, joints in everyone), np.inf)
    return View(
        centre=_rounded(centre),
        radius_m=round(radius, 4),
        ground_m=None if clip.gravity is None else round(float(lowest), 4),
        azimuth_rad=round(_side_azimuth(object_points, hand_points), 3),
        elevation_rad=0.42,
        frames=clip.n_frames,
    )


def still_view(clip: Clip, look_from: np.ndarray) -> View:
    """A camera that sees the object of a one-frame clip from ``look_from`` (3,), at least a little from above."""
    points = _object_points(clip.object)[0] @ upright_rotation(clip.gravity).as_matrix().T
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return View(
        centre=_rounded(centre),
        radius_m=round(float(np.linalg.norm(points - centre, axis=1).max()) * 1.2, 4),
        ground_m=None,
        azimuth_rad=round(float(np.arctan2(look_from[0], look_from[2]) + ASIDE_RAD), 3),
        elevation_rad=round(float(np.clip(np.arcsin(look_from[1]), 0.15, 1.0)), 3),
        frames=1,
    )


def touched_side(clip: Clip, paint: ContactPaint) -> np.ndarray:
    """(3,) unit direction, in the upright world of the first frame, from the object's middle to where it is touched."""
    turn = upright_rotation(clip.gravity).as_matrix() @ rotvec_to_rotmat(clip.object.rotvec[:1])[0]
    toward = (paint.points_m - paint.points_m.mean(axis=0)).T @ paint.value
    direction = turn @ toward + np.array((1e-6, 0.0, 1e-6))
    return direction / np.linalg.norm(direction)


def _object_points(track: ObjectTrack) -> np.ndarray:
    """(frame, point, 3) world points of an object, thinned evenly."""
    model = track.model
    step = max(1, len(model.vertices_m) // _POINTS_FOR_VIEW)
    return track.points_in_world(model.vertices_m[::step], model.part[::step])


def _comes_near(joints: np.ndarray, valid: np.ndarray, object_points: np.ndarray) -> bool:
    """Whether a joint ever comes within 10 cm of the ball around the object: an idle hand must not widen the view."""
    moving = np.broadcast_to(object_points, (len(joints), *object_points.shape[1:]))
    centre = moving.mean(axis=1, keepdims=True)
    reach = np.linalg.norm(moving - centre, axis=2).max(axis=1, keepdims=True)
    return bool(((np.linalg.norm(joints - centre, axis=2) - reach)[valid] < _NEAR_M).any())


def _side_azimuth(object_points: np.ndarray, hand_points: list[np.ndarray]) -> float:
    """Azimuth across the line from the hands to the object, so that neither hides the other; pi/5 without hands."""
    if not hand_points:
        return float(np.pi / 5)
    wrists = np.concatenate([points[:, 0] for points in hand_points]).mean(axis=0)
    toward = object_points.reshape(-1, 3).mean(axis=0) - wrists
    if np.hypot(toward[0], toward[2]) < 1e-3:
        return float(np.pi / 5)
    return float(np.arctan2(toward[0], toward[2]) + np.radians(65.0))


def _rounded(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 4) for value in vector)
    return x, y, z
