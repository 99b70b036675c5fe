"""What the network reads and writes: pose, trajectory and sensors of one hand, all in canonical axes of its wrist.

Sizes for ManipNet's 17-joint hand: pose 192, trajectory 336, sensors 1,822 (2,350 in all); output 192 + 22 = 214.
Metres and right-handed axes. Groups of columns have names, to scale by unit.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import SIDES, Side
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import N_TIPS, HandState, TrackedHand
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import OURS, SensorSettings, sense
from hoidata.sensors.settings import CELLS
from models.manipnet.control import Control, Motion

SAMPLE_NUMBERS = 16


@dataclass(frozen=True)
class FeatureSettings:
    """step_s: from one pose to the next. past_s, future_s, spacing_s: samples of the trajectory around now.

    range_m: distances of the output, less the radius of the capsule that begins at the joint, are clamped to 0 and this
    and divided by it.
    """

    step_s: float = 1 / 60
    past_s: float = 0.5
    future_s: float = 0.5
    spacing_s: float = 0.05
    range_m: float = 0.03
    sensors: SensorSettings = OURS

    @property
    def samples_s(self) -> np.ndarray:
        """(sample,) times around now, 0 among them."""
        past, future = (round(length / self.spacing_s) for length in (self.past_s, self.future_s))
        return np.arange(-past, future + 1) * self.spacing_s


class HandInputs(NamedTuple):
    """pose: (frame, 192); trajectory: (frame, 336); sensors: (frame, 1822); of other hands their own sizes."""

    pose: np.ndarray
    trajectory: np.ndarray
    sensors: np.ndarray


def pose_features(hand: TrackedHand, state: HandState) -> np.ndarray:
    """(frame, 9 joint + 15 + 6 palm capsule): 192. Canonical axes, metres, in the order

    joint positions, tips in the hand's order, palm capsule starts, their ends, then per joint its z axis and y axis.
    state: the hand in its wrist's frame.
    """
    canonical, palm = hand.wrist_from_canonical, hand.palm_capsules
    places = [state.joint_m, state.tip_m, state.capsule_start_m[:, palm], state.capsule_end_m[:, palm]]
    axes = canonical.T @ state.joint_rotmats @ canonical
    vectors = np.concatenate([np.concatenate(places, axis=1) @ canonical, _axis_rows(axes)], axis=1)
    return vectors.reshape(len(vectors), -1)


def _axis_rows(rotmats: np.ndarray) -> np.ndarray:
    """(frame, 2 joint, 3): z axis, then y axis of each (frame, joint, 3, 3)."""
    return rotmats[..., [2, 1]].swapaxes(-1, -2).reshape(len(rotmats), -1, 3)


def joint_rotmats_of(hand: TrackedHand, pose: np.ndarray) -> np.ndarray:
    """(frame, joint, 3, 3) wrist_from_joint, from the axes in pose features or network output (frame, 192 or more).

    Axes are made orthonormal: z as given, y as near as it can be. ``hand.finger_rotmats`` makes them local.
    """
    first = 3 * (hand.n_points + 2 * len(hand.palm_capsules))
    axes = np.reshape(pose[:, first : first + 6 * hand.n_joints], (len(pose), hand.n_joints, 2, 3))
    z = axes[..., 0, :] / np.linalg.norm(axes[..., 0, :], axis=-1, keepdims=True)
    y = axes[..., 1, :] - (axes[..., 1, :] * z).sum(-1, keepdims=True) * z
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    canonical = hand.wrist_from_canonical
    return canonical @ np.stack([np.cross(y, z), y, z], axis=-1) @ canonical.T


def trajectory_features(
    control: Control, side: Side, hand: TrackedHand, time_s: np.ndarray, settings: FeatureSettings
) -> np.ndarray:
    """(frame, 21 x 16): per sample distance of the other wrist; own wrist position, z axis, y axis; the object's
    position and angular velocity (rad/s). Metres, canonical axes of the own wrist at ``time_s (frame,)``.
    """
    own, other = control.wrists[side], control.wrists[SIDES[1 - SIDES.index(side)]]
    canonical = hand.wrist_from_canonical
    start, stop = own.time_s[0], own.time_s[-1]
    samples = np.clip(time_s[:, None] + settings.samples_s, start, stop)
    now, wrist, thing = own.at(time_s), own.at(samples), control.thing.at(samples)
    wrist_from_world = now.inverse()
    away = np.linalg.norm(other.at(samples).translation - now.translation[:, None], axis=-1, keepdims=True)
    axes = canonical.T @ (now.rotation[:, None].swapaxes(-1, -2) @ wrist.rotation) @ canonical
    middle = (thing @ control.box_middle_m[None])[:, :, 0]
    turning = _angular_velocity(control.thing, own, samples, now, settings)
    turning = np.linalg.det(canonical) * turning @ canonical  # a mirror turns axial vectors round
    places = [(wrist_from_world @ points) @ canonical for points in (wrist.translation, middle)]
    rows = np.concatenate([away, places[0], axes[..., 2], axes[..., 1], places[1], turning], axis=-1)
    return rows.reshape(len(time_s), -1)


def _angular_velocity(
    thing: Motion, own: Motion, samples_s: np.ndarray, now: RigidTransform, settings: FeatureSettings
) -> np.ndarray:
    """(frame, sample, 3) rad/s of the object relative to the wrist, from one step before."""
    before_s = np.maximum(samples_s - settings.step_s, own.time_s[0])
    here, before = (
        own.at(times).rotation.swapaxes(-1, -2) @ thing.at(times).rotation for times in (samples_s, before_s)
    )
    turn = rotmat_to_rotvec(here @ before.swapaxes(-1, -2)) / settings.step_s
    now_from_then = now.rotation[:, None].swapaxes(-1, -2) @ own.at(samples_s).rotation
    return (now_from_then @ turn[..., None])[..., 0]


def object_from_wrist(
    control: Control, side: Side, time_s: np.ndarray, settings: FeatureSettings
) -> tuple[RigidTransform, np.ndarray | None]:
    """(frame, time) transforms and hinge angles for ``sense``, at ``time_s (frame,)`` and the future times after it."""
    times = time_s[:, None] + np.array(settings.sensors.times_s)
    wrist, thing = control.wrists[side].at(times), control.thing.at(times)
    turn = thing.rotation.swapaxes(-1, -2)
    way = (turn @ (wrist.translation - thing.translation)[..., None])[..., 0]
    return RigidTransform(turn @ wrist.rotation, way), control.hinge_at(times)


def hand_inputs(
    control: Control,
    side: Side,
    hand: TrackedHand,
    state: HandState,
    time_s: np.ndarray,
    surface: SurfaceIndex,
    settings: FeatureSettings,
) -> HandInputs:
    """All inputs of one hand at ``time_s (frame,)``. state: (frame,) in its wrist's frame; hand: that side's."""
    seen, hinge_rad = object_from_wrist(control, side, time_s, settings)
    sensed = sense(hand, state, seen, hinge_rad, surface, settings.sensors)
    trajectory = trajectory_features(control, side, hand, time_s, settings)
    return HandInputs(pose_features(hand, state), trajectory, sensed.flat())


def output_distances(hand: TrackedHand, distance_m: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """(frame, 22) in 0 to 1, of signed distances (frame, 22) of joints and tips (``Sensed.distance_m[:, 0]``)."""
    return np.clip((distance_m - hand.point_radius_m) / settings.range_m, 0.0, 1.0)


def outputs(hand: TrackedHand, state: HandState, distance_m: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """(frame, 214): pose features and distances of the next frame, in its own wrist's frame: what is learnt."""
    return np.concatenate([pose_features(hand, state), output_distances(hand, distance_m, settings)], axis=1)


METRES, AXES, CELL, RAD_S, SHARE = 0.001, 0.01, 0.05, 0.05, 0.02  # the least spread a number is scaled by


def sizes(hand: TrackedHand, settings: FeatureSettings) -> dict[str, int]:
    """Numbers of each group in their order: pose, trajectory, ambient, proximity, distance, normal."""
    times = len(settings.sensors.times_s)
    return {
        "pose": 3 * _positions(hand) + 6 * hand.n_joints,
        "trajectory": SAMPLE_NUMBERS * len(settings.samples_s),
        "ambient": CELLS**3,
        "proximity": times * hand.n_sensors,
        "distance": times * hand.n_points,
        "normal": 3 * hand.n_points,
    }


def floors(hand: TrackedHand, settings: FeatureSettings) -> tuple[np.ndarray, np.ndarray]:
    """(input,) and (output,): the least spread a number is scaled by, by what it is."""
    count = sizes(hand, settings)
    pose = np.repeat([METRES, AXES], [3 * _positions(hand), 6 * hand.n_joints])
    sample = np.repeat([METRES, AXES, METRES, RAD_S], [4, 6, 3, 3])
    inputs = [
        pose,
        np.tile(sample, count["trajectory"] // SAMPLE_NUMBERS),
        np.full(count["ambient"], CELL),
        np.full(count["proximity"] + count["distance"], METRES),
        np.full(count["normal"], CELL),
    ]
    return np.concatenate(inputs), np.concatenate([pose, np.full(hand.n_points, SHARE)])


def _positions(hand: TrackedHand) -> int:
    """How many positions a pose has: joints, tips, both ends of the palm's capsules."""
    return hand.n_joints + N_TIPS + 2 * len(hand.palm_capsules)
