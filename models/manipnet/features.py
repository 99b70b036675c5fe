"""What the network reads and writes: pose, trajectory and sensors of one hand, all in canonical axes of its wrist.

Sizes for ManipNet's 17-joint hand: pose 192, trajectory 336, sensors 1,822 (2,350 in all); output 192 + 22 = 214.
Metres here; ``released_layout`` turns to the release's decimetres and left-handed axes.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from hoidata.clips.clip import Side
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import OURS, SensorSettings
from models.manipnet.control import Control


@dataclass(frozen=True)
class FeatureSettings:
    """step_s: from one pose to the next. past_s, future_s, spacing_s: samples of the trajectory around now.

    velocity_axes: of the object's angular velocity. object_place: what stands for the object's position.
    smooth: the release's smoothing of trajectories in training. range_m: distances of the output are clamped to 0 and
    this and divided by it; less_radius: less the radius of the joint's capsule.
    """

    step_s: float = 1 / 60
    past_s: float = 0.5
    future_s: float = 0.5
    spacing_s: float = 0.05
    velocity_axes: Literal["wrist", "object"] = "wrist"
    object_place: Literal["box", "mass"] = "box"
    smooth: bool = False
    range_m: float = 0.03
    less_radius: bool = True
    sensors: SensorSettings = OURS


class HandInputs(NamedTuple):
    """pose: (frame, 192); trajectory: (frame, 336); sensors: (frame, 1822); of other hands their own sizes."""

    pose: np.ndarray
    trajectory: np.ndarray
    sensors: np.ndarray


def pose_features(hand: TrackedHand, state: HandState) -> np.ndarray:
    """(frame, 9 joint + 15 + 6 palm capsule): 192. Canonical axes, metres, in the order

    joint positions, tips (thumb to pinky), palm capsule starts, their ends, then per joint its z axis and y axis.
    state: the hand in its wrist's frame.
    """
    raise NotImplementedError


def joint_rotmats_of(hand: TrackedHand, pose: np.ndarray) -> np.ndarray:
    """(frame, joint, 3, 3) wrist_from_joint, from the axes in pose features or network output (frame, 192 or more).

    Axes are made orthonormal: z as given, y as near as it can be. ``hand.finger_rotmats`` makes them local.
    """
    raise NotImplementedError


def trajectory_features(control: Control, side: Side, hand: TrackedHand, time_s: np.ndarray,
                        settings: FeatureSettings) -> np.ndarray:  # fmt: skip
    """(frame, 21 x 16): per sample distance of the other wrist; own wrist position, z axis, y axis; the object's
    position and angular velocity (rad/s). Metres, canonical axes of the own wrist at ``time_s (frame,)``.
    """
    raise NotImplementedError


def object_from_wrist(control: Control, side: Side, time_s: np.ndarray,
                      settings: FeatureSettings) -> tuple[RigidTransform, np.ndarray | None]:  # fmt: skip
    """(frame, time) transforms and hinge angles for ``sense``, at ``time_s (frame,)`` and the future times after it."""
    raise NotImplementedError


def hand_inputs(control: Control, side: Side, hand: TrackedHand, state: HandState, time_s: np.ndarray,
                surface: SurfaceIndex, settings: FeatureSettings) -> HandInputs:  # fmt: skip
    """All inputs of one hand at ``time_s (frame,)``. state: (frame,) in its wrist's frame; hand: that side's."""
    raise NotImplementedError


def output_distances(hand: TrackedHand, distance_m: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """(frame, 22) in 0 to 1, of signed distances (frame, 22) of joints and tips (``Sensed.distance_m[:, 0]``)."""
    raise NotImplementedError


def outputs(hand: TrackedHand, state: HandState, distance_m: np.ndarray, settings: FeatureSettings) -> np.ndarray:
    """(frame, 214): pose features and distances of the next frame, in its own wrist's frame: what is learnt."""
    return np.concatenate([pose_features(hand, state), output_distances(hand, distance_m, settings)], axis=1)


def released_layout(hand: TrackedHand, values: np.ndarray, inverse: bool = False) -> np.ndarray:
    """(frame, 2350) inputs or (frame, 214) outputs in the release's decimetres, left-handed axes and order; or back.

    A sign and scale per number and an order (both known as arrays: see ``released_signs``), so it can be folded into
    the mean, deviation and matrices of a network.
    """
    raise NotImplementedError
