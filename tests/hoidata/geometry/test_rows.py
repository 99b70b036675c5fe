"""Equal rows are found as NumPy finds them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from hoidata.geometry.rows import distinct_rows

FEW = st.sampled_from([-1.5, -0.0, 0.0, 0.25, 3.0])


@given(arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=9), elements=FEW))
def test_rows_are_numbered_as_numpy_sorts_them(rows: np.ndarray) -> None:
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    result = distinct_rows(rows)
    np.testing.assert_array_equal(result.first, first)
    np.testing.assert_array_equal(result.number, number.reshape(-1))


@pytest.mark.parametrize("dtype", [np.int64, np.float32])
def test_an_array_without_rows_has_no_distinct_rows(dtype: type) -> None:
    first, number = distinct_rows(np.zeros((0, 3), dtype))
    assert first.shape == number.shape == (0,)


def test_a_row_of_numbers_that_are_not_finite_has_its_number_too() -> None:
    first, number = distinct_rows(np.array([[np.nan, 1.0], [0.0, 1.0], [np.nan, 1.0], [np.inf, 1.0]]))
    assert number.tolist() == [2, 0, 2, 1]
    assert first.tolist() == [1, 3, 0]
