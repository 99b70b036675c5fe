"""ManipNet's control signal: the motions of both wrists and of the object, at any frame rate."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Trajectories
from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.clips.features import (
    GLOBAL_ORIENT_6D,
    HAND_POSE_6D,
    N_ROTATIONS,
    OBJECT_HINGE,
    OBJECT_POSITION,
    OBJECT_ROTATION_6D,
    WRIST,
    hand_features,
    object_features,
)
from hoidata.geometry.motion import Motion
from hoidata.geometry.rotations import rot6d_to_rotmat
from hoidata.objects.model import ObjectModel

UNTRACKED_DISTANCE_M = 1.0  # from the object to a wrist that is never tracked: out of range of all sensors


@dataclass(frozen=True, eq=False)
class Control:
    """The motions of both wrists and of one object, or of an object in each hand."""

    wrists: dict[Side, Motion]  # world_from_wrist
    object_motion: Motion  # world_from_object
    model: ObjectModel
    hinge_rad: np.ndarray | None = None  # (frame,) at ``object_motion.time_s``; None for a rigid object
    left: "Control | None" = None  # with the left hand's object, if it is another one

    def of(self, side: Side) -> "Control":
        """The control signal with the object of one hand."""
        return self.left if side == "left" and self.left else self

    @cached_property
    def box_middle_m(self) -> np.ndarray:
        """(3,) centre of the object's bounding box, object frame, hinge at 0."""
        return (self.model.vertices_m.min(axis=0) + self.model.vertices_m.max(axis=0)) / 2

    @cached_property
    def mass_centre_m(self) -> np.ndarray:
        """(3,) centre of mass of all parts, object frame, hinge at 0; parts without a volume count equally."""
        volumes = np.array([part.volume_m3 for part in self.model.masses])
        weights = volumes if volumes.sum() > 0 else np.ones(len(volumes))
        return np.average([part.centre_m for part in self.model.masses], axis=0, weights=weights)

    def at(self, time_s: np.ndarray) -> "Control":
        """Resample at times (frame,)."""

        def taken(motion: Motion) -> Motion:
            pose = motion.at(time_s)
            return Motion(time_s, pose.rotation, pose.translation)

        wrists: dict[Side, Motion] = {side: taken(motion) for side, motion in self.wrists.items()}
        left = self.left and self.left.at(time_s)
        return Control(wrists, taken(self.object_motion), self.model, self.hinge_at(time_s), left)

    def hinge_at(self, time_s: np.ndarray) -> np.ndarray | None:
        """Hinge angles at times of any shape, radians; None for a rigid object."""
        if self.hinge_rad is None:
            return None
        return np.interp(time_s, self.object_motion.time_s, self.hinge_rad)


def control_of(trajectories: Trajectories, model: ObjectModel) -> Control:
    """Wrists and object at 30 fps from time 0; an untracked wrist has its pose of the nearest tracked frame."""
    time_s = np.arange(len(trajectories.object)) / FPS
    body_features = trajectories.object.astype(np.float64)
    hinge = body_features[:, OBJECT_HINGE] * model.joint_scale if model.is_articulated else None
    wrists: dict[Side, Motion] = {side: _wrist(trajectories, index, time_s) for index, side in enumerate(SIDES)}
    body = Motion(time_s, rot6d_to_rotmat(body_features[:, OBJECT_ROTATION_6D]), body_features[:, OBJECT_POSITION])
    return Control(wrists, body, model, hinge)


def _wrist(trajectories: Trajectories, side_index: int, time_s: np.ndarray) -> Motion:
    tracked = np.flatnonzero(trajectories.valid[side_index])
    if not len(tracked):
        return untracked_wrist(time_s, trajectories.object[:, OBJECT_POSITION])
    nearest = tracked[abs(np.arange(len(time_s))[:, None] - tracked).argmin(axis=1)]
    wrist = trajectories.wrists[side_index, nearest].astype(np.float64)
    return Motion(time_s, rot6d_to_rotmat(wrist[:, GLOBAL_ORIENT_6D]), wrist[:, WRIST])


def untracked_wrist(time_s: np.ndarray, object_m: np.ndarray) -> Motion:
    """A wrist out of range of all sensors, from object positions (frame, 3)."""
    position_m = object_m + np.array([UNTRACKED_DISTANCE_M, 0.0, 0.0])
    return Motion(time_s, np.tile(np.eye(3), (len(time_s), 1, 1)), position_m.astype(np.float64))


def control_from_clip(clip: Clip) -> Control:
    """Wrists and object of a recorded clip, world frame."""
    axes, origin_m = np.eye(3), np.zeros(3)
    tracks = [clip.hands[side] for side in SIDES]
    wrists = np.stack([hand_features(track, axes, origin_m)[:, : GLOBAL_ORIENT_6D.stop] for track in tracks])
    valid = np.stack([track.valid for track in tracks])
    return control_of(Trajectories(wrists, valid, object_features(clip.object, axes, origin_m)), clip.object.model)


def trajectories_of(sample: ClipSample) -> Trajectories:
    """The trajectories of a clip's wrists and object, without fingers."""
    return Trajectories(sample.hands[..., : GLOBAL_ORIENT_6D.stop], sample.valid, sample.object)


def finger_rotmats_of(hand_features: np.ndarray) -> np.ndarray:
    """Finger rotations (frame, 15, 3, 3) of features (frame, 99)."""
    return rot6d_to_rotmat(hand_features[:, HAND_POSE_6D].astype(np.float64).reshape(-1, N_ROTATIONS - 1, 6))
