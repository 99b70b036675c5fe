"""Normal equations of a motion whose frames are tied to the two before them: solved in time linear in its length."""

import numpy as np
from scipy.linalg import solveh_banded

# How the second difference of frame t weighs the frames t, t - 1 and t - 2.
_DIFFERENCE = (1.0, -2.0, 1.0)
_TINY = 1e-6  # keeps a frame without any data where it is


def second_differences(values: np.ndarray) -> np.ndarray:
    """(frame, ...) ``x[t] - 2 x[t - 1] + x[t - 2]``, zero in the first two frames."""
    out = np.zeros_like(values)
    out[2:] = values[2:] - 2 * values[1:-1] + values[:-2]
    return out


def acceleration_equations(
    derivative: np.ndarray, difference: np.ndarray, weight: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Blocks and vector of the normal equations of weighted squared second differences.

    derivative: (frame, row, n) of the values by the unknowns of their frame. difference: (frame, row) as
    ``second_differences`` gives it. weight: (frame,) of each, zero in the first two frames.
    Gives [(frame, n, n), (frame - 1, n, n), (frame - 2, n, n)], block b of frame t being rows t + b, columns t, and
    minus half the gradient (frame, n).
    """
    n_frames, padded = len(weight), np.concatenate((weight, np.zeros(2)))
    turned = derivative.swapaxes(1, 2)
    blocks = []
    for apart in range(min(3, n_frames)):
        pairs = range(3 - apart)
        factor = sum(_DIFFERENCE[k] * _DIFFERENCE[k + apart] * padded[k + apart : k + apart + n_frames] for k in pairs)
        rows = n_frames - apart
        blocks.append((turned[apart:] * np.asarray(factor)[:rows, None, None]) @ derivative[:rows])
    pulled = np.concatenate((weight[:, None] * difference, np.zeros((2, difference.shape[1]))))
    pull = sum(_DIFFERENCE[k] * pulled[k : k + n_frames] for k in range(3))
    return blocks, -(turned @ np.asarray(pull)[..., None])[..., 0]


def solve_blocks(blocks: list[np.ndarray], vector: np.ndarray) -> np.ndarray:
    """(frame, n) solution of the symmetric positive system with these blocks below its diagonal (Cholesky, banded)."""
    n_frames, n = vector.shape
    band = np.zeros((len(blocks) * n, n_frames, n))
    row, column = (index.ravel() for index in np.indices((n, n)))
    for apart, block in enumerate(blocks):
        kept = row >= column if apart == 0 else slice(None)
        r, c = row[kept], column[kept]
        band[apart * n + r - c, : len(block), c] = block[:, r, c].T
    return solveh_banded(band.reshape(len(band), -1), vector.ravel(), lower=True, check_finite=False).reshape(
        n_frames, n
    )


def solve_damped(blocks: list[np.ndarray], vector: np.ndarray, damping: float) -> np.ndarray:
    """``solve_blocks`` damped by Marquardt's share of the diagonal."""
    damped = blocks[0].copy()
    diagonal = np.einsum("fii->fi", damped)
    diagonal += damping * diagonal + _TINY
    return solve_blocks([damped, *blocks[1:]], vector)
