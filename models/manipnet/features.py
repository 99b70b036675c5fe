"""Inputs and outputs of ManipNet's network: pose, trajectory and sensors of one hand, in canonical axes of its wrist.

Sizes for ManipNet's 17-joint hand: pose 192, trajectory 336, sensors 1,822 (2,350 in all); output 192 + 22 = 214.
Metres and right-handed axes.
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
    """How inputs and outputs are sampled and scaled."""

    step_s: float = 1 / 60  # from one pose to the next
    past_s: float = 0.5  # trajectory samples reach from this long ago
    future_s: float = 0.5  # to this far ahead
    spacing_s: float = 0.05  # between trajectory samples
    range_m: float = 0.03  # output distances from the skin are clamped to [0, range_m] and divided by it
    sensors: SensorSettings = OURS

    @property
    def samples_s(self) -> np.ndarray:
        """(sample,) times relative to the present, including 0."""
        past, future = (round(length / self.spacing_s) for length in (self.past_s, self.future_s))
        return np.arange(-past, future + 1) * self.spacing_s


class HandInputs(NamedTuple):
    """All inputs of one hand; sizes are those of ManipNet's hand."""

    pose: np.ndarray  # (frame, 192)
    trajectory: np.ndarray  # (frame, 336)
    sensors: np.ndarray  # (frame, 1822)


def pose_features(hand: TrackedHand, state: HandState) -> np.ndarray:
    """Pose of a hand as the network reads it.

    Args:
        hand: the hand's skeleton and capsules.
        state: (frame,) the hand in its wrist's frame.

    Returns:
        (frame, 9 joints + 15 + 6 palm capsules), metres, canonical axes: joint positions, tips, starts and ends of the
        palm's capsules, then z axis and y axis of each joint.
    """
    canonical, palm = hand.wrist_from_canonical, hand.palm_capsules
    positions_m = [state.joint_m, state.tip_m, state.capsule_start_m[:, palm], state.capsule_end_m[:, palm]]
    axes = canonical.T @ state.joint_rotmats @ canonical
    vectors = np.concatenate([np.concatenate(positions_m, axis=1) @ canonical, _axis_rows(axes)], axis=1)
    return vectors.reshape(len(vectors), -1)


def _axis_rows(rotmats: np.ndarray) -> np.ndarray:
    """(frame, 2 joints, 3): z axis, then y axis of each rotation (frame, joint, 3, 3)."""
    return rotmats[..., [2, 1]].swapaxes(-1, -2).reshape(len(rotmats), -1, 3)


def joint_rotmats_of(hand: TrackedHand, pose: np.ndarray) -> np.ndarray:
    """Joint rotations from pose features or network output.

    The predicted axes are orthonormalised by Gram-Schmidt, z first.

    Args:
        hand: the hand's skeleton.
        pose: (frame, 192 or more).

    Returns:
        (frame, joint, 3, 3) wrist_from_joint; ``hand.finger_rotmats`` converts them to local rotations.
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
    """Past and future trajectory of wrists and object around ``time_s (frame,)``.

    Returns:
        (frame, 21 x 16), metres, canonical axes of this hand's wrist at ``time_s``. Per sample: distance of the other
        wrist; this wrist's position, z axis and y axis; the object's position and angular velocity (rad/s).
    """
    own_wrist, other_wrist = control.wrists[side], control.wrists[SIDES[1 - SIDES.index(side)]]
    canonical = hand.wrist_from_canonical
    start, stop = own_wrist.time_s[0], own_wrist.time_s[-1]
    samples = np.clip(time_s[:, None] + settings.samples_s, start, stop)
    wrist_now, wrist_samples, object_samples = (
        own_wrist.at(time_s),
        own_wrist.at(samples),
        control.object_motion.at(samples),
    )
    wrist_from_world = wrist_now.inverse()
    to_other_m = other_wrist.at(samples).translation - wrist_now.translation[:, None]
    other_distance_m = np.linalg.norm(to_other_m, axis=-1, keepdims=True)
    # A change of basis on both sides: the axes themselves are canonical too.
    axes = canonical.T @ (wrist_now.rotation[:, None].swapaxes(-1, -2) @ wrist_samples.rotation) @ canonical
    middle = (object_samples @ control.box_middle_m[None])[:, :, 0]
    angular_velocity = _angular_velocity(control.object_motion, own_wrist, samples, wrist_now, settings)
    # An axial vector changes sign in a mirrored frame.
    angular_velocity = np.linalg.det(canonical) * angular_velocity @ canonical
    positions_m = [(wrist_from_world @ points) @ canonical for points in (wrist_samples.translation, middle)]
    features = other_distance_m, positions_m[0], axes[..., 2], axes[..., 1], positions_m[1], angular_velocity
    by_sample = np.concatenate(features, axis=-1)
    return by_sample.reshape(len(time_s), -1)


def _angular_velocity(
    object_motion: Motion, wrist: Motion, samples_s: np.ndarray, wrist_now: RigidTransform, settings: FeatureSettings
) -> np.ndarray:
    """(frame, sample, 3) angular velocity of the object relative to the wrist, rad/s, by backward differences."""
    before_s = np.maximum(samples_s - settings.step_s, wrist.time_s[0])
    rotation, before = (
        wrist.at(times).rotation.swapaxes(-1, -2) @ object_motion.at(times).rotation for times in (samples_s, before_s)
    )
    angular_velocity = rotmat_to_rotvec(rotation @ before.swapaxes(-1, -2)) / settings.step_s
    # From the wrist's axes at the sample to those at the present.
    now_from_then = wrist_now.rotation[:, None].swapaxes(-1, -2) @ wrist.at(samples_s).rotation
    return (now_from_then @ angular_velocity[..., None])[..., 0]


def object_from_wrist(
    control: Control, side: Side, time_s: np.ndarray, settings: FeatureSettings
) -> tuple[RigidTransform, np.ndarray | None]:
    """(frame, time) transforms and hinge angles for ``sense``, at ``time_s (frame,)`` and the sensors' future times."""
    times = time_s[:, None] + np.array(settings.sensors.times_s)
    wrist, body = control.wrists[side].at(times), control.object_motion.at(times)
    object_from_world = body.rotation.swapaxes(-1, -2)
    translation = (object_from_world @ (wrist.translation - body.translation)[..., None])[..., 0]
    return RigidTransform(object_from_world @ wrist.rotation, translation), control.hinge_at(times)


def hand_inputs(
    control: Control,
    side: Side,
    hand: TrackedHand,
    state: HandState,
    time_s: np.ndarray,
    surface: SurfaceIndex,
    settings: FeatureSettings,
) -> HandInputs:
    """All inputs of one hand at ``time_s (frame,)``; state: (frame,) the hand in its wrist's frame."""
    placed, hinge_rad = object_from_wrist(control, side, time_s, settings)
    sensed = sense(hand, state, placed, hinge_rad, surface, settings.sensors)
    trajectory = trajectory_features(control, side, hand, time_s, settings)
    return HandInputs(pose_features(hand, state), trajectory, sensed.flat())


def output_distances(hand: TrackedHand, distance_m: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """Scale signed distances (frame, 22) of joints and tips (``distance_m[:, 0]``) from the skin to [0, 1]."""
    return np.clip((distance_m - hand.point_radius_m) / settings.range_m, 0.0, 1.0)


def outputs(hand: TrackedHand, state: HandState, distance_m: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """Training targets (frame, 214): pose features and distances of the next frame, in the wrist's frame."""
    return np.concatenate([pose_features(hand, state), output_distances(hand, distance_m, settings)], axis=1)


METRES, AXES, CELL, RAD_S, FRACTION = 0.001, 0.01, 0.05, 0.05, 0.02  # least standard deviation by unit


def sizes(hand: TrackedHand, settings: FeatureSettings) -> dict[str, int]:
    """Size of each input group, in order: pose, trajectory, ambient, proximity, distance, normal."""
    times = len(settings.sensors.times_s)
    return {
        "pose": 3 * _position_count(hand) + 6 * hand.n_joints,
        "trajectory": SAMPLE_NUMBERS * len(settings.samples_s),
        "ambient": CELLS**3,
        "proximity": times * hand.n_sensors,
        "distance": times * hand.n_points,
        "normal": 3 * hand.n_points,
    }


def std_floors(hand: TrackedHand, settings: FeatureSettings) -> tuple[np.ndarray, np.ndarray]:
    """Least standard deviations for normalisation: (input,) and (output,), by unit."""
    count = sizes(hand, settings)
    pose = np.repeat([METRES, AXES], [3 * _position_count(hand), 6 * hand.n_joints])
    sample = np.repeat([METRES, AXES, METRES, RAD_S], [4, 6, 3, 3])
    inputs = [
        pose,
        np.tile(sample, count["trajectory"] // SAMPLE_NUMBERS),
        np.full(count["ambient"], CELL),
        np.full(count["proximity"] + count["distance"], METRES),
        np.full(count["normal"], CELL),
    ]
    return np.concatenate(inputs), np.concatenate([pose, np.full(hand.n_points, FRACTION)])


def _position_count(hand: TrackedHand) -> int:
    """Number of positions in a pose: joints, tips, both ends of the palm's capsules."""
    return hand.n_joints + N_TIPS + 2 * len(hand.palm_capsules)
