"""What physics is asked about: an object's motion, the capsules of the hands, gravity; and which frames are scored."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack
from hoidata.errors import BadInput
from hoidata.hands import HandModel, HandPair
from hoidata.objects.model import ObjectModel, articulate
from hoidata.physics.capsules import Capsules, ObjectPoses, joined
from hoidata.physics.contact_forces import GRAVITY_M_S2, BodyMotion, body_motion, required_wrench
from hoidata.physics.mano_capsules import hand_capsules

LIFTED_M = 0.015
TABLE_PERCENTILE = 3
_AT_ONCE = 16  # frames
_FALLING = 0.05  # of the weight: an object that needs less support than this falls


@dataclass(frozen=True, eq=False)
class Scene:
    """One object, the capsules that may touch it (none at all is allowed), world frame, every frame of a recording.

    gravity: (3,) unit vector, the direction things fall. A capsule whose ends are NaN in a frame is not there.
    table_m: height of the table top, measured against gravity from the world's origin, or None: the 3rd percentile of
    the lowest vertex over these frames stands for it (``reference/manipnet-data.md``), which needs frames at rest.
    """

    model: ObjectModel
    poses: ObjectPoses
    capsules: Capsules
    fps: float
    gravity: np.ndarray
    table_m: float | None = None

    @property
    def n_frames(self) -> int:
        return len(self.poses.translation_m)

    @cached_property
    def motion(self) -> BodyMotion:
        """Of 1 kg of even density; a hinged object is one body at each frame's angle."""
        return body_motion(self.model, self.poses.rotmats, self.poses.translation_m, self.poses.hinge_rad)

    @cached_property
    def wrench(self) -> np.ndarray:
        """(frame, 6) N and N m about the centre of mass that hands and table together must give."""
        return required_wrench(self.motion, self.fps, self.gravity)

    def vertices_m(self, frames: slice) -> np.ndarray:
        """(chosen frame, vertex, 3) of the object in the world; of all frames at once they may be gigabytes."""
        model, poses = self.model, self.poses.taken(frames)
        local = articulate(model.vertices_m, model.part, model.hinge, poses.hinge_rad)
        return poses.world_from_part(model, 0) @ local

    @cached_property
    def lowest_m(self) -> np.ndarray:
        """(frame,) height of the object's lowest vertex, against gravity."""
        return np.minimum.reduce([self._lowest_of_part_m(part) for part in self.model.parts])

    def _lowest_of_part_m(self, part: int) -> np.ndarray:
        """(frame,) of one part. A height is linear in a vertex's place, so that none is taken to the world."""
        model, world_from_part = self.model, self.poses.world_from_part(self.model, part)
        vertices_m = model.vertices_m[model.part == part] if model.is_articulated else model.vertices_m
        up = -self.gravity
        ways, origins_m = up @ world_from_part.rotation, world_from_part.translation @ up
        starts = range(0, self.n_frames, _AT_ONCE)
        lowest = [(vertices_m @ ways[start : start + _AT_ONCE].T).min(axis=0) for start in starts]
        return np.concatenate([np.zeros(0), *lowest]) + origins_m

    @property
    def table_height_m(self) -> float:
        return float(np.percentile(self.lowest_m, TABLE_PERCENTILE)) if self.table_m is None else self.table_m

    def lowest_of_m(self, hand: Capsules) -> float:
        """Height of a hand's lowest capsule in any frame in which it is there, against gravity."""
        ends_m = np.stack((hand.start_m, hand.end_m)) @ -self.gravity
        return float(np.nanmin(ends_m - hand.radius_m))

    @property
    def lifted(self) -> np.ndarray:
        """(frame,) bool: the lowest vertex is more than 1.5 cm above the table. Nothing but hands can hold it then."""
        return self.lowest_m - self.table_height_m > LIFTED_M

    @property
    def held(self) -> np.ndarray:
        """(frame,) bool: lifted, and not falling: the force it needs is more than 5 % of its weight."""
        return self.lifted & (np.linalg.norm(self.wrench[:, :3], axis=1) > _FALLING * GRAVITY_M_S2)

    def with_capsules(self, capsules: Capsules) -> "Scene":
        """The same object under other hands; what is known of its motion already is kept."""
        twin = replace(self, capsules=capsules)
        known = ("motion", "wrench", "lowest_m")
        vars(twin).update({name: value for name, value in vars(self).items() if name in known})
        return twin


def capsules_there(track: HandTrack, hand: HandModel) -> Capsules:
    """The capsules of a hand in the world, NaN in frames without it."""
    found, valid = hand_capsules(track, hand), track.valid[:, None, None]
    return Capsules(np.where(valid, found.start_m, np.nan), np.where(valid, found.end_m, np.nan), found.radius_m)


def clip_scene(clip: Clip, hands: HandPair, table_m: float | None = None) -> Scene:
    """A clip's object and the 19 capsules of each of its hands, left before right, at 30 fps. Raises BadInput."""
    capsules = [capsules_there(clip.hands[side], hands[side]) for side in SIDES]
    return object_scene(clip, table_m).with_capsules(joined(capsules))


def object_scene(clip: Clip, table_m: float | None = None) -> Scene:
    """A clip's object without hands. Raises BadInput where its gravity is not known."""
    if clip.gravity is None:
        raise BadInput(clip.clip_id, "a clip whose gravity is known", "none", "leave it out of physical measures")
    track, nothing = clip.object, np.zeros((clip.n_frames, 0, 3))
    hinge = None if track.hinge_rad is None else np.asarray(track.hinge_rad, dtype=np.float64)
    poses = ObjectPoses(track.world_from_object.rotation, track.world_from_object.translation, hinge)
    capsules = Capsules(nothing, nothing, np.zeros(0))
    return Scene(clip.object.model, poses, capsules, FPS, clip.gravity, table_m)
