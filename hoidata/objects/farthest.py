"""Farthest-point sampling with points in buckets: only buckets that the newest choice can affect are visited.

Compiled with numba. Squared distances in float32 in one fixed order, so that every point keeps the bits a plain loop
gives it (Eldar et al. 1997; buckets as in Han et al. 2023, "QuickFPS").
"""

import numpy as np
from numba import njit

_POINTS_PER_BUCKET = 128
_ROUNDING = np.float32(1 - 1e-5)  # a bound from box corners rounds differently from a distance


def farthest_points(points_m: np.ndarray, count: int) -> np.ndarray:
    """(count,) indices of points (point, 3): the first point, then each time the one farthest from all chosen ones.

    Squared distances are float32, and the lowest index wins a tie. Indices repeat only when points coincide.
    """
    points = np.ascontiguousarray(points_m, dtype=np.float32)
    order, first = _buckets(points)
    x, y, z = np.ascontiguousarray(points[order].T, np.float32)
    low = np.minimum.reduceat(points[order], first[:-1], axis=0)
    high = np.maximum.reduceat(points[order], first[:-1], axis=0)
    return _choose_points(x, y, z, order, first, low, high, points, count)


def _buckets(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Point indices in buckets (intervals of a Morton curve), rising in each bucket, and the start of each bucket."""
    above = points.astype(np.float64) - points.min(axis=0)
    cell = (above / (above.max() or 1) * 1023).astype(np.uint32)
    x, y, z = _spread_bits(cell).T
    order = np.argsort(x | y << 1 | z << 2, kind="stable")
    first = np.append(np.arange(0, len(points), _POINTS_PER_BUCKET), len(points))
    whole = order[: len(order) // _POINTS_PER_BUCKET * _POINTS_PER_BUCKET]
    rest = np.sort(order[len(whole) :])
    return np.concatenate((np.sort(whole.reshape(-1, _POINTS_PER_BUCKET), axis=1).ravel(), rest)), first


def _spread_bits(value: np.ndarray) -> np.ndarray:
    """Ten bits with two empty ones between each pair, for interleaving three coordinates."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        value = (value | value << np.uint32(shift)) & np.uint32(mask)
    return value


@njit(cache=True)
def _choose_points(x, y, z, order, first, low, high, points, count):  # pragma: no cover (compiled)
    nearest = np.full(len(x), np.float32(np.inf), np.float32)
    farthest = np.full(len(low), np.float32(np.inf), np.float32)  # (bucket,) its largest distance
    winner = np.zeros(len(low), np.int64)  # (bucket,) the lowest index of a point at that distance
    chosen = np.zeros(count, np.int64)
    for step in range(1, count):
        last = points[chosen[step - 1]]
        best, best_point = np.float32(-1), 0
        # A bucket changes only if the last choice is closer to its box than its farthest point is to the chosen ones.
        for bucket in range(len(low)):
            if _square_to_box(last, low[bucket], high[bucket]) * _ROUNDING < farthest[bucket]:
                start, stop = first[bucket], first[bucket + 1]
                point = start + _lower_distances(x[start:stop], y[start:stop], z[start:stop], last, nearest[start:stop])
                farthest[bucket], winner[bucket] = nearest[point], order[point]
            if farthest[bucket] > best or (farthest[bucket] == best and winner[bucket] < best_point):
                best, best_point = farthest[bucket], winner[bucket]
        chosen[step] = best_point
    return chosen


@njit(cache=True)
def _square_to_box(point, low, high):  # pragma: no cover (compiled)
    """Square of the distance from a point to a box, 0 inside."""
    square = np.float32(0)
    for axis in range(3):
        outside = max(low[axis] - point[axis], point[axis] - high[axis], np.float32(0))
        square += outside * outside
    return square


@njit(cache=True)
def _lower_distances(x, y, z, reference, nearest):  # pragma: no cover (compiled)
    """Lower each distance to that from ``reference`` if smaller. Returns the first index of the largest distance."""
    for point in range(len(x)):
        dx, dy, dz = x[point] - reference[0], y[point] - reference[1], z[point] - reference[2]
        square = (dx * dx + dy * dy) + dz * dz
        nearest[point] = min(nearest[point], square)
    # Non-negative floats sort like their bits, and the compiler vectorizes the maximum of integers.
    bits, largest = nearest.view(np.int32), np.int32(-1)
    for point in range(len(bits)):
        largest = max(largest, bits[point])
    for point in range(len(bits)):
        if bits[point] == largest:
            return point
    return 0
