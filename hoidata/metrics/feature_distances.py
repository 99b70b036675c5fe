"""Distances between two sets of features, and within one: pure functions of (row, F) arrays, float64.

Sources: FID, Heusel et al. 2017; KID, Binkowski et al. 2018; the paired form, IMoS (Ghosh et al. 2023) as released.
"""

import numpy as np
from scipy.spatial.distance import cdist

ROWS_PER_FEATURE = 4
TOO_SMALL = "N too small"


def fid_paired(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(row,) squared distance of paired features plus that of their spreads over the F units (ddof 1).

    What IMoS's released "FID" averages: it runs on one clip at a time. It needs pairs and punishes diversity.
    """
    spread = one.std(axis=1, ddof=1) - other.std(axis=1, ddof=1)
    return np.square(one - other).sum(axis=1) + np.square(spread)


def enough_rows(features: np.ndarray) -> bool:
    """At least 4 rows per feature: with fewer, two draws of one distribution seem far apart (``TOO_SMALL``)."""
    return len(features) >= ROWS_PER_FEATURE * features.shape[1]


def fid_frechet(one: np.ndarray, other: np.ndarray) -> float | None:
    """Frechet distance of the Gaussians of two sets; None where either has too few rows to know its covariance."""
    if not (enough_rows(one) and enough_rows(other)):
        return None
    return frechet_distance(*gaussian(one), *gaussian(other))


def gaussian(features: np.ndarray, weights: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (F,) and covariance (F, F) with ddof 1. weights: (row,) how often each row counts."""
    count = np.ones(len(features)) if weights is None else weights
    mean = count @ features / count.sum()
    apart = features - mean
    return mean, (apart * count[:, None]).T @ apart / (count.sum() - 1)


def frechet_distance(mean: np.ndarray, cov: np.ndarray, other_mean: np.ndarray, other_cov: np.ndarray) -> float:
    """``|m1 - m2|^2 + tr C1 + tr C2 - 2 tr (C1 C2)^(1/2)``, the root by eigenvalues, which are never complex."""
    value, vector = np.linalg.eigh(cov)
    root = vector * np.sqrt(np.maximum(value, 0)) @ vector.T
    cross = np.linalg.eigvalsh(root @ other_cov @ root)
    apart = np.square(mean - other_mean).sum()
    return float(apart + np.trace(cov) + np.trace(other_cov) - 2 * np.sqrt(np.maximum(cross, 0)).sum())


def cubic_kernel(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(row, other row) ``(x.y / F + 1)^3``."""
    return (one @ other.T / one.shape[1] + 1) ** 3


def kid(one: np.ndarray, other: np.ndarray) -> float:
    """Unbiased squared distance of the kernel means of two sets, cubic kernel; NaN with fewer than two rows."""
    if min(len(one), len(other)) < 2:
        return np.nan
    same = [mean_of_pairs(cubic_kernel(rows, rows), np.ones((1, len(rows))))[0] for rows in (one, other)]
    return float(sum(same) - 2 * cubic_kernel(one, other).mean())


def euclidean(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(row, other row) distances."""
    return cdist(one, other)


def mean_of_pairs(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(draw,) mean over all pairs of two different rows of a symmetric (row, row) matrix; NaN with fewer than two.

    weights: (draw, row) how often each row counts; a row is never a pair with itself.
    """
    off = matrix - np.diag(np.diag(matrix))
    pairs = np.square(weights.sum(axis=1)) - np.square(weights).sum(axis=1)
    return np.divide(_total(off, weights), pairs, out=np.full(len(weights), np.nan), where=pairs > 0)


def mean_with_itself(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(draw,) mean over all pairs of rows of a (row, row) matrix, a row with itself among them; weights as above."""
    return _total(matrix, weights) / np.square(weights.sum(axis=1))


def _total(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.einsum("dr,dr->d", weights @ matrix, weights)
