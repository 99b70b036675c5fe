"""Fingers for a live tracker, delayed by the network's look-ahead of 0.5 s; faults of the tracker never end a stream.

- A frame without a wrist or object, or with a pose that is not a finite rigid transform, is skipped for that body.
  Gaps up to the look-ahead are interpolated. In a longer gap the hand keeps its fingers.
- After such a gap or a jump, the body starts a new trajectory, as at the start of a recording, and the fingers are
  blended from the kept to the predicted pose.
- Frames that are not later than the one before are dropped, as is a frame after a pause that no other follows within
  the look-ahead. After ``MAX_LATE_FRAMES`` earlier ones, or a pause of more than ``MAX_PAUSE_S``, the stream's clock
  continues from the new time: its times then differ from the tracker's.
"""

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import InitVar, dataclass
from itertools import chain
from typing import NamedTuple, TypeGuard

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.geometry.motion import Motion, interpolate_rotations
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.object_paths.trajectory_files import MAX_SPEED_M_S
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from models.manipnet.control import Control, untracked_wrist
from models.manipnet.features import object_from_wrist
from models.manipnet.rollout import FrameContext, HandRollout, Predictor, frame_context

MARGIN_S = 0.25  # frames kept before the oldest trajectory sample, whose velocity needs the frame before it
ROUNDING_S = 1e-6
BLEND_S = 0.3
MAX_GAP_S = 0.5  # a wrist lost for longer makes frames of a recording invalid
MAX_TURN_RAD_S = 40.0  # a body that turns faster has jumped
MAX_LATE_FRAMES, MAX_PAUSE_S = 10, 5.0
MAX_POSITION_M, ROTATION_TOLERANCE = 1e3, 1e-3  # of a usable pose; the tolerance is that of R R^T - I


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """One frame of a tracker; bodies may be missing, None or not finite."""

    time_s: float
    wrists: Mapping[Side, RigidTransform | None]  # world_from_wrist
    objects: Mapping[Side, RigidTransform | None]  # world_from_object of the object of each hand
    hinge_rad: Mapping[Side, float] | None = None  # of hinged objects


def tracked_frames(control: Control) -> Iterator[TrackedFrame]:
    """The frames of recorded trajectories, as a tracker delivers them."""
    time_s = control.object_motion.time_s
    wrist_poses: dict[Side, RigidTransform] = {side: control.wrists[side].at(time_s) for side in SIDES}
    object_poses: dict[Side, RigidTransform] = {side: control.of(side).object_motion.at(time_s) for side in SIDES}
    hinge_rad = control.hinge_at(time_s)
    for frame, frame_s in enumerate(time_s.tolist()):
        wrists: dict[Side, RigidTransform | None] = {side: poses[frame] for side, poses in wrist_poses.items()}
        angles = None if hinge_rad is None else dict.fromkeys(SIDES, float(hinge_rad[frame]))
        objects: dict[Side, RigidTransform | None] = {side: poses[frame] for side, poses in object_poses.items()}
        yield TrackedFrame(frame_s, wrists, objects, angles)


class Sample(NamedTuple):
    """One frame of one body."""

    time_s: float
    pose: RigidTransform
    hinge_rad: float


Trajectory = list[Sample]  # without jumps and without gaps longer than the look-ahead


def is_usable(pose: RigidTransform | None) -> TypeGuard[RigidTransform]:
    """Whether a tracked pose is finite, not absurdly far, and a proper rotation."""
    if pose is None or not (np.isfinite(pose.rotation).all() and (np.abs(pose.translation) < MAX_POSITION_M).all()):
        return False
    error = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max()
    return bool(error < ROTATION_TOLERANCE and np.linalg.det(pose.rotation) > 0)


def is_jump(before: Sample, after: Sample) -> bool:
    """Whether a body moved or turned faster than it can between two frames."""
    elapsed_s = after.time_s - before.time_s
    moved_m = np.linalg.norm(after.pose.translation - before.pose.translation)
    cosine = ((before.pose.rotation * after.pose.rotation).sum() - 1) / 2
    return bool(moved_m > MAX_SPEED_M_S * elapsed_s or cosine < np.cos(min(MAX_TURN_RAD_S * elapsed_s, np.pi)) - 1e-6)


def add_sample(trajectories: list[Trajectory], sample: Sample, max_gap_s: float) -> None:
    """Append to the last trajectory; start a new one after a gap or jump."""
    last = trajectories[-1][-1] if trajectories else None
    if last and sample.time_s - last.time_s <= max_gap_s and not is_jump(last, sample):
        trajectories[-1].append(sample)
    else:
        trajectories.append([sample])


def trajectory_at(trajectories: list[Trajectory], time_s: float) -> Trajectory:
    """The last trajectory that has started at a time; empty if none has."""
    return next((samples for samples in reversed(trajectories) if samples[0].time_s <= time_s), [])


def joined_at(trajectories: list[Trajectory], time_s: float) -> Trajectory:
    """The trajectory at a time, or the first, with those before and after it up to the next jump."""
    joined: list[Trajectory] = []
    for samples in trajectories:
        if joined and not is_jump(joined[-1][-1], samples[0]):
            joined[-1] = joined[-1] + samples
        else:
            joined.append(samples)
    return trajectory_at(joined, time_s) or next(iter(joined), [])


def motion_of(samples: Trajectory) -> Motion:
    """A trajectory with interpolation."""
    rotmats = np.stack([sample.pose.rotation for sample in samples])
    position_m = np.stack([sample.pose.translation for sample in samples])
    return Motion(np.array([sample.time_s for sample in samples]), rotmats, position_m)


def control_of_frames(
    frames: Sequence[TrackedFrame], model: ObjectModel, hand: Side = "right"
) -> tuple[Control | None, np.ndarray]:
    """Trajectories at 30 fps of a tracker's frames with a hand's object, interpolated in gaps; None without it.

    Also (2, frame) whether each wrist is tracked, or lost for at most ``MAX_GAP_S``.
    """
    bodies: list[list[Sample]] = [[], [], []]  # wrists and object
    for one in frames:
        for samples, pose in zip(bodies, (*map(one.wrists.get, SIDES), one.objects.get(hand)), strict=True):
            if is_usable(pose):
                samples.append(Sample(one.time_s, pose, (one.hinge_rad or {}).get(hand, 0.0)))
    if not bodies[2]:
        return None, np.zeros((2, 0), bool)
    first_s, body, valid = frames[0].time_s, motion_of(bodies[2]), []
    time_s = first_s + np.arange(int((frames[-1].time_s - first_s) * FPS + ROUNDING_S) + 1) / FPS
    wrists: dict[Side, Motion] = {}
    for side, samples in zip(SIDES, bodies, strict=False):
        wrists[side] = motion_of(samples) if samples else untracked_wrist(body.time_s, body.position_m)
        sample_s = np.array([sample.time_s for sample in samples])
        before_s = np.append(sample_s, -np.inf)[np.searchsorted(sample_s, time_s + ROUNDING_S) - 1]
        after_s = np.append(sample_s, np.inf)[np.searchsorted(sample_s, time_s - ROUNDING_S)]
        valid.append(after_s - before_s <= MAX_GAP_S)
    hinge_rad = np.array([sample.hinge_rad for sample in bodies[2]]) if model.is_articulated else None
    return Control(wrists, body, model, hinge_rad).at(time_s), np.stack(valid)


@dataclass
class _HandStream:
    """One hand of a stream."""

    rollout: HandRollout
    blend_start: np.ndarray  # (joint - 1, 3, 3) the pose from which to blend
    model: ObjectModel  # its object at the time of its pose
    blended: float = 1.0  # weight of the predicted pose
    exchange_s: float = np.inf  # from when on the object is another
    trajectories: tuple[Trajectory, Trajectory] | None = None  # of wrist and object in the last step

    @property
    def pose(self) -> np.ndarray:
        """(joint - 1, 3, 3) the pose to show."""
        if self.blended >= 1:
            return self.rollout.answer[0]
        return interpolate_rotations(self.blend_start, self.rollout.answer[0], np.array([self.blended]))

    def restart(self) -> None:
        """Blend from the present pose."""
        self.blend_start, self.blended = self.pose, 0.0


@dataclass(eq=False)
class Stream:
    """Predicts finger poses while a tracker delivers frames.

    Pose k is for k network steps after the first frame, at any frame rate of the tracker. ``push`` returns it once the
    frames within the look-ahead have arrived; ``finish`` returns the remaining poses.
    """

    predictor: Predictor
    hands: Mapping[Side, TrackedHand]  # to animate
    models: dict[Side, ObjectModel]  # the object of each hand
    start: InitVar[Mapping[Side, np.ndarray]]  # (joint - 1, 3, 3) finger rotations in the first frame

    def __post_init__(self, start: Mapping[Side, np.ndarray]) -> None:
        self.models, settings = dict(self.models), self.predictor.settings
        read_s = [*settings.samples_s, *settings.sensors.times_s]  # relative to the present
        self._behind_s, self._ahead_s = -min(read_s), max(settings.step_s, *read_s)
        self._hands: dict[Side, _HandStream] = {}
        for side, hand in self.hands.items():
            model = self.models[side]
            rollout = HandRollout(self.predictor, hand, surface_index(model).prepare(), start[side])
            self._hands[side] = _HandStream(rollout, start[side], model)
        self._wrists: dict[Side, list[Trajectory]] = {side: [] for side in SIDES}
        self._objects: dict[Side, list[Trajectory]] = {side: [] for side in self.hands}
        self.pose_count, self.first_s, self.last_s = 0, -np.inf, -np.inf  # times of the first and last frame
        self._clock_offset_s, self._late_frames, self._unconfirmed_s = 0.0, 0, -np.inf
        self.dropped = 0  # frames with a time that was not used

    def push(self, frame: TrackedFrame) -> list[dict[Side, np.ndarray]]:
        """Add a frame and return the poses that are now complete, by side (joint - 1, 3, 3): often none or several."""
        if not np.isfinite(frame.time_s) or not self._advance_clock(frame.time_s):
            self.dropped += 1
            return []
        for side in SIDES:
            if is_usable(pose := frame.wrists.get(side)):
                add_sample(self._wrists[side], Sample(self.last_s, pose, 0.0), self._ahead_s)
        for side in self.hands:
            angle = (frame.hinge_rad or {}).get(side, np.nan) if self.models[side].is_articulated else 0.0
            if is_usable(pose := frame.objects.get(side)) and np.isfinite(angle):
                objects, exchange_s = self._objects[side], self._hands[side].exchange_s
                is_other = bool(objects) and objects[-1][-1].time_s <= exchange_s < np.inf
                add_sample(objects, Sample(self.last_s, pose, angle), -1.0 if is_other else self._ahead_s)
        return list(self._ready_poses(self.last_s - self._ahead_s))

    def finish(self) -> list[dict[Side, np.ndarray]]:
        """End the stream: return the poses not yet returned, as if wrists and objects rested after the last frame."""
        return list(self._ready_poses(np.inf)) if np.isfinite(self.first_s) else []

    def exchange(self, side: Side, model: ObjectModel) -> None:
        """Replace the object of a hand after the last frame; its tracked pose then moves the new mesh."""
        surface_index(model).prepare()
        self.models[side], self._hands[side].exchange_s = model, self.last_s

    def _advance_clock(self, time_s: float) -> bool:
        """Set ``last_s`` to the time of a frame on the stream's clock; False for a frame to drop."""
        if self.last_s == -np.inf:
            self.first_s = self.last_s = time_s
            return True
        elapsed_s = time_s + self._clock_offset_s - self.last_s
        is_repeated = abs(elapsed_s) < ROUNDING_S
        if is_repeated or (elapsed_s < 0 and self._late_frames < MAX_LATE_FRAMES):
            self._late_frames += not is_repeated
            return False
        if elapsed_s > self._ahead_s and not 0 < time_s - self._unconfirmed_s <= self._ahead_s:
            self._unconfirmed_s = time_s  # one wrong time must not move the clock
            return False
        if not 0 < elapsed_s <= MAX_PAUSE_S:  # count it as a pause that starts new trajectories
            self._clock_offset_s += self._ahead_s + MARGIN_S - elapsed_s
        self.last_s, self._late_frames = time_s + self._clock_offset_s, 0
        return True

    def _ready_poses(self, until_s: float) -> Iterator[dict[Side, np.ndarray]]:
        """Poses whose input, one step earlier, is before ``until_s``."""
        if self.pose_count == 0 and self.last_s > -np.inf:
            yield self._next_poses()
        while self._time_s(self.pose_count - 1) < until_s and self._time_s(self.pose_count) <= self.last_s + ROUNDING_S:
            now_s, next_s = self._time_s(self.pose_count - 1), self._time_s(self.pose_count)
            for side, hand in self._hands.items():
                if next_s > hand.exchange_s:
                    hand.model, hand.exchange_s = self.models[side], np.inf
                    hand.rollout.surface = surface_index(hand.model)
                    hand.restart()
            sides: list[Side] = [
                side for side in self.hands if self._is_tracked(side, now_s) and self._is_tracked(side, next_s)
            ]
            outputs = self.predictor(np.stack([self._inputs(side, now_s) for side in sides])) if sides else []
            for side, output in zip(sides, outputs, strict=True):
                # Post-processing reads only the present of the following frame; its future may not have arrived.
                control, settings = self._control(side, next_s), self.predictor.settings
                following = object_from_wrist(control, side, np.array([next_s]), settings)
                self._hands[side].rollout.advance(output, FrameContext(np.empty(0), *following))
                self._hands[side].blended += settings.step_s / BLEND_S
            yield self._next_poses()
            for bodies in chain(self._wrists.values(), self._objects.values()):
                _discard(bodies, now_s - self._behind_s - MARGIN_S)

    def _time_s(self, number: int) -> float:
        return self.first_s + number / (1 / self.predictor.settings.step_s)  # rounds like the times of clips

    def _next_poses(self) -> dict[Side, np.ndarray]:
        self.pose_count += 1
        return {side: hand.pose for side, hand in self._hands.items()}

    def _trajectories(self, side: Side, time_s: float) -> tuple[Trajectory, Trajectory]:
        """Those of a hand's wrist and object at a time; empty before they start."""
        return trajectory_at(self._wrists[side], time_s), trajectory_at(self._objects[side], time_s)

    def _is_tracked(self, side: Side, time_s: float) -> bool:
        """Whether wrist and object are known at a time, recorded or interpolated."""
        return all(body and time_s <= body[-1].time_s + ROUNDING_S for body in self._trajectories(side, time_s))

    def _inputs(self, side: Side, time_s: float) -> np.ndarray:
        """The network's input of a tracked hand."""
        hand, bodies = self._hands[side], self._trajectories(side, time_s)
        # In the first step the start pose is not blended.
        if self.pose_count > 1 and not (hand.trajectories and all(map(operator.is_, bodies, hand.trajectories))):
            hand.restart()
        hand.trajectories, control = bodies, self._control(side, time_s)
        return hand.rollout.inputs(frame_context(control, side, self.hands[side], time_s, self.predictor.settings))

    def _control(self, side: Side, time_s: float) -> Control:
        """Wrists and object of a tracked hand around a time."""
        bodies = self._trajectories(side, time_s)
        # Wrist and object rest after the end of either: one alone would move through the other.
        stop_s = min(body[-1].time_s for body in bodies) + ROUNDING_S
        wrist, samples = ([sample for sample in body if sample.time_s <= stop_s] for body in bodies)
        body = motion_of(samples)
        # The other wrist is interpolated over gaps and rests at jumps: its distance then has no jump.
        wrists: dict[Side, Motion] = {
            other: motion_of(frames) if frames else untracked_wrist(body.time_s, body.position_m)
            for other in SIDES
            for frames in [wrist if other == side else joined_at(self._wrists[other], time_s)]
        }
        model = self._hands[side].model
        hinge_rad = np.array([sample.hinge_rad for sample in samples]) if model.is_articulated else None
        return Control(wrists, body, model, hinge_rad)


def _discard(trajectories: list[Trajectory], before_s: float) -> None:
    """Discard what is before a time, but keep the last frame before it for interpolation."""
    while len(trajectories) > 1 and trajectories[1][0].time_s < before_s:
        trajectories.pop(0)
    while trajectories and len(trajectories[0]) > 2 and trajectories[0][1].time_s < before_s:
        trajectories[0].pop(0)
