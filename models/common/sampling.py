"""Noise schedule and samplers around any denoiser that predicts what is clean.

Text2HOI: 1,000 steps, cosine schedule (Nichol and Dhariwal 2021), x0-prediction. DDPM walks every step (Ho et al.
2020); DDIM strides over them (Song et al. 2021); DPM-Solver++ (Lu et al. 2022, second order, multistep) needs fewer
calls still. The schedule is plain numbers: no step waits for a device. A denoiser of motions is
``x0 = denoise(x_t, t)`` on a pair (hands, object).
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
Denoise = Callable[[Tensor, Tensor, Tensor], Motion]


@dataclass(frozen=True)
class SamplerConfig:
    """kind: "ddim" and "dpm++" are deterministic after the first noise, "ddpm" is not. steps: denoiser calls.

    guidance: scale of classifier-free guidance; 1 is none. Raises BadInput for steps that are not there.
    """

    kind: Kind = "ddim"
    steps: int = 20
    guidance: float = 1.0

    def __post_init__(self) -> None:
        if not (1 <= self.steps <= TRAIN_STEPS and math.isfinite(self.guidance)):
            wanted, got = f"1 to {TRAIN_STEPS} steps, a finite guidance", f"{self.steps}, {self.guidance:g}"
            raise BadInput("sampler", wanted, got, "correct steps, or guidance (--scale)")


@cache
def signal_shares() -> tuple[float, ...]:
    """Cumulative signal share of each of the 1,000 steps: alpha-bar of Ho et al. 2020, betas at most 0.999."""
    curve = [math.cos((step / TRAIN_STEPS + 0.008) / 1.008 * math.pi / 2) ** 2 for step in range(TRAIN_STEPS + 1)]
    shares, share = [], 1.0
    for step in range(TRAIN_STEPS):
        share *= max(curve[step + 1] / curve[step], 0.001)
        shares.append(share)
    return tuple(shares)


def alphas_cumprod(device: torch.device | str = "cpu") -> Tensor:
    """(1000,) float32 of :func:`signal_shares`."""
    return torch.tensor(signal_shares()).to(device)


def timesteps(steps: int) -> list[int]:
    """The steps that are walked: from the last of the 1,000 down, evenly ("trailing", Lin et al. 2024)."""
    return [round(TRAIN_STEPS * (1 - number / steps)) - 1 for number in range(steps)]


def add_noise(clean: Tensor, noise: Tensor, steps: Tensor, signal: Tensor) -> Tensor:
    """The noised motion at steps (B,): Text2HOI eq. 1. ``signal`` is :func:`alphas_cumprod`."""
    share = signal[steps].reshape(-1, *[1] * (clean.ndim - 1))
    return share.sqrt() * clean + (1 - share).sqrt() * noise


def draw_motion(hands_shape: tuple[int, ...], object_shape: tuple[int, ...], generator: torch.Generator) -> Motion:
    """Noise of the given shapes (B, ...) from one generator, a row after the other."""
    sizes = [math.prod(shape[1:]) for shape in (hands_shape, object_shape)]
    return _unflatten(torch.randn(hands_shape[0], sum(sizes), generator=generator), hands_shape, object_shape)


def draw_each(
    longest: tuple[int, int],
    rows: tuple[int, int],
    generators: Sequence[torch.Generator],
    object_features: int = OBJECT_FEATURES,
) -> Motion:
    """Noise (B, 2, K, 99) and (B, L, object_features), a generator for each of B motions. rows: K and L.

    The ``longest`` motion's noise is drawn and cut: a motion's noise does not depend on the others of its batch.
    """
    drawn = [
        (
            torch.randn(longest[0], 2, HAND_FEATURES, generator=generator)[: rows[0]].transpose(0, 1),
            torch.randn(longest[1], object_features, generator=generator)[: rows[1]],
        )
        for generator in generators
    ]
    return torch.stack([hands for hands, _ in drawn]), torch.stack([objects for _, objects in drawn])


@torch.no_grad()
def sample_motion(
    denoise: Denoise, noise: Motion, config: SamplerConfig, generator: torch.Generator | list[torch.Generator]
) -> Motion:
    """Motions (hands, object) from noise, on the noise's device; ``generator`` as in :func:`sample`."""
    shapes = noise[0].shape, noise[1].shape

    def denoise_both(x: Tensor, steps: Tensor) -> Tensor:
        return torch.cat([part.flatten(1) for part in denoise(*_unflatten(x, *shapes), steps)], 1)

    return _unflatten(
        sample(denoise_both, torch.cat([part.flatten(1) for part in noise], 1), config, generator), *shapes
    )


@torch.no_grad()
def sample(
    denoise: Callable[[Tensor, Tensor], Tensor],
    noise: Tensor,
    config: SamplerConfig,
    generator: torch.Generator | list[torch.Generator],
) -> Tensor:
    """Samples from noise (B, ...), on its device; ``denoise(x, t)`` gives what is clean in x at timesteps (B,).

    generator: of the noise that DDPM adds, one for all rows or one for each.
    """
    x, walked, shares = noise, timesteps(config.steps), signal_shares()
    before: Tensor | None = None
    for number, step in enumerate(walked):
        now, then = shares[step], shares[walked[number + 1]] if number + 1 < len(walked) else 1.0
        clean = denoise(x, torch.full((len(x),), step, device=x.device))
        if config.kind == "ddpm":
            fresh = _drawn(x, generator) if then < 1 else torch.zeros_like(x)
            x = _ddpm(x, clean, now, then, fresh)
        elif config.kind == "ddim" or then == 1:
            x = _ddim(x, clean, now, then)
        else:
            last = shares[walked[number - 1]] if number else now
            x = _dpm_solver(x, clean, before, last, now, then)
        before = clean
    return x


def _ddpm(x: Tensor, clean: Tensor, now: float, then: float, fresh: Tensor) -> Tensor:
    """Ho et al. 2020, eq. 6-7: the posterior of a step, between signal shares ``now`` and ``then``."""
    ratio = now / then
    mean = math.sqrt(then) * (1 - ratio) / (1 - now) * clean + math.sqrt(ratio) * (1 - then) / (1 - now) * x
    return mean + math.sqrt((1 - then) / (1 - now) * (1 - ratio)) * fresh


def _ddim(x: Tensor, clean: Tensor, now: float, then: float) -> Tensor:
    """Song et al. 2021, eq. 12 with sigma 0."""
    return math.sqrt(then) * clean + math.sqrt((1 - then) / (1 - now)) * (x - math.sqrt(now) * clean)


def _dpm_solver(x: Tensor, clean: Tensor, before: Tensor | None, last: float, now: float, then: float) -> Tensor:
    """Lu et al. 2022 (DPM-Solver++), algorithm 2; its first step, without one ``before``, is of first order."""
    width = _half_log_ratio(then) - _half_log_ratio(now)
    data = clean
    if before is not None:
        share = (_half_log_ratio(now) - _half_log_ratio(last)) / width
        data = clean + (clean - before) / (2 * share)
    return math.sqrt((1 - then) / (1 - now)) * x - math.sqrt(then) * math.expm1(-width) * data


def _half_log_ratio(share: float) -> float:
    """Half the logarithm of signal over noise."""
    return 0.5 * math.log(share / (1 - share))


def _drawn(x: Tensor, generator: torch.Generator | list[torch.Generator]) -> Tensor:
    if isinstance(generator, list):
        return send(torch.stack([torch.randn(x.shape[1:], generator=own) for own in generator]), x.device)
    return send(torch.randn(x.shape, generator=generator), x.device)


def _unflatten(x: Tensor, hands_shape: tuple[int, ...], object_shape: tuple[int, ...]) -> Motion:
    hands, objects = x.split([math.prod(hands_shape[1:]), math.prod(object_shape[1:])], 1)
    return hands.reshape(hands_shape), objects.reshape(object_shape)
