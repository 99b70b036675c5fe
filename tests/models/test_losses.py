"""Losses vanish at the truth, grow away from it, and read distances as exact geometry gives them."""

import numpy as np
import pytest
import torch
import trimesh

from hoidata.batches.dataset import ClipBatch, collate
from hoidata.batches.sight import Sight
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import ObjectModel
from hoidata.objects.signed_distance_grid import DistanceFields
from models.common import losses
from models.common.features import Hands, place_points, scaled_text, to_object_frame
from models.common.sampling import add_noise
from models.text2hoi.contact import contact_loss
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


def test_the_entries_of_chosen_frames_are_the_distances_there(batch: ClipBatch) -> None:
    sight = Sight.drawn(batch.lengths.tolist(), 5, 10_000, np.random.default_rng(0))
    seen = collate(batch.samples, sight)
    joints, objects = (
        losses.take_frames(own, seen.chosen, axis) for own, axis in ((seen.joints_m, 2), (seen.object, 1))
    )
    points = place_points(seen, objects)
    assert len(seen.entries) > 0
    assert float(losses.distance_map_loss(joints, points, seen.entries, seen.entry_distance_m)) < 1e-9


def test_penetration_counts_only_what_is_inside() -> None:
    distance = torch.tensor([0.02, -0.01, -0.02, 0.0]).reshape(1, 1, 1, 4)
    # (1 cm)^2 + (2 cm)^2 in units of 1 cm.
    assert float(losses.penetration_loss(distance, torch.ones(1, 1, 1))) == pytest.approx(5.0)
    assert float(losses.penetration_loss(distance.abs(), torch.ones(1, 1, 1))) == 0
    assert float(losses.penetration_loss(distance, torch.zeros(1, 1, 1))) == 0


def test_contact_pulls_only_joints_that_truly_touch() -> None:
    true = torch.tensor([0.010, 0.021, -0.010]).reshape(1, 1, 1, 3)
    now = torch.tensor([0.020, 5.0, 0.010]).reshape(1, 1, 1, 3)
    # Joints one and three count, off by 1 cm and 2 cm: (1 + 4) / 2.
    assert float(losses.contact_loss(now, true, torch.ones(1, 1, 1), 0.02)) == pytest.approx(2.5)
    assert float(losses.contact_loss(true, true, torch.ones(1, 1, 1), 0.02)) == 0
    # At a threshold of 1 cm (strictly below) none of them touches.
    assert float(losses.contact_loss(now, true, torch.ones(1, 1, 1), 0.01)) == 0
    # 10 cm off: linear beyond 3 cm, 2 x 3 x (10 - 1.5) instead of 100.
    assert float(losses.contact_loss(true + 0.1, true, torch.ones(1, 1, 1), 0.02)) == pytest.approx(51, rel=1e-5)


def test_a_field_reads_the_distance_of_a_sphere() -> None:
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
    # Beyond the box the distance to it is added: never nearer than the truth.
    assert (distance.detach() - (radius - 0.05))[~inside_box].min() > -1.5e-3
    reached = (points.detach() + offset.detach()).norm(dim=-1)
    assert (reached - 0.05)[away & inside_box].abs().max() < 2e-3
    (gradient,) = torch.autograd.grad(distance.sum(), points)
    outward = torch.nn.functional.cosine_similarity(gradient, points.detach(), dim=-1)
    assert outward[away & inside_box].min() > 0.95


def test_a_field_turns_the_moving_part_with_the_hinge(batch: ClipBatch, hands: Hands) -> None:
    surface = Surface.of(hands, batch.objects, 40, torch.device("cpu"))
    points = place_points(batch, batch.object)
    both = points[:, None].expand(-1, 2, -1, -1, -1)
    _, distance, _ = surface.measure(batch, both, batch.object)
    # Sampled points lie on the surface; a hinge line where parts meet may be inside the other part.
    assert distance.transpose(1, 2)[batch.frames].abs().median() < 1e-3
    assert distance.transpose(1, 2)[batch.frames].max() < 3e-3


def test_distance_map_loss_by_hand() -> None:
    """A joint of the right hand is 5 cm from a point where 2 cm are asked for; the other one fits."""
    joints, points = torch.zeros(1, 2, 1, 21, 3), torch.zeros(1, 1, 3, 3)
    joints[0, 1, 0, 2] = torch.tensor([0.03, 0.0, 0.0])
    points[0, 0, 1] = torch.tensor([0.0, 0.04, 0.0])
    joints[0, 0, 0, 2] = torch.tensor([0.0, 0.05, 0.0])
    entries = torch.tensor([[0, 1, 0, 2, 1], [0, 0, 0, 2, 1]])
    found = losses.distance_map_loss(joints, points, entries, torch.tensor([0.02, 0.01]))
    assert float(found) == pytest.approx(0.03**2 / 2, rel=1e-4)
    assert float(losses.distance_map_loss(joints, points, entries[:0], torch.zeros(0))) == 0


def test_relative_orientation_by_hand() -> None:
    """Off by a quarter turn four entries of the matrix are off by one: 4; by half a turn two are off by two: 8."""
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    still, hand = torch.eye(3).expand(1, 2, 1, 3, 3), torch.stack([quarter, quarter @ quarter])[None, :, None]
    body = torch.eye(3).expand(1, 1, 3, 3)
    for present, expected in (((1, 0), 4.0), ((0, 1), 8.0), ((1, 1), 6.0), ((0, 0), 0.0)):
        mask = torch.tensor(present, dtype=torch.float32).reshape(1, 2, 1)
        assert float(losses.relative_orientation_loss(hand, body, still, body, mask)) == pytest.approx(expected)
    # A hand that keeps to the world while its object turns is off as well; one turned along is not.
    mask, turned = torch.ones(1, 2, 1), quarter.expand(1, 1, 3, 3)
    assert float(losses.relative_orientation_loss(still, turned, still, body, mask)) == pytest.approx(4)
    along = quarter.expand(1, 2, 1, 3, 3)
    assert float(losses.relative_orientation_loss(along, turned, still, body, mask)) == pytest.approx(0)
    # Nor is the truth itself, whose object has turned under its hand; one turned along is a quarter off from that.
    assert float(losses.relative_orientation_loss(still, turned, still, turned, mask)) == pytest.approx(0)
    assert float(losses.relative_orientation_loss(along, turned, still, turned, mask)) == pytest.approx(4)


def test_noise_by_hand() -> None:
    """Of a signal of 0.64, 0.8 is kept and 0.6 is noise."""
    signal = torch.tensor([1.0, 0.64])
    noised = add_noise(torch.full((2, 1, 1), 10.0), torch.ones(2, 1, 1), torch.tensor([0, 1]), signal)
    assert noised.flatten().tolist() == pytest.approx([10.0, 8.6])


def test_places_of_the_model_frame_by_hand() -> None:
    """An object at (1, 2, 3) turned a quarter about z, its x axis along the world's y."""
    objects = torch.tensor([[[1.0, 2, 3, 0, -1, 1, 0, 0, 0, 0]]])
    world = torch.tensor([[[[1.0, 3, 3], [0, 2, 3.5]]]])
    torch.testing.assert_close(to_object_frame(world, objects), torch.tensor([[[[1.0, 0, 0], [0, 1, 0.5]]]]))
    assert scaled_text(torch.tensor([30.0, 40.0])).tolist() == pytest.approx([0.6 * 2**0.5, 0.8 * 2**0.5])


def test_length_and_contact_losses_by_hand() -> None:
    """150 frames are 1: a mean of 0.5 is off by 0.25 squared, a likelihood of 0.125 at a spread of one."""
    found = length_loss(torch.tensor([0.5]), torch.tensor([0.0]), torch.tensor([150]))
    assert [float(found[name]) for name in ("square", "likelihood", "total")] == pytest.approx([0.25, 0.125, 5.125])
    wider = length_loss(torch.tensor([0.5]), torch.tensor([1.0]), torch.tensor([150]))
    assert float(wider["likelihood"]) == pytest.approx(1 + 0.125 * np.exp(-2))
    logits, touched, latent = torch.full((1, 4), 20.0), torch.tensor([[1.0, 1, 0, 0]]), torch.ones(1, 2)
    found = contact_loss(logits, touched, latent, 0 * latent)
    # Everything is called touched: 1 - (2 x 2 + 1) / (4 + 2 + 1); two points wrong by 20; two latents of mean 1.
    expected = [1 - 5 / 7, 40.0, 1.0]
    assert [float(found[name]) for name in ("dice", "cross_entropy", "kl")] == pytest.approx(expected, rel=1e-4)
    narrow = contact_loss(logits, touched, 0 * latent, -latent)
    assert float(narrow["kl"]) == pytest.approx(np.exp(-1))
