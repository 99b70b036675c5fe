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
REST = 300.0


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


def settled(points: Tensor, there: Tensor, reach: Tensor, around: int, rounds: int = 8) -> Tensor:
    """Control points (..., K, D) drawn together where they stay in one place; those that move keep theirs.

    there (..., K) bool: the points there are. reach (D,): points that differ by less stay in one place, by twice that
    they move. around: how many points on either side of the gap between two say which. The difference of the two alone
    would not: a slow way would come out as steps, and a shake of some centimetres as rest in its middle.
    Least squares with Tukey's biweight (Beaton and Tukey 1974), found by reweighting.
    """
    places = torch.arange(points.shape[-2], device=points.device)
    diff = torch.eye(len(places), device=points.device).diff(dim=0)
    gaps = places[:-1, None] + 0.5
    beside = ((places - gaps).abs() < around).to(points) * there[..., None, :]
    beside = beside / beside.sum(-1, keepdim=True).clamp_min(1)
    both, found = there[..., 1:] & there[..., :-1], points
    for _ in range(rounds):
        spread = (beside @ found.square() - (beside @ found).square()).clamp_min(0)
        apart = (spread / (2 * reach).square()).sum(-1)
        weight = REST * both * (1 - apart).clamp_min(0).square()
        normal = torch.eye(len(places), device=points.device) + diff.T @ (weight[..., None] * diff)
        found = torch.linalg.solve(normal, points)
    return found


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
