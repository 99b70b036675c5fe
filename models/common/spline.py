"""Motion as control points of uniform cubic B-splines: smooth by construction, and fewer numbers than frames.

Between two knots a curve is a cubic polynomial, twice continuously differentiable across knots (de Boor 1978); the
curve of n frames with m intervals has m + 3 control points. Control points sum to one at every frame, so they have
the unit and the mean of what they stand for.
"""

from functools import lru_cache

import torch
from torch import Tensor

from hoidata.devices import send

# Keeps control points determined where few frames, or none, say what they are.
STIFFNESS = 1e-6
# How much more neighbours at rest are held together than each is held to its own place.
REST = 100.0


def intervals_of(n_frames: int, knot_frames: int) -> int:
    """Between-knot intervals of a motion of ``n_frames`` with a knot about every ``knot_frames``."""
    return max(1, round((n_frames - 1) / knot_frames))


@lru_cache(maxsize=1024)
def spline_basis(n_frames: int, intervals: int) -> Tensor:
    """(n_frames, intervals + 3) float64 weights of the control points at each frame."""
    place = torch.linspace(0, intervals, n_frames, dtype=torch.float64)
    first = place.floor().clamp_max(intervals - 1)
    u = place - first
    weights = (1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3
    columns = first.long()[:, None] + torch.arange(4)
    return torch.zeros(n_frames, intervals + 3, dtype=torch.float64).scatter_(1, columns, torch.stack(weights, 1) / 6)


def fit_spline(values: Tensor, present: Tensor, intervals: int) -> Tensor:
    """Control points (intervals + 3, D) of the curve nearest to ``values`` (F, D) in the frames of ``present`` (F,)."""
    basis = spline_basis(len(values), intervals)
    bend = torch.eye(basis.shape[1], dtype=torch.float64).diff(n=2, dim=0)
    weighted = basis * present.double()[:, None]
    # Without any frame at all only the stiffness is left, which no straight line feels.
    normal = weighted.T @ basis + STIFFNESS * bend.T @ bend + 1e-9 * torch.eye(basis.shape[1], dtype=torch.float64)
    return torch.linalg.solve(normal, weighted.T @ values.double()).to(values.dtype)


def spline_values(points: Tensor, bases: Tensor) -> Tensor:
    """Values (B, ..., F, D) of control points (B, ..., K, D); bases (B, F, K)."""
    return bases.reshape(len(bases), *[1] * (points.ndim - 3), *bases.shape[1:]) @ points


def stacked_bases(lengths: list[int], intervals: list[int], n_frames: int, device: torch.device) -> Tensor:
    """(B, n_frames, K) float32 bases of motions of different lengths; in the padding a motion keeps its last pose."""
    bases = torch.zeros(len(lengths), n_frames, max(intervals) + 3)
    for row, (length, count) in enumerate(zip(lengths, intervals, strict=True)):
        own = spline_basis(length, count)
        bases[row, :length, : count + 3] = own
        bases[row, length:, : count + 3] = own[-1]
    return send(bases, device)


def settled(points: Tensor, there: Tensor, reach: Tensor | float, around: int) -> Tensor:
    """Control points (..., K, D) drawn together where they stay in one place; those that move keep theirs.

    there (..., K) bool: the points there are. reach (D,) or for all: half of how far points lie apart that surely move:
    those on one side of a gap from those on its other side, in the mean, and each from the mean of both. around: how
    many points a side has. The two at the gap alone would not tell: a slow way would come out as steps, and a shake of
    some centimetres as rest in its middle. Weighted least squares, once: weights (Tukey's biweight) found again from
    what came out would make steps, too.
    """
    places = torch.arange(points.shape[-2], device=points.device)
    way = places - places[:-1, None] - 0.5
    sides = (way < 0) & (way > -around), (way > 0) & (way < around)
    before, after = (_means(side.to(points) * there[..., None, :]) for side in sides)
    both = (before + after) / 2
    own = torch.eye(len(places), device=points.device)
    centred = points - _means(there.to(points)[..., None, :]) @ points  # squares of large numbers would not differ
    moved = (after @ centred - before @ centred).square()
    spread = (both @ centred.square() - (both @ centred).square()).clamp_min(0)
    apart = ((moved + spread) / (2 * reach) ** 2).sum(-1)
    weight = REST * (there[..., 1:] & there[..., :-1]) * (1 - apart).clamp_min(0).square()
    diff = own.diff(dim=0)
    return torch.linalg.solve(own + diff.T @ (weight[..., None] * diff), points)


def _means(shares: Tensor) -> Tensor:
    """Rows (..., K) of ones and zeros that give the mean of the points they name; none of nothing."""
    return shares / shares.sum(-1, keepdim=True).clamp_min(1)


def projected(x: Tensor, lengths: list[int], knot_frames: int) -> Tensor:
    """(B, ..., F, D) replaced by the nearest splines with a knot every ``knot_frames``; padding becomes zero."""
    counts = [intervals_of(length, knot_frames) for length in lengths]
    onto = torch.zeros(len(x), x.shape[-2], x.shape[-2])
    for row, (length, count) in enumerate(zip(lengths, counts, strict=True)):
        onto[row, :length, :length] = _projection(length, count)
    return spline_values(x, send(onto, x.device))


@lru_cache(maxsize=1024)
def _projection(n_frames: int, intervals: int) -> Tensor:
    return spline_basis(n_frames, intervals) @ fit_spline(
        torch.eye(n_frames, dtype=torch.float64), torch.ones(n_frames), intervals
    )
