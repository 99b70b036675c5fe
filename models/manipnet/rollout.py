"""Autoregressive rollout of ManipNet: the pose of each frame is an input of the next (Sec. 6.4).

Each hand is rolled out separately, because its input has no fingers of the other: :class:`HandRollout` takes one step,
``roll_out`` runs whole clips of many hands, ``stream.Stream`` runs frames as they arrive. The network predicts
rotations, and forward kinematics places the joints, so bones keep their length (unlike in the release).

Post-processing moves joints to target points: those of the paper's Algorithm 1, or ours. Points are in the wrist's
frame, metres. Distances are those of joint centres: skin distance plus radius.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch

from hoidata.clips.clip import Side
from hoidata.geometry.motion import interpolate_rotations, poses_at
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.distance import SignedDistance
from hoidata.objects.surface_index import SurfaceIndex, surface_index
from hoidata.sensors import sense
from models.manipnet.control import Control
from models.manipnet.features import (
    FeatureSettings,
    distance_offset_m,
    joint_rotmats_of,
    object_from_wrist,
    pose_features,
    trajectory_features,
)
from models.manipnet.inverse_kinematics import Limits, reach
from models.manipnet.network import ManipNet

Rule = Literal["preset", "off", "paper", "ours"]
ACTIVE_M = 0.028  # Algorithm 1: a point is active up to this predicted distance
# Our rule: a point is active below this fraction of the distance range, as in the release.
ACTIVE_FRACTION = 0.8
NEAR_M = 0.06  # as in the release; without it, a wrong predicted distance pulls at a hand far from the object
# Our rule, chosen on the validation tenths of the real recordings. Their touching points are 4 to 8 mm deep in 5 %.
MAX_INDENTATION_M = 0.008  # how far a finger may be indented by the object
PRESS_M = 0.007  # target distance is the predicted one minus this
FADE_FRACTION = 0.3  # confidence rises from 0 to 1 over this fraction of the range below ACTIVE_FRACTION
MIN_WEIGHT = 0.5  # weight of the predicted pose for points without a contact prediction


@dataclass(frozen=True)
class Targets:
    """Target positions for inverse kinematics."""

    point_m: np.ndarray  # (..., point, 3)
    weight: np.ndarray  # (..., point); 0: no target


def paper_targets(points_m: np.ndarray, predicted: np.ndarray, radius_m: np.ndarray, range_m: float,
                  nearest: SignedDistance) -> Targets:  # fmt: skip
    """Algorithm 1: move active points to a mixture of predicted and true distance; inactive points stay.

    points_m: (..., point, 3) of the predicted pose, where the object's surface is ``nearest``; predicted: (..., point)
    output distances, as fractions of ``range_m``.
    """
    distance_m = predicted * range_m + radius_m
    inside = nearest.distance_m < 0
    mixed_m = np.where(inside, 0.8 * distance_m + 0.2 * nearest.distance_m, 0.2 * distance_m + 0.8 * nearest.distance_m)
    target_m = nearest.closest_m + mixed_m[..., None] * nearest.normal
    return Targets(np.where((distance_m <= ACTIVE_M)[..., None], target_m, points_m), np.ones(predicted.shape))


def our_targets(points_m: np.ndarray, predicted: np.ndarray, radius_m: np.ndarray, range_m: float,
                is_near: np.ndarray, thickness_m: np.ndarray, nearest: SignedDistance) -> Targets:  # fmt: skip
    """Our rule: keep the predicted pose, press points that are predicted to touch, and limit penetration.

    Algorithm 1 has three problems. It stops at the surface, where a contact has no pressure. A predicted distance is a
    mean over many poses, so it lifts touching points off the object. In a thin object, the nearest surface may be on
    the far side. So our rule presses near points against the object, and moves points outward only if they are
    inside. It takes the surface plane at the pose that the solver starts from (``nearest``): a point below that
    plane is inside.

    points_m, predicted: as in ``paper_targets``, (point, 3) and (point,). is_near: (point,) bool, whether the predicted
    points are at the object or in it. thickness_m: (point,) radius of the finger at the point.
    """
    target_height_m = predicted * range_m + radius_m - PRESS_M
    min_height_m = thickness_m - MAX_INDENTATION_M
    # Signed distance of the predicted points from the surface planes.
    height_m = ((points_m - nearest.closest_m) * nearest.normal).sum(axis=-1)
    # Inwards to the target height, never outwards, except up to the indentation limit.
    move_m = np.maximum(np.minimum(target_height_m, height_m), min_height_m) - height_m
    in_range = nearest.distance_m < NEAR_M
    confidence = np.clip((ACTIVE_FRACTION - predicted) / FADE_FRACTION, 0, 1) * in_range
    enters = (height_m < min_height_m) & in_range & is_near
    weight = np.where(enters, 1.0, confidence)
    target = points_m + (weight * move_m)[..., None] * nearest.normal
    return Targets(target, np.where(enters, 1.0, np.maximum(confidence, MIN_WEIGHT)))


# Our rule: after solving, these passes move joints and capsules out that are deeper in the object than the limit.
EXIT_PASSES, MAX_DEPTH_M = 4, 0.006
# A capsule rotates about its joint, so its far end moves twice as far as its middle.
CAPSULE_FACTOR = 2.0
AT_OBJECT_M = 0.01  # penetration is limited for predicted points whose skin is closer to the object than this
SOLVER_ROUNDS = 2  # of surface planes at the present pose and inverse kinematics
# The solver starts this fraction of the way from the previous answer to the prediction: it takes the twist of joints
# from there, which point targets do not determine.
BLEND_FRACTION = 0.2


@dataclass(frozen=True)
class Predictor:
    """A trained network with its post-processing."""

    network: ManipNet
    rule: Rule = "preset"  # of post-processing; "preset": that of the network's features

    @property
    def settings(self) -> FeatureSettings:
        return self.network.config.features

    @property
    def chosen_rule(self) -> Rule:
        return self.settings.definition if self.rule == "preset" else self.rule

    @torch.no_grad()
    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Outputs (hand, 214) for inputs (hand, 2350)."""
        return self.network(torch.from_numpy(inputs.astype(np.float32))).double().numpy()


@dataclass(frozen=True, eq=False)
class FrameContext:
    """The control signal of one hand in one frame."""

    trajectory: np.ndarray  # (1, 336) features
    object_from_wrist: RigidTransform  # (1, time) at the present and the sensors' future times
    hinge_rad: np.ndarray | None  # (1, time); None for a rigid object


def frame_context(
    control: Control, side: Side, hand: TrackedHand, time_s: float, settings: FeatureSettings
) -> FrameContext:
    """Wrist and object trajectories around one time. One call per time: the last bits depend on the batch size."""
    times_s = np.array([time_s])
    trajectory = trajectory_features(control, side, hand, times_s, settings)
    return FrameContext(trajectory, *object_from_wrist(control, side, times_s, settings))


@dataclass
class HandRollout:
    """The rollout of one hand."""

    predictor: Predictor
    hand: TrackedHand
    surface: SurfaceIndex
    finger_rotmats: np.ndarray  # (1, joint - 1, 3, 3) pose for the next input; at first the start pose
    answer: np.ndarray = field(init=False)  # (1, joint - 1, 3, 3) post-processed pose
    limits: Limits = field(init=False)
    thickness_m: np.ndarray = field(init=False)  # (point,) radius of the finger at each point
    state: HandState = field(init=False)  # of ``finger_rotmats``

    def __post_init__(self) -> None:
        network = self.predictor.network
        # The limits of the training poses, and of the hand's hinge joints.
        self.limits = Limits.of(self.hand, network.low_rad.double().numpy(), network.high_rad.double().numpy())
        radius = self.hand.point_radius_m
        self.thickness_m = np.r_[radius[: self.hand.n_joints], radius[self.hand.tip_joint]]
        self._set_pose(np.asarray(self.finger_rotmats, dtype=np.float64).reshape(1, -1, 3, 3))

    def inputs(self, frame: FrameContext) -> np.ndarray:
        """(2350,) the network's input for a frame."""
        hand, state, settings = self.hand, self.state, self.predictor.settings
        sensed = sense(hand, state, frame.object_from_wrist, frame.hinge_rad, self.surface, settings.sensors)
        return np.concatenate([pose_features(hand, state, settings), frame.trajectory, sensed.flat()], axis=1)[0]

    def advance(self, output: np.ndarray, next_frame: FrameContext) -> None:
        """Go to the next frame with an output (214,) of the network, post-processed.

        With our rule the next input is the pose before post-processing: corrected poses are out of distribution, and
        the next prediction is worse.
        """
        rule, previous_answer = self.predictor.chosen_rule, self.answer
        fingers = self.hand.finger_rotmats(joint_rotmats_of(self.hand, output[None], self.predictor.settings))
        self._set_pose(self.limits.within(fingers))
        if rule != "off":
            state = self._corrected(output, next_frame, previous_answer)
            self.answer = self.hand.finger_rotmats(state.joint_rotmats)
            if rule != "ours":
                self.finger_rotmats, self.state = self.answer, state

    def _set_pose(self, finger_rotmats: np.ndarray) -> None:
        self.finger_rotmats = self.answer = finger_rotmats
        self.state = self.hand.state(finger_rotmats)

    def _corrected(self, output: np.ndarray, next_frame: FrameContext, previous_answer: np.ndarray) -> HandState:
        """The predicted hand, post-processed; previous_answer: that of the previous frame."""
        hand, settings, points_m = self.hand, self.predictor.settings, self.state.point_m[0]
        predicted = np.clip(output[-hand.n_points :], 0, 1)
        nearest = self._nearest(points_m, next_frame)
        shared = points_m, predicted, distance_offset_m(hand, settings), settings.range_m
        if self.predictor.chosen_rule == "paper":
            return self._solve(self.state, paper_targets(*shared, nearest))
        is_near = nearest.distance_m < self.thickness_m + AT_OBJECT_M
        state = hand.state(interpolate_rotations(previous_answer, self.finger_rotmats, np.full(1, BLEND_FRACTION)))
        for _ in range(SOLVER_ROUNDS):  # the planes depend on the pose
            from_state = self._nearest(state.point_m[0], next_frame)
            state = self._solve(state, our_targets(*shared, is_near, self.thickness_m, from_state))
        for _ in range(EXIT_PASSES):
            targets = self._out_of_object(state, next_frame)
            if not targets.weight.any():
                break
            state = self._solve(state, targets)
        return state

    def _solve(self, state: HandState, targets: Targets) -> HandState:
        """Solve inverse kinematics from a state."""
        return self.hand.state(reach(self.hand, self.limits, state, targets.point_m, targets.weight))

    def _out_of_object(self, state: HandState, next_frame: FrameContext) -> Targets:
        """Targets of an exit pass: joints and capsules that are too deep in the object move out by the excess depth."""
        hand = self.hand
        target_m, weight, n_points = state.point_m[0].copy(), np.zeros(hand.n_points), hand.n_points
        middle_m = (state.capsule_start_m[0] + state.capsule_end_m[0]) / 2
        nearest = self._nearest(np.concatenate([target_m, middle_m]), next_frame)
        excess_m = np.maximum(self.thickness_m - nearest.distance_m[:n_points] - MAX_DEPTH_M, 0)
        target_m += excess_m[:, None] * nearest.normal[:n_points]
        weight[excess_m > 0] = 1
        excess_m = np.maximum(hand.capsules.radius_m - nearest.distance_m[n_points:] - MAX_DEPTH_M, 0)
        excess_m *= hand.capsules.joint > 0  # capsules of the wrist cannot move
        for capsule in np.flatnonzero(excess_m):
            # A capsule lies between its joint and the next one: moving the next joint moves the capsule.
            next_joints = np.flatnonzero(hand.parents == hand.capsules.joint[capsule])
            tips = hand.n_joints + np.flatnonzero(hand.tip_joint == hand.capsules.joint[capsule])
            points = np.concatenate([next_joints, tips])
            target_m[points] += CAPSULE_FACTOR * excess_m[capsule] * nearest.normal[n_points + capsule]
            weight[points] = 1
        return Targets(target_m, weight)

    def _nearest(self, points_m: np.ndarray, frame: FrameContext) -> SignedDistance:
        """The object's surface at points (point, 3), wrist frame."""
        object_from_wrist = frame.object_from_wrist[0, 0]
        hinge_rad = None if frame.hinge_rad is None else frame.hinge_rad[0, :1]
        distance_m, closest_m, normal = self.surface.nearest((object_from_wrist @ points_m)[None], hinge_rad)
        wrist_from_object = object_from_wrist.inverse()
        return SignedDistance(distance_m[0], wrist_from_object @ closest_m[0], wrist_from_object.turn(normal[0]))


@dataclass(frozen=True, eq=False)
class RolloutTask:
    """One hand to roll out."""

    hand: TrackedHand
    side: Side
    control: Control
    time_s: np.ndarray  # (frame,) of the poses to return; the network's steps start at the first
    start: np.ndarray  # (joint - 1, 3, 3) finger rotations in the first frame


def roll_out(predictor: Predictor, tasks: Sequence[RolloutTask]) -> list[np.ndarray]:
    """Roll out several hands: finger rotations (frame, joint - 1, 3, 3) of each task, with the start pose first.

    The hands of a frame share one call of the network. Its last bits depend on the number of hands.
    """
    rate = 1 / predictor.settings.step_s
    step_numbers = [(task.time_s - task.time_s[0]) * rate for task in tasks]  # of each task's frames, fractional
    contexts = [
        [
            frame_context(task.control, task.side, task.hand, task.time_s[0] + step / rate, predictor.settings)
            for step in range(int(np.ceil(numbers[-1] - 1e-6)) + 1)
        ]
        for task, numbers in zip(tasks, step_numbers, strict=True)
    ]
    rollouts = [HandRollout(predictor, task.hand, surface_index(task.control.model), task.start) for task in tasks]
    poses_by_task = [[rollout.answer[0]] for rollout in rollouts]
    for frame in range(1, max(map(len, contexts), default=0)):
        running = [number for number, frames in enumerate(contexts) if frame < len(frames)]
        inputs = np.stack([rollouts[number].inputs(contexts[number][frame - 1]) for number in running])
        for number, output in zip(running, predictor(inputs), strict=True):
            rollouts[number].advance(output, contexts[number][frame])
            poses_by_task[number].append(rollouts[number].answer[0])
    return [poses_at(np.stack(poses), numbers) for poses, numbers in zip(poses_by_task, step_numbers, strict=True)]
