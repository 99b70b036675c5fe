"""A whole recording with the hands as its source has them: their own joints, at the source's own rate."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from hoidata.clips.clip import Frames, ObjectTrack, Side, SourceFile, Track
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand


@dataclass(frozen=True, eq=False)
class OwnHandTrack(Track):
    """Motion of one hand of any skeleton, world frame.

    wrist_m: (frame, 3) metres. rotvec: (frame, joint, 3) axis-angles, radians: world_from_wrist, then each joint
    relative to its parent.
    """

    PER_FRAME: ClassVar = ("wrist_m", "rotvec")

    wrist_m: np.ndarray
    rotvec: np.ndarray


@dataclass(frozen=True, eq=False)
class HandRecording:
    """One sequence of a source, every frame of it, in the world its clips are in.

    fps: frames per second. hand: the right hand; the left one is its mirror image. usable: (frame,) bool, False where
    tracking failed. gravity: (3,) unit vector.
    """

    dataset: str
    subject: str
    sequence: str
    fps: float
    hand: TrackedHand
    hands: dict[Side, OwnHandTrack]
    object: ObjectTrack
    usable: np.ndarray
    gravity: np.ndarray
    sources: tuple[SourceFile, ...] = ()

    @property
    def n_frames(self) -> int:
        return len(self.usable)

    @property
    def time_s(self) -> np.ndarray:
        """(frame,) from 0."""
        return np.arange(self.n_frames) / self.fps

    def tracked_hand(self, side: Side) -> TrackedHand:
        return self.hand if side == "right" else self.hand.mirrored()

    def world_from_wrist(self, side: Side) -> RigidTransform:
        """(frame,) transforms in float64."""
        track = self.hands[side]
        return RigidTransform.from_rotvec(track.rotvec[:, 0].astype(np.float64), track.wrist_m.astype(np.float64))

    def finger_rotmats(self, side: Side, frames: Frames = slice(None)) -> np.ndarray:
        """(frame, joint - 1, 3, 3) float64, for ``TrackedHand.state``."""
        return rotvec_to_rotmat(self.hands[side].rotvec[frames, 1:].astype(np.float64))

    def state(self, side: Side, frames: Frames = slice(None)) -> HandState:
        """The recorded hand in its wrist's frame."""
        return self.tracked_hand(side).state(self.finger_rotmats(side, frames))

    def take(self, frames: Frames) -> "HandRecording":
        """Some frames of it: evenly spaced ones, of which ``fps`` is the caller's to say."""
        return replace(
            self,
            hands={side: track.take(frames) for side, track in self.hands.items()},
            object=self.object.take(frames),
            usable=self.usable[frames],
        )
