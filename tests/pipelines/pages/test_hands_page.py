"""The page of hands made for an object's motion: what is said of an object without an inside."""

import numpy as np

from models.bimart.hands import Standing
from pipelines.pages.hands_page import _figures


def test_depths_of_an_object_without_an_inside_are_not_measured_and_not_dropped():
    touching = {"right": np.array([True, False])}
    open_mesh, solid = (Standing(touching, depth, 1.0) for depth in (None, np.array([0.004, 0.012])))
    rows = {name: values for name, *values in _figures(open_mesh, open_mesh)}
    reason = "not measured: the object has no inside"
    assert rows["deepest vertex"] == rows["frames deeper than 1 cm"] == [reason, reason]
    rows = {name: values for name, *values in _figures(solid, solid)}
    assert (rows["deepest vertex"], rows["frames deeper than 1 cm"]) == (["12.0 mm"] * 2, ["50 %"] * 2)
