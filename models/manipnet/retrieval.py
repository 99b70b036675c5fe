"""Retrieval baseline of ManipNet: finger poses of the training frames with the most similar control inputs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Side
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import sense
from models.manipnet.control import Control
from models.manipnet.features import FeatureSettings, object_from_wrist, sizes, std_floors, trajectory_features

BATCH_SIZE = 256


def control_inputs(
    control: Control,
    side: Side,
    hand: TrackedHand,
    time_s: np.ndarray,
    surface: SurfaceIndex,
    settings: FeatureSettings,
) -> np.ndarray:
    """(frame, 336 + 1000) float32: trajectories, and the ambient sensor of the hand in its neutral pose."""
    trajectory = trajectory_features(control, side, hand, time_s, settings)
    transforms, hinge_rad = object_from_wrist(control, side, time_s, settings)
    neutral = hand.state(np.tile(hand.rest_rotmats, (len(time_s), 1, 1, 1)))
    ambient = sense(hand, neutral, transforms, hinge_rad, surface, settings.sensors).ambient
    return np.concatenate([trajectory, ambient], axis=1, dtype=np.float32)


def joint_errors_m(hand: TrackedHand, predicted: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """Errors (frame, point) of joints and tips, wrist frame; both poses: finger rotations (frame, joint - 1, 3, 3)."""
    return np.linalg.norm(hand.state(predicted).point_m - hand.state(recorded).point_m, axis=-1)[:, 1:]


def mirrored_to_right(hand: TrackedHand, fingers: np.ndarray) -> np.ndarray:
    """Mirror finger rotations of a left hand to a right hand, or back; those of a right hand are unchanged."""
    mirror = np.array([-1.0, 1.0, 1.0])
    return mirror[:, None] * fingers * mirror if hand.side == "left" else fingers


def mean_rotmats(rotmats: np.ndarray) -> np.ndarray:
    """Mean of rotations (frame, joint, 3, 3) in the least-squares sense: (joint, 3, 3)."""
    means = [Rotation.from_matrix(joint_rotmats).mean().as_matrix() for joint_rotmats in np.moveaxis(rotmats, 1, 0)]
    return np.stack(means)


@dataclass(frozen=True)
class NearestFrames:
    """Training frames, searched by control inputs."""

    mean: np.ndarray  # (1336,) of the inputs
    scale: np.ndarray  # (1336,)
    scaled_inputs: np.ndarray  # (frame, 1336)
    finger_rotmats: np.ndarray  # (frame, joint - 1, 3, 3) as a right hand's

    @classmethod
    def of(
        cls, hand: TrackedHand, settings: FeatureSettings, inputs: Sequence[np.ndarray], fingers: Sequence[np.ndarray]
    ) -> "NearestFrames":
        """Build from control inputs and finger rotations (as a right hand's) of recorded hands."""
        count, all_inputs = sizes(hand, settings), np.concatenate(inputs)
        floor = std_floors(hand, settings)[0][count["pose"] : count["pose"] + all_inputs.shape[1]].astype(np.float32)
        mean, scale = all_inputs.mean(axis=0), np.maximum(all_inputs.std(axis=0), floor)
        return cls(mean, scale, (all_inputs - mean) / scale, np.concatenate(fingers))

    def nearest(self, inputs: np.ndarray, count: int) -> np.ndarray:
        """Indices (frame, count) of the training frames nearest to control inputs (frame, 1336), nearest first."""
        squares, nearest = (self.scaled_inputs**2).sum(axis=1), []
        for start in range(0, len(inputs), BATCH_SIZE):
            scaled = (inputs[start : start + BATCH_SIZE] - self.mean) / self.scale
            distances = squares - 2 * scaled @ self.scaled_inputs.T
            nearest.append(np.argsort(distances, axis=1, kind="stable")[:, :count])
        return np.concatenate(nearest)

    def poses(self, inputs: np.ndarray, count: int) -> np.ndarray:
        """(frame, joint - 1, 3, 3) mean finger rotations of the ``count`` nearest training frames."""
        chosen = self.finger_rotmats[self.nearest(inputs, count)]
        return chosen[:, 0] if count == 1 else np.stack([mean_rotmats(poses) for poses in chosen])
