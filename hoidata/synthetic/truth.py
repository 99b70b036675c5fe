"""What a synthetic action truly is, before any writer turns it into a dataset's own files."""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from hoidata.clips.clip import FPS, SIDES, HandTrack, HandType, ObjectTrack, Side
from hoidata.hands import HandPair, track_joints

GRAVITY = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class TruthSequence:
    """One action with its approach and retreat, at the source's own frame rate, world frame (z up), metres, radians.

    dataset, subject: as in the source. source_key: the raw sequence it lies in (H2O "subject1/h1/0", GRAB
    "s1/mug_drink_1", ARCTIC "s01/box_use_01"). raw_start: its first frame there. source_fps: 30, or 120 for GRAB.
    verb, object_words: in words. object_name: the source's name. hand_type: the hands that touch.
    hands: both sides; ``valid`` is False where the source says the hand is absent. object: pose and hinge.
    clip: first frame and one past the last of the labelled interval. contact: the same for the firm grasp.
    held: (frame,) the object is more than 1.5 cm above its rest. stand_m: height of the stand it rests on.
    firm: by side ``contact`` of that hand alone; empty where the acting hands hold together, and nobody else is near.
    """

    dataset: str
    subject: str
    source_key: str
    raw_start: int
    source_fps: int
    verb: str
    object_name: str
    object_words: str
    intent: str
    hand_type: HandType
    hands: dict[Side, HandTrack]
    object: ObjectTrack
    clip: tuple[int, int]
    contact: tuple[int, int]
    held: np.ndarray
    stand_m: float
    firm: dict[Side, tuple[int, int]] = field(default_factory=dict)

    @property
    def n_frames(self) -> int:
        return len(self.held)

    @property
    def stride(self) -> int:
        """Source frames per 30 fps frame."""
        return self.source_fps // FPS

    @property
    def clip_frames(self) -> np.ndarray:
        """Own frame numbers of the clip at 30 fps: those whose raw frame number the stride divides."""
        frames = np.arange(*self.clip)
        return frames[(frames + self.raw_start) % self.stride == 0]

    @property
    def source_frames(self) -> np.ndarray:
        """(clip frame,) raw frame numbers, counted from 0, of the clip at 30 fps."""
        return self.clip_frames + self.raw_start

    @property
    def acting_sides(self) -> tuple[Side, ...]:
        return tuple(side for side in SIDES if self.hand_type in (side, "both"))

    def holding(self) -> list[tuple[int, int, tuple[Side, ...]]]:
        """The contact in pieces during which the same hands hold: first frame, one past the last, and the hands."""
        firm = self.firm or dict.fromkeys(self.acting_sides, self.contact)
        cuts = sorted({frame for span in firm.values() for frame in span})
        return [
            (start, stop, tuple(side for side in SIDES if side in firm and firm[side][0] <= start < firm[side][1]))
            for start, stop in pairwise(cuts)
        ]

    def at_30_fps(self) -> "TruthSequence":
        """The whole action, approach and retreat included, every ``stride``-th raw frame."""
        frames = np.arange(self.n_frames)
        return self.take(frames[(frames + self.raw_start) % self.stride == 0])

    def take(self, frames: np.ndarray) -> "TruthSequence":
        """Only the given own frames; ``clip`` and ``contact`` then span what is left of them."""
        return replace(
            self,
            hands={side: hand.take(frames) for side, hand in self.hands.items()},
            object=self.object.take(frames),
            held=self.held[frames],
            clip=_span(frames, self.clip),
            contact=_span(frames, self.contact),
            firm={side: _span(frames, span) for side, span in self.firm.items()},
        )

    def joints(self, pair: HandPair) -> dict[Side, np.ndarray]:
        """(frame, 21, 3) world joints of both hands at every frame of this sequence."""
        return {side: track_joints(self.hands[side], pair[side]) for side in SIDES}


def _span(frames: np.ndarray, span: tuple[int, int]) -> tuple[int, int]:
    return int(np.searchsorted(frames, span[0])), int(np.searchsorted(frames, span[1]))
