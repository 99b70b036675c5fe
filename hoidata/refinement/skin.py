"""Some vertices of one hand of known shape: where they are in each pose, and how they follow the 51 unknowns."""

from typing import NamedTuple

import numpy as np
import torch

from hoidata.clips.clip import HandTrack
from hoidata.geometry.rotations import nearest_rotvec, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.model import N_ROTATIONS, PARENTS, HandModel
from hoidata.hands.solver import left_jacobian
from hoidata.refinement.kernels import N_UNKNOWNS, place_joints, skin_vertices, vertex_derivatives


class HandPose(NamedTuple):
    """wrist_m (frame, 3) world; orient (frame, 3, 3) world-from-hand; fingers (frame, 15, 3) axis-angles."""

    wrist_m: np.ndarray
    orient: np.ndarray
    fingers: np.ndarray

    @classmethod
    def of(cls, track: HandTrack) -> "HandPose":
        wrist_m, global_orient, hand_pose = (
            np.asarray(array, np.float64) for array in (track.wrist_m, track.global_orient, track.hand_pose)
        )
        return cls(wrist_m, rotvec_to_rotmat(global_orient), hand_pose.reshape(-1, 15, 3))

    def moved(self, step: np.ndarray) -> "HandPose":
        """After a step (frame, 51) of the unknowns."""
        orient = rotvec_to_rotmat(step[:, 3:6]) @ self.orient
        return HandPose(self.wrist_m + step[:, :3], orient, self.fingers + step[:, 6:].reshape(-1, 15, 3))

    def taken(self, frames: np.ndarray) -> "HandPose":
        """Of the chosen frames."""
        return HandPose(*(array[frames] for array in self))

    def step_to(self, other: "HandPose") -> np.ndarray:
        """(frame, 51) the step that leads to the other pose."""
        turn = rotmat_to_rotvec(other.orient @ self.orient.swapaxes(-1, -2))
        fingers = (nearest_rotvec(other.fingers, self.fingers) - self.fingers).reshape(len(turn), -1)
        return np.concatenate((other.wrist_m - self.wrist_m, turn, fingers), 1)

    def seen_from(self, a_from_world: RigidTransform) -> "HandPose":
        """The same hand in frame a, ``a_from_world`` (frame,) transforms."""
        wrist = (a_from_world @ self.wrist_m[:, None])[:, 0]
        return HandPose(wrist, a_from_world.rotation @ self.orient, self.fingers)

    def where(self, chosen: np.ndarray, other: "HandPose") -> "HandPose":
        """Per frame this pose where ``chosen (frame,)``, else the other."""
        mask = chosen[:, None]
        return HandPose(
            np.where(mask, self.wrist_m, other.wrist_m),
            np.where(mask[..., None], self.orient, other.orient),
            np.where(mask[..., None], self.fingers, other.fingers),
        )

    def track(self, betas: np.ndarray, valid: np.ndarray, template_m: np.ndarray | None) -> HandTrack:
        """As it is stored; betas (10,), valid (frame,)."""
        return HandTrack(
            self.wrist_m.astype(np.float32),
            rotmat_to_rotvec(self.orient).astype(np.float32),
            self.fingers.reshape(-1, 45).astype(np.float32),
            np.asarray(betas, np.float32)[None],
            valid,
            template_m,
        )


class Chain(NamedTuple):
    """Of the joints in each frame, as ``kernels.vertex_derivatives`` explains."""

    rotation: np.ndarray
    position_m: np.ndarray
    axis: np.ndarray
    local: np.ndarray
    rested_m: np.ndarray


class Skin:
    """The vertices ``ids`` of a hand model with the shape betas (10,) or of a personal mesh template_m (778, 3)."""

    def __init__(
        self, model: HandModel, betas: np.ndarray, template_m: np.ndarray | None = None, ids: np.ndarray | None = None
    ) -> None:
        ids = np.arange(len(model.template_m)) if ids is None else np.asarray(ids)
        base = model.template_m if template_m is None else np.asarray(template_m, np.float64)
        betas = np.asarray(betas, np.float64).reshape(-1)
        self.shaped_m = (base + model.shape_directions @ betas)[ids]
        self.rest_joints_m = model.rest_joints_m(betas, template_m).reshape(N_ROTATIONS, 3)
        self.weights = np.ascontiguousarray(model.skin_weights[ids], np.float64)
        self.pose_directions = np.ascontiguousarray(model.pose_directions[ids], np.float64)
        feels = np.zeros((len(ids), N_ROTATIONS), bool)
        feels[:, 1:] = self.pose_directions.reshape(len(ids), 3, 15, 9).any(axis=(1, 3))
        owner = self.weights.argmax(axis=1)
        self._segments = [np.flatnonzero(owner == joint) for joint in range(N_ROTATIONS)]
        self._skin = (self.weights, self.rest_joints_m, self.pose_directions, feels)

    def chain(self, pose: HandPose, slopes: bool = False) -> Chain:
        """The joints of every frame; axis and local only where derivatives will be asked for."""
        n_frames, turns = len(pose.wrist_m), rotvec_to_rotmat(pose.fingers)
        rotation, position = np.empty((n_frames, N_ROTATIONS, 3, 3)), np.empty((n_frames, N_ROTATIONS, 3))
        rotation[:, 0], position[:, 0] = pose.orient, pose.wrist_m
        place_joints(turns, self.rest_joints_m[1:] - self.rest_joints_m[list(PARENTS[1:])], rotation, position)
        bends = (turns - np.eye(3)).reshape(n_frames, 135)
        flat = self.pose_directions.reshape(-1, self.pose_directions.shape[-1])
        rested = self.shaped_m + (bends @ flat.T).reshape(n_frames, len(self.shaped_m), 3)
        axis, local = np.zeros((0, N_ROTATIONS, 3, 3)), np.zeros((0, 15, 9, 3))
        if slopes:
            left = left_jacobian(torch.from_numpy(pose.fingers)).numpy()
            axis = np.empty_like(rotation)
            axis[:, 0] = np.eye(3)
            axis[:, 1:] = rotation[:, list(PARENTS[1:])] @ left
            local = np.stack([_cross(left[..., c], turns) for c in range(3)], -1).reshape(n_frames, 15, 9, 3)
        return Chain(rotation, position, axis, local, rested)

    def vertices_m(self, chain: Chain) -> np.ndarray:
        """(frame, vertex, 3) world."""
        out = np.empty(chain.rested_m.shape)
        skin_vertices(self.weights, self.rest_joints_m, chain.rotation, chain.position_m, chain.rested_m, out)
        return out

    def nearest_of_segments(self, distance_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(frame, 16) of each joint's skin the vertex with the least of distances (frame, vertex), and its distance."""
        vertex = np.stack([own[distance_m[:, own].argmin(axis=1)] for own in self._segments], 1)
        return vertex, np.take_along_axis(distance_m, vertex, 1)

    def derivatives(self, chain: Chain, frame: np.ndarray, vertex: np.ndarray) -> np.ndarray:
        """(pair, 3, 51) of vertices (pair,), numbers among those of the skin, in frames (pair,)."""
        out = np.empty((len(frame), 3, N_UNKNOWNS))
        vertex_derivatives(frame, vertex, self._skin, tuple(chain), out)
        return out

    def all_derivatives(self, chain: Chain) -> np.ndarray:
        """(frame, vertex x 3, 51) of all of them."""
        frame, vertex = (index.ravel() for index in np.indices(chain.rested_m.shape[:2]))
        return self.derivatives(chain, frame, vertex).reshape(len(chain.rotation), -1, N_UNKNOWNS)


def _cross(axis: np.ndarray, rotmats: np.ndarray) -> np.ndarray:
    """(..., 3, 3) each column of the matrices turned about the axes (..., 3): derivative of a small turn."""
    return np.cross(axis[..., None, :], rotmats.swapaxes(-1, -2)).swapaxes(-1, -2)
