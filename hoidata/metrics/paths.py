"""Encoder without learned weights: the trajectory of joints and object. It reveals copies of training clips."""

from collections.abc import Sequence

import numpy as np

from hoidata.clips.clip import SIDES, Side
from hoidata.clips.features import upright
from hoidata.files.atomic import sha256_bytes
from hoidata.metrics.encoded import Encoding
from hoidata.metrics.pair import Motion

JOINTS = 42  # 21 of the left hand, then 21 of the right
FRAMES = 15
MOST_FRAMES = 150  # longer motions are cut: generators produce at most this many frames
AXIS_M = 0.1  # length of the object axes whose end points represent the rotation


def joints_and_presence(motion: Motion, sides: tuple[Side, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(frame, 42, 3) float64 joints in the upright world, metres, and (frame, 42) whether the hand acts and is valid.

    Only the first 150 frames of longer motions.
    """
    clip = motion.clip
    joints = np.concatenate([motion.joints_m[side][:MOST_FRAMES] for side in SIDES], axis=1).astype(np.float64)
    present = [clip.hands[side].valid[:MOST_FRAMES] & (side in sides) for side in SIDES]
    return joints @ upright(clip.gravity).T, np.repeat(np.stack(present, axis=1), JOINTS // 2, axis=1)


def even_frames(n_frames: int) -> np.ndarray:
    """(15,) frame indices spread evenly over a clip, the first and last included."""
    return np.linspace(0, n_frames - 1, FRAMES).astype(np.int64)


class PathEncoder:
    """Encodes joints, object origin and object axes (10 cm long) in 15 frames, relative to the object's first position.

    The distance of two encodings is the root mean square over these points, metres. An absent hand is zero.
    """

    name = "path"
    digest = sha256_bytes(b"path 1")
    labels: tuple[str, ...] = ()

    def encode(self, motions: Sequence[Motion], sides: Sequence[tuple[Side, ...]]) -> Encoding:
        paths = [_path(motion, acting) for motion, acting in zip(motions, sides, strict=True)]
        return Encoding(np.stack(paths), np.zeros((len(paths), 0)))

    def encode_text(self, text: np.ndarray) -> np.ndarray | None:
        return None


def _path(motion: Motion, sides: tuple[Side, ...]) -> np.ndarray:
    joints, present = joints_and_presence(motion, sides)
    frames, world_to_upright = even_frames(len(joints)), upright(motion.clip.gravity)
    origin = world_to_upright @ motion.clip.object.translation_m[0].astype(np.float64)
    placed = np.where(present[frames][..., None], joints[frames] - origin, 0.0)
    corners = np.concatenate((np.zeros((1, 3)), AXIS_M * np.eye(3)))
    moved = (motion.clip.object.take(frames).world_from_object @ corners) @ world_to_upright.T - origin
    points = np.concatenate((placed, moved), axis=1)
    return points.reshape(-1) / np.sqrt(points.shape[0] * points.shape[1])
