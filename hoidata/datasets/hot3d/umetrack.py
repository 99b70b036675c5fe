"""UmeTrack's hand (Han et al. 2022) as HOT3D states it: from joint angles and a person's profile to joints.

A profile describes a left hand in millimetres, its wrist at the origin; a right hand is the same, x mirrored. Each
digit has four hinges one after the other, given by an axis and a point at rest; after the second, third and fourth a
bone follows. Landmarks hang on bones with weights.
"""

from typing import Any, NamedTuple

import numpy as np

from hoidata.clips.clip import Side
from hoidata.datasets import checks
from hoidata.datasets.hot3d.files import Poses, read_json, small_table
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform

N_DIGITS, HINGES = 5, 4
N_BONES = 2 + 3 * N_DIGITS  # root and wrist, which lie in the same place, then three of each digit from the thumb on
N_ANGLES = N_DIGITS * HINGES
MILLIMETRES = 1e-3
# The landmark of each of our 21 joints: wrist; index, middle, pinky, ring from the knuckle out; thumb; tips. UmeTrack
# has no landmark at the base of the thumb.
LANDMARKS = (5, 8, 9, 10, 11, 12, 13, 17, 18, 19, 14, 15, 16, None, 6, 7, 1, 2, 4, 3, 0)


class Profile(NamedTuple):
    """axes: (20, 3) unit; places_m: (20, 3) a point of each hinge at rest; landmarks_m: (21, 3) at rest.

    skin: (21, 17) weight of each bone for each landmark.
    """

    axes: np.ndarray
    places_m: np.ndarray
    landmarks_m: np.ndarray
    skin: np.ndarray


def parse_profile(data: bytes, where: str) -> Profile:
    """``umetrack_hand_user_profile.json``; the mesh it also holds is not looked at."""
    return profile_of(checks.entry(where, read_json(data, where), "hand_model"), where)


def profile_of(hand: Any, where: str) -> Profile:
    """From what a file says of the hand."""

    def rows(name: str, count: int) -> np.ndarray:
        return small_table(f"{where}: {name}", checks.entry(where, hand, name), 3, count)

    axes, places = (rows(f"joint_{name}", N_ANGLES + 2)[:N_ANGLES] for name in ("rotation_axes", "rest_positions"))
    if (np.abs(np.linalg.norm(axes, axis=1) - 1) > 1e-3).any():
        raise BadInput(f"{where}: joint_rotation_axes", "axes of length 1", "another length")
    landmarks = rows("landmark_rest_positions", len(LANDMARKS))
    bones, weights = (rows(f"landmark_rest_bone_{name}", len(LANDMARKS)) for name in ("indices", "weights"))
    if not np.isin(bones, range(N_BONES)).all() or (np.abs(weights.sum(axis=1) - 1) > 1e-3).any():
        raise BadInput(f"{where}: landmark_rest_bone_*", f"bones 0 to {N_BONES - 1}, weights that sum to 1", "others")
    skin = np.zeros((len(LANDMARKS), N_BONES))
    np.add.at(skin, (np.arange(len(LANDMARKS))[:, None], bones.astype(int)), weights)
    return Profile(axes, places * MILLIMETRES, landmarks * MILLIMETRES, skin)


def joints_m(profile: Profile, poses: Poses, side: Side) -> np.ndarray:
    """(row, 21, 3) joints and tips in our order and the file's world, metres; NaN for the base of the thumb."""
    bones = _bones(profile, poses.numbers["joint_angles"][:, :N_ANGLES])
    moved = np.stack([bone @ profile.landmarks_m for bone in bones], axis=-2)  # (row, landmark, bone, 3)
    local = np.einsum("lb,rlbc->rlc", profile.skin, moved)
    if side == "right":
        local = local * (-1.0, 1.0, 1.0)
    world = local @ poses.rotation.transpose(0, 2, 1) + poses.translation_m[:, None]
    found = [np.full_like(world[:, 0], np.nan) if landmark is None else world[:, landmark] for landmark in LANDMARKS]
    return np.stack(found, axis=1)


def _bones(profile: Profile, angles: np.ndarray) -> list[RigidTransform]:
    """Each bone's turn about the hinges before it, (row,) transforms in the wrist's frame; angles: (row, 20)."""
    still = RigidTransform(np.tile(np.eye(3), (len(angles), 1, 1)))
    bones = [still, still]
    for first in range(0, N_ANGLES, HINGES):
        bone = still
        for hinge in range(first, first + HINGES):
            turn = rotvec_to_rotmat(profile.axes[hinge] * angles[:, hinge, None])
            bone = bone @ RigidTransform(turn, profile.places_m[hinge], profile.places_m[hinge])
            if hinge > first:
                bones.append(bone)
    return bones
