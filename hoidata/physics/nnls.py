"""Non-negative least squares of many small systems: how much of a wrench no non-negative mix of contact forces gives.

Active-set method of Lawson and Hanson (Solving Least Squares Problems, 1974, chapter 23) for six rows and any number of
columns. At most six columns are ever active, so each step is a fresh Gram-Schmidt factorisation of a few 6-vectors.
"""

import numpy as np
from numba import njit

ROWS = 6
MOST_STEPS = 300
_DEPENDENT = 1e-11  # a column that keeps less than this share of its length beside the active ones adds nothing
_GRADIENT = 1e-12  # of |column| |wrench|: a smaller gain is rounding


def wrench_residuals(
    columns: np.ndarray, offsets: np.ndarray, wrenches: np.ndarray, most_steps: int = MOST_STEPS
) -> np.ndarray:
    """(frame, 6) what is left of each wrench: ``wrench - columns @ x`` at the non-negative ``x`` that leaves least.

    columns: (6, column) of all frames one after another; frame i owns ``columns[:, offsets[i] : offsets[i + 1]]``,
    maybe none. offsets: (frame + 1,). wrenches: (frame, 6). Rows may have any units; the norm mixes them as they come.
    A frame that needs more than ``most_steps`` exchanges of columns keeps the ``x`` it has by then, whose residual is
    an upper bound: it may be called infeasible wrongly, never feasible.
    """
    columns = np.ascontiguousarray(columns, dtype=np.float64)
    wrenches = np.ascontiguousarray(wrenches, dtype=np.float64)
    offsets = np.ascontiguousarray(offsets, dtype=np.int64)
    if columns.ndim != 2 or len(columns) != ROWS or wrenches.ndim != 2 or wrenches.shape[1] != ROWS:
        raise ValueError(f"columns (6, n) and wrenches (frame, 6) expected, got {columns.shape} and {wrenches.shape}")
    rising = len(offsets) == len(wrenches) + 1 and offsets[0] == 0 and (np.diff(offsets) >= 0).all()
    if not rising or offsets[-1] != columns.shape[1]:
        raise ValueError("offsets must rise from 0 to the number of columns, one more than there are frames")
    if not (np.isfinite(columns).all() and np.isfinite(wrenches).all()):
        raise ValueError("finite columns and wrenches expected")
    return _residuals(columns, offsets, wrenches, most_steps)


@njit(cache=True)
def _residuals(columns, offsets, wrenches, most_steps):  # pragma: no cover (compiled)
    left = wrenches.copy()
    for frame in range(len(wrenches)):
        if offsets[frame + 1] > offsets[frame]:
            _reduce(columns[:, offsets[frame] : offsets[frame + 1]], left[frame], most_steps)
    return left


@njit(cache=True)
def _reduce(columns, left, most_steps):  # pragma: no cover (compiled)
    """Replace the wrench in ``left`` by its residual."""
    n_columns = columns.shape[1]
    wrench = left.copy()
    size = np.sqrt((wrench * wrench).sum())
    banned = np.zeros(n_columns, np.bool_)
    active, amount, wanted = np.empty(ROWS, np.int64), np.zeros(ROWS), np.empty(ROWS)
    basis, upper = np.empty((ROWS, ROWS)), np.zeros((ROWS, ROWS))
    gain = np.empty(n_columns)
    n_active, steps = 0, 0
    while n_active < ROWS and steps < most_steps:
        steps += 1
        best = _most_promising(columns, left, banned, gain)
        if best < 0 or gain[best] <= _GRADIENT * size * _length(columns, best):
            break
        active[n_active], amount[n_active] = best, 0.0
        banned[best] = True  # active columns are not candidates; one that must go at once stays out until progress
        if not _append(columns, active, n_active, basis, upper):
            continue
        _solve(basis, upper, wrench, wanted, n_active + 1)
        if wanted[n_active] <= 0.0:
            continue
        n_active = _step(columns, active, amount, wanted, basis, upper, wrench, n_active + 1)
        banned[:] = False
        for row in range(ROWS):
            left[row] = wrench[row]
        for slot in range(n_active):
            banned[active[slot]] = True
            for row in range(ROWS):
                left[row] -= columns[row, active[slot]] * amount[slot]


@njit(cache=True)
def _most_promising(columns, left, banned, gain):  # pragma: no cover (compiled)
    """The column that what is left points along most, -1 when along none; ``gain`` is filled on the way."""
    for column in range(columns.shape[1]):
        gain[column] = (
            columns[0, column] * left[0]
            + columns[1, column] * left[1]
            + columns[2, column] * left[2]
            + columns[3, column] * left[3]
            + columns[4, column] * left[4]
            + columns[5, column] * left[5]
        )
    best, best_gain = -1, 0.0
    for column in range(columns.shape[1]):
        if gain[column] > best_gain and not banned[column]:
            best, best_gain = column, gain[column]
    return best


@njit(cache=True)
def _length(columns, column):  # pragma: no cover (compiled)
    square = 0.0
    for row in range(ROWS):
        square += columns[row, column] ** 2
    return np.sqrt(square)


@njit(cache=True)
def _step(columns, active, amount, wanted, basis, upper, wrench, n_active):  # pragma: no cover (compiled)
    """Move ``amount`` to the least-squares solution, dropping columns that would turn negative; how many stay."""
    while True:
        share, blocking = 1.0, -1
        for slot in range(n_active):
            if wanted[slot] <= 0.0:
                reach = amount[slot] / (amount[slot] - wanted[slot]) if amount[slot] > wanted[slot] else 0.0
                if reach < share or blocking < 0:
                    share, blocking = reach, slot
        for slot in range(n_active):
            amount[slot] += share * (wanted[slot] - amount[slot])
        if blocking < 0:
            return n_active
        amount[blocking] = 0.0
        kept = 0
        for slot in range(n_active):
            if amount[slot] > 0.0:
                active[kept], amount[kept] = active[slot], amount[slot]
                kept += 1
        n_active = kept
        for slot in range(n_active):
            _append(columns, active, slot, basis, upper)
        _solve(basis, upper, wrench, wanted, n_active)


@njit(cache=True)
def _append(columns, active, slot, basis, upper):  # pragma: no cover (compiled)
    """Orthogonalise the column of ``slot`` against those before it, twice; False when nothing of it is left."""
    length = 0.0
    for row in range(ROWS):
        basis[slot, row] = columns[row, active[slot]]
        length += basis[slot, row] ** 2
    for other in range(slot):
        upper[other, slot] = 0.0
    for _ in range(2):
        for other in range(slot):
            along = 0.0
            for row in range(ROWS):
                along += basis[other, row] * basis[slot, row]
            upper[other, slot] += along
            for row in range(ROWS):
                basis[slot, row] -= along * basis[other, row]
    rest = 0.0
    for row in range(ROWS):
        rest += basis[slot, row] ** 2
    if rest <= _DEPENDENT * _DEPENDENT * length:
        return False
    upper[slot, slot] = np.sqrt(rest)
    for row in range(ROWS):
        basis[slot, row] /= upper[slot, slot]
    return True


@njit(cache=True)
def _solve(basis, upper, wrench, wanted, n_active):  # pragma: no cover (compiled)
    for slot in range(n_active - 1, -1, -1):
        value = 0.0
        for row in range(ROWS):
            value += basis[slot, row] * wrench[row]
        for later in range(slot + 1, n_active):
            value -= upper[slot, later] * wanted[later]
        wanted[slot] = value / upper[slot, slot]
