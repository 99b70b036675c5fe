"""Samplers compared with closed forms and with diffusers; the cost of absent hands."""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, collate
from hoidata.errors import BadInput
from models.common import sampling
from models.common.sampling import (
    Motion,
    SamplerConfig,
    alpha_bar_values,
    alphas_cumprod,
    draw_each,
    sample,
    sample_motion,
    timesteps,
)
from models.common.transformer import TransformerConfig
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel

MEANS, SPREADS = (0.0, 0.5, -2.0), (0.4, 0.8, 1.5)


def gaussian_denoiser(mean: Tensor, spread: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """E[x0 | x_t] of data from N(mean, spread^2): the optimal denoiser."""
    alpha_bars = torch.tensor(alpha_bar_values(), dtype=torch.float64)

    def denoise(x: Tensor, steps: Tensor) -> Tensor:
        alpha_bar = alpha_bars[steps][:, None]
        gain = spread**2 * alpha_bar.sqrt() / (alpha_bar * spread**2 + 1 - alpha_bar)
        return mean + gain * (x - alpha_bar.sqrt() * mean)

    return denoise


def like(noise: Tensor, generator: torch.Generator) -> Callable[[], Tensor]:
    return lambda: torch.randn(noise.shape, generator=generator)


def moments(kind: Any, steps: int, count: int = 40_000) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of a sampler's output for the three Gaussians."""
    mean, spread = (torch.tensor(values, dtype=torch.float64) for values in (MEANS, SPREADS))
    generator = torch.Generator().manual_seed(0)
    half = torch.randn(count // 2, 3, generator=generator, dtype=torch.float64)
    noise = torch.cat((half, -half)) / half.square().mean(0).sqrt()  # mean 0 and spread 1, exactly
    samples = sample(gaussian_denoiser(mean, spread), noise, SamplerConfig(kind, steps), like(noise, generator))
    return samples.mean(0), samples.std(0, correction=0)


def off(kind: Any, steps: int) -> float:
    """Largest error of a moment, relative to the standard deviation."""
    mean, spread = moments(kind, steps)
    expected = torch.tensor(MEANS, dtype=torch.float64), torch.tensor(SPREADS, dtype=torch.float64)
    return float(torch.maximum((mean - expected[0]).abs() / expected[1], (spread / expected[1] - 1).abs()).max())


@pytest.mark.long
@pytest.mark.parametrize(("kind", "few", "many"), [("ddim", 10, 250), ("dpm++", 6, 60), ("ddpm", 20, 1000)])
def test_moments_of_gaussians_are_within_3_percent_and_closer_with_more_steps(kind: str, few: int, many: int) -> None:
    assert off(kind, many) < 0.03
    assert off(kind, many) < off(kind, few) / 2


def test_the_second_order_needs_fewer_steps_than_ddim() -> None:
    assert off("dpm++", 20) < off("ddim", 20) / 2


@pytest.mark.parametrize("kind", ["ddim", "dpm++", "ddpm"])
def test_another_schedule_than_the_denoisers_gives_other_moments(kind: Any) -> None:
    mean, spread = (torch.tensor(values, dtype=torch.float64) for values in (MEANS, SPREADS))
    denoise = gaussian_denoiser(mean, spread)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(20_000, 3, generator=generator, dtype=torch.float64)
    samples = sample(denoise, noise, SamplerConfig(kind, 50), like(noise, generator), "linear")
    assert float((samples.std(0) / spread - 1).abs().max()) > 0.1


@pytest.mark.slow  # importing diffusers takes five seconds
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
@pytest.mark.parametrize(
    ("kind", "scheduler", "more"),
    [
        ("ddim", "ddim.DDIMScheduler", {"clip_sample": False}),
        ("ddpm", "ddpm.DDPMScheduler", {"clip_sample": False}),
        (
            "dpm++",
            "dpmsolver_multistep.DPMSolverMultistepScheduler",
            {"algorithm_type": "dpmsolver++", "final_sigmas_type": "zero"},
        ),
    ],
)
def test_every_step_is_that_of_diffusers(kind: Any, scheduler: str, more: dict) -> None:
    module, _, name = scheduler.partition(".")
    scheduler_class = getattr(import_module(f"diffusers.schedulers.scheduling_{module}"), name)
    shared = {"num_train_timesteps": 1000, "beta_schedule": "squaredcos_cap_v2", "prediction_type": "sample"}
    theirs = scheduler_class(**shared, timestep_spacing="trailing", **more)
    theirs.set_timesteps(20)
    assert theirs.timesteps.tolist() == timesteps(20)
    torch.testing.assert_close(theirs.alphas_cumprod, alphas_cumprod(), atol=1e-6, rtol=1e-3)
    generators = [torch.Generator().manual_seed(1) for _ in range(2)]
    x = noise = torch.randn(2, 4, generator=torch.Generator().manual_seed(0))
    for step in theirs.timesteps:
        more_noise = {} if kind == "ddim" else {"generator": generators[0]}
        x = theirs.step(torch.tanh(x), step, x, return_dict=False, **more_noise)[0]
    samples = sample(lambda x, _: torch.tanh(x), noise, SamplerConfig(kind, 20), like(noise, generators[1]))
    torch.testing.assert_close(samples, x, atol=2e-3 if kind == "ddpm" else 1e-4, rtol=0)


def test_the_schedule_is_nichol_and_dhariwals_cosine() -> None:
    time = torch.arange(1001, dtype=torch.float64) / 1000
    curve = torch.cos((time + 0.008) / 1.008 * torch.pi / 2) ** 2
    betas = (1 - curve[1:] / curve[:-1]).clamp_max(0.999)
    torch.testing.assert_close(alphas_cumprod().double(), (1 - betas).cumprod(0), atol=1e-6, rtol=1e-5)


def test_the_linear_schedule_is_that_of_ho_et_al() -> None:
    expected = np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))
    np.testing.assert_allclose(alphas_cumprod(schedule="linear"), expected, rtol=1e-5)


def test_a_perfect_denoiser_returns_the_clean_motion() -> None:
    generator = torch.Generator().manual_seed(0)
    truth = torch.randn(3, 2, 7, 99, generator=generator), torch.randn(3, 7, 10, generator=generator)
    for kind, steps in (("ddim", 1), ("ddim", 20), ("dpm++", 8), ("ddpm", 50)):
        config = SamplerConfig(kind, steps)  # pyright: ignore[reportArgumentType]
        draw = partial(draw_each, (7, 7), (7, 7), [generator] * 3)
        for denoised, true in zip(sample_motion(lambda *_: truth, draw, config), truth, strict=True):
            torch.testing.assert_close(denoised, true, atol=1e-4, rtol=0)


def test_a_ddpm_motion_depends_on_its_generator_and_not_on_the_other_motions_of_a_batch() -> None:
    def motion(seeds: list[int], n_frames: int) -> Motion:
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        draw = partial(draw_each, (60, 60), (n_frames, n_frames), generators)
        return sample_motion(lambda *parts: (parts[0].tanh(), parts[1].tanh()), draw, SamplerConfig("ddpm", 20))

    (hands, objects), (of_three, other_objects) = motion([7], 24), motion([5, 6, 7], 40)
    torch.testing.assert_close(of_three[2:, :, :24], hands)
    torch.testing.assert_close(other_objects[2:, :24], objects)
    assert len({round(float(value), 6) for value in of_three[:, 0, 0, 0]}) == 3


def small_model() -> DiffusionModel:
    torch.manual_seed(0)
    return DiffusionModel(
        DiffusionConfig(TransformerConfig(width=32, layers=2, heads=2, feed_forward=64, dropout=0.0))
    ).eval()


def condition_of(batch: ClipBatch) -> Condition:
    return Condition(batch, batch.text[:, 0], [None] * len(batch), batch.contact)


@torch.no_grad()
def test_inactive_hands_and_padding_are_cut_instead_of_masked(batch: ClipBatch) -> None:
    """One hand, F frames: one condition token and F tokens each of the hand and the object."""
    model, tokens = small_model(), []
    model.encoder.register_forward_pre_hook(lambda _, inputs: tokens.append(inputs[0].shape[1]))
    alone, both = collate([batch.samples[0]]), collate(batch.samples[2:])
    for clips in (alone, both):
        model(clips.hands, clips.object, torch.zeros(1, dtype=torch.long), condition_of(clips))
    assert tokens == [1 + 2 * alone.counts[0], 1 + 3 * both.counts[0]]
    hands, _ = model(alone.hands, alone.object, torch.zeros(1, dtype=torch.long), condition_of(alone))
    assert not hands[:, 1].any()


@pytest.mark.parametrize("steps", [0, 1001])
def test_steps_out_of_range_are_refused(steps: int) -> None:
    with pytest.raises(BadInput, match="1 to 1000 steps"):
        sampling.SamplerConfig(steps=steps)
