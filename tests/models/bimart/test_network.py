"""BimArt's denoisers: parameter counts, masked inputs have no effect, statistics, settings."""

from dataclasses import fields, replace
from typing import cast

import numpy as np
import pytest
import torch

from models.bimart.network import ContactModel, Denoiser, DenoiserConfig, MotionModel, Windows, contact_channels
from models.bimart.scene import FeatureConfig, RecordedClip, Scene, split_motion
from models.bimart.training import LossConfig, Moments, Targets, window_losses
from tests.models.bimart.test_sampling import TINY


def linear(inputs: int, outputs: int) -> int:
    return inputs * outputs + outputs


@pytest.mark.parametrize(
    ("kind", "numbers", "total"), [(ContactModel, 2048, 24_175_616), (MotionModel, 1200, 26_454_448)]
)
def test_parameters_at_paper_size_are_counted_layer_by_layer(kind, numbers: int, total: int) -> None:
    network = kind(DenoiserConfig())
    latent = 256 if kind is MotionModel else 512  # object and contact share a token
    width, forward, scene = 512, 1024, 2 * 512 * 3 + 6 + 1
    block = (
        linear(width, 3 * width) + linear(width, width) + linear(width, forward) + linear(forward, width) + 4 * width
    )
    expected = {
        "x_in": linear(numbers, width),
        "x_out": linear(width, numbers),
        "step_in": 2 * linear(width, width),
        "object_in": linear(scene, 1024) + linear(1024, 1024) + linear(1024, latent),
        "encoder": 8 * block,
    }
    if kind is MotionModel:
        expected["contact_in"] = linear(2048, 1024) + linear(1024, 1024) + linear(1024, latent)
        expected["null"] = latent
    counts: dict[str, int] = {}
    for name, parameter in network.named_parameters():
        module = name.split(".")[0]
        counts[module] = counts.get(module, 0) + parameter.numel()
    assert counts == expected
    assert sum(counts.values()) == total


def random_windows(lengths: list[int], frames: int, seed: int = 0, config: DenoiserConfig = TINY) -> Windows:
    """Random windows of these lengths, padded to ``frames``; the second has no moving part and no left hand."""
    generator, batch, n_points = torch.Generator().manual_seed(seed), len(lengths), config.features.object_points
    exists, hands = torch.ones(batch, n_points, dtype=torch.bool), torch.ones(batch, 2, dtype=torch.bool)
    exists[1:, : n_points // 2] = False
    hands[1:, 0] = False
    shape = (3 * n_points, config.features.scene_size - 3 * n_points - 1)
    offset, state, contact = (torch.randn(batch, frames, n, generator=generator) for n in (*shape, 2 * n_points))
    frame_mask = torch.arange(frames) < torch.tensor(lengths)[:, None]
    scale = torch.rand(batch, generator=generator)
    return Windows(
        basis_offset=offset,
        state=state,
        object_scale=scale,
        point_exists=exists,
        active_hands=hands,
        frame_mask=frame_mask,
        contact_m=contact,
    )


@pytest.fixture(params=[ContactModel, MotionModel])
def network(request: pytest.FixtureRequest) -> Denoiser:
    torch.manual_seed(0)
    return request.param(TINY).eval()


def predicted(network: Denoiser, windows: Windows, x: torch.Tensor) -> torch.Tensor:
    return network(x, torch.full((len(windows.object_scale),), 399), windows).detach()


def test_padding_has_no_effect(network: Denoiser) -> None:
    windows, x = random_windows([8, 5], 8), torch.randn(2, 8, len(network.mean))
    whole = predicted(network, windows, x)
    corrupted = {name: getattr(windows, name).clone() for name in ("basis_offset", "state", "contact_m")}
    for value in (*corrupted.values(), changed := x.clone()):
        value[1, 5:] = 1e3
    torch.testing.assert_close(predicted(network, replace(windows, **corrupted), changed), whole)
    short = {item.name: getattr(windows, item.name)[1:] for item in fields(windows)}
    short |= {name: short[name][:, :5] for name in ("basis_offset", "state", "contact_m", "frame_mask")}
    torch.testing.assert_close(predicted(network, Windows(**short), x[1:, :5]), whole[1:, :5])
    assert not whole[1, 5:].any()


def test_an_inactive_hand_and_a_missing_part_have_no_effect_and_no_output(network: Denoiser) -> None:
    windows, x = random_windows([8, 8], 8), torch.randn(2, 8, len(network.mean))
    mask, whole = network.channel_mask(windows), predicted(network, windows, x)
    assert not whole[~mask].any()
    corrupted = torch.where(mask, x, 1e3)
    contact = torch.where(contact_channels(windows), windows.contact_m, 1e3)
    offset = torch.where(windows.point_exists.repeat_interleave(3, 1)[:, None], windows.basis_offset, 1e3)
    torch.testing.assert_close(
        predicted(network, replace(windows, contact_m=contact, basis_offset=offset), corrupted), whole
    )
    assert mask[0].all()
    assert 0 < mask[1].float().mean() < 0.6


def test_windows_of_a_batch_are_independent(network: Denoiser) -> None:
    windows, x = random_windows([8, 6], 8), torch.randn(2, 8, len(network.mean))
    alone = {item.name: getattr(windows, item.name)[:1] for item in fields(windows)}
    torch.testing.assert_close(predicted(network, Windows(**alone), x[:1]), predicted(network, windows, x)[:1])


def test_a_dropped_contact_map_has_no_effect_and_the_contact_model_has_no_map(network: Denoiser) -> None:
    windows, x, steps = random_windows([8, 8], 8), torch.randn(2, 8, len(network.mean)), torch.full((2,), 399)
    other = replace(windows, contact_m=windows.contact_m * 2)
    outputs = [network(x, steps, condition, torch.tensor([True, False])) for condition in (windows, other)]
    torch.testing.assert_close(outputs[0][0], outputs[1][0])
    assert torch.equal(outputs[0][1], outputs[1][1]) == isinstance(network, ContactModel)


@pytest.mark.parametrize("change", [{"latents": "concatenate"}, {"latents": "joint"}, {"knot_frames": 4}])
def test_the_same_holds_for_every_kind_of_encoding(change: dict) -> None:
    network = MotionModel(replace(TINY, **change)).eval()
    test_padding_has_no_effect(network)
    test_an_inactive_hand_and_a_missing_part_have_no_effect_and_no_output(network)
    test_a_dropped_contact_map_has_no_effect_and_the_contact_model_has_no_map(network)


def test_encode_uses_the_statistics_and_the_signal_scale_and_decode_is_its_inverse() -> None:
    network = ContactModel(replace(TINY, signal_scale=0.2))
    network.mean.copy_(torch.arange(12.0))
    network.scale.copy_(torch.arange(1.0, 13))
    values = torch.randn(5, 12)
    torch.testing.assert_close(network.encode(values), 0.2 * (values - torch.arange(12)) / torch.arange(1, 13))
    torch.testing.assert_close(network.decode(network.encode(values)), values)


def test_moments_are_those_of_the_known_values() -> None:
    rng = np.random.default_rng(0)
    values, mask = rng.normal(2, 3, (40, 3)), rng.random((40, 3)) < 0.7
    mask[:, 2] = False
    moments = Moments(3)
    for rows in (slice(0, 25), slice(25, None)):
        moments.add(torch.from_numpy(values[None, rows]), torch.from_numpy(mask[None, rows]))
    mean, std = (tensor.numpy() for tensor in moments.mean_and_std())
    for column in range(2):
        values_known = values[mask[:, column], column]
        np.testing.assert_allclose((mean[column], std[column]), (values_known.mean(), values_known.std()), rtol=1e-9)
    assert (mean[2], std[2]) == (0, 1)


def test_a_motion_is_keypoints_left_and_right_then_vectors_to_the_object_left_and_right() -> None:
    rng, features = np.random.default_rng(0), FeatureConfig(keypoints=4)
    points, vectors = rng.normal(size=(2, 2, 3, 4, 3))
    rows = RecordedClip(
        scene=cast(Scene, None),
        contact_m=vectors,
        keypoints_m=points,
        to_object_m=vectors,
        present=vectors,
        active_hands=vectors,
    ).motion
    expected = [points[0, 1].ravel(), points[1, 1].ravel(), vectors[0, 1].ravel(), vectors[1, 1].ravel()]
    np.testing.assert_array_equal(rows[1], np.concatenate(expected))
    assert rows.shape == (3, features.motion_size)
    for array, restored in zip((points, vectors), split_motion(rows), strict=True):
        np.testing.assert_array_equal(restored, array)
    left = features.spread_over_motion(torch.tensor([True, False])).numpy()
    np.testing.assert_array_equal(rows[1][left], np.concatenate((expected[0], expected[2])))


class ZeroModel(MotionModel):
    """Predicts zeros, so that the error is the clean motion."""

    def forward(self, x: torch.Tensor, steps: torch.Tensor, windows: Windows, drop: torch.Tensor | None = None):
        return torch.zeros_like(x)


def test_the_velocity_loss_is_the_error_of_differences_between_frames() -> None:
    network, windows = ZeroModel(TINY), random_windows([6, 6], 6)
    clean, mask = torch.randn(2, 6, len(network.mean)), torch.rand(2, 6, len(network.mean)) < 0.8
    target = Targets(windows, clean, mask, contact_channels(windows))
    losses = window_losses(network, target, LossConfig(velocity_weight=2.0), torch.Generator().manual_seed(0))
    both_known = (mask[:, 1:] & mask[:, :-1]).numpy()
    velocity = np.diff(clean.numpy(), axis=1)[both_known] ** 2
    assert losses["velocity"].item() == pytest.approx(velocity.mean(), rel=1e-5)
    assert losses["total"].item() == pytest.approx((clean[mask] ** 2).mean().item() + 2 * velocity.mean(), rel=1e-5)
