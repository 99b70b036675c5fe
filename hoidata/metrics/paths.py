"""A motion as the path of its points: learnt from nothing, so that copies of training clips show in any dataset."""

from collections.abc import Sequence

import numpy as np

from hoidata.clips.clip import SIDES, Side
from hoidata.clips.features import upright
from hoidata.files.atomic import sha256_bytes
from hoidata.metrics.encoded import Encoding
from hoidata.metrics.pair import Motion

JOINTS = 42  # 21 of the left hand, then 21 of the right
FRAMES = 15
MOST_FRAMES = 150
AXIS_M = 0.1


def joints_and_presence(motion: Motion, sides: tuple[Side, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(frame, 42, 3) float64 world joints turned upright, metres, and (frame, 42) whether the hand acts and is seen.

    Of longer motions the first 150 frames, as generators make no more.
    """
    clip = motion.clip
    joints = np.concatenate([motion.joints_m[side][:MOST_FRAMES] for side in SIDES], axis=1).astype(np.float64)
    seen = [clip.hands[side].valid[:MOST_FRAMES] & (side in sides) for side in SIDES]
    return joints @ upright(clip.gravity).T, np.repeat(np.stack(seen, axis=1), JOINTS // 2, axis=1)


def even_frames(n_frames: int) -> np.ndarray:
    """(15,) frames evenly over a clip, its first and last among them."""
    return np.linspace(0, n_frames - 1, FRAMES).astype(np.int64)


class PathEncoder:
    """Joints and the object's origin and axes (10 cm long) in 15 frames, upright, from where the object first was.

    The distance of two motions is the root mean square over these points, metres; a hand that is absent stands at zero.
    """

    name = "path"
    digest = sha256_bytes(b"path 1")
    labels: tuple[str, ...] = ()

    def encode(self, motions: Sequence[Motion], sides: Sequence[tuple[Side, ...]]) -> Encoding:
        paths = [_path(motion, own) for motion, own in zip(motions, sides, strict=True)]
        return Encoding(np.stack(paths), np.zeros((len(paths), 0)))

    def encode_text(self, text: np.ndarray) -> np.ndarray | None:
        return None


def _path(motion: Motion, sides: tuple[Side, ...]) -> np.ndarray:
    joints, present = joints_and_presence(motion, sides)
    frames, turn = even_frames(len(joints)), upright(motion.clip.gravity)
    origin = turn @ motion.clip.object.translation_m[0].astype(np.float64)
    placed = np.where(present[frames][..., None], joints[frames] - origin, 0.0)
    corners = np.concatenate((np.zeros((1, 3)), AXIS_M * np.eye(3)))
    moved = (motion.clip.object.take(frames).world_from_object @ corners) @ turn.T - origin
    points = np.concatenate((placed, moved), axis=1)
    return points.reshape(-1) / np.sqrt(points.shape[0] * points.shape[1])
