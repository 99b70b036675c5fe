"""Motion of a hand within its grasp, and noise of the recording: of the size that real recordings of grasps have.

In ARCTIC, the finger joints of a hand in contact rotate by 60 degrees per second, mostly below 2 Hz, and the hand
slides by 4 cm/s on the object. Above 4 Hz, wrists and objects move by 0.1 mm per axis and frame.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import HandTrack, ObjectTrack
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandPair
from hoidata.objects.surface_index import surface_index
from hoidata.synthetic.grasps import Grip, PosedHands
from hoidata.synthetic.paths import waves

# Standard deviation of a free hand: wrist position in metres, wrist rotation and joint angles in radians.
_FREE = np.repeat([0.005, 0.04, 0.12], [3, 3, 45])
_TOUCHING_M, _TOLERANCE_M, _PRESSED_M = 0.003, 0.0003, 0.0015
_SMALL = 0.1  # step of the finite differences, relative to _FREE
_RATES_HZ = (0.2, 1.6)
# Standard deviations of the noise of a recording, per axis and frame.
_NOISE_M, _OBJECT_NOISE_RAD, _JOINT_NOISE_RAD = 1e-4, 5e-4, 2e-3


class Play(NamedTuple):
    """Motions within a grasp: shift and rotation of the wrist in the frame of the part, and 45 joint angles."""

    pressed: np.ndarray  # (51,) presses the hand on the object
    modes: np.ndarray  # (51, 51) maps independent random numbers of variance 1 to motions

    def sample(self, times: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
        """Return (time, 51) smooth motions. times: frames at 30 fps."""
        return scale * (self.pressed + waves(times, _RATES_HZ, len(self.modes), rng) @ self.modes)


def grasp_play(grip: Grip, betas: np.ndarray, track: ObjectTrack, pair: HandPair) -> Play:
    """Return the motions within a grasp that keep its contacts.

    They are the random motions of a free hand, under the condition that touching vertices keep their distance from the
    surface, to first order.
    """
    moves = np.concatenate([np.zeros((1, len(_FREE))), _SMALL * np.diag(_FREE)])
    hands = PosedHands(
        side=grip.side,
        wrist_m=grip.wrist_m + moves[:, :3],
        rotmats=rotvec_to_rotmat(moves[:, 3:6]) @ grip.rotmat,
        hand_pose=grip.hand_pose + moves[:, 6:],
        open_pose=grip.open_pose,
        betas=np.repeat(betas[None], len(moves), axis=0),
    )
    hinge = None if track.hinge_rad is None else track.hinge_rad[:1]
    vertices = track.model.object_from_part(grip.part, hinge) @ hands.mesh(pair)[0]
    near = surface_index(track.model).nearest(vertices[:1], hinge, _TOUCHING_M)
    touching = near.distance_m[0] < _TOUCHING_M
    normals = near.normal[0, touching]
    lifted_m = np.einsum("mvi,vi->mv", vertices[1:, touching] - vertices[0, touching], normals) / _SMALL
    eigenvalues, vectors = np.linalg.eigh(np.eye(len(_FREE)) + lifted_m @ lifted_m.T / _TOLERANCE_M**2)
    pressed = vectors / eigenvalues @ vectors.T @ lifted_m.sum(axis=1) * (-_PRESSED_M / _TOLERANCE_M**2)
    return Play(_FREE * pressed, vectors / np.sqrt(eigenvalues) @ vectors.T * _FREE)


def recorded_hand(hand: HandTrack, scale: float, rng: np.random.Generator) -> HandTrack:
    """Add the noise of a recording. scale: of the noise."""
    pose = hand.hand_pose + scale * _JOINT_NOISE_RAD * rng.normal(size=hand.hand_pose.shape)
    wrist_m = hand.wrist_m + scale * _NOISE_M * rng.normal(size=hand.wrist_m.shape)
    return replace(hand, wrist_m=wrist_m, hand_pose=pose)


def recorded_object(track: ObjectTrack, scale: float, rng: np.random.Generator) -> ObjectTrack:
    """Add the noise of a recording. scale: of the noise."""
    rotations = rotvec_to_rotmat(scale * _OBJECT_NOISE_RAD * rng.normal(size=track.rotvec.shape))
    return replace(
        track,
        rotvec=rotmat_to_rotvec(rotations @ rotvec_to_rotmat(track.rotvec)),
        translation_m=track.translation_m + scale * _NOISE_M * rng.normal(size=track.translation_m.shape),
    )
