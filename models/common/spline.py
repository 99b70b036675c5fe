"""Motion as control points of uniform cubic B-splines: smooth by construction, and fewer numbers than frames.

Between two knots a curve is a cubic polynomial, twice continuously differentiable across knots (de Boor 1978); the
curve of n frames with m intervals has m + 3 control points. Control points sum to one at every frame, so they have
the unit and the mean of the values that they describe.
"""

from functools import lru_cache

import torch
from torch import Tensor

from hoidata.devices import send

# Weight of the second differences: determines control points that few frames constrain, or none.
STIFFNESS = 1e-6
# Weight of differences between neighbours at rest, relative to the distance of each from its original position.
REST = 100.0


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


def snapped_to_rest(points: Tensor, mask: Tensor, reach: Tensor | float, around: int) -> Tensor:
    """Control points (..., K, D) with those at rest pulled together; moving ones keep their values.

    Weighted least squares with Tukey's biweight. The weights are not re-estimated from the result, which would create
    steps.

    Args:
        mask: (..., K) bool, valid control points.
        reach: (D,) or one number. Two sides of a gap that differ by twice this surely move.
        around: control points compared on each side of a gap. The two at the gap are not enough: a slow trajectory
            would become steps, and the turning point of a shake would count as rest.
    """
    index = torch.arange(points.shape[-2], device=points.device)
    offset = index - index[:-1, None] - 0.5  # of each control point from each gap
    sides = (offset < 0) & (offset > -around), (offset > 0) & (offset < around)
    before, after = (_mean_weights(side.to(points) * mask[..., None, :]) for side in sides)
    both = (before + after) / 2
    identity = torch.eye(len(index), device=points.device)
    # Centred, because squares of large numbers lose the digits in which they differ.
    centred = points - _mean_weights(mask.to(points)[..., None, :]) @ points
    moved = (after @ centred - before @ centred).square()
    spread = (both @ centred.square() - (both @ centred).square()).clamp_min(0)
    apart = ((moved + spread) / (2 * reach) ** 2).sum(-1)
    weight = REST * (mask[..., 1:] & mask[..., :-1]) * (1 - apart).clamp_min(0).square()
    diff = identity.diff(dim=0)
    return torch.linalg.solve(identity + diff.T @ (weight[..., None] * diff), points)


def _mean_weights(selection: Tensor) -> Tensor:
    """Rows (..., K) of zeros and ones, scaled so that a product with them gives the mean of the selected points."""
    return selection / selection.sum(-1, keepdim=True).clamp_min(1)


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
