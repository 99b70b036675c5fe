"""Skinned vertices of one hand of fixed shape, and their derivatives by the 51 unknowns of a pose."""

from typing import NamedTuple

import numpy as np
import torch

from hoidata.clips.clip import HandTrack
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.model import N_ROTATIONS, PARENTS, HandModel
from hoidata.hands.solver import left_jacobian
from hoidata.refinement.kernels import N_UNKNOWNS, place_joints, skin_vertices, vertex_derivatives


class HandPose(NamedTuple):
    """Hand poses; the frame of reference is the world unless said otherwise."""

    wrist_m: np.ndarray  # (frame, 3)
    orient: np.ndarray  # (frame, 3, 3) world-from-hand
    fingers: np.ndarray  # (frame, 15, 3) axis-angles, absolute

    @classmethod
    def of(cls, track: HandTrack) -> "HandPose":
        """The poses of all frames of a track."""
        wrist_m, global_orient, hand_pose = (
            np.asarray(array, np.float64) for array in (track.wrist_m, track.global_orient, track.hand_pose)
        )
        return cls(wrist_m, rotvec_to_rotmat(global_orient), hand_pose.reshape(-1, 15, 3))

    def moved(self, step: np.ndarray) -> "HandPose":
        """The pose after a step (frame, 51): wrist translation, hand rotation about the wrist, finger angles."""
        orient = rotvec_to_rotmat(step[:, 3:6]) @ self.orient
        return HandPose(self.wrist_m + step[:, :3], orient, self.fingers + step[:, 6:].reshape(-1, 15, 3))

    def taken(self, frames: np.ndarray) -> "HandPose":
        """The poses of the chosen frames."""
        return HandPose(*(array[frames] for array in self))

    def relative_to(self, a_from_world: RigidTransform) -> "HandPose":
        """The same hand in frame of reference a; ``a_from_world``: (frame,) transforms."""
        wrist = (a_from_world @ self.wrist_m[:, None])[:, 0]
        return HandPose(wrist, a_from_world.rotation @ self.orient, self.fingers)

    def where(self, chosen: np.ndarray, other: "HandPose") -> "HandPose":
        """In each frame this pose if ``chosen (frame,)``, else the other one."""
        mask = chosen[:, None]
        return HandPose(
            np.where(mask, self.wrist_m, other.wrist_m),
            np.where(mask[..., None], self.orient, other.orient),
            np.where(mask[..., None], self.fingers, other.fingers),
        )

    def track(self, betas: np.ndarray, valid: np.ndarray, template_m: np.ndarray | None) -> HandTrack:
        """The poses as a track; betas: (10,), valid: (frame,), template_m: (778, 3) or None."""
        return HandTrack(
            wrist_m=self.wrist_m.astype(np.float32),
            global_orient=rotmat_to_rotvec(self.orient).astype(np.float32),
            hand_pose=self.fingers.reshape(-1, 45).astype(np.float32),
            betas=np.asarray(betas, np.float32)[None],
            valid=valid,
            template_m=template_m,
        )


class Chain(NamedTuple):
    """Joint transforms of each frame, and what the derivatives of vertices need; world axes."""

    rotation: np.ndarray  # (frame, 16, 3, 3) world-from-joint
    position_m: np.ndarray  # (frame, 16, 3)
    axis: np.ndarray  # (frame, 16, 3, 3) world rotation axes of each joint's unknowns in columns; empty without slopes
    local: np.ndarray  # (frame, 15, 9, 3) derivative of the local rotations by the axis-angles; empty without slopes
    rest_m: np.ndarray  # (frame, vertex, 3) vertices at rest with pose correctives


class SkinnedHand:
    """Vertices of a hand model with a fixed shape.

    Args:
        betas: (10,) shape coefficients.
        template_m: (778, 3) personal rest mesh instead of the model's template.
        ids: (vertex,) which vertices, all by default.
    """

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
        has_corrective = np.zeros((len(ids), N_ROTATIONS), bool)
        has_corrective[:, 1:] = self.pose_directions.reshape(len(ids), 3, 15, 9).any(axis=(1, 3))
        segment = self.weights.argmax(axis=1)
        self._segments = [np.flatnonzero(segment == joint) for joint in range(N_ROTATIONS)]
        self._skin = (self.weights, self.rest_joints_m, self.pose_directions, has_corrective)

    def chain(self, pose: HandPose, slopes: bool = False) -> Chain:
        """Joint transforms of every frame. slopes: include what ``derivatives`` needs."""
        n_frames, local_rotmats = len(pose.wrist_m), rotvec_to_rotmat(pose.fingers)
        rotation, position = np.empty((n_frames, N_ROTATIONS, 3, 3)), np.empty((n_frames, N_ROTATIONS, 3))
        rotation[:, 0], position[:, 0] = pose.orient, pose.wrist_m
        bones = self.rest_joints_m[1:] - self.rest_joints_m[list(PARENTS[1:])]
        place_joints(local_rotmats, bones, rotation, position)
        features = (local_rotmats - np.eye(3)).reshape(n_frames, 135)
        directions = self.pose_directions.reshape(-1, self.pose_directions.shape[-1])
        rest_m = self.shaped_m + (features @ directions.T).reshape(n_frames, len(self.shaped_m), 3)
        axis, local = np.zeros((0, N_ROTATIONS, 3, 3)), np.zeros((0, 15, 9, 3))
        if slopes:
            # A change of an axis-angle rotates the joint about the columns of the left Jacobian, in its parent's axes.
            left = left_jacobian(torch.from_numpy(pose.fingers)).numpy()
            axis = np.empty_like(rotation)
            axis[:, 0] = np.eye(3)
            axis[:, 1:] = rotation[:, list(PARENTS[1:])] @ left
            columns = [_cross(left[..., c], local_rotmats) for c in range(3)]
            local = np.stack(columns, -1).reshape(n_frames, 15, 9, 3)
        return Chain(rotation, position, axis=axis, local=local, rest_m=rest_m)

    def vertices_m(self, chain: Chain) -> np.ndarray:
        """(frame, vertex, 3) vertex positions, world."""
        out = np.empty(chain.rest_m.shape)
        skin_vertices(self.weights, self.rest_joints_m, chain.rotation, chain.position_m, chain.rest_m, out)
        return out

    def nearest_of_segments(self, distance_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """In each joint's skin the vertex with the smallest of the distances (frame, vertex).

        Returns its index (frame, 16) and its distance (frame, 16).
        """
        vertex = np.stack([ids[distance_m[:, ids].argmin(axis=1)] for ids in self._segments], 1)
        return vertex, np.take_along_axis(distance_m, vertex, 1)

    def derivatives(self, chain: Chain, frame: np.ndarray, vertex: np.ndarray) -> np.ndarray:
        """(pair, 3, 51) derivatives of the positions of ``vertex (pair,)`` in ``frame (pair,)`` by the unknowns.

        vertex: indices among the vertices of this object.
        """
        out = np.empty((len(frame), 3, N_UNKNOWNS))
        vertex_derivatives(frame, vertex, self._skin, tuple(chain), out)
        return out

    def all_derivatives(self, chain: Chain) -> np.ndarray:
        """(frame, vertex x 3, 51) derivatives of all vertices."""
        frame, vertex = (index.ravel() for index in np.indices(chain.rest_m.shape[:2]))
        return self.derivatives(chain, frame, vertex).reshape(len(chain.rotation), -1, N_UNKNOWNS)


def _cross(axis: np.ndarray, rotmats: np.ndarray) -> np.ndarray:
    """(..., 3, 3) cross product of the axes (..., 3) with each column: derivative of a small rotation."""
    return np.cross(axis[..., None, :], rotmats.swapaxes(-1, -2)).swapaxes(-1, -2)
