"""An object not yet taken, or put down again, lies on what it lay on at first, and is never under it.

Generated objects come back some millimetres too high or too low, or pass through the table on the way. All that is in
the frame is moved up or down together, so nothing changes between hands and object.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from hoidata.clips.clip import FPS, Clip
from hoidata.physics.scene import object_scene

_ENOUGH = 500  # vertices tell whether a rigid body moves


@dataclass(frozen=True)
class RestSettings:
    """still_m_s: an object slower than this at the clip's ends is at rest there. level_m: nearer than this to its
    first height it is meant to lie where it lay; farther, it was put down elsewhere. smooth: frames, odd, over which
    an object that passes through the table is lifted.
    """

    still_m_s: float = 0.03
    level_m: float = 0.03
    smooth: int = 11


def rest_object(clip: Clip, settings: RestSettings = RestSettings()) -> Clip:
    """The clip with every frame raised or lowered, so that the object rests at the height it started from.

    A clip whose gravity is not known, or that starts with an object in motion, stays as it was.
    """
    if clip.gravity is None or clip.n_frames < 3:
        return clip
    scene = object_scene(clip)
    some = 1 + scene.vertices_m.shape[1] // _ENOUGH
    first, last = _at_rest(scene.vertices_m[:, ::some], settings.still_m_s)
    if not first:
        return clip
    return _raised(clip, -clip.gravity * _rises(scene.lowest_m, first, last, settings)[:, None])


def _at_rest(vertices_m: np.ndarray, still_m_s: float) -> tuple[int, int]:
    """How many frames of (frame, vertex, 3) at the start, and at the end, the object has not been moved in."""
    speed = np.linalg.norm(np.diff(vertices_m, axis=0), axis=-1).max(axis=1) * FPS
    moving = np.append(speed > still_m_s, True)
    return int(moving.argmax()), int(np.append(moving[-2::-1], True).argmax())


def _rises(lowest_m: np.ndarray, first: int, last: int, settings: RestSettings) -> np.ndarray:
    """(frame,) metres to raise: to the first height at both ends, and between them as far as it is below."""
    n_frames, too_low = len(lowest_m), lowest_m[0] - lowest_m
    rises = np.zeros(n_frames)
    rises[:first] = too_low[:first]
    stop = n_frames - last
    level = last > 0 and np.abs(too_low[stop:]).max() < settings.level_m
    if level:
        rises[stop:] = too_low[stop:]
        u = np.arange(1, stop - first + 1) / (stop - first + 1)
        rises[first:stop] = rises[first - 1] + u * u * (3 - 2 * u) * (rises[stop] - rises[first - 1])
    below = np.maximum(too_low - rises, 0)
    if level or below.max() < settings.level_m:
        rises += _covering(below, settings.smooth)
    return rises


def _covering(values: np.ndarray, width: int) -> np.ndarray:
    """Smooth values, nowhere less than ``values``: the largest of each ``width`` frames, averaged over as many."""
    half, window = width // 2, np.hanning(width + 2)[1:-1]
    largest = np.pad(maximum_filter1d(values, width), half, mode="edge")
    return np.convolve(largest, window / window.sum(), "valid")


def _raised(clip: Clip, up_m: np.ndarray) -> Clip:
    """Hands and object of every frame moved by up_m (frame, 3), world."""
    thing = clip.object
    hands = {
        side: replace(track, wrist_m=(track.wrist_m + up_m).astype(np.float32)) for side, track in clip.hands.items()
    }
    place_m = (thing.translation_m + up_m).astype(thing.translation_m.dtype)
    return replace(clip, hands=hands, object=replace(thing, translation_m=place_m))
