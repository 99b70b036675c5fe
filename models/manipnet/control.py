"""What ManipNet is given: the motion of both wrists and of an object, at any rate, asked at any time.

Of a clip or a request the same is at its 30 frames per second, with the fingers the network is to give.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Trajectories
from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.clips.features import (
    GLOBAL_ORIENT_6D,
    HAND_POSE_6D,
    N_ROTATIONS,
    OBJECT_HINGE,
    OBJECT_POSITION,
    OBJECT_ROTATION_6D,
    WRIST,
)
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.sensors.mano_hand import mano_hand

_ON_FRAME = 1e-6  # of a frame: times this near to a frame are that frame's


@dataclass(frozen=True, eq=False)
class Motion:
    """One rigid body, world frame. time_s: (frame,) rising. rotmats: (frame, 3, 3); position_m: (frame, 3)."""

    time_s: np.ndarray
    rotmats: np.ndarray
    position_m: np.ndarray

    def at(self, time_s: np.ndarray) -> RigidTransform:
        """``world_from_body`` at times of any shape: turned by slerp, moved straight, held beyond the ends.

        What it says of a time depends on the two frames beside it alone, to the last bit: a stream forgets the others.
        """
        time = np.clip(time_s, self.time_s[0], self.time_s[-1])
        before = np.searchsorted(self.time_s[1:-1], time, side="right")
        after = np.minimum(before + 1, len(self.time_s) - 1)
        since, until = time - self.time_s[before], self.time_s[after] - time
        on_frame = np.minimum(since, until) <= _ON_FRAME * (since + until)
        frame = np.where(since <= until, before, after)
        turn, place = self.rotmats[frame], self.position_m[frame]
        if not on_frame.all():
            between = self._slerp(time.ravel()).as_matrix().reshape(*time.shape, 3, 3)
            columns = [np.interp(time, self.time_s, column) for column in self.position_m.T]
            turn = np.where(on_frame[..., None, None], turn, between)
            place = np.where(on_frame[..., None], place, np.stack(columns, axis=-1))
        return RigidTransform(turn, place)

    @cached_property
    def _slerp(self) -> Slerp:
        return Slerp(self.time_s, Rotation.from_matrix(self.rotmats))


@dataclass(frozen=True, eq=False)
class Control:
    """Wrists and object of one recording. wrists: world_from_wrist by side. thing: world_from_object.

    model: the object's mesh. hinge_rad: (frame,) at ``thing.time_s`` for a hinged object, else None.
    """

    wrists: dict[Side, Motion]
    thing: Motion
    model: ObjectModel
    hinge_rad: np.ndarray | None = None

    @cached_property
    def box_middle_m(self) -> np.ndarray:
        """(3,) the middle of the object's bounding box, object frame, hinge at 0."""
        return (self.model.vertices_m.min(axis=0) + self.model.vertices_m.max(axis=0)) / 2

    def hinge_at(self, time_s: np.ndarray) -> np.ndarray | None:
        """Angles at times of any shape, radians."""
        if self.hinge_rad is None:
            return None
        return np.interp(time_s, self.thing.time_s, self.hinge_rad)


UNSEEN_M = 1.0  # how far away a wrist is taken to be that is never tracked


def between(start: np.ndarray, stop: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Rotations (frame, joint, 3, 3) a share (frame,) of the way from the first to the second."""
    way = rotmat_to_rotvec(start.swapaxes(-1, -2) @ stop)
    return start @ rotvec_to_rotmat(share[:, None, None] * way)


def control_of(given: Trajectories, model: ObjectModel) -> Control:
    """Wrists and object at 30 fps, time 0 in the first frame; a wrist that is lost stays where it was seen nearest."""
    time_s = np.arange(len(given.object)) / FPS
    thing = given.object.astype(np.float64)
    hinge = thing[:, OBJECT_HINGE] if model.is_articulated else None
    wrists: dict[Side, Motion] = {side: _wrist(given, row, time_s) for row, side in enumerate(SIDES)}
    body = Motion(time_s, rot6d_to_rotmat(thing[:, OBJECT_ROTATION_6D]), thing[:, OBJECT_POSITION])
    return Control(wrists, body, model, hinge)


def _wrist(given: Trajectories, row: int, time_s: np.ndarray) -> Motion:
    seen = np.flatnonzero(given.valid[row])
    if not len(seen):
        away = given.object[:, OBJECT_POSITION] + np.array([UNSEEN_M, 0.0, 0.0])
        return Motion(time_s, np.tile(np.eye(3), (len(time_s), 1, 1)), away.astype(np.float64))
    nearest = seen[abs(np.arange(len(time_s))[:, None] - seen).argmin(axis=1)]
    wrist = given.wrists[row, nearest].astype(np.float64)
    return Motion(time_s, rot6d_to_rotmat(wrist[:, GLOBAL_ORIENT_6D]), wrist[:, WRIST])


def trajectories_of(sample: ClipSample) -> Trajectories:
    """What a recording of the clip without its fingers would know."""
    return Trajectories(sample.hands[..., : GLOBAL_ORIENT_6D.stop], sample.valid, sample.object)


def finger_rotmats_of(hand_features: np.ndarray) -> np.ndarray:
    """(frame, 15, 3, 3) of features (frame, 99)."""
    turns = hand_features[:, HAND_POSE_6D].astype(np.float64).reshape(-1, N_ROTATIONS - 1, 6)
    return rot6d_to_rotmat(turns)


def hands_of(pair: HandPair, betas: np.ndarray, template_m: np.ndarray | None) -> Mapping[Side, TrackedHand]:
    """Both hands of a person: betas (2, 10), personal rest meshes (2, 778, 3) or None."""
    templates = [None, None] if template_m is None else [own.tobytes() for own in template_m]
    return {side: _tracked(pair, side, betas[row].tobytes(), templates[row]) for row, side in enumerate(SIDES)}


@lru_cache(maxsize=64)
def _tracked(pair: HandPair, side: Side, betas: bytes, template: bytes | None) -> TrackedHand:
    """Kept, since a person's hand is in many clips and takes a while to make."""
    shape = np.frombuffer(betas, np.float32).astype(np.float64)
    rest = None if template is None else np.frombuffer(template, np.float32).reshape(-1, 3).astype(np.float64)
    return mano_hand(pair, side, shape, rest)
