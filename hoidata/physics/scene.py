"""The input of physical measures: object motion, hand capsules and gravity, and the frames that are scored."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack
from hoidata.errors import BadInput
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandModel, HandPair
from hoidata.objects.model import ObjectModel
from hoidata.physics.capsules import Capsules, ObjectPoses, joined
from hoidata.physics.contact_forces import GRAVITY_M_S2, BodyMotion, body_motion, required_wrench
from hoidata.physics.mano_capsules import hand_capsules

LIFTED_M = 0.015
TABLE_PERCENTILE = 3
_FALLING_FRACTION = 0.05  # an object falls if its support force is below this fraction of its weight


@dataclass(frozen=True, eq=False)
class Scene:
    """The motion of an object and of capsules that may touch it, in the world frame."""

    model: ObjectModel
    poses: ObjectPoses
    capsules: Capsules  # may be empty; NaN ends in frames without the capsule
    fps: float
    gravity: np.ndarray  # (3,) unit vector, downwards
    # Height of the table top above the world's origin. None: the 3rd percentile of the object's lowest vertex, which
    # needs frames at rest.
    table_m: float | None = None

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.poses.translation_m)

    @cached_property
    def motion(self) -> BodyMotion:
        """Motion of an object of 1 kg with uniform density; a hinged object is one body at each frame's angle."""
        return body_motion(self.model, self.poses.rotmats, self.poses.translation_m, self.poses.hinge_rad)

    @cached_property
    def wrench(self) -> np.ndarray:
        """(frame, 6) N and N m about the centre of mass, the required wrench of hands and table together."""
        return required_wrench(self.motion, self.fps, self.gravity)

    @cached_property
    def lowest_m(self) -> np.ndarray:
        """(frame,) height of the object's lowest vertex."""
        poses = self.poses
        world_from_object = RigidTransform(poses.rotmats, poses.translation_m)
        return self.model.lowest_m(world_from_object, poses.hinge_rad, -self.gravity)

    @property
    def table_height_m(self) -> float:
        """Height of the table top, estimated from the object if not given."""
        return float(np.percentile(self.lowest_m, TABLE_PERCENTILE)) if self.table_m is None else self.table_m

    @property
    def lifted(self) -> np.ndarray:
        """(frame,) bool: the lowest vertex is more than 1.5 cm above the table, so only hands can support it."""
        return self.lowest_m - self.table_height_m > LIFTED_M

    @property
    def held(self) -> np.ndarray:
        """(frame,) bool: lifted and not falling, that is, the support force exceeds 5 % of the weight."""
        return self.lifted & (np.linalg.norm(self.wrench[:, :3], axis=1) > _FALLING_FRACTION * GRAVITY_M_S2)

    def with_capsules(self, capsules: Capsules) -> "Scene":
        """The scene with other capsules; cached values of the object's motion are kept."""
        twin = replace(self, capsules=capsules)
        cached_names = ("motion", "wrench", "lowest_m")
        vars(twin).update({name: value for name, value in vars(self).items() if name in cached_names})
        return twin


def capsules_or_nan(track: HandTrack, hand: HandModel) -> Capsules:
    """World capsules of a hand, NaN in frames without the hand."""
    capsules, valid = hand_capsules(track, hand), track.valid[:, None, None]
    return Capsules(
        np.where(valid, capsules.start_m, np.nan), np.where(valid, capsules.end_m, np.nan), capsules.radius_m
    )


def clip_scene(clip: Clip, hands: HandPair, table_m: float | None = None) -> Scene:
    """Scene of a clip with 19 capsules per hand, left first, at 30 fps. Raises BadInput without gravity."""
    capsules = [capsules_or_nan(clip.hands[side], hands[side]) for side in SIDES]
    return object_scene(clip, table_m).with_capsules(joined(capsules))


def object_scene(clip: Clip, table_m: float | None = None) -> Scene:
    """Scene of a clip's object without hands. Raises BadInput if the clip has no gravity."""
    if clip.gravity is None:
        raise BadInput(clip.clip_id, "a clip whose gravity is known", "none", "exclude it from physical measures")
    track, nothing = clip.object, np.zeros((clip.n_frames, 0, 3))
    hinge = None if track.hinge_rad is None else np.asarray(track.hinge_rad, dtype=np.float64)
    poses = ObjectPoses(track.world_from_object.rotation, track.world_from_object.translation, hinge)
    capsules = Capsules(nothing, nothing, np.zeros(0))
    return Scene(clip.object.model, poses, capsules, fps=FPS, gravity=clip.gravity, table_m=table_m)
