"""A whole recording with the hand skeleton and the frame rate of its source."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from hoidata.clips.clip import Frames, ObjectTrack, Side, SourceFile, Track
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand


@dataclass(frozen=True, eq=False)
class SourceHandTrack(Track):
    """Motion of one hand with the skeleton of the source, world frame."""

    PER_FRAME: ClassVar = ("wrist_m", "rotvec")

    wrist_m: np.ndarray  # (frame, 3) metres
    # (frame, joint, 3) axis-angles, radians: world_from_wrist, then joints relative to their parents
    rotvec: np.ndarray


@dataclass(frozen=True, eq=False)
class HandRecording:
    """All frames of one source sequence, in the world frame of its clips."""

    dataset: str
    subject: str
    sequence: str
    fps: float
    hand: TrackedHand  # the right hand; the left hand is its mirror image
    hands: dict[Side, SourceHandTrack]
    object: ObjectTrack
    usable: np.ndarray  # (frame,) bool: False if tracking failed
    gravity: np.ndarray  # (3,) unit vector
    sources: tuple[SourceFile, ...] = ()

    @property
    def n_frames(self) -> int:
        return len(self.usable)

    @property
    def time_s(self) -> np.ndarray:
        """(frame,) seconds since the first frame."""
        return np.arange(self.n_frames) / self.fps

    def tracked_hand(self, side: Side) -> TrackedHand:
        return self.hand if side == "right" else self.hand.mirrored()

    def world_from_wrist(self, side: Side) -> RigidTransform:
        """Return (frame,) transforms in float64."""
        track = self.hands[side]
        return RigidTransform.from_rotvec(track.rotvec[:, 0].astype(np.float64), track.wrist_m.astype(np.float64))

    def finger_rotmats(self, side: Side, frames: Frames = slice(None)) -> np.ndarray:
        """Return (frame, joint - 1, 3, 3) float64 rotations of the finger joints, for ``TrackedHand.state``."""
        return rotvec_to_rotmat(self.hands[side].rotvec[frames, 1:].astype(np.float64))

    def state(self, side: Side, frames: Frames = slice(None)) -> HandState:
        """Return the recorded hand in the frame of its wrist."""
        return self.tracked_hand(side).state(self.finger_rotmats(side, frames))

    def take(self, frames: Frames) -> "HandRecording":
        """Select evenly spaced frames. The caller must adapt ``fps``."""
        return replace(
            self,
            hands={side: track.take(frames) for side, track in self.hands.items()},
            object=self.object.take(frames),
            usable=self.usable[frames],
        )
