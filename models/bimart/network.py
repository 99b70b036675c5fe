"""Both denoisers of BimArt: Transformer encoders over frames, conditioned on the object's motion (Secs. 3.2 and 3.3).

Token 0 is the diffusion step. Each further token is one frame (or a few) of the noised values, plus the encodings of
that frame's object and contact map. The network predicts the clean values, normalised.

``Layout`` cuts a motion into windows and joins them again. ``build_windows`` makes the condition of windows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from hoidata.devices import send
from models.bimart.scene import FeatureConfig, Scene
from models.common.sampling import TRAIN_STEPS, Schedule, alphas_cumprod
from models.common.spline import projected
from models.common.transformer import Encoder, TransformerConfig, attention_mask_of, sinusoid, to_frames, to_tokens


@dataclass(frozen=True)
class DenoiserConfig:
    """Architecture of one denoiser; the defaults are the paper's, but for the noise schedule of its released code."""

    features: FeatureConfig = field(default_factory=FeatureConfig)
    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    encoder: tuple[int, ...] = (1024, 1024)  # hidden widths of the object encoder and of the contact encoder
    # "concatenate" (paper): object and contact latents have half a token's width each. "joint": one encoder takes both,
    # so it can relate a contact distance to its object point.
    latents: Literal["concatenate", "joint"] = "concatenate"
    condition_on_hands: bool = False  # on which hands are active; inactive hands are masked in input and output
    diffusion_steps: int = 50  # trained steps of the 1,000: 50 are sampled one by one, 1,000 by any sampler
    noise_schedule: Schedule = "cosine"
    position_dropout: float = 0.1  # of tokens with their positional encoding
    min_std_fraction: float = 0.0  # normalisation: least standard deviation, relative to that of its group
    knot_frames: int = 0  # the output is a spline with a control point every so many frames; 0: any values
    signal_scale: float = 1.0  # standard deviation of clean values; smaller decides the motion later (Chen 2023)


@dataclass(frozen=True)
class Windows:
    """The condition of B windows of F frames. All but ``contact_m`` come from the object's motion."""

    basis_offset: Tensor  # (B, F, 3N) O
    state: Tensor  # (B, F, S) G
    object_scale: Tensor  # (B,)
    point_exists: Tensor  # (B, N) bool, object points of parts that the object has
    active_hands: Tensor  # (B, 2) bool, left and right
    frame_mask: Tensor  # (B, F) bool, False for padding
    contact_m: Tensor | None = None  # (B, F, 2N) left then right; None for the contact model

    def to(self, device: torch.device | str) -> Self:
        tensors = {name: send(value, device) for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **tensors)


@dataclass(frozen=True)
class EncodedWindows:
    """Windows encoded once for all diffusion steps."""

    conditional: Tensor  # (B, token, width), with the contact map
    unconditional: Tensor  # (B, token, width), with the null embedding instead
    attention_mask: Tensor  # (B, token + 1) bool
    channel_mask: Tensor  # (B, F, D) bool, values that exist
    lengths: list[int]  # frames of each window

    def doubled(self) -> "EncodedWindows":
        """All windows twice, first with and then without the contact map, both as ``conditional``."""
        both = torch.cat((self.conditional, self.unconditional))
        attention_mask, channel_mask = (torch.cat((mask, mask)) for mask in (self.attention_mask, self.channel_mask))
        return EncodedWindows(both, both, attention_mask, channel_mask, 2 * self.lengths)


class Denoiser(nn.Module):
    """``clean = network(x, steps, windows)`` of ``size`` numbers D per frame; contact maps are optional conditions."""

    input_mean: Tensor  # of O, G and scale
    input_scale: Tensor
    mean: Tensor  # of the denoised values
    scale: Tensor
    contact_mean: Tensor
    contact_scale: Tensor
    basis_points: Tensor
    keypoint_ids: Tensor
    signal: Tensor

    def __init__(self, config: DenoiserConfig, size: int, with_contact: bool) -> None:
        super().__init__()
        self.config, self.with_contact = config, with_contact
        features, width = config.features, config.transformer.width
        frames_per_token = config.transformer.frames_per_token
        self.x_in, self.x_out = nn.Linear(frames_per_token * size, width), nn.Linear(width, frames_per_token * size)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        latent = width // 2 if config.latents == "concatenate" and with_contact else width
        self.is_joint = config.latents == "joint" and with_contact
        object_inputs = features.scene_size + self.is_joint * features.contact_size
        self.object_in = _layers(object_inputs, config.encoder, latent)
        self.hands_in = nn.Linear(2, width, bias=False) if config.condition_on_hands else None
        self.tokens_in = nn.Linear(frames_per_token * width, width) if frames_per_token > 1 else nn.Identity()
        if with_contact:
            null_size = features.contact_size if self.is_joint else latent
            self.contact_in = nn.Identity() if self.is_joint else _layers(features.contact_size, config.encoder, latent)
            self.null = nn.Parameter(0.02 * torch.randn(1, null_size))
        self.encoder, self.drop = Encoder(config.transformer), nn.Dropout(config.position_dropout)
        for name, count in (("input", features.scene_size), ("", size), ("contact", features.contact_size)):
            self.register_buffer(f"{name}_mean".strip("_"), torch.zeros(count))
            self.register_buffer(f"{name}_scale".strip("_"), torch.ones(count))
        self.register_buffer("signal", alphas_cumprod(schedule=config.noise_schedule), persistent=False)
        self.register_buffer("basis_points", torch.from_numpy(features.basis.points()))
        self.register_buffer("keypoint_ids", torch.zeros(features.keypoints, dtype=torch.long))

    def channel_mask(self, windows: Windows) -> Tensor:
        """(B, F, D) bool: values of existing parts, active hands and frames that are not padding."""
        raise NotImplementedError

    def forward(self, x: Tensor, steps: Tensor, windows: Windows, drop: Tensor | None = None) -> Tensor:
        """Predict clean from noised values (B, F, D), both normalised, at diffusion steps (B,) from 0 to 999.

        drop: (B,) bool, windows whose contact map is dropped.
        """
        encoded = self.prepare(windows)
        tokens = encoded.conditional
        if drop is not None:
            tokens = torch.where(drop[:, None, None], encoded.unconditional, tokens)
        return self.denoise(x, steps, encoded, tokens)

    def prepare(self, windows: Windows) -> EncodedWindows:
        """Encode the condition: the part of ``forward`` that is the same at every diffusion step."""
        frames_per_token, (scene, exists) = self.config.transformer.frames_per_token, scene_inputs(windows)
        scene, frame_mask = (scene - self.input_mean) / self.input_scale * exists, windows.frame_mask[..., None]
        hands = 0.0 if self.hands_in is None else self.hands_in(windows.active_hands.float())[:, None]
        conditional, unconditional = (
            self.tokens_in(to_tokens(self._encode(scene, windows, with_map) * frame_mask, frames_per_token)) + hands
            for with_map in (True, False)
        )
        # A column for token 0, the diffusion step.
        attention_mask = functional.pad(attention_mask_of(windows.frame_mask, frames_per_token), (1, 0), value=True)
        lengths = windows.frame_mask.sum(1).tolist() if self.config.knot_frames else []
        return EncodedWindows(conditional, unconditional, attention_mask, self.channel_mask(windows), lengths)

    def _encode(self, scene: Tensor, windows: Windows, with_map: bool) -> Tensor:
        """(B, F, width) encoding of each frame's object, and of its contact map if ``with_map``."""
        if not self.with_contact:
            return self.object_in(scene)
        contact = self.null.expand(*scene.shape[:2], -1)
        if with_map:
            assert windows.contact_m is not None
            normalised = (windows.contact_m - self.contact_mean) / self.contact_scale
            contact = self.contact_in(normalised * contact_channels(windows))
        if self.is_joint:
            return self.object_in(torch.cat((scene, contact), -1))
        return torch.cat((self.object_in(scene), contact), -1)

    def denoise(self, x: Tensor, steps: Tensor, encoded: EncodedWindows, tokens: Tensor) -> Tensor:
        """``forward`` for encoded windows; tokens: their conditional or unconditional ones."""
        config, frames_per_token = self.config, self.config.transformer.frames_per_token
        width = config.transformer.width
        # The embedding counts trained steps, which are spread over the 1,000.
        trained_step = (steps + 1) * config.diffusion_steps / TRAIN_STEPS - 1
        time = self.step_in(sinusoid(trained_step, width))[:, None]
        signal = self.signal[steps][:, None, None]
        # Noised values get standard deviation 1 (EDM's c_in).
        x = x * (signal * config.signal_scale**2 + 1 - signal).rsqrt() * encoded.channel_mask
        frames = torch.cat((time, self.x_in(to_tokens(x, frames_per_token)) + tokens), 1)
        frames = self.drop(frames + sinusoid(torch.arange(frames.shape[1], device=x.device), width))
        hidden = self.encoder(frames, encoded.attention_mask)[:, 1:]
        clean = to_frames(self.x_out(hidden), x.shape[1], frames_per_token)
        if config.knot_frames:
            clean = projected(clean, encoded.lengths, config.knot_frames)
        return clean * encoded.channel_mask * config.signal_scale

    def encode(self, values: Tensor) -> Tensor:
        """Normalise values (..., D) in metres."""
        return (values - self.mean) / self.scale * self.config.signal_scale

    def decode(self, x: Tensor) -> Tensor:
        """The inverse of ``encode``."""
        return x / self.config.signal_scale * self.scale + self.mean


class ContactModel(Denoiser):
    """Denoises contact maps (B, F, 2N): of the left hand, then of the right (Sec. 3.2)."""

    def __init__(self, config: DenoiserConfig) -> None:
        super().__init__(config, config.features.contact_size, with_contact=False)

    def channel_mask(self, windows: Windows) -> Tensor:
        return contact_channels(windows)


class MotionModel(Denoiser):
    """Denoises keypoints and vectors to the object (B, F, motion_size), conditioned on contact maps (Sec. 3.3)."""

    def __init__(self, config: DenoiserConfig) -> None:
        super().__init__(config, config.features.motion_size, with_contact=True)

    def channel_mask(self, windows: Windows) -> Tensor:
        hands = self.config.features.spread_over_motion(windows.active_hands.bool())
        return hands[:, None] & windows.frame_mask[..., None]


def scene_inputs(windows: Windows) -> tuple[Tensor, Tensor]:
    """(B, F, 3N + S + 1) O, G and scale, and a bool mask: O of a part that the object does not have is missing."""
    exists = windows.point_exists.repeat_interleave(3, 1)[:, None].expand_as(windows.basis_offset)
    scale = windows.object_scale[:, None, None].expand(-1, windows.basis_offset.shape[1], 1)
    scene = torch.cat((windows.basis_offset, windows.state, scale), -1)
    return scene, functional.pad(exists, (0, scene.shape[-1] - exists.shape[-1]), value=True)


def contact_channels(windows: Windows) -> Tensor:
    """(B, F, 2N) bool: contact distances of existing object points to active hands."""
    by_hand = windows.active_hands.bool()[..., None] & windows.point_exists[:, None]
    return by_hand.flatten(1)[:, None] & windows.frame_mask[..., None]


def _layers(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    sizes = (inputs, *hidden)
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


@dataclass(frozen=True)
class Layout:
    """Start frames of windows of ``length`` frames on a motion of ``frames``; neighbours overlap by half or not."""

    frames: int
    length: int
    overlapping: bool = True

    @cached_property
    def starts(self) -> list[int]:
        """First frame of each window. Only the last window without overlap may reach beyond the motion's end."""
        if not self.overlapping:
            return list(range(0, self.frames, self.length))
        last = max(self.frames - self.length, 0)
        return [*range(0, last, max(self.length // 2, 1)), last]

    def cut(self, motion: Tensor) -> Tensor:
        """Cut (B, frame, ...) into windows (B n, length, ...), zeros beyond the end."""
        padding = max(self.starts[-1] + self.length - self.frames, 0)
        padded = functional.pad(motion.flatten(2), (0, 0, 0, padding)).unflatten(2, motion.shape[2:])
        return torch.stack([padded[:, start : start + self.length] for start in self.starts], 1).flatten(0, 1)

    def joined(self, windows: Tensor) -> Tensor:
        """Join windows (B n, length, D) to (B, frame, D): a mean with triangular weights where they overlap."""
        by_motion = windows.unflatten(0, (-1, len(self.starts)))
        total = by_motion.new_zeros(len(by_motion), self.starts[-1] + self.length, by_motion.shape[-1])
        weight = total.new_zeros(total.shape[1], 1)
        step = torch.arange(self.length, device=by_motion.device, dtype=by_motion.dtype)
        ramp = torch.minimum(step + 1, self.length - step)[:, None]
        for number, start in enumerate(self.starts):
            total[:, start : start + self.length] += ramp * by_motion[:, number]
            weight[start : start + self.length] += ramp
        return (total / weight.clamp_min(1e-9))[:, : self.frames]


@dataclass(frozen=True)
class SceneWindow:
    """Frames ``start`` to ``stop - 1`` of a scene."""

    scene: Scene
    start: int
    stop: int
    active_hands: np.ndarray  # (2,) bool


def padded(windows: Sequence[np.ndarray]) -> Tensor:
    """(window, frame, ...) float32 of windows (frame, ...), with zeros after their last frame."""
    return pad_sequence([torch.tensor(window, dtype=torch.float32) for window in windows], batch_first=True)


def build_windows(scene_windows: Sequence[SceneWindow], config: DenoiserConfig) -> Windows:
    """The condition of windows, padded to the longest, without contact maps."""
    spans = [(window.scene, window.start, min(window.stop, len(window.scene))) for window in scene_windows]
    hands = [window.active_hands if config.condition_on_hands else np.ones(2, bool) for window in scene_windows]
    return Windows(
        basis_offset=padded([scene.basis_offset[start:stop] for scene, start, stop in spans]).flatten(2),
        state=padded([scene.state(config.features.state, start, stop) for scene, start, stop in spans]),
        object_scale=torch.tensor([scene.object_scale for scene, _, _ in spans]),
        point_exists=torch.from_numpy(np.stack([scene.point_exists for scene, _, _ in spans])),
        active_hands=torch.from_numpy(np.stack(hands)),
        frame_mask=padded([np.ones(stop - start) for _, start, stop in spans]).bool(),
    )
