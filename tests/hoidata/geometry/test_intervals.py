import numpy as np
import pytest

from hoidata.geometry.intervals import bridged, runs, sudden_steps


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("", []),
        ("000", []),
        ("111", [(0, 3)]),
        ("0110100", [(1, 3), (4, 5)]),
        ("1001", [(0, 1), (3, 4)]),
    ],
)
def test_runs_are_the_maximal_stretches_of_true(flags, expected):
    assert runs(np.array([flag == "1" for flag in flags], dtype=bool)) == expected


@pytest.mark.parametrize(
    ("flags", "longest", "expected"),
    [("1001", 2, "1111"), ("10001", 2, "10001"), ("0010100", 5, "0011100"), ("000", 9, "000"), ("", 1, "")],
)
def test_only_gaps_between_true_ones_are_bridged_and_only_short_ones(flags, longest, expected):
    flag_array = np.array([flag == "1" for flag in flags], dtype=bool)
    assert bridged(flag_array, longest).tolist() == [flag == "1" for flag in expected]


def test_step_is_sudden_when_it_is_notable_and_several_times_the_motion_around_it():
    step = np.full(20, 0.01)
    step[[3, 8, 9]] = 0.035, 0.05, 0.05
    assert np.flatnonzero(sudden_steps(step, 0.02, 1.0, 4.0)).tolist() == [8, 9]
    assert np.flatnonzero(sudden_steps(step, 0.02, 1.0, 3.0)).tolist() == [3, 8, 9]
    assert np.flatnonzero(sudden_steps(step, 0.06, 1.0, 3.0)).tolist() == []


def test_fast_motion_is_not_sudden_until_it_is_large_for_any_motion():
    step = np.full(20, 0.2)
    assert not sudden_steps(step, 0.02, 0.3, 4.0).any()
    assert sudden_steps(step, 0.02, 0.1, 4.0).all()


def test_recording_of_one_frame_has_no_steps():
    assert sudden_steps(np.zeros(0), 0.02, 0.3, 4.0).shape == (0,)
    assert sudden_steps(np.array([0.5]), 0.02, 0.3, 4.0).tolist() == [True]
