"""Rows of an object that make verbs alike: how it has turned since the first frame, and what is new in each row.

A turn of the object in the world, ``R(t) R(0)^T``, is the same whatever its mesh calls front or up; ``R(0)`` stands
beside it. And rows of a path are nearly the same as those before: a shake of 3 cm hardly counts beside a lift of 20.
Whitened rows, each what the smooth course of those before does not say, give slow and quick movement the same weight,
and what a network gets wrong in them comes out smooth.
"""

from functools import lru_cache

import torch
from torch import Tensor

from hoidata.clips.features import OBJECT_FEATURES, OBJECT_HINGE, OBJECT_POSITION
from hoidata.devices import send
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d
from models.common.features import OBJECT_START_6D, object_rotmat

# An object that has not moved: position, 6D of no turn, hinge.
UNMOVED = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
# Share of a row's variance that no neighbour tells; and the deviation of a row, which keeps those of a path of some
# centimetres above the smallest spread a normaliser knows.
ROUGH, DEVIATION = 0.3, 0.5


def turned_since_start(thing: Tensor) -> Tensor:
    """Object features (F, 10) as rows (F, 16): turned since the first frame, and how it lay in that."""
    rotation = object_rotmat(thing)
    turn, start = (rotmat_to_rot6d(own) for own in (rotation @ rotation[0].T, rotation[:1].expand_as(rotation)))
    return torch.cat((thing[:, OBJECT_POSITION], turn, thing[:, OBJECT_HINGE:], start), -1)


def mean_start(rows: Tensor, there: Tensor) -> Tensor:
    """(B, 1, 3, 3) rotations of the first frame: the mean of what the rows (B, L, 16) of ``there`` (B, L) say."""
    said = (rows[..., OBJECT_START_6D] * there[..., None]).sum(1, keepdim=True)
    return rot6d_to_rotmat(said / there.sum(1)[:, None, None])


def turned_from(rows: Tensor, start: Tensor) -> Tensor:
    """Object features (B, F, 10) of rows (B, F, 16) and first rotations (B, 1, 3, 3)."""
    rotation = rotmat_to_rot6d(object_rotmat(rows) @ start)
    return torch.cat((rows[..., OBJECT_POSITION], rotation, rows[..., OBJECT_HINGE:OBJECT_FEATURES]), -1)


def whiten(rows: Tensor, reach: float) -> Tensor:
    """Rows (..., L, 10 or 16) as what is new in each. reach: rows over which a path is alike."""
    moved = rows[..., :OBJECT_FEATURES] - _as(UNMOVED, rows)
    new = torch.linalg.solve_triangular(_as(smooth_root(rows.shape[-2], reach), rows), moved, upper=False)
    return torch.cat((new, rows[..., OBJECT_FEATURES:]), -1)


def unwhiten(rows: Tensor, reach: float) -> Tensor:
    """The inverse of :func:`whiten`."""
    moved = _as(smooth_root(rows.shape[-2], reach), rows) @ rows[..., :OBJECT_FEATURES]
    return torch.cat((moved + _as(UNMOVED, rows), rows[..., OBJECT_FEATURES:]), -1)


def _as(known: Tensor, rows: Tensor) -> Tensor:
    """What is known beforehand, of the device and kind of ``rows``."""
    return send(known, rows.device).to(rows.dtype)


@lru_cache(maxsize=256)
def smooth_root(rows: int, reach: float) -> Tensor:
    """(rows, rows) lower triangular, the Cholesky factor of the covariance of smooth rows.

    Of fewer rows it is the upper left part: a motion's rows do not depend on how long others of its batch are.
    """
    place = torch.arange(rows, dtype=torch.float64)
    alike = torch.exp(-0.5 * ((place[:, None] - place) / reach).square())
    covariance = (1 - ROUGH) * alike + ROUGH * torch.eye(rows, dtype=torch.float64)
    return DEVIATION * torch.linalg.cholesky(covariance).float()
