"""Ground truth of a synthetic action, from which the writers produce the files of a dataset."""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from hoidata.clips.clip import FPS, SIDES, HandTrack, HandType, ObjectTrack, Side
from hoidata.hands import HandPair, track_joints

GRAVITY = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class TruthSequence:
    """One action with approach and retreat, at the frame rate of the source; world frame (z up), metres, radians."""

    dataset: str
    subject: str  # as in the source
    source_key: str  # raw sequence: H2O "subject1/h1/0", GRAB "s1/mug_drink_1", ARCTIC "s01/box_use_01"
    raw_start: int  # first frame in the raw sequence
    source_fps: int  # 30, or 120 for GRAB
    verb: str
    object_name: str  # as in the source
    object_words: str  # noun in sentences
    intent: str
    hand_type: HandType  # the hands that touch the object
    hands: dict[Side, HandTrack]  # both sides; ``valid`` is False if the source marks the hand as absent
    object: ObjectTrack
    clip: tuple[int, int]  # first frame and one past the last of the labelled interval
    contact: tuple[int, int]  # the same of the grasp
    lifted: np.ndarray  # (frame,) bool: the object is more than 1.5 cm above its rest
    stand_m: float  # height of the stand that it rests on
    # ``contact`` of each hand; empty if the active hands grasp together and the other hand stays away
    contact_by_side: dict[Side, tuple[int, int]] = field(default_factory=dict)
    # hands that let go and grasp again: first frame without contact and the first with contact again
    released: dict[Side, tuple[int, int]] = field(default_factory=dict)

    @property
    def n_frames(self) -> int:
        return len(self.lifted)

    @property
    def stride(self) -> int:
        """Source frames per 30 fps frame."""
        return self.source_fps // FPS

    @property
    def clip_frames(self) -> np.ndarray:
        """Frame numbers of the clip at 30 fps: those whose raw frame number is a multiple of the stride."""
        frames = np.arange(*self.clip)
        return frames[(frames + self.raw_start) % self.stride == 0]

    @property
    def source_frames(self) -> np.ndarray:
        """(clip frame,) raw frame numbers, counted from 0, of the clip at 30 fps."""
        return self.clip_frames + self.raw_start

    @property
    def active_sides(self) -> tuple[Side, ...]:
        return tuple(side for side in SIDES if self.hand_type in (side, "both"))

    def contact_intervals(self) -> list[tuple[int, int, tuple[Side, ...]]]:
        """Divide the contact into intervals with the same hands: first frame, one past the last, and the hands."""
        touching = {side: self.in_contact(side) for side in self.active_sides}
        changes = np.any([np.diff(flags, prepend=False, append=False) for flags in touching.values()], axis=0)
        return [
            (int(start), int(stop), tuple(side for side in self.active_sides if touching[side][start]))
            for start, stop in pairwise(np.flatnonzero(changes))
        ]

    def in_contact(self, side: Side) -> np.ndarray:
        """Return (frame,) bool: whether an active hand grasps the object."""
        frames = np.arange(self.n_frames)
        (start, stop), gap = self.contact_by_side.get(side, self.contact), self.released.get(side, (0, 0))
        return (frames >= start) & (frames < stop) & ~((frames >= gap[0]) & (frames < gap[1]))

    def at_30_fps(self) -> "TruthSequence":
        """Return the whole action, with approach and retreat, at every ``stride``-th raw frame."""
        frames = np.arange(self.n_frames)
        return self.take(frames[(frames + self.raw_start) % self.stride == 0])

    def take(self, frames: np.ndarray) -> "TruthSequence":
        """Select frames; ``clip`` and ``contact`` become their intervals among the selected frames."""
        return replace(
            self,
            hands={side: hand.take(frames) for side, hand in self.hands.items()},
            object=self.object.take(frames),
            lifted=self.lifted[frames],
            clip=_span(frames, self.clip),
            contact=_span(frames, self.contact),
            contact_by_side={side: _span(frames, span) for side, span in self.contact_by_side.items()},
            released={side: _span(frames, span) for side, span in self.released.items()},
        )

    def joints(self, pair: HandPair) -> dict[Side, np.ndarray]:
        """Return (frame, 21, 3) world joints of both hands."""
        return {side: track_joints(self.hands[side], pair[side]) for side in SIDES}


def _span(frames: np.ndarray, span: tuple[int, int]) -> tuple[int, int]:
    return int(np.searchsorted(frames, span[0])), int(np.searchsorted(frames, span[1]))
