"""Signed distances of the refinement's grids, for thin and long objects."""

import numpy as np
import pytest

from hoidata.clips.clip import ObjectTrack
from hoidata.refinement.object_field import ObjectField
from tests.builders.objects import box_model

STILL = np.zeros((1, 3), np.float32)


@pytest.mark.parametrize("sizes_m", [(0.3, 0.2, 0.003), (1.4, 0.025, 0.025), (0.06, 0.06, 0.06), (2.0, 0.5, 0.02)])
def test_distances_of_any_proportions(sizes_m):
    """Above a face the distance is the height; inside the distance is negative."""
    field = ObjectField(ObjectTrack(box_model(sizes_m), STILL, STILL))
    heights = np.array([-0.5 * sizes_m[2], 0.002, 0.006])
    points_m = np.stack(
        (0.31 * sizes_m[0] + 0 * heights, 0.1 * sizes_m[1] + 0 * heights, 0.5 * sizes_m[2] + heights), 1
    )
    distance = field.distances(points_m[None])[0][0]
    np.testing.assert_allclose(distance[1:], heights[1:], atol=0.001)
    assert distance[0] < 0
