"""Noise schedule and samplers: diffusers' schedulers around any denoiser that predicts the clean motion.

Text2HOI: 1,000 steps, cosine schedule (Nichol and Dhariwal 2021), x0-prediction. DDPM walks every step (Ho et al.
2020); DDIM strides over them (Song et al. 2021); DPM-Solver++ (Lu et al. 2022, second order) needs fewer calls still.
A denoiser here is ``x0 = denoise(x_t, t)`` on a pair (hands, object).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from torch import Tensor

from hoidata.clips.features import HAND_FEATURES, OBJECT_FEATURES

TRAIN_STEPS = 1000
Motion = tuple[Tensor, Tensor]
Kind = Literal["ddim", "ddpm", "dpm++"]
Denoise = Callable[[Tensor, Tensor, Tensor], Motion]


@dataclass(frozen=True)
class SamplerConfig:
    """kind: "ddim" and "dpm++" are deterministic after the first noise, "ddpm" is not. steps: denoiser calls.

    guidance: scale of classifier-free guidance; 1 is none.
    """

    kind: Kind = "ddim"
    steps: int = 20
    guidance: float = 1.0


def noise_schedule(kind: Kind = "ddim") -> DDIMScheduler | DDPMScheduler | DPMSolverMultistepScheduler:
    """The cosine schedule over 1,000 steps for x0-prediction, without clipping."""
    shared: dict[str, Any] = {
        "num_train_timesteps": TRAIN_STEPS,
        "beta_schedule": "squaredcos_cap_v2",
        "prediction_type": "sample",
        "timestep_spacing": "trailing",
    }
    if kind == "dpm++":
        return DPMSolverMultistepScheduler(**shared, algorithm_type="dpmsolver++", final_sigmas_type="zero")
    scheduler = DDIMScheduler if kind == "ddim" else DDPMScheduler
    return scheduler(**shared, clip_sample=False)


def alphas_cumprod(device: torch.device | str = "cpu") -> Tensor:
    """(1000,) cumulative signal share of the schedule, alpha-bar of Ho et al. 2020."""
    return noise_schedule().alphas_cumprod.to(device)


def add_noise(clean: Tensor, noise: Tensor, steps: Tensor, signal: Tensor) -> Tensor:
    """The noised motion at steps (B,): Text2HOI eq. 1. ``signal`` is :func:`alphas_cumprod`."""
    share = signal[steps].reshape(-1, *[1] * (clean.ndim - 1))
    return share.sqrt() * clean + (1 - share).sqrt() * noise


def draw_motion(hands_shape: tuple[int, ...], object_shape: tuple[int, ...], generator: torch.Generator) -> Motion:
    """Noise of the given shapes (B, ...) from one generator, a row after the other."""
    sizes = [math.prod(shape[1:]) for shape in (hands_shape, object_shape)]
    return _unflatten(torch.randn(hands_shape[0], sum(sizes), generator=generator), hands_shape, object_shape)


def draw_each(longest: tuple[int, int], rows: tuple[int, int], generators: Sequence[torch.Generator]) -> Motion:
    """Noise (B, 2, K, 99) and (B, L, 10), a generator for each of B motions. rows: K and L.

    The ``longest`` motion's noise is drawn and cut: a motion's noise does not depend on the others of its batch.
    """
    drawn = [
        (
            torch.randn(longest[0], 2, HAND_FEATURES, generator=generator)[: rows[0]].transpose(0, 1),
            torch.randn(longest[1], OBJECT_FEATURES, generator=generator)[: rows[1]],
        )
        for generator in generators
    ]
    return torch.stack([hands for hands, _ in drawn]), torch.stack([objects for _, objects in drawn])


@torch.no_grad()
def sample_motion(
    denoise: Denoise, noise: Motion, config: SamplerConfig, generator: torch.Generator | list[torch.Generator]
) -> Motion:
    """Motions (hands, object) from noise, on the noise's device.

    generator: of the noise that DDPM adds, one for all motions or one for each.
    """
    scheduler = noise_schedule(config.kind)
    scheduler.set_timesteps(config.steps)
    shapes = noise[0].shape, noise[1].shape
    x = torch.cat([part.flatten(1) for part in noise], 1)
    for timestep in scheduler.timesteps:
        hands, objects = _unflatten(x, *shapes)
        timesteps = torch.full((len(x),), int(timestep), device=x.device)
        clean = torch.cat([part.flatten(1) for part in denoise(hands, objects, timesteps)], 1)
        # diffusers draws from a list of generators too, one for each row, though its signature does not say so.
        step = scheduler.step(clean, int(timestep), x, generator=generator, return_dict=False)  # pyright: ignore[reportArgumentType]
        x = step[0]
    return _unflatten(x, *shapes)


def _unflatten(x: Tensor, hands_shape: tuple[int, ...], object_shape: tuple[int, ...]) -> Motion:
    hands, objects = x.split([math.prod(hands_shape[1:]), math.prod(object_shape[1:])], 1)
    return hands.reshape(hands_shape), objects.reshape(object_shape)
