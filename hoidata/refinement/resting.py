"""Snap a resting object to its first height, and keep it above the table.

Generated objects are put down some millimetres too high or too low, or pass through the table. Hands and object are
raised or lowered together, so that their relative pose is unchanged. An object that ends elsewhere and was far below
its first height was put down on something lower.
"""

from dataclasses import dataclass, replace

import numpy as np

from hoidata.clips.clip import FPS, Clip
from hoidata.physics.scene import object_scene

_ENOUGH = 500  # vertices tell whether a rigid body moves


@dataclass(frozen=True)
class RestingSettings:
    """What counts as at rest, and which heights are corrected."""

    still_m_s: float = 0.03  # an object slower than this at an end of the clip is at rest
    drift_m: float = 0.01  # if its height changes by less than this
    level_m: float = 0.03  # an end closer than this to the first height is at that height; farther, it is elsewhere
    fade: int = 11  # frames over which the correction of the start fades if the object is put down elsewhere
    through_m: float = 0.08  # an object that goes lower than this below both ends was held at both ends; unchanged


def snap_to_rest(clip: Clip, settings: RestingSettings = RestingSettings()) -> Clip:
    """Raise or lower each frame of a clip, so that the object rests at the height it started from.

    A clip without known gravity, or with an object in motion at the start, is unchanged.
    """
    if clip.gravity is None or clip.n_frames < 3:
        return clip
    model, some = clip.object.model, slice(None, None, 1 + len(clip.object.model.vertices_m) // _ENOUGH)
    places_m = clip.object.points_in_world(model.vertices_m[some], model.part[some])
    speed = np.linalg.norm(np.diff(places_m, axis=0), axis=-1).max(axis=1) * FPS
    still, lowest_m = speed <= settings.still_m_s, object_scene(clip).lowest_m
    first, last = (_resting(*ends, settings.drift_m) for ends in ((still, lowest_m), (still[::-1], lowest_m[::-1])))
    if not first:
        return clip
    return _raised(clip, -clip.gravity * _rises(lowest_m, first, last, settings)[:, None])


def _resting(still: np.ndarray, lowest_m: np.ndarray, drift_m: float) -> int:
    """How many frames from the first on an object lies; still (frame - 1,): it does not move to the next one."""
    near = np.abs(lowest_m[:-1] - lowest_m[0]) < drift_m
    return int(np.append(still & near, False).argmin())


def _rises(lowest_m: np.ndarray, first: int, last: int, settings: RestingSettings) -> np.ndarray:
    """(frame,) metres to raise: to the first height at both ends, and between them as far as it is below."""
    n_frames, too_low = len(lowest_m), lowest_m[0] - lowest_m
    rises, stop = np.zeros(n_frames), n_frames - last
    level = last > 0 and np.abs(too_low[stop:]).max() < settings.level_m
    if level and too_low.max() >= settings.through_m:
        return rises
    rises[:first] = too_low[:first]
    if level:
        rises[stop:] = too_low[stop:]
    end = rises[stop] if level else 0.0
    way = stop - first if level else min(settings.fade, n_frames - first)
    share = _smooth(np.arange(1, way + 1) / (way + 1))
    rises[first : first + way] = rises[first - 1] + share * (end - rises[first - 1])
    below = np.maximum(too_low - rises, 0)
    return rises if not level and below.max() >= settings.level_m else rises + below


def _smooth(share: np.ndarray) -> np.ndarray:
    """From 0 to 1 with no speed at either end."""
    return share * share * (3 - 2 * share)


def _raised(clip: Clip, up_m: np.ndarray) -> Clip:
    """Hands and object of every frame moved by up_m (frame, 3), world."""
    thing = clip.object
    hands = {
        side: replace(track, wrist_m=(track.wrist_m + up_m).astype(np.float32)) for side, track in clip.hands.items()
    }
    place_m = (thing.translation_m + up_m).astype(thing.translation_m.dtype)
    return replace(clip, hands=hands, object=replace(thing, translation_m=place_m))
