"""Fingers for trajectories that come frame by frame: the same numbers as for the whole clip, a look-ahead later.

The look-ahead is what the network reads: half a second.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import Side
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from models.manipnet.control import Control, Motion
from models.manipnet.rollout import Follower, Predictor, Situation, situation

SPARE_S = 0.25  # kept beyond the oldest sample: the one before it tells a velocity


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """One frame as a tracker gives it. wrists: world_from_wrist, things: world_from_object of what each hand handles.

    hinge_rad: of hinged objects, by side.
    """

    time_s: float
    wrists: Mapping[Side, RigidTransform]
    things: Mapping[Side, RigidTransform]
    hinge_rad: Mapping[Side, float] | None = None


class Stream:
    """Push frames; every push gives the finger rotations that can be told by then, in order, ``finish`` the rest.

    hands: those to animate; both wrists are always tracked. models: the object of each. start: finger rotations
    (joint - 1, 3, 3) at the first frame. Frame k of the answer stands for k steps of the network after the first
    frame, whatever the tracker's rate, and is told when what the network reads of later times is there.
    """

    def __init__(
        self,
        predictor: Predictor,
        hands: Mapping[Side, TrackedHand],
        models: Mapping[Side, ObjectModel],
        start: Mapping[Side, np.ndarray],
    ) -> None:
        self.predictor, self.hands, self.models = predictor, hands, models
        surfaces = {side: surface_index(models[side]) for side in hands}
        self.followers: dict[Side, Follower] = {
            side: Follower(predictor, hands[side], surfaces[side], start[side]) for side in hands
        }
        self.frames: list[TrackedFrame] = []
        self.made = 0
        self.first_s = 0.0
        settings = predictor.settings
        read_s = [*settings.samples_s, *settings.sensors.times_s]  # from now
        self._behind_s, self._ahead_s = -min(read_s), max(settings.step_s, *read_s)

    def push(self, frame: TrackedFrame) -> list[dict[Side, np.ndarray]]:
        """Poses that can be told now: by side (joint - 1, 3, 3). Often none, sometimes several."""
        self.first_s = frame.time_s if not self.frames else self.first_s
        self.frames.append(frame)
        return self._told(frame.time_s - self._ahead_s)

    def finish(self) -> list[dict[Side, np.ndarray]]:
        """The poses up to the last frame; what lies beyond it is taken to stand still."""
        return self._told(np.inf)

    def _told(self, known_s: float) -> list[dict[Side, np.ndarray]]:
        """Poses whose inputs, one step before, lie before ``known_s``."""
        told = []
        if self.made == 0 and self.frames:
            told.append(self._poses())
            self.made = 1
        while self._time_s(self.made - 1) < known_s and self._time_s(self.made) <= self.frames[-1].time_s + 1e-6:
            now = self._situations(self._time_s(self.made - 1))
            # Of the frame that is made only where the object is now counts: what is ahead of it may not be there yet.
            then = self._situations(self._time_s(self.made))
            rows = np.stack([self.followers[side].inputs(now[side]) for side in self.hands])
            for side, output in zip(self.hands, self.predictor(rows), strict=True):
                self.followers[side].advance(output, then[side])
            told.append(self._poses())
            self.made += 1
            self._forget(self._time_s(self.made - 1) - self._behind_s - SPARE_S)
        return told

    def _time_s(self, number: int) -> float:
        return self.first_s + number / (1 / self.predictor.settings.step_s)  # as the times of clips round

    def _poses(self) -> dict[Side, np.ndarray]:
        return {side: self.followers[side].answer[0] for side in self.hands}

    def _situations(self, time_s: float) -> dict[Side, Situation]:
        settings = self.predictor.settings
        return {side: situation(self._control(side), side, hand, time_s, settings) for side, hand in self.hands.items()}

    def _control(self, side: Side) -> Control:
        times = np.array([frame.time_s for frame in self.frames])
        angles = [frame.hinge_rad for frame in self.frames]
        hinge = None if not self.models[side].is_articulated else np.array([angle[side] for angle in angles if angle])
        return Control(
            {own: _motion(times, [frame.wrists[own] for frame in self.frames]) for own in self.frames[0].wrists},
            _motion(times, [frame.things[side] for frame in self.frames]),
            self.models[side],
            hinge,
        )

    def _forget(self, before_s: float) -> None:
        """Let go of frames that nothing asks for any more; the one just before is kept to interpolate from."""
        while len(self.frames) > 2 and self.frames[1].time_s < before_s:
            self.frames.pop(0)


def _motion(times: np.ndarray, placed: list[RigidTransform]) -> Motion:
    return Motion(times, np.stack([one.rotation for one in placed]), np.stack([one.translation for one in placed]))
