"""Physical realism, penetration and smoothness of hand-object motion, as ManipNet (Zhang et al. 2021, Sec. 8) measures.

The one entry point is ``measure``, for MANO-layout hands of a clip (19 capsules fitted to the skin, 30 fps)::

    measure(clip_scene(clip, hands), clip_motions(clip, hands))

and for ManipNet's own hands (its 19 capsules and 17 joints, 120 Hz; ``hoidata.datasets.manipnet.source_hands``)::

    source = read_source_hands(raw, "cyl_med3")
    measure(source.scene, source.motions)

Scored are lifted frames in which no capsule is 1.5 cm or more inside the object.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from hoidata.clips.clip import SIDES, Clip
from hoidata.hands import HandPair, track_joints
from hoidata.physics.as_released import AsReleased
from hoidata.physics.capsules import CapsuleContacts, capsule_contacts
from hoidata.physics.mano_capsules import world_rotmats
from hoidata.physics.scene import Scene
from hoidata.physics.standard_units import StandardUnits

LARGEST_PENETRATION_M = 0.015
SMOOTHNESS_FPS = 60.0


class Variant(Protocol):
    """A way to score frames: ``StandardUnits`` or ``AsReleased``."""

    at_centre: ClassVar[bool]

    @property
    def limit(self) -> float: ...
    @property
    def tolerance_m(self) -> float: ...
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


class HandMotion(NamedTuple):
    """joints_m: (frame, joint, 3) world, metres, the wrist first; NaN in frames in which the hand is not there.

    wrist_rotmats: (frame, 3, 3) world_from_wrist.
    """

    joints_m: np.ndarray
    wrist_rotmats: np.ndarray


class Measures(NamedTuple):
    """Of one recording.

    shares: by variant, of ``scored`` frames those whose motion the contacts can give (Appendix A); NaN when none is
    scored. floors: the same with no hands at all, what a variant gives for nothing: 0 in SI units but for free fall.
    penetration_m: mean depth over capsules that overlap the object, in frames looked at; NaN without any.
    smoothness_m_s2: by hand, mean acceleration of its joints in the wrist's frame; only hands that have three frames.
    """

    shares: dict[str, float]
    floors: dict[str, float]
    scored: int
    penetration_m: float
    smoothness_m_s2: dict[str, float]


VARIANTS: Mapping[str, Variant] = MappingProxyType({"SI": StandardUnits(), "as released": AsReleased()})


def measure(
    scene: Scene,
    motions: Mapping[str, HandMotion],
    variants: Mapping[str, Variant] = VARIANTS,
    frames: np.ndarray | None = None,
) -> Measures:
    """All of ManipNet's physical measures of one recording, of any hands that are capsules and joints.

    scene: ``clip_scene`` or ``SourceRecording.scene``; motions: ``clip_motions`` or ``SourceRecording.motions``.
    frames: as in ``score``. The capsules of a MANO-layout hand follow its skin to a few millimetres:
    ``StandardUnits(tolerance_m=0.002)`` counts a capsule that near as touching.
    """
    results = {name: score(scene, variant, frames) for name, variant in variants.items()}
    bare = scene.with_capsules(scene.capsules.taken(slice(None), slice(0, 0)))
    floors = {name: score(bare, variant, frames).share for name, variant in variants.items()}
    first = next(iter(results.values()), None) or score(scene, StandardUnits(), frames)
    smooth = {
        side: smoothness_m_s2(motion.joints_m, motion.wrist_rotmats, scene.fps)
        for side, motion in motions.items()
        if has_acceleration(motion.joints_m, scene.fps)
    }
    shares = {name: result.share for name, result in results.items()}
    return Measures(shares, floors, len(first.frames), first.colliding_m, smooth)


def clip_motions(clip: Clip, hands: HandPair) -> dict[str, HandMotion]:
    """Both hands of a clip: its 16 joints and 5 tips."""
    motions = {}
    for side in SIDES:
        track = clip.hands[side]
        joints = np.where(track.valid[:, None, None], track_joints(track, hands[side]).astype(np.float64), np.nan)
        motions[side] = HandMotion(joints, world_rotmats(track)[:, 0])
    return motions


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
