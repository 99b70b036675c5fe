"""Intervals against formulas from elsewhere."""

import numpy as np
import pytest

from hoidata.metrics.intervals import Interval, bootstrap_interval, t_interval


def test_twenty_repetitions_get_students_factor_with_one_degree_less():
    values = np.random.default_rng(0).normal(3, 2, 20)
    half = 2.0930240544 * values.std(ddof=1) / np.sqrt(20)
    assert t_interval(values) == pytest.approx((values.mean() - half, values.mean() + half), rel=1e-9)
    assert t_interval([1.0]) is None


def test_a_bootstrap_over_single_clips_is_as_wide_as_the_normal_interval():
    values = np.random.default_rng(1).normal(size=400)
    low, high = bootstrap_interval(values, np.arange(400))
    half = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.15 * half)


def test_clips_of_one_sequence_are_resampled_together():
    values = np.repeat(np.random.default_rng(2).normal(size=40), 25)
    alone, together = bootstrap_interval(values, np.arange(1000)), bootstrap_interval(values, np.repeat(range(40), 25))
    assert together.high - together.low == pytest.approx(5 * (alone.high - alone.low), rel=0.15)


def test_equal_inputs_give_equal_intervals_in_any_order_of_clips_and_groups_of_any_name():
    values, groups = np.random.default_rng(3).normal(size=30), np.repeat([f"s{k}" for k in range(10)], 3)
    order = np.random.default_rng(4).permutation(30)
    assert bootstrap_interval(values[order], groups[order]) == pytest.approx(bootstrap_interval(values, groups))


def test_one_group_has_no_interval_and_undefined_resamples_are_skipped():
    assert bootstrap_interval(np.ones(5), np.zeros(5)) is None

    def first_alone(values, weights):
        return np.where(weights[:, 0] > 0, 7.0, np.nan)

    assert bootstrap_interval(np.ones(9), np.arange(9), first_alone) == Interval(7.0, 7.0)
