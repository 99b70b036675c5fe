"""Running ManipNet: each hand frame by frame, its pose the next frame's input (Sec. 6.4).

No hand sees the fingers of the other, so every hand is followed by itself: :class:`Follower` takes one step,
``roll_out`` whole clips of many hands at once, ``stream.Stream`` frames as they come. Rotations are predicted and
joints placed by forward kinematics: bones keep their length, which the release's do not.

Post-processing moves the joints to targets: those of the paper's Algorithm 1, or ours. Points are in the wrist's frame,
metres. Distances here are of points themselves: a predicted distance that stops at the skin has the radius added before
it comes here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch

from hoidata.clips.clip import Side
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.surface_index import SurfaceIndex, surface_index
from hoidata.sensors import sense
from models.manipnet.control import Control, between
from models.manipnet.features import (
    FeatureSettings,
    joint_rotmats_of,
    object_from_wrist,
    pose_features,
    trajectory_features,
)
from models.manipnet.inverse_kinematics import Limits, reach, target_points
from models.manipnet.network import ManipNet

Rule = Literal["off", "paper", "ours"]
ACTIVE_SHARE = 0.8  # of the range of predicted distances: the paper's 2.8 of 3.5 cm, the demo's 2.4 of 3 cm
NEAR_M = 0.06  # the demo looks at no point farther away; nor do we, or a wrong distance pulls at a hand in the air
# Ours, chosen on the validation tenths of the real recordings, whose touching points are 4 to 8 mm deep in 5 %.
DEEPEST_M = 0.008  # a finger gives way by so much and no more
PRESS_M = 0.007  # and is brought so much nearer than it is said to be
FADE_SHARE = 0.3  # of the range below the active share: the nearer it is said to be, the more it counts
HOLD = 0.5  # weight of the network's own pose, where it says nothing of the object


@dataclass(frozen=True)
class Nearest:
    """What the object is like at points (..., point): signed distance, nearest surface point, outward gradient."""

    distance_m: np.ndarray
    closest_m: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class Targets:
    """point_m: (..., point, 3). weight: (..., point), 0 where there is nothing to reach."""

    point_m: np.ndarray
    weight: np.ndarray


def paper_targets(points_m: np.ndarray, predicted: np.ndarray, radius_m: np.ndarray, range_m: float,
                  found: Nearest) -> Targets:  # fmt: skip
    """Algorithm 1: near points to a mixture of predicted and true distance, the others to where they are.

    points_m: (..., point, 3) as the network has them. predicted: (..., point) its distances, 0 to 1 of range_m from the
    skin, which is radius_m (point,) from the point.
    """
    distance_m = predicted * range_m + radius_m
    inside = found.distance_m < 0
    mixed = np.where(inside, 0.8 * distance_m + 0.2 * found.distance_m, 0.2 * distance_m + 0.8 * found.distance_m)
    wanted = found.closest_m + mixed[..., None] * found.normal
    return Targets(np.where(_active(predicted, found)[..., None], wanted, points_m), np.ones(predicted.shape))


def our_targets(points_m: np.ndarray, predicted: np.ndarray, radius_m: np.ndarray, range_m: float,
                near: np.ndarray, cover_m: np.ndarray, seen: Nearest) -> Targets:  # fmt: skip
    """Fingers go where the network has them and press what it says is near; none enters the object or is drawn off it.

    The rules above stop at the surface, where a contact carries nothing; a distance that is a mean of many takes off
    the object what touches it; and from a pose that is deep in a thin thing the nearest way out may be the far side.
    So the surface is what the hand sees from the pose that it comes from: ``seen``, of its points there, and what lies
    below the plane of the nearest place is inside. Arguments else as in ``paper_targets``. near: (point,) bool, the
    network's points are at the object or in it. cover_m: (point,) how thick the finger is there.
    """
    wanted_m = predicted * range_m + radius_m - PRESS_M
    least_m = cover_m - DEEPEST_M
    height_m = ((points_m - seen.closest_m) * seen.normal).sum(axis=-1)
    up_m = np.maximum(np.minimum(wanted_m, height_m), least_m) - height_m
    is_seen = seen.distance_m < NEAR_M
    sure = np.clip((ACTIVE_SHARE - predicted) / FADE_SHARE, 0, 1) * is_seen
    enters = (height_m < least_m) & is_seen & near
    share = np.where(enters, 1.0, sure)
    target = points_m + (share * up_m)[..., None] * seen.normal
    return Targets(target, np.where(enters, 1.0, np.maximum(sure, HOLD)))


def _active(predicted: np.ndarray, found: Nearest) -> np.ndarray:
    return (predicted < ACTIVE_SHARE) & (found.distance_m < NEAR_M)


# Of our rule: so many passes move joints out that they, or their capsule, are deeper in the object than allowed.
PASSES, ALLOWED_M = 4, 0.006
# A capsule is held by its joint, so that the one after it goes twice as far as its middle is to go.
OUT_SHARE = 2.0
AT_OBJECT_M = 0.01  # a point of the network's this far from the finger's skin is kept out of the object
ROUNDS = 2  # of ours: what a hand sees changes with its pose
LEAD = 0.2  # of the way from the answer before to the network's pose, whose twist points do not tell


@dataclass(frozen=True)
class Predictor:
    """A trained network and how it is run. rule: of post-processing."""

    network: ManipNet
    rule: Rule = "ours"

    @property
    def settings(self) -> FeatureSettings:
        return self.network.config.features

    def limits(self, hand: TrackedHand) -> Limits:
        """How far the joints of a hand may turn: as far as in training, and as far as its hinges do."""
        low, high = (array.double().numpy() for array in (self.network.low_rad, self.network.high_rad))
        return Limits.of(hand, low, high)

    @torch.no_grad()
    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Outputs (hand, 214) of inputs (hand, 2350)."""
        return self.network(torch.from_numpy(rows.astype(np.float32))).double().numpy()


@dataclass(frozen=True, eq=False)
class Situation:
    """What is given of one hand in one frame. trajectory: (336,) features. object_from_wrist: (time,) now and later.

    hinge_rad: (time,) of a hinged object, else None.
    """

    trajectory: np.ndarray
    object_from_wrist: RigidTransform
    hinge_rad: np.ndarray | None


def situation(control: Control, side: Side, hand: TrackedHand, time_s: float, settings: FeatureSettings) -> Situation:
    """What is given at one time. Not for many at once: last bits would depend on how many, and a stream has one."""
    now = np.array([time_s])
    placed, hinge = object_from_wrist(control, side, now, settings)
    trajectory = trajectory_features(control, side, hand, now, settings)
    return Situation(trajectory[0], placed[0], None if hinge is None else hinge[0])


@dataclass
class Follower:
    """One hand on its way. finger_rotmats: (1, joint - 1, 3, 3) that the network goes on from, the start pose first.

    answer: (1, joint - 1, 3, 3) the post-processed ones.
    """

    predictor: Predictor
    hand: TrackedHand
    surface: SurfaceIndex
    finger_rotmats: np.ndarray
    answer: np.ndarray = field(init=False)
    limits: Limits = field(init=False)
    cover_m: np.ndarray = field(init=False)
    state: HandState = field(init=False)

    def __post_init__(self) -> None:
        self.limits = self.predictor.limits(self.hand)
        radius = self.hand.point_radius_m
        self.cover_m = np.r_[radius[: self.hand.n_joints], radius[self.hand.tip_joint]]
        self._take(np.asarray(self.finger_rotmats, dtype=np.float64).reshape(1, -1, 3, 3))

    def inputs(self, now: Situation) -> np.ndarray:
        """(2350,) what the network sees."""
        hinge = None if now.hinge_rad is None else now.hinge_rad[None]
        at = now.object_from_wrist
        placed = RigidTransform(at.rotation[None], at.translation[None])
        sensed = sense(self.hand, self.state, placed, hinge, self.surface, self.predictor.settings.sensors)
        return np.concatenate([pose_features(self.hand, self.state)[0], now.trajectory, sensed.flat()[0]])

    def advance(self, output: np.ndarray, then: Situation) -> None:
        """Take the pose of an output (214,) for the next frame, post-processed.

        With our rule the network goes on from its own pose: a corrected one is none that it learnt from, and the next
        is the worse for it.
        """
        rule, before = self.predictor.rule, self.answer
        fingers = self.hand.finger_rotmats(joint_rotmats_of(self.hand, output[None]))
        self._take(self.limits.within(fingers))
        if rule != "off":
            state = self._corrected(output, then, before)
            self.answer = self.hand.finger_rotmats(state.joint_rotmats)
            if rule != "ours":
                self.finger_rotmats, self.state = self.answer, state

    def _take(self, finger_rotmats: np.ndarray) -> None:
        self.finger_rotmats = self.answer = finger_rotmats
        self.state = self.hand.state(finger_rotmats)

    def _corrected(self, output: np.ndarray, then: Situation, before: np.ndarray) -> HandState:
        """The hand that an output means, post-processed; before: the answer of the frame before."""
        hand, settings, points = self.hand, self.predictor.settings, self.state.point_m[0]
        predicted = np.clip(output[-hand.n_points :], 0, 1)
        found, given = self._nearest(points, then), (points, predicted, hand.point_radius_m, settings.range_m)
        if self.predictor.rule == "paper":
            return self._reached(self.state, paper_targets(*given, found))
        near = found.distance_m < self.cover_m + AT_OBJECT_M
        state = self.hand.state(between(before, self.finger_rotmats, np.full(1, LEAD)))
        for _ in range(ROUNDS):
            seen = self._nearest(state.point_m[0], then)
            state = self._reached(state, our_targets(*given, near, self.cover_m, seen))
        for _ in range(PASSES):
            targets = self._out_of_object(state, then)
            if not targets.weight.any():
                break
            state = self._reached(state, targets)
        return state

    def _reached(self, state: HandState, targets: Targets) -> HandState:
        """The hand turned towards its targets."""
        weight = np.zeros(self.hand.n_points)
        moved = target_points(self.hand)
        weight[moved] = targets.weight[moved]
        if not weight.any():
            return state
        return self.hand.state(reach(self.hand, self.limits, state, targets.point_m, weight))

    def _out_of_object(self, state: HandState, then: Situation) -> Targets:
        """A further pass: what of the hand is too deep in the object moves out by a share of what is too much."""
        hand = self.hand
        target, weight, n_points = state.point_m[0].copy(), np.zeros(hand.n_points), hand.n_points
        middle = (state.capsule_start_m[0] + state.capsule_end_m[0]) / 2
        found = self._nearest(np.concatenate([target, middle]), then)
        depth = np.maximum(self.cover_m - found.distance_m[:n_points] - ALLOWED_M, 0)
        target += depth[:, None] * found.normal[:n_points]
        weight[depth > 0] = 1
        depth = np.maximum(hand.capsules.radius_m - found.distance_m[n_points:] - ALLOWED_M, 0)
        depth *= hand.capsules.joint > 0
        for capsule in np.flatnonzero(depth):
            # A capsule hangs between its joint and the one after it: the latter moves it.
            after = np.flatnonzero(hand.parents == hand.capsules.joint[capsule])
            tip = hand.n_joints + np.flatnonzero(hand.tip_joint == hand.capsules.joint[capsule])
            moved = np.concatenate([after, tip])
            target[moved] += OUT_SHARE * depth[capsule] * found.normal[n_points + capsule]
            weight[moved] = 1
        return Targets(target, weight)

    def _nearest(self, points_m: np.ndarray, then: Situation) -> Nearest:
        """What the object is like at points (point, 3) of the wrist's frame."""
        placed = then.object_from_wrist[0]
        hinge = None if then.hinge_rad is None else then.hinge_rad[:1]
        found = self.surface.nearest((placed @ points_m)[None], hinge)
        back = placed.inverse()
        return Nearest(found.distance_m[0], back @ found.closest_m[0], back.turn(found.normal[0]))


@dataclass(frozen=True, eq=False)
class Task:
    """A hand to follow through a clip. start: (joint - 1, 3, 3) finger rotations at the first of ``time_s``."""

    hand: TrackedHand
    side: Side
    control: Control
    time_s: np.ndarray
    start: np.ndarray


def roll_out(predictor: Predictor, tasks: Sequence[Task]) -> list[np.ndarray]:
    """Finger rotations (frame, joint - 1, 3, 3) of each task, the start pose first; times are a step apart.

    The hands of a frame share one call of the network, whose last bits depend on how many they are.
    """
    given = [
        [situation(task.control, task.side, task.hand, time_s, predictor.settings) for time_s in task.time_s]
        for task in tasks
    ]
    followers = [Follower(predictor, task.hand, surface_index(task.control.model), task.start) for task in tasks]
    made = [[follower.answer[0]] for follower in followers]
    for frame in range(1, max(map(len, given), default=0)):
        running = [number for number, frames in enumerate(given) if frame < len(frames)]
        rows = np.stack([followers[number].inputs(given[number][frame - 1]) for number in running])
        for number, output in zip(running, predictor(rows), strict=True):
            followers[number].advance(output, given[number][frame])
            made[number].append(followers[number].answer[0])
    return [np.stack(poses) for poses in made]
