"""Motion as control points of uniform cubic B-splines: smooth by construction, and fewer numbers than frames.

Between two knots a curve is a cubic polynomial, twice continuously differentiable across knots (de Boor 1978); the
curve of n frames with m intervals has m + 3 control points. Control points sum to one at every frame, so they have
the unit and the mean of the values that they describe. ``whiten`` decorrelates those of an object's trajectory.
"""

from functools import lru_cache

import torch
from torch import Tensor

from hoidata.clips.features import OBJECT_FEATURES
from hoidata.devices import send

# Weight of the second differences: determines control points that few frames constrain, or none.
STIFFNESS = 1e-6
# Features of an object that has not moved: position, 6D of the identity, hinge.
UNMOVED = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
# Smoothness prior: fraction of the variance that is independent per control point, and the standard deviation. The
# deviation keeps trajectories of a few centimetres above the normaliser's SMALLEST_SCALE.
ROUGH, DEVIATION = 0.3, 0.5


def intervals_of(n_frames: int, knot_frames: int) -> int:
    """Number of spline intervals of a motion of ``n_frames`` with a knot about every ``knot_frames``."""
    return max(1, round((n_frames - 1) / knot_frames))


@lru_cache(maxsize=1024)
def spline_basis(n_frames: int, intervals: int) -> Tensor:
    """(n_frames, intervals + 3) float64 weights of the control points at each frame."""
    position = torch.linspace(0, intervals, n_frames, dtype=torch.float64)
    first = position.floor().clamp_max(intervals - 1)
    u = position - first
    # Uniform cubic B-spline: weights, times six, of the four control points of an interval.
    weights = (1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3
    columns = first.long()[:, None] + torch.arange(4)
    return torch.zeros(n_frames, intervals + 3, dtype=torch.float64).scatter_(1, columns, torch.stack(weights, 1) / 6)


def fit_spline(values: Tensor, present: Tensor, intervals: int) -> Tensor:
    """Control points (intervals + 3, D) of the curve nearest to ``values`` (F, D) in the frames of ``present`` (F,)."""
    basis = spline_basis(len(values), intervals)
    # Second differences: zero on a straight line.
    bend = torch.eye(basis.shape[1], dtype=torch.float64).diff(n=2, dim=0)
    weighted = basis * present.double()[:, None]
    # Without any frame only the stiffness is left, which is zero on straight lines; the last term fixes those.
    normal = weighted.T @ basis + STIFFNESS * bend.T @ bend + 1e-9 * torch.eye(basis.shape[1], dtype=torch.float64)
    return torch.linalg.solve(normal, weighted.T @ values.double()).to(values.dtype)


def spline_values(points: Tensor, bases: Tensor) -> Tensor:
    """Values (B, ..., F, D) of control points (B, ..., K, D); bases (B, F, K)."""
    return bases.reshape(len(bases), *[1] * (points.ndim - 3), *bases.shape[1:]) @ points


def stacked_bases(lengths: list[int], intervals: list[int], n_frames: int, device: torch.device) -> Tensor:
    """(B, n_frames, K) float32 bases of motions of different lengths; in the padding the last pose is repeated."""
    bases = torch.zeros(len(lengths), n_frames, max(intervals) + 3)
    for index, (length, count) in enumerate(zip(lengths, intervals, strict=True)):
        basis = spline_basis(length, count)
        bases[index, :length, : count + 3] = basis
        bases[index, length:, : count + 3] = basis[-1]
    return send(bases, device)


def projected(x: Tensor, lengths: list[int], knot_frames: int) -> Tensor:
    """(B, ..., F, D) replaced by the nearest splines with a knot every ``knot_frames``; padding becomes zero."""
    counts = [intervals_of(length, knot_frames) for length in lengths]
    projection = torch.zeros(len(x), x.shape[-2], x.shape[-2])
    for index, (length, count) in enumerate(zip(lengths, counts, strict=True)):
        projection[index, :length, :length] = _projection(length, count)
    return spline_values(x, send(projection, x.device))


@lru_cache(maxsize=1024)
def _projection(n_frames: int, intervals: int) -> Tensor:
    return spline_basis(n_frames, intervals) @ fit_spline(
        torch.eye(n_frames, dtype=torch.float64), torch.ones(n_frames), intervals
    )


def whiten(rows: Tensor, reach: float) -> Tensor:
    """Control points (..., L, 10 or 16) decorrelated by the smoothness prior; first-frame rotations are unchanged.

    reach: correlation length of the prior, in control points.
    """
    moved = rows[..., :OBJECT_FEATURES] - _as(UNMOVED, rows)
    # Multiplication by the inverse of the Cholesky factor decorrelates the control points.
    whitened = torch.linalg.solve_triangular(_as(smooth_root(rows.shape[-2], reach), rows), moved, upper=False)
    return torch.cat((whitened, rows[..., OBJECT_FEATURES:]), -1)


def unwhiten(rows: Tensor, reach: float) -> Tensor:
    """The inverse of :func:`whiten`."""
    moved = _as(smooth_root(rows.shape[-2], reach), rows) @ rows[..., :OBJECT_FEATURES]
    return torch.cat((moved + _as(UNMOVED, rows), rows[..., OBJECT_FEATURES:]), -1)


def _as(constant: Tensor, rows: Tensor) -> Tensor:
    """``constant`` with the device and dtype of ``rows``."""
    return send(constant, rows.device).to(rows.dtype)


@lru_cache(maxsize=256)
def smooth_root(rows: int, reach: float) -> Tensor:
    """Cholesky factor (rows, rows), lower triangular, of the smoothness prior's covariance.

    The factor of fewer rows is its upper left block, so padding in a batch does not change a motion.
    """
    position = torch.arange(rows, dtype=torch.float64)
    correlation = torch.exp(-0.5 * ((position[:, None] - position) / reach).square())
    covariance = (1 - ROUGH) * correlation + ROUGH * torch.eye(rows, dtype=torch.float64)
    return DEVIATION * torch.linalg.cholesky(covariance).float()
