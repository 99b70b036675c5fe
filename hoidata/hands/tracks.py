"""Joints and vertices of a recorded hand track, as NumPy arrays in the world frame."""

from functools import lru_cache
from typing import Protocol

import numpy as np
import torch

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands.kinematics import HandKinematics
from hoidata.hands.model import N_JOINTS, N_ROTATIONS, HandModel

_CHUNK_FRAMES = 512


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
