"""Fingers for a live tracker: the same results as for the whole clip, delayed by the network's look-ahead of 0.5 s."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import Side
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from models.manipnet.control import Control, Motion
from models.manipnet.rollout import FrameContext, HandRollout, Predictor, frame_context

MARGIN_S = 0.25  # frames kept before the oldest trajectory sample, whose velocity needs the frame before it


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """One frame of a tracker."""

    time_s: float
    wrists: Mapping[Side, RigidTransform]  # world_from_wrist
    objects: Mapping[Side, RigidTransform]  # world_from_object of the object of each hand
    hinge_rad: Mapping[Side, float] | None = None  # of hinged objects


class Stream:
    """Predicts finger poses while a tracker delivers frames.

    Pose k is for k network steps after the first frame, at any frame rate of the tracker. ``push`` returns it once the
    frames within the look-ahead have arrived; ``finish`` returns the remaining poses.

    Args:
        predictor: the network.
        hands: the hands to animate. Both wrists must be tracked.
        models: the object of each hand.
        start: finger rotations (joint - 1, 3, 3) in the first frame.
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
        self.rollouts: dict[Side, HandRollout] = {
            side: HandRollout(predictor, hands[side], surfaces[side], start[side]) for side in hands
        }
        self.frames: list[TrackedFrame] = []
        self.pose_count = 0
        self.first_s = 0.0
        settings = predictor.settings
        read_s = [*settings.samples_s, *settings.sensors.times_s]  # relative to the present
        self._behind_s, self._ahead_s = -min(read_s), max(settings.step_s, *read_s)

    def push(self, frame: TrackedFrame) -> list[dict[Side, np.ndarray]]:
        """Add a frame and return the poses that are now complete, by side (joint - 1, 3, 3): often none or several."""
        self.first_s = frame.time_s if not self.frames else self.first_s
        self.frames.append(frame)
        return self._ready_poses(frame.time_s - self._ahead_s)

    def finish(self) -> list[dict[Side, np.ndarray]]:
        """End the stream: return the poses not yet returned, as if wrists and objects rested after the last frame."""
        return self._ready_poses(np.inf)

    def _ready_poses(self, until_s: float) -> list[dict[Side, np.ndarray]]:
        """Poses whose input, one step earlier, is before ``until_s``."""
        poses = []
        if self.pose_count == 0 and self.frames:
            poses.append(self._poses())
            self.pose_count = 1
        while (
            self._time_s(self.pose_count - 1) < until_s
            and self._time_s(self.pose_count) <= self.frames[-1].time_s + 1e-6
        ):
            current = self._contexts(self._time_s(self.pose_count - 1))
            # Post-processing reads only the present of the following frame; its future may not have arrived.
            following = self._contexts(self._time_s(self.pose_count))
            inputs = np.stack([self.rollouts[side].inputs(current[side]) for side in self.hands])
            for side, output in zip(self.hands, self.predictor(inputs), strict=True):
                self.rollouts[side].advance(output, following[side])
            poses.append(self._poses())
            self.pose_count += 1
            self._discard_frames(self._time_s(self.pose_count - 1) - self._behind_s - MARGIN_S)
        return poses

    def _time_s(self, number: int) -> float:
        return self.first_s + number / (1 / self.predictor.settings.step_s)  # rounds like the times of clips

    def _poses(self) -> dict[Side, np.ndarray]:
        return {side: self.rollouts[side].answer[0] for side in self.hands}

    def _contexts(self, time_s: float) -> dict[Side, FrameContext]:
        settings = self.predictor.settings
        return {
            side: frame_context(self._control(side), side, hand, time_s, settings) for side, hand in self.hands.items()
        }

    def _control(self, side: Side) -> Control:
        times = np.array([frame.time_s for frame in self.frames])
        angles = [frame.hinge_rad for frame in self.frames]
        hinge = None if not self.models[side].is_articulated else np.array([angle[side] for angle in angles if angle])
        return Control(
            {
                wrist_side: _motion(times, [frame.wrists[wrist_side] for frame in self.frames])
                for wrist_side in self.frames[0].wrists
            },
            _motion(times, [frame.objects[side] for frame in self.frames]),
            self.models[side],
            hinge,
        )

    def _discard_frames(self, before_s: float) -> None:
        """Discard frames before a time, but keep the last one for interpolation."""
        while len(self.frames) > 2 and self.frames[1].time_s < before_s:
            self.frames.pop(0)


def _motion(times: np.ndarray, poses: list[RigidTransform]) -> Motion:
    return Motion(times, np.stack([pose.rotation for pose in poses]), np.stack([pose.translation for pose in poses]))
