"""How fast joints that touch an object slide over it while it moves: a hold that holds lets none slide."""

import numpy as np

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.hands.model import N_JOINTS

MOVING_CM_S = 2.0


def touched_parts(
    n_frames: int, frame: np.ndarray, joint: np.ndarray, distance_m: np.ndarray, part: np.ndarray
) -> np.ndarray:
    """(n_frames, 21) the part of the sampled point nearest to each joint of a hand, -1 where none is near.

    frame, joint, distance_m, part: (entry,) of every joint near a sampled point; part is the point's.
    """
    touched = np.full((n_frames, N_JOINTS), -1)
    if part.any():  # of several entries of a joint the last one stays: the nearest
        order = np.argsort(-distance_m, kind="stable")
        frame, joint, part = frame[order], joint[order], part[order]
    touched[frame, joint] = part
    return touched


def joint_slips_cm_s(thing: ObjectTrack, joints_m: np.ndarray, touched: np.ndarray) -> np.ndarray:
    """(joint and frame,) speed of a touching joint over the part it touches, while that moves there, cm/s.

    A joint counts from a frame to the next where it touches the same part in both, and that part's own motion carries
    the point under the joint by more than ``MOVING_CM_S``. joints_m: (frame, 21, 3) of one hand, world. touched: as
    ``touched_parts`` gives it.
    """
    each = [np.zeros(0)]
    for part in thing.model.parts:
        world_from_part = thing.world_from_object @ thing.model.object_from_part(part, thing.hinge_rad)
        local = world_from_part.inverse() @ joints_m.astype(np.float64)
        carried = world_from_part[1:] @ local[:-1] - world_from_part[:-1] @ local[:-1]
        speed, slip = (100 * FPS * np.linalg.norm(way, axis=-1) for way in (carried, np.diff(local, axis=0)))
        touching = touched == part
        each.append(slip[touching[1:] & touching[:-1] & (speed > MOVING_CM_S)])
    return np.concatenate(each)
