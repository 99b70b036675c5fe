"""Noise schedule and samplers for any denoiser that predicts the clean motion (x0-prediction).

Text2HOI has 1,000 steps and a cosine schedule (Nichol and Dhariwal 2021), BimArt's paper a linear schedule. Samplers:
DDPM takes every step (Ho et al. 2020), DDIM skips steps (Song et al. 2021), and second-order multistep DPM-Solver++ (Lu
et al. 2022) needs even fewer. The schedule is plain numbers, so that no step waits for a GPU.

A denoiser of motions is ``x0 = denoise(x_t, t)`` on a pair (hands, object).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from hoidata.clips.features import HAND_FEATURES, OBJECT_FEATURES
from hoidata.devices import send
from hoidata.errors import BadInput

TRAIN_STEPS = 1000
Motion = tuple[Tensor, Tensor]
Kind = Literal["ddim", "ddpm", "dpm++"]
Schedule = Literal["cosine", "linear"]
FIRST_BETA, LAST_BETA = 1e-4, 0.02  # of the linear schedule (Ho et al. 2020, Sec. 4)
Denoise = Callable[[Tensor, Tensor, Tensor], Motion]


@dataclass(frozen=True)
class SamplerConfig:
    """The sampler and its effort. Raises BadInput for values out of range."""

    kind: Kind = "ddim"  # "ddim" and "dpm++" are deterministic given the initial noise, "ddpm" is not
    steps: int = 20  # denoiser calls, 1 to 1,000

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= TRAIN_STEPS:
            raise BadInput("sampler", f"1 to {TRAIN_STEPS} steps", str(self.steps), "correct steps")


@cache
def alpha_bar_values(schedule: Schedule = "cosine") -> tuple[float, ...]:
    """Alpha-bar (Ho et al. 2020), the fraction of signal variance, at each of the 1,000 steps; betas at most 0.999."""
    if schedule == "linear":
        betas = torch.linspace(FIRST_BETA, LAST_BETA, TRAIN_STEPS, dtype=torch.float64)
        return tuple((1 - betas).cumprod(0).tolist())
    curve = [math.cos((step / TRAIN_STEPS + 0.008) / 1.008 * math.pi / 2) ** 2 for step in range(TRAIN_STEPS + 1)]
    alpha_bars, alpha_bar = [], 1.0
    for step in range(TRAIN_STEPS):
        # 1 - beta of this step; the bound keeps beta at most 0.999.
        alpha_bar *= max(curve[step + 1] / curve[step], 0.001)
        alpha_bars.append(alpha_bar)
    return tuple(alpha_bars)


def alphas_cumprod(device: torch.device | str = "cpu", schedule: Schedule = "cosine") -> Tensor:
    """(1000,) float32 of :func:`alpha_bar_values`."""
    return torch.tensor(alpha_bar_values(schedule)).to(device)


def timesteps(steps: int, start: int = TRAIN_STEPS) -> list[int]:
    """The timesteps of a sampler: evenly spaced from ``start - 1`` down ("trailing", Lin et al. 2024)."""
    return [round(start * (1 - number / steps)) - 1 for number in range(steps)]


def add_noise(clean: Tensor, noise: Tensor, steps: Tensor, alphas_bar: Tensor) -> Tensor:
    """Noise a clean motion to ``steps`` (B,) (Text2HOI, Eq. 1). ``alphas_bar`` (1000,) is :func:`alphas_cumprod`."""
    alpha_bar = alphas_bar[steps].reshape(-1, *[1] * (clean.ndim - 1))
    return alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * noise


def draw_each(
    longest: tuple[int, int],
    sizes: tuple[int, int],
    generators: Sequence[torch.Generator],
    object_features: int = OBJECT_FEATURES,
) -> Motion:
    """Noise (B, 2, K, 99) and (B, L, object_features) with one generator per motion.

    Noise of the ``longest`` motion is generated and cut, so that it does not depend on the other motions of the batch.
    longest: K and L of the longest possible motion. sizes: K and L of this batch.
    """
    noise = [
        (
            torch.randn(longest[0], 2, HAND_FEATURES, generator=generator)[: sizes[0]].transpose(0, 1),
            torch.randn(longest[1], object_features, generator=generator)[: sizes[1]],
        )
        for generator in generators
    ]
    return torch.stack([hands for hands, _ in noise]), torch.stack([objects for _, objects in noise])


@torch.no_grad()
def sample_motion(
    denoise: Denoise, draw: Callable[[], Motion], config: SamplerConfig, device: torch.device | str = "cpu"
) -> Motion:
    """Motions (hands, object) on ``device``.

    draw: standard normal noise of both parts, which the motions start from and which DDPM adds.
    """
    noise = draw()
    shapes = noise[0].shape, noise[1].shape

    def denoise_both(x: Tensor, steps: Tensor) -> Tensor:
        return _flat(denoise(*_unflatten(x, *shapes), steps))

    clean = sample(denoise_both, send(_flat(noise), device), config, lambda: send(_flat(draw()), device))
    return _unflatten(clean, *shapes)


@torch.no_grad()
def sample(
    denoise: Callable[[Tensor, Tensor], Tensor],
    noise: Tensor,
    config: SamplerConfig,
    draw: Callable[[], Tensor],
    schedule: Schedule = "cosine",
    start: int = TRAIN_STEPS,
) -> Tensor:
    """Samples from noise (B, ...), on its device; ``denoise(x, t)`` predicts the clean x at timesteps t (B,).

    noise: standard normal, or clean values noised by ``start`` steps. draw: standard normal noise (B, ...), which DDPM
    adds in every step but the last.
    """
    x, steps, alpha_bars = noise, timesteps(config.steps, start), alpha_bar_values(schedule)
    previous_clean: Tensor | None = None
    for number, step in enumerate(steps):
        alpha_bar = alpha_bars[step]
        next_alpha_bar = alpha_bars[steps[number + 1]] if number + 1 < len(steps) else 1.0
        clean = denoise(x, torch.full((len(x),), step, device=x.device))
        if config.kind == "ddpm":
            added_noise = draw() if next_alpha_bar < 1 else torch.zeros_like(x)
            x = _ddpm(x, clean, alpha_bar, next_alpha_bar, added_noise)
        elif config.kind == "ddim" or next_alpha_bar == 1:
            x = _ddim(x, clean, alpha_bar, next_alpha_bar)
        else:
            last_alpha_bar = alpha_bars[steps[number - 1]] if number else alpha_bar
            x = _dpm_solver(x, clean, previous_clean, last_alpha_bar, alpha_bar, next_alpha_bar)
        previous_clean = clean
    return x


def _ddpm(x: Tensor, clean: Tensor, alpha_bar: float, next_alpha_bar: float, noise: Tensor) -> Tensor:
    """One DDPM step: the posterior of Ho et al. 2020, Eq. 6-7."""
    ratio = alpha_bar / next_alpha_bar
    clean_weight = math.sqrt(next_alpha_bar) * (1 - ratio) / (1 - alpha_bar)
    mean = clean_weight * clean + math.sqrt(ratio) * (1 - next_alpha_bar) / (1 - alpha_bar) * x
    return mean + math.sqrt((1 - next_alpha_bar) / (1 - alpha_bar) * (1 - ratio)) * noise


def _ddim(x: Tensor, clean: Tensor, alpha_bar: float, next_alpha_bar: float) -> Tensor:
    """One DDIM step: Song et al. 2021, Eq. 12 with sigma 0."""
    noise = x - math.sqrt(alpha_bar) * clean
    return math.sqrt(next_alpha_bar) * clean + math.sqrt((1 - next_alpha_bar) / (1 - alpha_bar)) * noise


def _dpm_solver(
    x: Tensor,
    clean: Tensor,
    previous_clean: Tensor | None,
    last_alpha_bar: float,
    alpha_bar: float,
    next_alpha_bar: float,
) -> Tensor:
    """One DPM-Solver++ step: Lu et al. 2022, Algorithm 2; first order without ``previous_clean``."""
    width = _half_log_ratio(next_alpha_bar) - _half_log_ratio(alpha_bar)
    data = clean
    if previous_clean is not None:
        ratio = (_half_log_ratio(alpha_bar) - _half_log_ratio(last_alpha_bar)) / width
        data = clean + (clean - previous_clean) / (2 * ratio)
    return math.sqrt((1 - next_alpha_bar) / (1 - alpha_bar)) * x - math.sqrt(next_alpha_bar) * math.expm1(-width) * data


def _half_log_ratio(alpha_bar: float) -> float:
    """Half the log signal-to-noise ratio."""
    return 0.5 * math.log(alpha_bar / (1 - alpha_bar))


def _flat(motion: Motion) -> Tensor:
    return torch.cat([part.flatten(1) for part in motion], 1)


def _unflatten(x: Tensor, hands_shape: tuple[int, ...], object_shape: tuple[int, ...]) -> Motion:
    hands, objects = x.split([math.prod(hands_shape[1:]), math.prod(object_shape[1:])], 1)
    return hands.reshape(hands_shape), objects.reshape(object_shape)
