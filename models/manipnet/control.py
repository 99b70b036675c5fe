"""What ManipNet is given: the motion of both wrists and of an object, at any rate, asked at any time."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hoidata.clips.clip import SIDES, Side
from hoidata.clips.recording import HandRecording
from hoidata.geometry.transform import RigidTransform
from hoidata.objects.model import ObjectModel

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


def recording_control(recording: HandRecording) -> Control:
    """What a recording with its source's own hands gives the network, at its own rate, time 0 in its first frame."""
    thing, time_s = recording.object, recording.time_s
    wrists: dict[Side, Motion] = {}
    for side in SIDES:
        pose = recording.world_from_wrist(side)
        wrists[side] = Motion(time_s, pose.rotation, pose.translation)
    body = thing.world_from_object
    hinge = None if thing.hinge_rad is None else thing.hinge_rad.astype(np.float64)
    return Control(wrists, Motion(time_s, body.rotation, body.translation), thing.model, hinge)
