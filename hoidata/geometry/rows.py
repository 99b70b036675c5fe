"""Finds equal rows of an array, such as coinciding vertices of a mesh."""

from typing import NamedTuple

import numpy as np
import pandas as pd


class DistinctRows(NamedTuple):
    """The distinct rows of an array, sorted by value."""

    first: np.ndarray  # (distinct,) index of the first occurrence of each distinct row
    number: np.ndarray  # (row,) index of each row's distinct row


def distinct_rows(rows: np.ndarray) -> DistinctRows:
    """Find the distinct rows of an array (row, column); NaN equals NaN.

    The result is that of ``np.unique(rows, axis=0)``, several times faster for repeated rows such as triangle corners.
    """
    table = pd.DataFrame(np.asarray(rows))
    number = table.groupby(list(table.columns), sort=True, dropna=False).ngroup().to_numpy(np.int64)
    first = np.full(number.max(initial=-1) + 1, -1, np.int64)
    first[number[::-1]] = np.arange(len(number))[::-1]  # the last assignment wins, so assign in reverse order
    return DistinctRows(first, number)
