"""Levenberg-Marquardt for motions whose normal equations are block-banded in time; linear time in the frames."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from scipy.linalg import solveh_banded

# Weights of the frames t, t - 1 and t - 2 in the second difference at frame t.
_DIFFERENCE = (1.0, -2.0, 1.0)
_TINY = 1e-6  # keeps a frame without any residual unchanged
_MAX_DAMPING = 1e4

State = TypeVar("State")


def minimize_banded(
    start: State,
    cost: Callable[[State], float],
    equations: Callable[[State], tuple[list[np.ndarray], np.ndarray]],
    stepped: Callable[[State, np.ndarray], State],
    max_steps: int,
    min_gain: float,
) -> State:
    """Minimise a least-squares cost by Levenberg-Marquardt with one damping for all frames.

    Args:
        equations: blocks and vector of the normal equations at a state, as ``solve_damped`` takes them.
        stepped: the state after a step (frame or control point, unknown).
        max_steps: largest number of accepted steps.
        min_gain: stop when a step reduces the cost by less than this fraction.
    """
    state, damping = start, 1e-3
    state_cost = cost(state)
    for _ in range(max_steps):
        blocks, vector = equations(state)
        while True:
            trial = stepped(state, solve_damped(blocks, vector, damping))
            trial_cost = cost(trial)
            if trial_cost < state_cost or damping > _MAX_DAMPING:
                break
            damping *= 10
        if not trial_cost < state_cost:  # true for NaN, too
            break
        gain, state, state_cost, damping = 1 - trial_cost / state_cost, trial, trial_cost, damping / 10
        if gain < min_gain:
            break
    return state


def second_differences(values: np.ndarray) -> np.ndarray:
    """(frame, ...) ``x[t] - 2 x[t - 1] + x[t - 2]``, zero in the first two frames."""
    out = np.zeros_like(values)
    out[2:] = values[2:] - 2 * values[1:-1] + values[:-2]
    return out


def acceleration_equations(
    derivative: np.ndarray, difference: np.ndarray, weight: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Normal equations of the weighted squared second differences of some values.

    Args:
        derivative: (frame, value, n) derivative of the values by the n unknowns of their frame.
        difference: (frame, value) second differences, as from ``second_differences``.
        weight: (frame,) weight of each second difference, zero in the first two frames.

    Returns blocks [(frame, n, n), (frame - 1, n, n), (frame - 2, n, n)], block b of frame t at rows of frame t + b and
    columns of frame t; and minus half the gradient (frame, n).
    """
    n_frames, padded = len(weight), np.concatenate((weight, np.zeros(2)))
    transposed = derivative.swapaxes(1, 2)
    blocks = []
    for offset in range(min(3, n_frames)):
        factor = sum(
            _DIFFERENCE[k] * _DIFFERENCE[k + offset] * padded[k + offset : k + offset + n_frames]
            for k in range(3 - offset)
        )
        count = n_frames - offset
        blocks.append((transposed[offset:] * np.asarray(factor)[:count, None, None]) @ derivative[:count])
    weighted = np.concatenate((weight[:, None] * difference, np.zeros((2, difference.shape[1]))))
    gradient = sum(_DIFFERENCE[k] * weighted[k : k + n_frames] for k in range(3))
    return blocks, -(transposed @ np.asarray(gradient)[..., None])[..., 0]


def solve_blocks(blocks: list[np.ndarray], vector: np.ndarray) -> np.ndarray:
    """(frame, n) solution of the symmetric positive system with these blocks below its diagonal (banded Cholesky)."""
    n_frames, n = vector.shape
    band = np.zeros((len(blocks) * n, n_frames, n))
    rows, columns = (index.ravel() for index in np.indices((n, n)))
    for offset, block in enumerate(blocks):
        lower = rows >= columns if offset == 0 else slice(None)
        r, c = rows[lower], columns[lower]
        band[offset * n + r - c, : len(block), c] = block[:, r, c].T
    solution = solveh_banded(band.reshape(len(band), -1), vector.ravel(), lower=True, check_finite=False)
    return solution.reshape(n_frames, n)


def solve_damped(blocks: list[np.ndarray], vector: np.ndarray, damping: float) -> np.ndarray:
    """``solve_blocks`` with the diagonal enlarged by the fraction ``damping`` (Marquardt 1963)."""
    damped = blocks[0].copy()
    diagonal = np.einsum("fii->fi", damped)
    diagonal += damping * diagonal + _TINY
    return solve_blocks([damped, *blocks[1:]], vector)
