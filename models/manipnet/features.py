"""Inputs and outputs of ManipNet's network: pose, trajectory and sensors of one hand, in canonical axes of its wrist.

Sizes for ManipNet's 17-joint hand: pose 192, trajectory 336, sensors 1,822 (2,350 in all); output 192 + 22 = 214.
With the paper's definitions: pose 198, input 2,356, output 220. Metres and right-handed axes.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.geometry.motion import Motion
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.surface_index import surface_index
from hoidata.sensors import OURS, PAPER, SensorSettings, sense
from hoidata.sensors.sense import CELLS
from models.manipnet.control import Control

SAMPLE_NUMBERS = 16
SENSINGS_PER_S = 10


@dataclass(frozen=True)
class FeatureSettings:
    """How inputs and outputs are sampled and scaled."""

    # Of sensors, pose, distances, object position and angular velocity: docs/fingers.md has the differences.
    definition: Literal["ours", "paper"] = "ours"
    step_s: float = 1 / FPS  # from one pose to the next
    past_s: float = 0.5  # trajectory samples reach from this long ago
    future_s: float = 0.5  # to this far ahead
    spacing_s: float = 0.05  # between trajectory samples

    @property
    def is_paper(self) -> bool:
        return self.definition == "paper"

    @property
    def range_m(self) -> float:
        """Output distances are clamped to [0, range_m] and divided by it."""
        return 0.035 if self.is_paper else 0.03

    @cached_property
    def sensors(self) -> SensorSettings:
        """Sensor readings at the present and every 0.1 s until ``future_s``."""
        times_s = np.arange(round(self.future_s * SENSINGS_PER_S) + 1) / SENSINGS_PER_S
        return replace(PAPER if self.is_paper else OURS, times_s=tuple(times_s.tolist()))

    @property
    def samples_s(self) -> np.ndarray:
        """(sample,) times relative to the present, including 0."""
        past, future = (round(length / self.spacing_s) for length in (self.past_s, self.future_s))
        return np.arange(-past, future + 1) * self.spacing_s


def pose_features(hand: TrackedHand, state: HandState, settings: FeatureSettings) -> np.ndarray:
    """Pose (frame, 9 joints + 15 + 6 palm capsules) of a hand ``state (frame,)`` in its wrist's frame.

    Metres, canonical axes: joint positions, tips, starts and ends of the palm's capsules, then z axis and y axis of
    each joint. Paper: (frame, 9 joints + 45), no capsules; the tips have axes too, those of the finger's last joint.
    """
    canonical, palm = hand.wrist_from_canonical, hand.palm_capsules
    positions_m, rotmats = [state.joint_m, state.tip_m], state.joint_rotmats
    if settings.is_paper:
        rotmats = np.concatenate([rotmats, rotmats[:, hand.tip_joint]], axis=1)
    else:
        positions_m += [state.capsule_start_m[:, palm], state.capsule_end_m[:, palm]]
    z_then_y = (canonical.T @ rotmats @ canonical)[..., [2, 1]].swapaxes(-1, -2)
    axes = z_then_y.reshape(len(rotmats), -1, 3)  # (frame, 2 joints, 3)
    vectors = np.concatenate([np.concatenate(positions_m, axis=1) @ canonical, axes], axis=1)
    return vectors.reshape(len(vectors), -1)


def joint_rotmats_of(hand: TrackedHand, pose: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """(frame, joint, 3, 3) wrist_from_joint, from pose features or network output (frame, 192 or more).

    The predicted axes are orthonormalised by Gram-Schmidt, z first.
    """
    first = _pose_counts(hand, settings)[0]
    axes = np.reshape(pose[:, first : first + 6 * hand.n_joints], (len(pose), hand.n_joints, 2, 3))
    z = axes[..., 0, :] / np.linalg.norm(axes[..., 0, :], axis=-1, keepdims=True)
    y = axes[..., 1, :] - (axes[..., 1, :] * z).sum(-1, keepdims=True) * z
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    canonical = hand.wrist_from_canonical
    return canonical @ np.stack([np.cross(y, z), y, z], axis=-1) @ canonical.T


def trajectory_features(
    control: Control, side: Side, hand: TrackedHand, time_s: np.ndarray, settings: FeatureSettings
) -> np.ndarray:
    """Past and future trajectory (frame, 21 x 16) of wrists and object around ``time_s (frame,)``.

    Metres, canonical axes of this hand's wrist at ``time_s``. Per sample: distance of the other wrist; this wrist's
    position, z axis and y axis; the position of the object's box centre (paper: centre of mass), and its angular
    velocity (rad/s) relative to the wrist (paper: in the world).
    """
    own_wrist, other_wrist = control.wrists[side], control.wrists[SIDES[1 - SIDES.index(side)]]
    canonical = hand.wrist_from_canonical
    start, stop = own_wrist.time_s[0], own_wrist.time_s[-1]
    samples = np.clip(time_s[:, None] + settings.samples_s, start, stop)
    wrist_now, wrist_samples = own_wrist.at(time_s), own_wrist.at(samples)
    object_samples = control.object_motion.at(samples)
    wrist_from_world = wrist_now.inverse()
    to_other_m = other_wrist.at(samples).translation - wrist_now.translation[:, None]
    other_distance_m = np.linalg.norm(to_other_m, axis=-1, keepdims=True)
    # A change of basis on both sides: the axes themselves are canonical too.
    axes = canonical.T @ (wrist_now.rotation[:, None].swapaxes(-1, -2) @ wrist_samples.rotation) @ canonical
    centre_m = control.mass_centre_m if settings.is_paper else control.box_middle_m
    middle = (object_samples @ centre_m[None])[:, :, 0]
    angular_velocity = _angular_velocity(control.object_motion, own_wrist, samples, wrist_now, settings)
    # An axial vector changes sign in a mirrored frame.
    angular_velocity = np.linalg.det(canonical) * angular_velocity @ canonical
    positions_m = [(wrist_from_world @ points) @ canonical for points in (wrist_samples.translation, middle)]
    features = other_distance_m, positions_m[0], axes[..., 2], axes[..., 1], positions_m[1], angular_velocity
    return np.concatenate(features, axis=-1).reshape(len(time_s), -1)


def _angular_velocity(
    object_motion: Motion, wrist: Motion, samples_s: np.ndarray, wrist_now: RigidTransform, settings: FeatureSettings
) -> np.ndarray:
    """(frame, sample, 3) angular velocity of the object, rad/s, in present wrist axes, by backward differences."""
    before_s = np.maximum(samples_s - settings.step_s, wrist.time_s[0])
    rotation, before = (object_motion.at(times).rotation for times in (samples_s, before_s))
    now_from_axes = wrist_now.rotation[:, None].swapaxes(-1, -2)  # from the axes of the differences
    if not settings.is_paper:
        wrists = wrist.at(samples_s).rotation
        rotation, before = wrists.swapaxes(-1, -2) @ rotation, wrist.at(before_s).rotation.swapaxes(-1, -2) @ before
        now_from_axes = now_from_axes @ wrists
    angular_velocity = rotmat_to_rotvec(rotation @ before.swapaxes(-1, -2)) / settings.step_s
    return (now_from_axes @ angular_velocity[..., None])[..., 0]


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
    control: Control, side: Side, hand: TrackedHand, state: HandState, time_s: np.ndarray, settings: FeatureSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose (frame, 192), trajectory (frame, 336) and sensors (frame, 1822) of one hand at ``time_s (frame,)``.

    state: (frame,) the hand in its wrist's frame. The sizes are those of ManipNet's hand.
    """
    placed, hinge_rad = object_from_wrist(control, side, time_s, settings)
    sensed = sense(hand, state, placed, hinge_rad, surface_index(control.model), settings.sensors)
    trajectory = trajectory_features(control, side, hand, time_s, settings)
    return pose_features(hand, state, settings), trajectory, sensed.flat()


def mirrored_to_right(hand: TrackedHand, fingers: np.ndarray) -> np.ndarray:
    """Mirror finger rotations of a left hand to a right hand, or back; those of a right hand are unchanged."""
    mirror = np.array([-1.0, 1.0, 1.0])
    return mirror[:, None] * fingers * mirror if hand.side == "left" else fingers


def distance_offset_m(hand: TrackedHand, settings: FeatureSettings) -> np.ndarray:
    """(point,) what output distances leave out of the distance of joints and tips: the radius (paper: nothing)."""
    return np.zeros(hand.n_points) if settings.is_paper else hand.point_radius_m


def output_distances(hand: TrackedHand, distance_m: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """Scale signed distances (frame, 22) of joints and tips from the object to [0, 1]."""
    return np.clip((distance_m - distance_offset_m(hand, settings)) / settings.range_m, 0.0, 1.0)


def outputs(hand: TrackedHand, state: HandState, distance_m: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """Training targets (frame, 214): pose features and distances of the next frame, in the wrist's frame."""
    return np.concatenate([pose_features(hand, state, settings), output_distances(hand, distance_m, settings)], axis=1)


METRES, AXES, CELL, RAD_S, FRACTION = 0.001, 0.01, 0.05, 0.05, 0.02  # least standard deviation by unit


def sizes(hand: TrackedHand, settings: FeatureSettings) -> dict[str, int]:
    """Size of each input group, in order: pose, trajectory, ambient, proximity, distance, normal."""
    times = len(settings.sensors.times_s)
    return {
        "pose": sum(_pose_counts(hand, settings)),
        "trajectory": SAMPLE_NUMBERS * len(settings.samples_s),
        "ambient": CELLS**3,
        "proximity": times * hand.n_sensors,
        "distance": times * hand.n_points,
        "normal": 3 * hand.n_points,
    }


def std_floors(hand: TrackedHand, settings: FeatureSettings) -> tuple[np.ndarray, np.ndarray]:
    """Least standard deviations for normalisation: (input,) and (output,), by unit."""
    count = sizes(hand, settings)
    pose = np.repeat([METRES, AXES], _pose_counts(hand, settings))
    sample = np.repeat([METRES, AXES, METRES, RAD_S], [4, 6, 3, 3])
    inputs = [
        pose,
        np.tile(sample, count["trajectory"] // SAMPLE_NUMBERS),
        np.full(count["ambient"], CELL),
        np.full(count["proximity"] + count["distance"], METRES),
        np.full(count["normal"], CELL),
    ]
    return np.concatenate(inputs), np.concatenate([pose, np.full(hand.n_points, FRACTION)])


def _pose_counts(hand: TrackedHand, settings: FeatureSettings) -> tuple[int, int]:
    """Numbers of the positions and of the axes in a pose, see ``pose_features``."""
    if settings.is_paper:
        return 3 * hand.n_points, 6 * hand.n_points
    return 3 * (hand.n_points + 2 * len(hand.palm_capsules)), 6 * hand.n_joints
