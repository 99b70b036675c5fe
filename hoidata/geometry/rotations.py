"""Conversions between rotation representations, as pure functions.

Every function takes NumPy arrays or torch tensors and gives back the same kind. Rotation matrices act on
column vectors, ``x_world = R @ x_local``; axis-angles ("rotvec") are in radians; the last axes hold the rotation.
Differentiable in torch, including at zero rotation.
"""

from typing import TypeVar

import numpy as np
import torch

Array = TypeVar("Array", np.ndarray, torch.Tensor)


def rotvec_to_rotmat(rotvec: Array) -> Array:
    """Axis-angle ``(..., 3)`` in radians to rotation matrices ``(..., 3, 3)`` (Rodrigues' formula)."""
    if isinstance(rotvec, torch.Tensor):
        return _rotvec_to_rotmat_torch(rotvec)
    from scipy.spatial.transform import Rotation

    flat = np.asarray(rotvec, dtype=np.float64).reshape(-1, 3)
    matrices = Rotation.from_rotvec(flat).as_matrix() if len(flat) else np.zeros((0, 3, 3))
    return matrices.reshape(*rotvec.shape[:-1], 3, 3).astype(np.result_type(rotvec.dtype, np.float32), copy=False)


def _rotvec_to_rotmat_torch(rotvec: torch.Tensor) -> torch.Tensor:
    square = (rotvec * rotvec).sum(-1, keepdim=True)
    small = square < 1e-12
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    # Taylor series below 1e-6 rad keeps the gradient finite where angle has none.
    sine = torch.where(small, 1 - square / 6, torch.sin(angle) / angle)[..., None]
    versine = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / safe)[..., None]
    cross = skew(rotvec)
    identity = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return identity + sine * cross + versine * (cross @ cross)


def skew(vector: torch.Tensor) -> torch.Tensor:
    """Cross-product matrices ``(..., 3, 3)`` of vectors ``(..., 3)``."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*vector.shape[:-1], 3, 3)


def rotmat_to_rotvec(rotmat: Array) -> Array:
    """Rotation matrices ``(..., 3, 3)`` to axis-angle ``(..., 3)`` with angle in [0, pi]. Not differentiable."""
    from scipy.spatial.transform import Rotation

    source = rotmat.detach().cpu().numpy() if isinstance(rotmat, torch.Tensor) else np.asarray(rotmat)
    flat = source.astype(np.float64).reshape(-1, 3, 3)
    vectors = Rotation.from_matrix(flat).as_rotvec() if len(flat) else np.zeros((0, 3))
    vectors = vectors.reshape(*source.shape[:-2], 3)
    if isinstance(rotmat, torch.Tensor):
        return torch.as_tensor(vectors, dtype=rotmat.dtype, device=rotmat.device)
    return vectors.astype(np.result_type(source.dtype, np.float32), copy=False)


def canonical_rotvec(rotvec: np.ndarray) -> np.ndarray:
    """The same rotations as axis-angles (..., 3) of at most pi; vectors that are no longer than pi stay bit for bit."""
    beyond = np.linalg.norm(np.asarray(rotvec, dtype=np.float64), axis=-1) > np.pi
    if not beyond.any():
        return rotvec
    canonical = rotvec.copy()
    canonical[beyond] = rotmat_to_rotvec(rotvec_to_rotmat(np.asarray(rotvec[beyond], dtype=np.float64)))
    return canonical


def nearest_rotvec(rotvec: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Axis-angles (..., 3) of the same rotations as ``rotvec``, less or more one full turn if nearer to ``reference``.

    Differences of axis-angles mean something only between such numbers: 179 and -179 degrees are 2 degrees apart.
    """
    angle = np.linalg.norm(rotvec, axis=-1, keepdims=True)
    turn = 2 * np.pi * np.divide(rotvec, angle, out=np.zeros_like(rotvec), where=angle > 0)
    each = np.stack([rotvec, rotvec - turn, rotvec + turn])
    nearest = np.linalg.norm(each - reference, axis=-1).argmin(axis=0)
    return np.take_along_axis(each, nearest[None, ..., None], axis=0)[0]


def rotation_angle(rotmat: np.ndarray) -> np.ndarray:
    """Angle of rotation matrices (..., 3, 3), radians in [0, pi]."""
    return np.arccos(np.clip((np.trace(rotmat, axis1=-2, axis2=-1) - 1) / 2, -1, 1))


def rotmat_to_rot6d(rotmat: Array) -> Array:
    """Rotation matrices ``(..., 3, 3)`` to the 6D form ``(..., 6)`` of Zhou et al. 2019.

    Order as in Text2HOI: the first two columns, row by row: ``[R00, R01, R10, R11, R20, R21]``.
    """
    return rotmat[..., :, :2].reshape(*rotmat.shape[:-2], 6)


def rot6d_to_rotmat(rot6d: Array) -> Array:
    """6D form ``(..., 6)`` to rotation matrices ``(..., 3, 3)`` by Gram-Schmidt (Zhou et al. 2019, eq. 15).

    Takes any numbers, also network output, as long as the two columns are not parallel.
    """
    if isinstance(rot6d, np.ndarray):
        return rot6d_to_rotmat(torch.from_numpy(np.ascontiguousarray(rot6d))).numpy()
    columns = rot6d.reshape(*rot6d.shape[:-1], 3, 2)
    first = torch.nn.functional.normalize(columns[..., 0], dim=-1)
    second = columns[..., 1] - (first * columns[..., 1]).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second, dim=-1)), -1)


def turns_about(rotmat: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(frame - 1,) radians by which rotations (frame, 3, 3) turn about a unit axis (3,) from each frame to the next."""
    return rotmat_to_rotvec(rotmat[1:] @ rotmat[:-1].swapaxes(1, 2)) @ axis


def mirror_rotvec_x(rotvec: Array) -> Array:
    """The axis-angle ``(..., 3)`` seen in a mirror with normal x: ``diag(-1,1,1) R diag(-1,1,1)``."""
    if isinstance(rotvec, torch.Tensor):
        return rotvec * rotvec.new_tensor((1.0, -1.0, -1.0))
    return rotvec * np.asarray((1.0, -1.0, -1.0), dtype=rotvec.dtype)
