"""Losses are zero for recorded motions, grow with errors, and use exact distances."""

import numpy as np
import pytest
import torch
import trimesh

from hoidata.batches.dataset import ClipBatch, collate
from hoidata.batches.frame_selection import FrameSelection
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import ObjectModel
from hoidata.objects.signed_distance_grid import DistanceFields
from models.common import losses
from models.common.features import Hands, place_points, scaled_text, to_object_frame
from models.text2hoi.length import length_loss
from models.text2hoi.refiner import Surface


@pytest.fixture(scope="module")
def hands() -> Hands:
    return Hands(load_embedded_hands())


def test_joints_of_the_features_are_the_stored_joints(batch: ClipBatch, hands: Hands) -> None:
    joints = hands.joints(batch.hands, batch.betas, batch.template_m)
    torch.testing.assert_close(joints[batch.present], batch.joints_m[batch.present], atol=1e-5, rtol=0)
    _, same = hands.vertices(batch.hands, batch.betas, batch.template_m)
    torch.testing.assert_close(same, joints, atol=1e-5, rtol=0)


def test_distance_entries_of_chosen_frames_equal_the_distances(batch: ClipBatch) -> None:
    sight = FrameSelection.drawn(batch.lengths.tolist(), 5, 10_000, np.random.default_rng(0))
    chosen_batch = collate(batch.samples, sight)
    joints, objects = (
        losses.take_frames(tensor, chosen_batch.chosen, axis)
        for tensor, axis in ((chosen_batch.joints_m, 2), (chosen_batch.object, 1))
    )
    points = place_points(chosen_batch, objects)
    assert len(chosen_batch.entries) > 0
    assert float(losses.distance_map_loss(joints, points, chosen_batch.entries, chosen_batch.entry_distance_m)) < 1e-9
    assert float(losses.distance_map_loss(joints, points, chosen_batch.entries[:0], torch.zeros(0))) == 0


def test_the_contact_loss_counts_only_touching_joints() -> None:
    true = torch.tensor([0.010, 0.021, -0.010]).reshape(1, 1, 1, 3)
    predicted = torch.tensor([0.020, 5.0, 0.010]).reshape(1, 1, 1, 3)
    # Joints one and three count, off by 1 cm and 2 cm: (1 + 4) / 2.
    assert float(losses.contact_loss(predicted, true, torch.ones(1, 1, 1), 0.02)) == pytest.approx(2.5)
    assert float(losses.contact_loss(true, true, torch.ones(1, 1, 1), 0.02)) == 0
    # At a threshold of 1 cm (strictly below) none of them touches.
    assert float(losses.contact_loss(predicted, true, torch.ones(1, 1, 1), 0.01)) == 0
    # 10 cm off: linear beyond 3 cm, 2 x 3 x (10 - 1.5) instead of 100.
    assert float(losses.contact_loss(true + 0.1, true, torch.ones(1, 1, 1), 0.02)) == pytest.approx(51, rel=1e-5)


def test_a_field_has_the_distance_of_a_sphere() -> None:
    ball = trimesh.creation.icosphere(4, 0.05)
    model = ObjectModel("ball", ball.vertices, ball.faces, np.zeros(len(ball.vertices), np.uint8))
    fields = DistanceFields([("ball", model)], 40)
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(1, 1, 500, 3, generator=generator) - 0.5) * 0.3
    points.requires_grad_()
    distance, offset = fields.query(torch.zeros(1, dtype=torch.long), points, torch.zeros(1, 1))
    radius = points.detach().norm(dim=-1)
    away = radius > 0.02
    inside_box = points.detach().abs().amax(-1) < 0.08
    assert (distance.detach() - (radius - 0.05))[away & inside_box].abs().max() < 1.5e-3
    # Outside the grid the distance to the grid is added, so the result is never too small.
    assert (distance.detach() - (radius - 0.05))[~inside_box].min() > -1.5e-3
    reached = (points.detach() + offset.detach()).norm(dim=-1)
    assert (reached - 0.05)[away & inside_box].abs().max() < 2e-3
    (gradient,) = torch.autograd.grad(distance.sum(), points)
    outward = torch.nn.functional.cosine_similarity(gradient, points.detach(), dim=-1)
    assert outward[away & inside_box].min() > 0.95


def test_a_field_rotates_the_moving_part_with_the_hinge(batch: ClipBatch, hands: Hands) -> None:
    surface = Surface.of(hands, batch.objects, torch.device("cpu"))
    points = place_points(batch, batch.object)
    both_hands = points[:, None].expand(-1, 2, -1, -1, -1)
    _, distance, _ = surface.measure(batch, both_hands, batch.object)
    # Sampled points are on the surface; near the hinge they may be inside the other part.
    assert distance.transpose(1, 2)[batch.frames].abs().median() < 1e-3
    assert distance.transpose(1, 2)[batch.frames].max() < 3e-3


def test_points_in_the_objects_frame_by_hand() -> None:
    """An object at (1, 2, 3), rotated by a quarter turn about z: its x axis is the world's y axis."""
    objects = torch.tensor([[[1.0, 2, 3, 0, -1, 1, 0, 0, 0, 0]]])
    world = torch.tensor([[[[1.0, 3, 3], [0, 2, 3.5]]]])
    torch.testing.assert_close(to_object_frame(world, objects), torch.tensor([[[[1.0, 0, 0], [0, 1, 0.5]]]]))
    assert scaled_text(torch.tensor([30.0, 40.0])).tolist() == pytest.approx([0.6 * 2**0.5, 0.8 * 2**0.5])


def test_the_length_loss_by_hand() -> None:
    """150 frames are 1: a mean of 0.5 has a squared error of 0.25, and 0.125 log-likelihood loss at deviation one."""
    terms = length_loss(torch.tensor([0.5]), torch.tensor([0.0]), torch.tensor([150]))
    assert [float(terms[name]) for name in ("square", "likelihood", "total")] == pytest.approx([0.25, 0.125, 5.125])
    wider = length_loss(torch.tensor([0.5]), torch.tensor([1.0]), torch.tensor([150]))
    assert float(wider["likelihood"]) == pytest.approx(1 + 0.125 * np.exp(-2))
