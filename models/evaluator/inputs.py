"""What the networks of the evaluator see of a motion, as arrays.

``paper`` is the rule Text2HOI left in its released code (facts sheet 3.2): 15 frames of 42 joints, no object.
``corrected`` sees the object too, but not its shape, from which the label could be read (sheet 6.1).
"""

from functools import lru_cache

import numpy as np

from hoidata.clips.clip import SIDES, Side
from hoidata.clips.features import OBJECT_ROTATION_6D, object_features, upright
from hoidata.geometry.rotations import rot6d_to_rotmat, turns_about
from hoidata.metrics.pair import Motion
from hoidata.metrics.paths import FRAMES, JOINTS, joints_and_presence
from hoidata.objects.surface_index import surface_index

EVERY = 3
FAR_M = 0.10
PAPER_SIZE = JOINTS * 3
OBJECT = slice(PAPER_SIZE, PAPER_SIZE + 11)  # position 3, 6D 6, hinge 1, turn about the upright since the first frame 1
CORRECTED_SIZE = OBJECT.stop + JOINTS
MOTIONS_KEPT = 128


def drawn_frames(n_frames: int, shares: np.ndarray) -> np.ndarray:
    """(15,) one frame of each of 15 groups in a row. shares: (15,) where in its group, from 0 to below 1."""
    edges = np.linspace(0, n_frames, FRAMES + 1)
    return np.minimum(edges[:-1] + shares * np.diff(edges), n_frames - 1).astype(np.int64)


def paper_input(joints: np.ndarray, present: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """(15, 126) float32: joints less the wrist of the first frame (the right one if that hand acts), absent ones 0.

    First: of the frames in which that wrist is seen.
    """
    chosen, seen = joints[frames], present[frames]
    wrist = JOINTS // 2 if seen[:, JOINTS // 2].any() else 0
    placed = np.where(seen[..., None], chosen - chosen[seen[:, wrist].argmax(), wrist], 0.0)
    return placed.reshape(len(frames), -1).astype(np.float32)


@lru_cache(maxsize=MOTIONS_KEPT)
def corrected_input(motion: Motion, sides: tuple[Side, ...]) -> np.ndarray:
    """(step, 179) float32: joints and object in the clip frame at 10 per second, and how near each joint is.

    Clip frame: upright, the object's first position at zero; which way a clip faces means nothing. Hence the turn as a
    number of its own, radians: of two rotations that may face any way, a network does not learn whether a lid is
    screwed on or off. Kept for the last motions: two networks ask for it.
    """
    joints, present = joints_and_presence(motion, sides)
    frames = np.arange(len(joints))[::EVERY]
    clip, seen, turn = motion.clip, present[frames], upright(motion.clip.gravity)
    origin = clip.object.translation_m[0].astype(np.float64)
    objects = object_features(clip.object.take(frames), turn, origin)
    placed = np.where(seen[..., None], joints[frames] - turn @ origin, 0.0)
    near = np.where(seen, np.concatenate([_distances_m(motion, side, frames) for side in SIDES], axis=1), FAR_M)
    steps = turns_about(rot6d_to_rotmat(objects[:, OBJECT_ROTATION_6D]), np.array((0.0, 0.0, 1.0)))
    facing = np.concatenate(([0.0], np.cumsum(steps)))[:, None]  # whole turns counted
    return np.concatenate((placed.reshape(len(frames), -1), objects, facing, near), axis=1).astype(np.float32)


def _distances_m(motion: Motion, side: Side, frames: np.ndarray) -> np.ndarray:
    """(step, 21) distance of the joints of one hand to the surface, at most 0.10 m."""
    index = surface_index(motion.clip.object.model)
    positions = motion.joints_in_object(side, frames)
    return np.minimum(index.distance_m(positions, motion.hinge_rad(frames), FAR_M), FAR_M)
