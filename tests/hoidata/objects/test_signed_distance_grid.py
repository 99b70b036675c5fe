"""Grids of signed distances, the torch one of losses and the one of the grasp search: both against exact ones."""

import numpy as np
import torch

from hoidata.objects.distance import closest_points
from hoidata.objects.model import ObjectModel
from hoidata.objects.signed_distance_grid import DistanceFields
from hoidata.objects.surface_index import surface_index
from hoidata.synthetic.hand_capsules import grid_field
from hoidata.synthetic.shapes import sphere
from tests.builders.objects import igl_signed_m
from tests.hoidata.objects.test_hinge_cut import divided_cube


def test_both_look_ups_give_the_exact_signed_distance_to_a_fraction_of_a_cell():
    vertices, faces = sphere(0.05, 40)
    model = ObjectModel("ball", vertices, faces, np.zeros(len(vertices), np.uint8))
    points = np.random.default_rng(0).uniform(-0.07, 0.07, (400, 3))
    exact_m = igl_signed_m(vertices, faces, points)
    assert exact_m.min() < -0.03
    search_m = grid_field(surface_index(model).filled[0])(points)
    fields = DistanceFields([("ball", model)], 40)
    queries = torch.from_numpy(points[None, None].astype(np.float32))
    torch_m, offset_m = fields.query(torch.zeros(1, dtype=torch.long), queries, torch.zeros(1, 1))
    far = np.abs(exact_m) < 0.03  # the offset jumps in the middle of the ball
    near = far & (exact_m < 0.01)  # the grid of the search reaches 1 cm, that of losses 3 cm
    for distance_m, expected_m in ((search_m, near), (torch_m[0, 0].numpy(), far)):
        np.testing.assert_allclose(distance_m[expected_m], exact_m[expected_m], atol=4e-4)
    off = exact_m > 0.01  # a lower bound, by at most the root of two
    assert (search_m[off] < exact_m[off] + 4e-4).all()
    assert (search_m[off] > exact_m[off] / np.sqrt(2) - 4e-4).all()
    np.testing.assert_allclose(
        points[far] + offset_m[0, 0].numpy()[far], closest_points(vertices, faces, points).closest_m[far], atol=3e-3
    )


def test_beyond_the_grid_the_torch_look_up_goes_on_and_the_search_s_stays_below():
    vertices, faces = sphere(0.05, 40)
    model = ObjectModel("ball", vertices, faces, np.zeros(len(vertices), np.uint8))
    query = torch.tensor([[[[0.3, 0.0, 0.0]]]])
    distance, offset = DistanceFields([("ball", model)], 40).query(
        torch.zeros(1, dtype=torch.long), query, torch.zeros(1, 1)
    )
    np.testing.assert_allclose(distance, [[[0.25]]], atol=1e-3)
    np.testing.assert_allclose(offset, [[[[-0.25, 0, 0]]]], atol=1e-3)
    assert 0.2 < grid_field(surface_index(model).filled[0])(np.array([[0.3, 0.0, 0.0]]))[0] <= 0.251


def test_distances_alone_and_beside_a_hinged_object_are_those_of_the_query():
    vertices, faces = sphere(0.05, 40)
    ball = ObjectModel("ball", vertices, faces, np.zeros(len(vertices), np.uint8))
    fields = DistanceFields([("cube", divided_cube()), ("ball", ball)], 24)
    without_hinge = DistanceFields([("ball", ball)], 24)
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.09, 0.09, (2, 3, 50, 3)).astype(np.float32))
    angle = torch.full((2, 3), 0.4)

    def measured(rows: list[int], function, chosen: slice = slice(None)) -> tuple[torch.Tensor, torch.Tensor]:
        """Distances, and the gradient of their sum of squares."""
        places = points[chosen].clone().requires_grad_()
        distance = function(torch.tensor(rows), places, angle[chosen])
        return distance.detach(), torch.autograd.grad(distance.square().sum(), places)[0]

    both = measured([1, 0], lambda *query: fields.query(*query)[0])
    only = measured([1, 0], fields.distance)
    alone = measured([0], without_hinge.distance, slice(1))
    moved = measured([1, 0], lambda rows, places, angles: fields.distance(rows, places, 0 * angles))
    for whole, distances, of_ball in zip(both, only, alone, strict=True):
        assert torch.equal(whole, distances)
        assert torch.equal(whole[:1], of_ball)
    assert torch.equal(moved[0][0], only[0][0])
    assert not torch.allclose(moved[0][1], only[0][1])
