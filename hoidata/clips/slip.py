"""Slip of hands: speed of touching joints relative to the surface of a moving object. A stable grasp has none."""

import numpy as np

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.hands.model import N_JOINTS

MOVING_CM_S = 2.0


def touched_parts(
    n_frames: int, frame: np.ndarray, joint: np.ndarray, distance_m: np.ndarray, part: np.ndarray
) -> np.ndarray:
    """Return (n_frames, 21): the object part that each joint of a hand touches, -1 for none.

    Args:
        frame, joint, distance_m: (entry,) joints close to a sampled point.
        part: (entry,) object part of that point.
    """
    touched = np.full((n_frames, N_JOINTS), -1)
    if part.any():  # assignment keeps the last entry of a joint: sort, so that it is the closest point
        order = np.argsort(-distance_m, kind="stable")
        frame, joint, part = frame[order], joint[order], part[order]
    touched[frame, joint] = part
    return touched


def joint_slips_cm_s(track: ObjectTrack, joints_m: np.ndarray, touched: np.ndarray) -> np.ndarray:
    """Return (sample,) speeds of touching joints relative to the object part that they touch, cm/s.

    A sample is a joint and two successive frames in which it touches the same part, while the part moves by more than
    ``MOVING_CM_S`` at the joint.

    Args:
        joints_m: (frame, 21, 3) joints of one hand, world.
        touched: result of ``touched_parts``.
    """
    slips = [np.zeros(0)]
    for part in track.model.parts:
        world_from_part = track.world_from_object @ track.model.object_from_part(part, track.hinge_rad)
        local = world_from_part.inverse() @ joints_m.astype(np.float64)
        carried = world_from_part[1:] @ local[:-1] - world_from_part[:-1] @ local[:-1]
        speed, slip = (100 * FPS * np.linalg.norm(step_m, axis=-1) for step_m in (carried, np.diff(local, axis=0)))
        touching = touched == part
        slips.append(slip[touching[1:] & touching[:-1] & (speed > MOVING_CM_S)])
    return np.concatenate(slips)
