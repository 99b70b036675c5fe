"""Noise schedule and samplers: diffusers' schedulers around any denoiser that predicts the clean motion.

Text2HOI: 1,000 steps, cosine schedule (Nichol and Dhariwal 2021), x0-prediction. DDPM walks every step (Ho et al.
2020); DDIM strides over them (Song et al. 2021). A denoiser here is ``x0 = denoise(x_t, t)`` on a pair (hands, object).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from torch import Tensor

TRAIN_STEPS = 1000
Motion = tuple[Tensor, Tensor]
Denoise = Callable[[Tensor, Tensor, Tensor], Motion]


@dataclass(frozen=True)
class SamplerConfig:
    """kind: "ddim" (deterministic after the first noise) or "ddpm"; steps: denoiser calls; guidance: 1 is none."""

    kind: Literal["ddim", "ddpm"] = "ddim"
    steps: int = 20
    guidance: float = 1.0


def noise_schedule(kind: str = "ddim") -> DDIMScheduler | DDPMScheduler:
    """The cosine schedule over 1,000 steps for x0-prediction, without clipping."""
    scheduler = DDIMScheduler if kind == "ddim" else DDPMScheduler
    return scheduler(
        num_train_timesteps=TRAIN_STEPS,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="sample",
        clip_sample=False,
        timestep_spacing="trailing",
    )


def alphas_bar(device: torch.device | str = "cpu") -> Tensor:
    """(1000,) cumulative signal share of the schedule, alpha-bar of Ho et al. 2020."""
    return noise_schedule().alphas_cumprod.to(device)


def add_noise(clean: Tensor, noise: Tensor, steps: Tensor, signal: Tensor) -> Tensor:
    """The noised motion at steps (B,): Text2HOI eq. 1. ``signal`` is :func:`alphas_bar`."""
    share = signal[steps].reshape(-1, *[1] * (clean.ndim - 1))
    return share.sqrt() * clean + (1 - share).sqrt() * noise


@torch.no_grad()
def sample_motion(
    denoise: Denoise, hands_shape: tuple, object_shape: tuple, config: SamplerConfig, generator: torch.Generator
) -> Motion:
    """Motions (hands, object) of the given shapes from noise drawn from ``generator``, on the generator's device."""
    scheduler = noise_schedule(config.kind)
    scheduler.set_timesteps(config.steps)
    flat_sizes = [int(torch.tensor(shape[1:]).prod()) for shape in (hands_shape, object_shape)]
    x = torch.randn(hands_shape[0], sum(flat_sizes), generator=generator, device=generator.device)
    for step in scheduler.timesteps:
        hands, objects = _unflatten(x, flat_sizes, hands_shape, object_shape)
        steps = torch.full((len(x),), int(step), device=x.device)
        clean = torch.cat([part.flatten(1) for part in denoise(hands, objects, steps)], 1)
        x = scheduler.step(clean, int(step), x, generator=generator, return_dict=False)[0]
    return _unflatten(x, flat_sizes, hands_shape, object_shape)


def _unflatten(x: Tensor, sizes: list[int], hands_shape: tuple, object_shape: tuple) -> Motion:
    hands, objects = x.split(sizes, 1)
    return hands.reshape(hands_shape), objects.reshape(object_shape)
