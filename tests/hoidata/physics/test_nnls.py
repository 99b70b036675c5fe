"""Non-negative least squares against SciPy's and against the conditions every optimum meets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import nnls

from hoidata.physics.realism import wrench_residuals

NUMBERS = st.floats(-10, 10).map(lambda value: round(value, 3))


def _one(columns: np.ndarray, wrench: np.ndarray, **settings_) -> np.ndarray:
    return wrench_residuals(columns, np.array([0, columns.shape[1]]), wrench[None], **settings_)[0]


def test_residuals_and_decisions_are_scipys_on_a_thousand_random_systems():
    rng = np.random.default_rng(0)
    counts = rng.integers(1, 60, 1000)
    systems = [rng.normal(size=(6, count)) + 0.4 * rng.normal(size=(6, 1)) for count in counts]
    wrenches = rng.normal(size=(1000, 6)) * 5
    offsets = np.r_[0, np.cumsum(counts)]
    ours = np.linalg.norm(wrench_residuals(np.concatenate(systems, axis=1), offsets, wrenches), axis=1)
    theirs = np.array([nnls(one, wrench)[1] for one, wrench in zip(systems, wrenches, strict=True)])
    np.testing.assert_allclose(ours, theirs, atol=1e-10)
    assert 0.2 < (theirs < 0.01).mean() < 0.9  # both answers are common
    np.testing.assert_array_equal(ours < 0.01, theirs < 0.01)


@pytest.mark.slow
@settings(deadline=None, max_examples=100)
@given(
    st.integers(1, 12).flatmap(lambda n: arrays(float, (6, n), elements=NUMBERS)), arrays(float, 6, elements=NUMBERS)
)
def test_the_residual_has_no_component_along_a_column_and_is_at_most_the_wrench(columns, wrench):
    # The Karush-Kuhn-Tucker conditions: columns may repeat, vanish or depend on each other.
    left = _one(columns, wrench)
    scale = np.linalg.norm(columns, axis=0) * np.linalg.norm(wrench)
    assert (columns.T @ left <= 1e-9 * scale + 1e-9).all()
    assert left @ (wrench - left) == pytest.approx(0, abs=1e-7 * (1 + wrench @ wrench))
    assert np.linalg.norm(left) == pytest.approx(nnls(columns, wrench, maxiter=1000)[1], abs=1e-7)


def test_frames_without_columns_keep_their_wrench_and_do_not_disturb_others():
    columns = np.eye(6)[:, :3]
    wrenches = np.array([[1.0, 2, 3, 4, 5, 6], [1, 1, 1, 0, 0, 0], [0, 0, -1, 0, 0, 2]])
    left = wrench_residuals(columns, np.array([0, 0, 3, 3]), wrenches)
    np.testing.assert_allclose(left, [wrenches[0], np.zeros(6), wrenches[2]], atol=1e-12)


def test_a_push_that_would_have_to_pull_is_left_out():
    # One column along +x, one along -y: the pull along -x stays, the push along -y is met.
    columns = np.zeros((6, 2))
    columns[0, 0], columns[1, 1] = 2.0, -0.5
    np.testing.assert_allclose(_one(columns, np.array([-3.0, -4, 0, 0, 0, 0])), [-3, 0, 0, 0, 0, 0], atol=1e-12)


def test_too_few_steps_give_an_upper_bound():
    rng = np.random.default_rng(1)
    columns, wrench = rng.normal(size=(6, 40)), rng.normal(size=6)
    lengths = [np.linalg.norm(_one(columns, wrench, max_steps=steps)) for steps in (1, 2, 4, 8, 300)]
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[0] == pytest.approx(np.linalg.norm(wrench))
    assert lengths[-1] < 1e-9


@pytest.mark.parametrize(
    ("columns", "offsets", "wrenches"),
    [
        (np.zeros((5, 2)), [0, 2], np.zeros((1, 6))),
        (np.zeros((6, 2)), [0, 2], np.zeros((1, 5))),
        (np.zeros((6, 2)), [0, 1], np.zeros((1, 6))),
        (np.zeros((6, 2)), [0, 2, 1, 2], np.zeros((3, 6))),
        (np.full((6, 2), np.nan), [0, 2], np.zeros((1, 6))),
    ],
)
def test_shapes_that_do_not_fit_and_numbers_that_are_not_finite_are_refused(columns, offsets, wrenches):
    with pytest.raises(ValueError, match=r"expected|must rise"):
        wrench_residuals(columns, np.array(offsets), wrenches)
