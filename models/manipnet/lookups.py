"""What any network has to beat: poses without one, found by what it is given too, never by fingers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Side
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import sense
from models.manipnet.control import Control
from models.manipnet.features import FeatureSettings, floors, object_from_wrist, sizes, trajectory_features

ROWS_AT_ONCE = 256


def control_inputs(
    control: Control,
    side: Side,
    hand: TrackedHand,
    time_s: np.ndarray,
    surface: SurfaceIndex,
    settings: FeatureSettings,
) -> np.ndarray:
    """(frame, 336 + 1000) float32: trajectories, and the ambient sensor of a hand in its neutral pose."""
    trajectory = trajectory_features(control, side, hand, time_s, settings)
    placed, hinge = object_from_wrist(control, side, time_s, settings)
    neutral = hand.state(np.tile(hand.rest_rotmats, (len(time_s), 1, 1, 1)))
    ambient = sense(hand, neutral, placed, hinge, surface, settings.sensors).ambient
    return np.concatenate([trajectory, ambient], axis=1, dtype=np.float32)


def joint_errors_m(hand: TrackedHand, made: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """(frame, point) of joints and tips but the wrist, in its frame; finger rotations (frame, joint - 1, 3, 3)."""
    return np.linalg.norm(hand.state(made).point_m - hand.state(recorded).point_m, axis=-1)[:, 1:]


def as_right(hand: TrackedHand, fingers: np.ndarray) -> np.ndarray:
    """Finger rotations of a left hand as its mirror image's, and back; those of a right hand as they are."""
    mirror = np.array([-1.0, 1.0, 1.0])
    return mirror[:, None] * fingers * mirror if hand.side == "left" else fingers


def mean_rotmats(rotmats: np.ndarray) -> np.ndarray:
    """(joint, 3, 3) the mean of rotations (frame, joint, 3, 3), the rotation nearest to all in squared distance."""
    means = [Rotation.from_matrix(one).mean().as_matrix() for one in np.moveaxis(rotmats, 1, 0)]
    return np.stack(means)


@dataclass(frozen=True)
class Lookup:
    """Training frames by control inputs. rows: (frame, 1336) scaled. finger_rotmats: (frame, joint - 1, 3, 3)."""

    mean: np.ndarray
    scale: np.ndarray
    rows: np.ndarray
    finger_rotmats: np.ndarray

    @classmethod
    def of(
        cls, hand: TrackedHand, settings: FeatureSettings, inputs: Sequence[np.ndarray], fingers: Sequence[np.ndarray]
    ) -> "Lookup":
        """From the control inputs and the fingers (as a right hand's) of recorded hands."""
        count, every = sizes(hand, settings), np.concatenate(inputs)
        least = floors(hand, settings)[0][count["pose"] : count["pose"] + every.shape[1]].astype(np.float32)
        mean, scale = every.mean(axis=0), np.maximum(every.std(axis=0), least)
        return cls(mean, scale, (every - mean) / scale, np.concatenate(fingers))

    def nearest(self, inputs: np.ndarray, count: int) -> np.ndarray:
        """(frame, count) numbers of the training frames nearest to control inputs (frame, 1336), nearest first."""
        square, found = (self.rows**2).sum(axis=1), []
        for start in range(0, len(inputs), ROWS_AT_ONCE):
            row = (inputs[start : start + ROWS_AT_ONCE] - self.mean) / self.scale
            apart = square - 2 * row @ self.rows.T
            found.append(np.argsort(apart, axis=1, kind="stable")[:, :count])
        return np.concatenate(found)

    def poses(self, inputs: np.ndarray, count: int) -> np.ndarray:
        """(frame, joint - 1, 3, 3) for each row the mean of the fingers of the ``count`` nearest training frames."""
        chosen = self.finger_rotmats[self.nearest(inputs, count)]
        return chosen[:, 0] if count == 1 else np.stack([mean_rotmats(own) for own in chosen])
