"""Physical realism, penetration and smoothness of hand-object motion, as ManipNet (Zhang et al. 2021, Sec. 8) measures.

    score(clip_scene(clip, hands), StandardUnits(tolerance_m=0.002)).share

Scored are lifted frames in which no capsule is 1.5 cm or more inside the object.
"""

from typing import NamedTuple, Protocol

import numpy as np

from hoidata.physics.capsules import CapsuleContacts, capsule_contacts
from hoidata.physics.scene import Scene

LARGEST_PENETRATION_M = 0.015
SMOOTHNESS_FPS = 60.0


class Variant(Protocol):
    """A way to score frames: ``StandardUnits`` or ``AsReleased``."""

    @property
    def limit(self) -> float: ...
    @property
    def tolerance_m(self) -> float: ...
    @property
    def at_centre(self) -> bool: ...
    def residuals(self, scene: Scene, contacts: CapsuleContacts) -> np.ndarray: ...


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
    looked_at = np.flatnonzero(scene.lifted if frames is None else frames)
    near = capsule_contacts(
        scene.model,
        scene.poses.taken(looked_at),
        scene.capsules.taken(looked_at),
        variant.tolerance_m,
        variant.at_centre,
    )
    contacts = near._replace(frame=looked_at[near.frame])
    penetration = np.full(scene.n_frames, np.nan)
    penetration[looked_at] = 0.0
    np.maximum.at(penetration, contacts.frame, contacts.depth_m)
    scored = looked_at[penetration[looked_at] < LARGEST_PENETRATION_M]
    residual = variant.residuals(scene, contacts)[scored]
    inside = contacts.depth_m[contacts.depth_m > 0]
    mean_depth = float(inside.mean()) if len(inside) else float("nan")
    return Realism(scored, residual, residual < variant.limit, penetration, mean_depth)


def smoothness_m_s2(joints_m: np.ndarray, wrist_rotmats: np.ndarray, fps: float) -> float:
    """Mean acceleration of a hand's joints in the wrist's frame, m/s^2: jitter shows as a large figure.

    joints_m: (frame, joint, 3) world, the wrist first; wrist_rotmats: (frame, 3, 3) world_from_wrist. Second
    differences at ManipNet's 60 Hz where the frames are a multiple of it, else at ``fps``. Raises ValueError below
    three frames.
    """
    every = max(1, round(fps / SMOOTHNESS_FPS))
    local = ((joints_m - joints_m[:, :1]) @ wrist_rotmats)[::every]
    if len(local) < 3:
        raise ValueError(f"three frames are needed for accelerations, got {len(local)} of {fps / every:g} per second")
    return float(np.linalg.norm(np.diff(local, n=2, axis=0) * (fps / every) ** 2, axis=-1).mean())
