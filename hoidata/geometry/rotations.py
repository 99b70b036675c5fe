"""Conversions between rotation representations, as pure functions.

Functions of type ``Array`` take NumPy arrays or torch tensors and return the same type. Rotation matrices act on column
vectors, ``x_world = R @ x_local``. Axis-angles ("rotvec") are in radians. The last axes are the rotation. In torch,
they are differentiable, also at zero rotation.
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
    # A Taylor series below 1e-6 rad keeps the gradient finite, where that of the angle is not defined.
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
    """The same rotations as axis-angles (..., 3) of at most pi; vectors of at most pi keep their bits."""
    is_large = np.linalg.norm(np.asarray(rotvec, dtype=np.float64), axis=-1) > np.pi
    if not is_large.any():
        return rotvec
    canonical = rotvec.copy()
    canonical[is_large] = rotmat_to_rotvec(rotvec_to_rotmat(np.asarray(rotvec[is_large], dtype=np.float64)))
    return canonical


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

    The input may be any network output whose two columns are not parallel.
    """
    if isinstance(rot6d, np.ndarray):
        return rot6d_to_rotmat(torch.from_numpy(np.ascontiguousarray(rot6d))).numpy()
    columns = rot6d.reshape(*rot6d.shape[:-1], 3, 2)
    first = torch.nn.functional.normalize(columns[..., 0], dim=-1)
    second = columns[..., 1] - (first * columns[..., 1]).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second, dim=-1)), -1)


def rotation_angles_about(rotmat: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(frame - 1,) angles in radians about a unit axis (3,) between successive rotations (frame, 3, 3)."""
    return rotmat_to_rotvec(rotmat[1:] @ rotmat[:-1].swapaxes(1, 2)) @ axis


def mirror_rotvec_x(rotvec: Array) -> Array:
    """Mirror axis-angles ``(..., 3)`` at the plane with normal x: ``diag(-1,1,1) R diag(-1,1,1)``."""
    if isinstance(rotvec, torch.Tensor):
        return rotvec * rotvec.new_tensor((1.0, -1.0, -1.0))
    return rotvec * np.asarray((1.0, -1.0, -1.0), dtype=rotvec.dtype)
