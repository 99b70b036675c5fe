"""Means and medians of rigid transforms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracker_offset import is_near_median, mean_transform


def turned(degrees: list[float], x_m: list[float]) -> RigidTransform:
    rotvec = np.radians(degrees)[:, None] * [0.0, 0.0, 1.0]
    return RigidTransform(Rotation.from_rotvec(rotvec).as_matrix(), np.array(x_m)[:, None] * [1.0, 0.0, 0.0])


def test_the_mean_of_two_turns_about_one_axis_is_halfway() -> None:
    mean = mean_transform(turned([10, 30], [0.1, 0.2]))
    np.testing.assert_allclose(Rotation.from_matrix(mean.rotation).as_rotvec(degrees=True), [0, 0, 20], atol=1e-9)
    assert mean.translation == pytest.approx([0.15, 0, 0])


def test_outliers_in_angle_or_position_do_not_move_the_median() -> None:
    near = is_near_median(turned([0, 1, 2, 1, 90, 1, 1], [0, 0, 0.001, 0, 0, 5, 0]))
    assert near.tolist() == [True, True, True, True, False, False, True]
