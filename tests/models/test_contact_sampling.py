"""Contact tokens and sampled contact maps: independent of point order, one map per hand, several modes."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipBatch
from hoidata.contact.maps import f1_score
from models.common.point_net import PointNetConfig, spread_out
from models.text2hoi import contact_training
from models.text2hoi.contact import AnchoredContact, ContactConfig, ContactModel, by_hand_loss, sample_indices
from models.text2hoi.contact_training import most_typical
from models.text2hoi.diffusion import TOKEN_FEATURES, contact_tokens

POINT_NET = PointNetConfig(widths=(16, 32, 64), heads=(32, 16), align=False)


def network() -> AnchoredContact:
    torch.manual_seed(0)
    return AnchoredContact(ContactConfig(POINT_NET, (32, 32, 16), sampled_from="anchor_points"))


def test_contact_tokens_do_not_depend_on_the_order_of_points(batch: ClipBatch) -> None:
    order = torch.randperm(batch.points_m.shape[1], generator=torch.Generator().manual_seed(0))
    inputs = batch.points_m, batch.normals, batch.part, batch.contact
    mixed = (*(part[:, order] for part in inputs[:3]), batch.contact[..., order])
    tokens, mask = contact_tokens(*inputs, 5)
    other, other_mask = contact_tokens(*mixed, 5)
    assert torch.equal(mask, other_mask)
    torch.testing.assert_close(tokens[mask], other[other_mask])


def test_contact_tokens_have_their_points_position_and_touching_hand(batch: ClipBatch) -> None:
    tokens, mask = contact_tokens(batch.points_m, batch.normals, batch.part, batch.contact, 5)
    assert tokens.shape == (3, 15, TOKEN_FEATURES)
    for index, sample in enumerate(batch.samples):
        for number in mask[index].nonzero()[:, 0].tolist():
            kind = number // 5
            assert tokens[index, number, 10:].tolist() == [float(k == kind) for k in range(3)]
            point = (batch.points_m[index] - tokens[index, number, 3:6] / 10).norm(dim=-1).argmin()
            touched = torch.from_numpy(sample.contact)[:, point]
            assert touched[kind] if kind < 2 else not touched.any()
        counts = mask[index].reshape(3, 5).sum(1).tolist()
        assert counts == [min(5, n) for n in (*sample.contact.sum(1), (~sample.contact.any(0)).sum())]


def test_points_are_spread_out_over_their_kind() -> None:
    points = torch.stack((torch.linspace(0, 1, 101), torch.zeros(101), torch.zeros(101)), -1)[None]
    kinds = torch.ones(1, 1, 101, dtype=torch.bool)
    chosen, mask = spread_out(points, kinds, 3)
    assert mask.all()
    assert sorted(points[0, chosen[0, 0], 0].tolist()) == pytest.approx([0, 0.5, 1])


def test_indices_are_sampled_in_proportion_to_weights() -> None:
    weights = torch.tensor([0.0, 3.0, 0.0, 1.0])
    uniform = torch.linspace(0, 1, 10_001)[:-1]
    indices = sample_indices(weights, uniform)
    counts = torch.bincount(indices, minlength=4) / len(uniform)
    torch.testing.assert_close(counts, weights / 4, atol=1e-3, rtol=0)
    assert sample_indices(torch.zeros(4), torch.tensor([0.5])).item() < 4


def test_an_inactive_hand_has_an_empty_map_and_hand_flags_change_the_maps(batch: ClipBatch) -> None:
    model = network().eval()
    latents = model.draw_latents(2, 3, torch.Generator().manual_seed(0))
    maps = model.sample(batch, batch.text[:, 0], latents)
    assert maps.shape == (3, 2, 2, batch.points_m.shape[1])
    idle = ~batch.active_hands[:, None].expand(-1, 2, -1)
    assert not maps[idle].any()
    other = model.sample(replace(batch, active_hands=batch.active_hands.flip(1)), batch.text[:, 0], latents)
    assert not torch.allclose(maps.amax(2)[0], other.amax(2)[0])


def test_a_clips_maps_do_not_depend_on_the_others_in_the_batch(batch: ClipBatch) -> None:
    model = network().eval()
    latents = model.draw_latents(2, 3, torch.Generator().manual_seed(0))
    many = model.sample(batch, batch.text[:, 0], latents)
    parts = {name: getattr(batch, name)[1:2] for name in ("points_m", "active_hands", "scale_m")}
    single = replace(batch, **parts)
    one = model.sample(single, batch.text[1:2, 0], latents[:, 1:2])
    torch.testing.assert_close(many[1:2], one, atol=1e-5, rtol=1e-4)


def test_a_hand_inactive_in_the_whole_batch_is_skipped_without_effect(batch: ClipBatch) -> None:
    model, right = network().eval(), torch.tensor([[False, True]] * 3)
    latents = model.draw_latents(2, 3, torch.Generator().manual_seed(0))
    arguments = replace(batch, active_hands=right, sides=(True, True)), batch.text[:, 0], latents
    calls = list[int]()
    model.from_point.register_forward_hook(lambda *_: calls.append(1))
    whole, after = model.sample(*arguments), len(calls)
    torch.testing.assert_close(model.sample(replace(arguments[0], sides=(False, True)), *arguments[1:]), whole)
    assert len(calls) - after < after


@pytest.mark.parametrize(("clips", "used"), [(250, 100), (7, 7)])
def test_thresholds_are_chosen_on_at_most_100_clips(monkeypatch: pytest.MonkeyPatch, clips: int, used: int) -> None:
    monkeypatch.setattr(contact_training, "choose_contact_threshold", lambda network, held_out: len(held_out))
    held_out: Any = SimpleNamespace(held_out=list(range(clips)))
    results = contact_training.CONTACT.results(ContactModel(ContactConfig()), held_out)
    assert results == {"contact_threshold": used}


def test_the_medoid_has_the_best_mean_f1_with_the_others() -> None:
    generator = torch.Generator().manual_seed(3)
    maps = (torch.rand(20, 7, 2, 40, generator=generator) < torch.rand(20, 7, 1, 1, generator=generator)).float()
    maps[0, :, :] = 0  # no point is touched
    for samples, chosen in zip(maps, most_typical(maps), strict=True):
        touched = samples.amax(1).numpy() > 0
        means = [np.mean([f1_score(one, other) for other in touched if other is not one]) for one in touched]
        assert torch.equal(chosen, samples[int(np.argmax(means))]) or touched.sum() == 0


def test_an_outlier_is_never_the_medoid() -> None:
    usual, odd = torch.zeros(2, 30), torch.zeros(2, 30)
    usual[1, :9], odd[0, 20:] = 1, 1
    for index in range(4):
        maps = usual.repeat(1, 4, 1, 1)
        maps[0, index] = odd
        assert torch.equal(most_typical(maps)[0], usual)
    assert torch.equal(most_typical(odd[None, None])[0], odd)


@pytest.mark.long
def test_an_anchored_network_learns_two_modes(batch: ClipBatch) -> None:
    """One object and sentence: touched at the top in half of the clips and at the bottom in the others."""
    torch.manual_seed(0)
    right = next(index for index, flags in enumerate(batch.active_hands.tolist()) if flags == [False, True])
    points = batch.points_m[right].expand(8, -1, -1)
    high = points[..., 2] > points[..., 2].median()
    top = torch.arange(8)[:, None] % 2 == 0
    contact = torch.stack((torch.zeros_like(high), high == top), 1).float()
    active_hands = batch.active_hands[right].expand(8, -1)
    repeated = replace(batch, active_hands=active_hands, scale_m=batch.scale_m[right].expand(8))
    text = batch.text[right, 0].expand(8, -1)
    model, generator = network(), torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(150):
        chosen = torch.randperm(points.shape[1], generator=generator)[:256]
        touch, logits = model.losses(
            replace(repeated, points_m=points[:, chosen]), text, contact[..., chosen], generator
        )
        optimiser.zero_grad()
        terms = by_hand_loss(touch, logits, contact[..., chosen], active_hands)
        (terms["cross_entropy"] + terms["dice"] + terms["touch"]).backward()
        optimiser.step()
    latents = model.eval().draw_latents(16, 1, torch.Generator().manual_seed(1))
    single = replace(repeated, points_m=points[:1], active_hands=active_hands[:1], scale_m=repeated.scale_m[:1])
    maps = model.sample(single, text[:1], latents)[0, :, 1] > 0.5
    kinds = [best_of(contact_map, contact[:2, 1] > 0) for contact_map in maps]
    assert {region for region, _ in kinds} == {0, 1}
    assert sum(f1 for _, f1 in kinds) / len(kinds) > 0.8


def best_of(contact_map: Tensor, regions: Tensor) -> tuple[int, float]:
    f1 = [float(2 * (contact_map & region).sum() / (contact_map.sum() + region.sum())) for region in regions]
    return max(enumerate(f1), key=lambda pair: pair[1])
