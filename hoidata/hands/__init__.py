"""MANO-layout hand models: the embedded hand, MANO files, forward kinematics, fitting to keypoints."""

from hoidata.hands.embedded import load_embedded_hands, mirrored
from hoidata.hands.kinematics import (
    HandKinematics,
    HandTrackLike,
    kinematics_of,
    track_joints,
    track_rotmats,
    track_vertices,
)
from hoidata.hands.mano import load_mano_hands
from hoidata.hands.model import JOINT_NAMES, PARENTS, TIP_VERTICES, HandModel, HandPair

__all__ = [
    "JOINT_NAMES",
    "PARENTS",
    "TIP_VERTICES",
    "HandKinematics",
    "HandModel",
    "HandPair",
    "HandTrackLike",
    "kinematics_of",
    "load_embedded_hands",
    "load_mano_hands",
    "mirrored",
    "track_joints",
    "track_rotmats",
    "track_vertices",
]
