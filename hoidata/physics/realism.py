"""Physical realism, penetration and smoothness of hand-object motion, as ManipNet (Zhang et al. 2021, Sec. 8) measures.

Scored are lifted frames in which no capsule is 1.5 cm or more inside the object.
"""

from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from hoidata.physics.as_released import AsReleased
from hoidata.physics.capsules import CapsuleContacts, capsule_contacts
from hoidata.physics.scene import Scene
from hoidata.physics.standard_units import StandardUnits

LARGEST_PENETRATION_M = 0.015
SMOOTHNESS_FPS = 60.0


# A way to score frames.
Variant = StandardUnits | AsReleased


class Realism(NamedTuple):
    """frames: (scored frame,) index in the scene. residual: (scored frame,) in the variant's unit. passed: bool.

    penetration_m: (frame,) deepest capsule of each frame of the scene that was looked at, 0 without overlap; NaN for
    frames not looked at. colliding_m: mean depth over overlapping capsules and frames looked at; NaN without any.
    """

    frames: np.ndarray
    residual: np.ndarray
    passed: np.ndarray
    penetration_m: np.ndarray
    colliding_m: float

    @property
    def share(self) -> float:
        """Of scored frames, those that passed; NaN when none is scored."""
        return float(self.passed.mean()) if len(self.passed) else float("nan")


def score(scene: Scene, variant: Variant, frames: np.ndarray | None = None) -> Realism:
    """frames: (frame,) bool, which to look at, such as ``scene.lifted`` (if not given) or ``scene.held``.

    At least 3 frames are needed for accelerations.
    """
    frames = scene.lifted if frames is None else frames
    looked_at, near = np.flatnonzero(frames), contacts_in(scene, frames, variant.tolerance_m)
    contacts = near.at_middle() if variant.at_centre else near
    penetration = np.full(scene.n_frames, np.nan)
    penetration[looked_at] = 0.0
    np.maximum.at(penetration, contacts.frame, contacts.depth_m)
    scored = looked_at[penetration[looked_at] < LARGEST_PENETRATION_M]
    residual = variant.residuals(scene, contacts)[scored]
    inside = contacts.depth_m[contacts.depth_m > 0]
    mean_depth = float(inside.mean()) if len(inside) else float("nan")
    return Realism(scored, residual, residual < variant.limit, penetration, mean_depth)


def contacts_in(scene: Scene, frames: np.ndarray, tolerance_m: float = 0.0) -> CapsuleContacts:
    """Capsules that touch in frames (frame,) bool, numbered as in the scene; kept for the next to ask."""
    looked_at = np.flatnonzero(frames)
    near = _near(scene, looked_at.tobytes(), tolerance_m)
    return near._replace(frame=looked_at[near.frame])


@lru_cache(maxsize=2)
def _near(scene: Scene, looked_at: bytes, tolerance_m: float) -> CapsuleContacts:
    """Contacts in some frames (int64 numbers), kept for a scene and its floor: every variant asks, and it is dear."""
    frames = np.frombuffer(looked_at, np.int64)
    return capsule_contacts(scene.model, scene.poses.taken(frames), scene.capsules.taken(frames), tolerance_m)


VARIANTS: Mapping[str, Variant] = MappingProxyType({"SI": StandardUnits(), "as released": AsReleased()})


def smoothness_m_s2(joints_m: np.ndarray, wrist_rotmats: np.ndarray, fps: float) -> float:
    """Mean acceleration of a hand's joints in the wrist's frame, m/s^2: jitter shows as a large figure.

    joints_m: (frame, joint, 3) world, the wrist first, NaN where the hand is not there; wrist_rotmats: (frame, 3, 3)
    world_from_wrist. Second differences at ManipNet's 60 Hz where the frames are a multiple of it, else at ``fps``.
    Raises ValueError without three frames in a row.
    """
    if not has_acceleration(joints_m, fps):
        rate = fps / _stride(fps)
        raise ValueError(f"three frames in a row are needed for accelerations, got {len(joints_m)} at {rate:g} Hz")
    every = _stride(fps)
    local = ((joints_m - joints_m[:, :1]) @ wrist_rotmats)[::every]
    return float(np.nanmean(np.linalg.norm(np.diff(local, n=2, axis=0) * (fps / every) ** 2, axis=-1)))


def _stride(fps: float) -> int:
    return max(1, round(fps / SMOOTHNESS_FPS))


def has_acceleration(joints_m: np.ndarray, fps: float) -> bool:
    """Whether ``smoothness_m_s2`` finds three frames in a row with the hand. Arguments as there."""
    there = np.asarray(np.isfinite(joints_m).all(axis=(1, 2)))[:: _stride(fps)]
    return bool((there[2:] & there[1:-1] & there[:-2]).any())
