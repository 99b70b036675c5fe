"""Entries of a few frames of a clip."""

import numpy as np
import pytest

from hoidata.store.distances import DistanceEntries


def entries(frame: list[int]) -> DistanceEntries:
    """One entry per frame named; their points are 0, 1, 2 and so on, i + 1 mm away."""
    numbers, zeros = np.arange(len(frame)), np.zeros(len(frame), np.int64)
    return DistanceEntries(zeros, np.array(frame), zeros, numbers, np.float32(0.001 * (numbers + 1)))


@pytest.mark.parametrize("cut", [DistanceEntries.window, DistanceEntries.interval])
def test_entries_of_an_interval_count_its_frames_from_its_start_and_end_before_its_stop(cut) -> None:
    found = cut(entries([0, 2, 2, 3, 5, 5, 6]), 2, 5)
    assert found.frame.tolist() == [0, 0, 1]
    assert found.point.tolist() == [1, 2, 3]
    assert found.distance_m.tolist() == pytest.approx([0.002, 0.003, 0.004])
    assert len(cut(entries([0, 1, 8]), 2, 5).frame) == 0


def test_a_window_keeps_the_order_of_entries_that_follow_hand_by_hand() -> None:
    found = entries([3, 4, 9, 0, 3]).window(3, 5)
    assert found.frame.tolist() == [0, 1, 0]
    assert found.point.tolist() == [0, 1, 4]
