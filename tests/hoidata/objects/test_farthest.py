"""Farthest points in buckets against one plain loop over all points: the same rows, ties and doubles included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hoidata.objects.sampling import farthest_points


def plain_loop(points: np.ndarray, count: int) -> list[int]:
    """Every distance every time, float32; argmax takes the lowest row of equals."""
    x, y, z = points.T
    nearest = np.full(len(points), np.inf, np.float32)
    chosen = [0]
    while len(chosen) < count:
        last = chosen[-1]
        square = ((x - x[last]) ** 2 + (y - y[last]) ** 2) + (z - z[last]) ** 2
        nearest = np.minimum(nearest, square)
        chosen.append(int(nearest.argmax()))
    return chosen


@given(st.integers(0, 2**32), st.integers(1, 1500), st.sampled_from(["scattered", "sphere", "lattice", "doubled"]))
@settings(max_examples=60, deadline=None)
def test_rows_are_those_of_the_plain_loop(seed: int, n_points: int, kind: str) -> None:
    random = np.random.default_rng(seed)
    points = random.normal(0, 0.05, (n_points, 3))
    if kind == "sphere":
        points = 0.05 * points / np.linalg.norm(points, axis=1, keepdims=True)
    if kind == "lattice":  # many equal distances
        points = random.integers(0, 6, (n_points, 3)) * 0.01
    if kind == "doubled":
        points = np.concatenate((points, points))
    points = points.astype(np.float32)
    count = min(len(points), 300)
    assert farthest_points(points, count).tolist() == plain_loop(points, count)


@pytest.mark.parametrize("n_points", [4000, 32768])
def test_rows_of_dense_surfaces_are_those_of_the_plain_loop(n_points: int) -> None:
    angle = np.random.default_rng(n_points).uniform(0, 2 * np.pi, (2, n_points))
    ring = 0.05 + 0.02 * np.cos(angle[1])
    points = np.column_stack((ring * np.cos(angle[0]), ring * np.sin(angle[0]), 0.02 * np.sin(angle[1])))
    points = points.astype(np.float32)
    assert farthest_points(points, 1024).tolist() == plain_loop(points, 1024)


def test_more_rows_than_distinct_points_repeat_the_first() -> None:
    points = np.zeros((70, 3), np.float32)
    points[50:] = 1
    assert farthest_points(points, 5).tolist() == [0, 50, 0, 0, 0]
