"""Which part a joint touches, where points of both are near."""

import numpy as np

from hoidata.clips.slip import touched_parts


def test_a_joint_touches_the_part_of_its_nearest_point_in_whatever_order_entries_come() -> None:
    frame, joint = np.array([0, 0, 0, 1, 1, 2]), np.array([4, 4, 4, 4, 20, 4])
    distance_m, part = np.array([0.010, 0.004, 0.012, 0.005, 0.001, 0.015]), np.array([1, 0, 1, 1, 0, 0])
    for order in (np.arange(6), np.arange(6)[::-1], np.array([1, 3, 0, 5, 2, 4])):
        touched = touched_parts(4, frame[order], joint[order], distance_m[order], part[order])
        expected = np.full((4, 21), -1)
        expected[0, 4], expected[1, 4], expected[1, 20], expected[2, 4] = 0, 1, 0, 0
        np.testing.assert_array_equal(touched, expected)
    nothing = np.zeros(0, int)
    assert (touched_parts(3, nothing, nothing, np.zeros(0), nothing) == -1).all()
