"""Promises of BimArt's denoisers: sizes layer by layer, what is not there changes nothing, statistics, switches."""

from dataclasses import fields, replace
from typing import cast

import numpy as np
import pytest
import torch

from hoidata.sensors.part_bps import BasisSettings
from models.bimart.learning import Moments
from models.bimart.network import ContactModel, Denoiser, DenoiserConfig, MotionModel, Windows, contact_channels
from models.bimart.scene import FeatureConfig, Recorded, Scene, split_motion
from models.common.transformer import TransformerConfig

FEATURES = FeatureConfig(BasisSettings(3), keypoints=4, window=8, state="local")
TINY = DenoiserConfig(FEATURES, TransformerConfig(16, 1, 2, 16, 0.0), (8,), told=True, position_dropout=0.0)


def linear(inputs: int, outputs: int) -> int:
    return inputs * outputs + outputs


@pytest.mark.parametrize(
    ("kind", "numbers", "total"), [(ContactModel, 2048, 24_175_616), (MotionModel, 1200, 26_454_448)]
)
def test_parameters_at_paper_size_are_counted_layer_by_layer(kind, numbers: int, total: int) -> None:
    network = kind(DenoiserConfig())
    latent = 256 if kind is MotionModel else 512  # half a token each of object and contact
    width, forward, scene = 512, 1024, 2 * 512 * 3 + 6 + 1
    block = (
        linear(width, 3 * width) + linear(width, width) + linear(width, forward) + linear(forward, width) + 4 * width
    )
    wanted = {
        "x_in": linear(numbers, width),
        "x_out": linear(width, numbers),
        "step_in": 2 * linear(width, width),
        "object_in": linear(scene, 1024) + linear(1024, 1024) + linear(1024, latent),
        "encoder": 8 * block,
    }
    if kind is MotionModel:
        wanted["contact_in"] = linear(2048, 1024) + linear(1024, 1024) + linear(1024, latent)
        wanted["null"] = latent
    found: dict[str, int] = {}
    for name, parameter in network.named_parameters():
        own = name.split(".")[0]
        found[own] = found.get(own, 0) + parameter.numel()
    assert found == wanted
    assert sum(found.values()) == total


def drawn(lengths: list[int], frames: int, seed: int = 0, config: DenoiserConfig = TINY) -> Windows:
    """Random windows of these lengths, padded to ``frames``; the second has no moving part and no left hand."""
    draws, batch, places = torch.Generator().manual_seed(seed), len(lengths), config.features.places
    there, hands = torch.ones(batch, places, dtype=torch.bool), torch.ones(batch, 2, dtype=torch.bool)
    there[1:, : places // 2] = False
    hands[1:, 0] = False
    shape = (3 * places, config.features.scene_size - 3 * places - 1)
    offset, state, contact = (torch.randn(batch, frames, n, generator=draws) for n in (*shape, 2 * places))
    known = torch.arange(frames) < torch.tensor(lengths)[:, None]
    return Windows(offset, state, torch.rand(batch, generator=draws), there, hands, known, contact)


@pytest.fixture(params=[ContactModel, MotionModel])
def network(request: pytest.FixtureRequest) -> Denoiser:
    torch.manual_seed(0)
    return request.param(TINY).eval()


def made(network: Denoiser, windows: Windows, x: torch.Tensor) -> torch.Tensor:
    return network(x, torch.full((len(windows),), 399), windows).detach()


def test_padding_and_what_stands_in_it_change_nothing(network: Denoiser) -> None:
    windows, x = drawn([8, 5], 8), torch.randn(2, 8, len(network.mean))
    whole = made(network, windows, x)
    spoilt = {name: getattr(windows, name).clone() for name in ("offset", "state", "contact_m")}
    for value in (*spoilt.values(), changed := x.clone()):
        value[1, 5:] = 1e3
    torch.testing.assert_close(made(network, replace(windows, **spoilt), changed), whole)
    short = {item.name: getattr(windows, item.name)[1:] for item in fields(windows)}
    short |= {name: short[name][:, :5] for name in ("offset", "state", "contact_m", "frames")}
    torch.testing.assert_close(made(network, Windows(**short), x[1:, :5]), whole[1:, :5])
    assert not whole[1, 5:].any()


def test_a_hand_and_a_part_that_are_not_there_neither_enter_nor_are_made(network: Denoiser) -> None:
    windows, x = drawn([8, 8], 8), torch.randn(2, 8, len(network.mean))
    mask, whole = network.channel_mask(windows), made(network, windows, x)
    assert not whole[~mask].any()
    spoilt = torch.where(mask, x, 1e3)
    assert windows.contact_m is not None
    contact = torch.where(contact_channels(windows), windows.contact_m, 1e3)
    offset = torch.where(windows.there.repeat_interleave(3, 1)[:, None], windows.offset, 1e3)
    torch.testing.assert_close(made(network, replace(windows, contact_m=contact, offset=offset), spoilt), whole)
    assert mask[0].all()
    assert 0 < mask[1].float().mean() < 0.6


def test_a_batch_of_windows_is_each_by_itself(network: Denoiser) -> None:
    windows, x = drawn([8, 6], 8), torch.randn(2, 8, len(network.mean))
    alone = {item.name: getattr(windows, item.name)[:1] for item in fields(windows)}
    torch.testing.assert_close(made(network, Windows(**alone), x[:1]), made(network, windows, x)[:1])


def test_the_map_is_not_seen_where_it_is_dropped_and_the_contact_model_never_sees_one(network: Denoiser) -> None:
    windows, x, steps = drawn([8, 8], 8), torch.randn(2, 8, len(network.mean)), torch.full((2,), 399)
    assert windows.contact_m is not None
    other = replace(windows, contact_m=windows.contact_m * 2)
    both = [network(x, steps, own, torch.tensor([True, False])) for own in (windows, other)]
    torch.testing.assert_close(both[0][0], both[1][0])
    assert torch.equal(both[0][1], both[1][1]) == isinstance(network, ContactModel)


@pytest.mark.parametrize("change", [{"latents": "concatenate"}, {"latents": "joint"}, {"knot_frames": 4}])
def test_every_kind_of_encoding_keeps_these_promises(change: dict) -> None:
    network = MotionModel(replace(TINY, **change)).eval()
    test_padding_and_what_stands_in_it_change_nothing(network)
    test_a_hand_and_a_part_that_are_not_there_neither_enter_nor_are_made(network)
    test_the_map_is_not_seen_where_it_is_dropped_and_the_contact_model_never_sees_one(network)


def test_encoding_takes_the_statistics_and_the_scale_of_the_signal_and_goes_back() -> None:
    network = ContactModel(replace(TINY, signal_scale=0.2))
    network.mean.copy_(torch.arange(12.0))
    network.scale.copy_(torch.arange(1.0, 13))
    values = torch.randn(5, 12)
    torch.testing.assert_close(network.encode(values), 0.2 * (values - torch.arange(12)) / torch.arange(1, 13))
    torch.testing.assert_close(network.decode(network.encode(values)), values)


def test_moments_are_of_what_is_known_alone() -> None:
    draws = np.random.default_rng(0)
    values, known = draws.normal(2, 3, (40, 3)), draws.random((40, 3)) < 0.7
    known[:, 2] = False
    moments = Moments(3)
    for rows in (slice(0, 25), slice(25, None)):
        moments.add(torch.from_numpy(values[None, rows]), torch.from_numpy(known[None, rows]))
    mean, spread = (found.numpy() for found in moments.found())
    for column in range(2):
        own = values[known[:, column], column]
        np.testing.assert_allclose((mean[column], spread[column]), (own.mean(), own.std()), rtol=1e-9)
    assert (mean[2], spread[2]) == (0, 1)


def test_a_motion_is_keypoints_left_and_right_then_vectors_to_the_object_left_and_right() -> None:
    draws, features = np.random.default_rng(0), FeatureConfig(keypoints=4)
    points, vectors = draws.normal(size=(2, 2, 3, 4, 3))
    rows = Recorded(cast(Scene, None), vectors, points, vectors, vectors, vectors).motion
    wanted = [points[0, 1].ravel(), points[1, 1].ravel(), vectors[0, 1].ravel(), vectors[1, 1].ravel()]
    np.testing.assert_array_equal(rows[1], np.concatenate(wanted))
    assert rows.shape == (3, features.motion_size)
    for own, back in zip((points, vectors), split_motion(rows), strict=True):
        np.testing.assert_array_equal(back, own)
    left = features.of_hands(torch.tensor([True, False])).numpy()
    np.testing.assert_array_equal(rows[1][left], np.concatenate((wanted[0], wanted[2])))
