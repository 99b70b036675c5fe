"""The feature layout of hand and object motion, and the features of recorded tracks.

Text2HOI's layout (Cha et al. 2024, Sec. 3.2.1). Last axis; metres, radians, 6D rotations as in ``rotmat_to_rot6d``:

    hand (99):   WRIST 0:3 | GLOBAL_ORIENT_6D 3:9 | HAND_POSE_6D 9:99, the 15 finger joints, absolute
    object (10): OBJECT_POSITION 0:3 | OBJECT_ROTATION_6D 3:9 | OBJECT_HINGE 9, ``joint_angle_rad``, 0 for rigid objects

``HAND_ROTATIONS_6D`` has all 16 rotations of a hand, 6 numbers each, the global one first.
"""

import numpy as np

from hoidata.clips.clip import HandTrack, ObjectTrack
from hoidata.geometry.rotations import rotmat_to_rot6d, rotvec_to_rotmat
from hoidata.hands.kinematics import track_rotmats
from hoidata.hands.model import N_ROTATIONS

_POSITION, _ROT6D = 3, 6
WRIST = slice(0, _POSITION)
GLOBAL_ORIENT_6D = slice(WRIST.stop, WRIST.stop + _ROT6D)
HAND_POSE_6D = slice(GLOBAL_ORIENT_6D.stop, GLOBAL_ORIENT_6D.stop + (N_ROTATIONS - 1) * _ROT6D)
HAND_ROTATIONS_6D = slice(GLOBAL_ORIENT_6D.start, HAND_POSE_6D.stop)
HAND_FEATURES = HAND_POSE_6D.stop

OBJECT_POSITION = slice(0, _POSITION)
OBJECT_ROTATION_6D = slice(OBJECT_POSITION.stop, OBJECT_POSITION.stop + _ROT6D)
OBJECT_HINGE = OBJECT_ROTATION_6D.stop  # an index: one number, (...,) angles
OBJECT_FEATURES = OBJECT_HINGE + 1


def hand_features(track: HandTrack, model_from_world: np.ndarray, origin_m: np.ndarray) -> np.ndarray:
    """Return the features (frame, 99) float32 of one hand in the model frame.

    Args:
        model_from_world: (3, 3) rotation.
        origin_m: (3,) origin of the model frame, metres, world frame.
    """
    rotmats = track_rotmats(track).astype(np.float64)
    rotmats[:, 0] = model_from_world @ rotmats[:, 0]
    wrist = (track.wrist_m - origin_m) @ model_from_world.T
    return np.concatenate((wrist, rotmat_to_rot6d(rotmats).reshape(len(wrist), -1)), axis=1, dtype=np.float32)


def object_features(track: ObjectTrack, model_from_world: np.ndarray, origin_m: np.ndarray) -> np.ndarray:
    """Return the features (frame, 10) float32 of one object in the model frame; arguments as in ``hand_features``."""
    rotation = model_from_world @ rotvec_to_rotmat(track.rotvec.astype(np.float64))
    position = (track.translation_m - origin_m) @ model_from_world.T
    hinge = np.zeros(len(position)) if track.joint_angle_rad is None else track.joint_angle_rad
    return np.concatenate((position, rotmat_to_rot6d(rotation), hinge[:, None]), axis=1, dtype=np.float32)


def upright(gravity: np.ndarray | None) -> np.ndarray:
    """Return the smallest rotation (3, 3) from the gravity direction (3,) to -z; the identity if it is unknown."""
    if gravity is None:
        return np.eye(3)
    down = np.asarray(gravity, dtype=np.float64) / np.linalg.norm(gravity)
    axis = np.cross(down, (0.0, 0.0, -1.0))
    sine, cosine = float(np.linalg.norm(axis)), float(-down[2])
    if sine < 1e-9:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return rotvec_to_rotmat(axis / sine * np.arctan2(sine, cosine))
