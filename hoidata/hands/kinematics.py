"""Forward kinematics of a MANO-layout hand: linear blend skinning with shape and pose blend shapes, in torch.

``track_joints`` and ``track_vertices`` give the joints and vertices of a recorded hand track as NumPy arrays.

World convention of hoidata: joint 0 is at ``wrist_m``, and the hand rotates about it. MANO's translation is related by
``wrist_m = transl + J0(betas)``. Model: Romero et al. 2017. Skinning: Loper et al. 2015, Eq. 2-9.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands.model import N_JOINTS, N_ROTATIONS, N_SHAPE, PARENTS, TIP_VERTICES, HandModel

_CHUNK_FRAMES = 512
_LEVELS = ((1, 4, 7, 10, 13), (2, 5, 8, 11, 14), (3, 6, 9, 12, 15))


def product(left: Tensor, right: Tensor) -> Tensor:
    """Matrix product. On the CPU without gradients NumPy computes it: its bits do not depend on the processor.

    torch's library (MKL) chooses kernels by processor; NumPy's are fixed (``hoidata.processor``).
    """
    if left.device.type != "cpu" or torch.is_grad_enabled():
        return left @ right
    rows, columns = left.detach().numpy(), right.detach().numpy()
    if columns.ndim == 2:  # one product is faster than one per item of the batch
        flat = rows.reshape(-1, rows.shape[-1]) @ columns
        return torch.from_numpy(flat.reshape(*rows.shape[:-1], columns.shape[1]))
    return torch.from_numpy(rows @ columns)


class HandKinematics(nn.Module):
    """Batched joints and vertices of one side, metres in the world frame, differentiable in all inputs."""

    template_m: Tensor
    joint_regressor: Tensor
    rest_joints_m: Tensor
    joint_directions: Tensor
    # Indices are buffers on the device of the data. A list would be copied to the device at each call.
    parents: Tensor
    levels: Tensor
    tip_vertices: Tensor

    def __init__(self, model: HandModel, dtype: torch.dtype = torch.float32) -> None:
        """dtype: torch.float32 or torch.float64, of the buffers and of all inputs."""
        super().__init__()
        arrays = {name: getattr(model, name) for name in ("template_m", "joint_regressor", "joint_directions")}
        arrays["rest_joints_m"] = model.joint_regressor @ model.template_m
        for name, value in arrays.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=dtype).contiguous(), persistent=False)
        for name, indices in (("parents", PARENTS[1:]), ("levels", _LEVELS), ("tip_vertices", TIP_VERTICES)):
            self.register_buffer(name, torch.tensor(indices), persistent=False)
        self.mesh = _Skin(model, range(len(model.template_m)), dtype)
        self.tips = _Skin(model, TIP_VERTICES, dtype)

    def joints(self, wrist_m: Tensor, rotmats: Tensor, betas: Tensor, template_m: Tensor | None = None) -> Tensor:
        """Joints without skinning the whole mesh.

        Args:
            wrist_m: (batch, 3) world position of joint 0.
            rotmats: (batch, 16, 3, 3) local rotations: world-from-hand, then relative to the parent joint. Identities
                give the flat hand.
            betas: (batch or 1, 10) shape coefficients.
            template_m: (778, 3) or (batch, 778, 3) personal rest mesh.

        Returns (batch, 21, 3) joints, world.
        """
        rotations, positions, rest = self._chain(wrist_m, rotmats, betas, template_m)
        tips = self.tips(rotmats, betas, rotations, positions, rest, template_m)
        return torch.cat((positions, tips), 1)

    def forward(
        self, wrist_m: Tensor, rotmats: Tensor, betas: Tensor, template_m: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Vertices (batch, 778, 3) and joints (batch, 21, 3); arguments as in ``joints``."""
        rotations, positions, rest = self._chain(wrist_m, rotmats, betas, template_m)
        vertices = self.mesh(rotmats, betas, rotations, positions, rest, template_m)
        return vertices, torch.cat((positions, vertices[:, self.tip_vertices]), 1)

    def _chain(
        self, wrist_m: Tensor, rotmats: Tensor, betas: Tensor, template_m: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """World rotations (batch, 16, 3, 3) and positions (batch, 16, 3) of the joints, and the rest joints."""
        base = self.rest_joints_m if template_m is None else product(self.joint_regressor, template_m)
        rest = base + product(betas, self.joint_directions).reshape(-1, N_ROTATIONS, 3)
        bones = (rest[:, 1:] - rest[:, self.parents]).expand(len(wrist_m), -1, -1)
        rotations, positions = [rotmats[:, :1].expand(-1, 5, -1, -1)], [wrist_m[:, None].expand(-1, 5, -1)]
        for level in self.levels:
            bone = bones[:, level - 1, :, None]
            positions.append(positions[-1] + (rotations[-1] @ bone)[..., 0])
            rotations.append(rotations[-1] @ rotmats[:, level])
        fingers_rotation = torch.stack(rotations[1:], 2).flatten(1, 2)
        fingers_position = torch.stack(positions[1:], 2).flatten(1, 2)
        return (
            torch.cat((rotmats[:, :1], fingers_rotation), 1),
            torch.cat((wrist_m[:, None], fingers_position), 1),
            rest,
        )


class _Skin(nn.Module):
    """Blend shapes and skinning of some vertices, coordinate-major so that each sum is one matrix product."""

    template: Tensor
    weights: Tensor
    shape: Tensor
    pose: Tensor
    vertex_ids: Tensor

    def __init__(self, model: HandModel, vertices: Sequence[int], dtype: torch.dtype) -> None:
        super().__init__()
        self.vertices = list(vertices)
        self.register_buffer("vertex_ids", torch.tensor(self.vertices), persistent=False)
        self.is_whole = len(self.vertices) == len(model.template_m)
        shape = model.shape_directions[self.vertices].transpose(2, 1, 0).reshape(N_SHAPE, -1)
        pose = model.pose_directions[self.vertices].transpose(2, 1, 0).reshape(model.pose_directions.shape[2], -1)
        arrays = {"template": model.template_m[self.vertices].T, "weights": model.skin_weights[self.vertices].T}
        for name, value in {**arrays, "shape": shape, "pose": pose}.items():
            self.register_buffer(name, torch.tensor(value, dtype=dtype).contiguous(), persistent=False)

    def forward(
        self,
        rotmats: Tensor,
        betas: Tensor,
        rotations: Tensor,
        positions: Tensor,
        rest: Tensor,
        template_m: Tensor | None,
    ) -> Tensor:
        """World positions (batch, vertex, 3)."""
        n_batch = len(rotmats)
        moves = torch.cat((rotations, (positions[..., None] - rotations @ rest[..., None])), -1)
        blended = product(moves.reshape(n_batch, N_ROTATIONS, 12).transpose(1, 2), self.weights)
        x, y, z, shift = blended.reshape(n_batch, 3, 4, -1).unbind(2)
        rest_vertices = self._rest_vertices(rotmats, betas, template_m)
        posed = x * rest_vertices[:, :1] + y * rest_vertices[:, 1:2] + z * rest_vertices[:, 2:] + shift
        return posed.transpose(1, 2).contiguous()

    def _rest_vertices(self, rotmats: Tensor, betas: Tensor, template_m: Tensor | None) -> Tensor:
        """(batch, 3, vertex) rest positions with shape and pose blend shapes."""
        identity = torch.eye(3, dtype=rotmats.dtype, device=rotmats.device)
        features = (rotmats[:, 1:] - identity).reshape(len(rotmats), -1)
        shaped = product(betas, self.shape).reshape(-1, 3, len(self.vertices)) + self._template(template_m)
        return product(features, self.pose).reshape(len(rotmats), 3, -1) + shaped

    def _template(self, template_m: Tensor | None) -> Tensor:
        if template_m is None:
            return self.template
        return (template_m if self.is_whole else template_m[..., self.vertex_ids, :]).transpose(-1, -2)


class HandTrackLike(Protocol):
    """Protocol of ``hoidata.clips.HandTrack``; units and shapes are documented there."""

    @property
    def wrist_m(self) -> np.ndarray: ...
    @property
    def global_orient(self) -> np.ndarray: ...
    @property
    def hand_pose(self) -> np.ndarray: ...
    @property
    def betas(self) -> np.ndarray: ...
    @property
    def valid(self) -> np.ndarray: ...
    @property
    def template_m(self) -> np.ndarray | None: ...


def track_joints(track: HandTrackLike, model: HandModel) -> np.ndarray:
    """(frame, 21, 3) float32 world joints of all frames, valid or not."""
    return _in_chunks(track, model, N_JOINTS, lambda layer, inputs: layer.joints(*inputs))


def track_vertices(track: HandTrackLike, model: HandModel) -> np.ndarray:
    """(frame, 778, 3) float32 world vertices of all frames, valid or not."""
    return _in_chunks(track, model, len(model.template_m), lambda layer, inputs: layer(*inputs)[0])


@lru_cache(maxsize=8)
def kinematics_of(model: HandModel, dtype: torch.dtype = torch.float32) -> HandKinematics:
    """The cached HandKinematics of a model on the CPU, one per model object and dtype."""
    return HandKinematics(model, dtype)


def track_rotmats(track: HandTrackLike) -> np.ndarray:
    """(frame, 16, 3, 3) local rotations of a track, the global orientation first."""
    rotvec = np.concatenate((track.global_orient, track.hand_pose), axis=1, dtype=np.float64)
    return rotvec_to_rotmat(rotvec.reshape(len(rotvec), N_ROTATIONS, 3))


def _in_chunks(track: HandTrackLike, model: HandModel, n_points: int, run) -> np.ndarray:
    # float64 inside: a world position metres from the origin keeps its last micrometre.
    layer = kinematics_of(model, torch.float64)
    wrist, rotmats, betas = (
        torch.as_tensor(np.asarray(array, dtype=np.float64))
        for array in (track.wrist_m, track_rotmats(track), track.betas)
    )
    template = None if track.template_m is None else torch.as_tensor(np.asarray(track.template_m, dtype=np.float64))
    out = np.empty((len(wrist), n_points, 3), dtype=np.float32)
    with torch.no_grad():
        for start in range(0, len(wrist), _CHUNK_FRAMES):
            frames = slice(start, start + _CHUNK_FRAMES)
            chunk_betas = betas if len(betas) == 1 else betas[frames]
            out[frames] = run(layer, (wrist[frames], rotmats[frames], chunk_betas, template)).numpy()
    return out
