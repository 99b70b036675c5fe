"""The denoiser of both diffusion models: a Transformer encoder over frames, told of the object (Secs. 3.2 and 3.3).

Token 0 is the step; every other holds one frame (or a few) of what is noised, to which the encodings of that frame's
object, and of its contact map, are added. It predicts what is clean, normalised as in the windows it was trained on.

``Layout`` cuts a path into windows and puts them together again; ``windows_of`` says what a network is told of them.
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

from hoidata.devices import send
from models.bimart.scene import FeatureConfig, Scene
from models.common.sampling import TRAIN_STEPS, alphas_cumprod
from models.common.spline import projected
from models.common.transformer import Encoder, TransformerConfig, attention_mask_of, sinusoid, to_frames, to_tokens


@dataclass(frozen=True)
class DenoiserConfig:
    """The defaults are the paper's. encoder: widths of the hidden layers of both encoders, of object and map.

    latents: of object and contact have half a token's width each ("concatenate", paper), or one encoder sees both
    ("joint"), which can tell where on the object a value of the map belongs.
    told: which hands take part is told, and the others neither enter nor are made. diffusion_steps: of the 1,000 those
    that are trained; 50 are walked one by one, 1,000 by any sampler. position_dropout: of tokens with their positions.
    floor: no number counts as varying less than this share of the mean spread of its kind. knot_frames: what is made
    is a smooth curve with a knot so often (0: any numbers). signal_scale: spread of clean numbers beside the noise's 1:
    the smaller, the later a motion is decided on (Chen 2023).
    """

    features: FeatureConfig = field(default_factory=FeatureConfig)
    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    encoder: tuple[int, ...] = (1024, 1024)
    latents: Literal["concatenate", "joint"] = "concatenate"
    told: bool = False
    diffusion_steps: int = 50
    position_dropout: float = 0.1
    floor: float = 0.0
    knot_frames: int = 0
    signal_scale: float = 1.0


@dataclass(frozen=True)
class Windows:
    """B windows of F frames. offset (B, F, 3N), state (B, F, S), scale (B,), contact_m (B, F, 2N) left then right.

    there (B, N): places the object has. hands (B, 2): sides that are made. frames (B, F): frames there are. All but
    contact_m are what a motion is asked for; that is None for the contact model.
    """

    offset: Tensor
    state: Tensor
    scale: Tensor
    there: Tensor
    hands: Tensor
    frames: Tensor
    contact_m: Tensor | None = None

    def __len__(self) -> int:
        return len(self.scale)

    def to(self, device: torch.device | str) -> Self:
        found = {name: send(value, device) for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **found)


@dataclass(frozen=True)
class Prepared:
    """Windows as the Transformer takes them. conditional, unconditional: (B, token, width) with contact map, without.

    attention_mask: (B, token + 1). mask: (B, F, D) which numbers there are. lengths: frames of each window.
    """

    conditional: Tensor
    unconditional: Tensor
    attention_mask: Tensor
    mask: Tensor
    lengths: list[int]

    def twice(self) -> "Prepared":
        """All windows two times, with the contact map (as ``conditional``) and without."""
        both = torch.cat((self.conditional, self.unconditional))
        masks = [torch.cat((own, own)) for own in (self.attention_mask, self.mask)]
        return Prepared(both, both, masks[0], masks[1], 2 * self.lengths)


class Denoiser(nn.Module):
    """``clean = network(x, steps, windows)``. size: numbers per frame; with_contact: it is told contact maps."""

    input_mean: Tensor
    input_scale: Tensor
    mean: Tensor
    scale: Tensor
    contact_mean: Tensor
    contact_scale: Tensor
    basis_points: Tensor
    keypoint_ids: Tensor
    signal: Tensor

    def __init__(self, config: DenoiserConfig, size: int, with_contact: bool) -> None:
        super().__init__()
        self.config, self.with_contact = config, with_contact
        features, width, rows = config.features, config.transformer.width, config.transformer.frames_per_token
        self.x_in, self.x_out = nn.Linear(rows * size, width), nn.Linear(width, rows * size)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        latent = width // 2 if config.latents == "concatenate" and with_contact else width
        self.is_joint = config.latents == "joint" and with_contact
        seen = features.scene_size + self.is_joint * features.contact_size
        self.object_in = _layers(seen, config.encoder, latent)
        self.hands_in = nn.Linear(2, width, bias=False) if config.told else None
        self.tokens_in = nn.Linear(rows * width, width) if rows > 1 else nn.Identity()
        if with_contact:
            told = features.contact_size if self.is_joint else latent
            self.contact_in = nn.Identity() if self.is_joint else _layers(features.contact_size, config.encoder, latent)
            self.null = nn.Parameter(0.02 * torch.randn(1, told))
        self.encoder, self.drop = Encoder(config.transformer), nn.Dropout(config.position_dropout)
        for name, count in (("input", features.scene_size), ("", size), ("contact", features.contact_size)):
            self.register_buffer(f"{name}_mean".strip("_"), torch.zeros(count))
            self.register_buffer(f"{name}_scale".strip("_"), torch.ones(count))
        self.register_buffer("signal", alphas_cumprod(), persistent=False)
        self.register_buffer("basis_points", torch.from_numpy(features.basis.points()))
        self.register_buffer("keypoint_ids", torch.zeros(features.keypoints, dtype=torch.long))

    def channel_mask(self, windows: Windows) -> Tensor:
        """(B, F, D) bool: numbers of hands and parts that are there, in frames that are."""
        raise NotImplementedError

    def forward(self, x: Tensor, steps: Tensor, windows: Windows, drop: Tensor | None = None) -> Tensor:
        """Clean numbers (B, F, D) of noised ones at timesteps (B,); drop: (B,) bool, told no contact map."""
        known = self.prepare(windows)
        tokens = known.conditional
        if drop is not None:
            tokens = torch.where(drop[:, None, None], known.unconditional, tokens)
        return self.denoise(x, steps, known, tokens)

    def prepare(self, windows: Windows) -> Prepared:
        """The part of ``forward`` that is the same at every step."""
        rows, seen = self.config.transformer.frames_per_token, self._scene(windows)
        frames = windows.frames[..., None]
        hands = 0.0 if self.hands_in is None else self.hands_in(windows.hands.float())[:, None]
        conditional, unconditional = (
            self.tokens_in(to_tokens(self._encoded(seen, windows, known) * frames, rows)) + hands
            for known in (True, False)
        )
        mask = attention_mask_of(windows.frames, rows)
        attention_mask = torch.cat((mask.new_ones(len(mask), 1), mask), 1)
        lengths = windows.frames.sum(1).tolist() if self.config.knot_frames else []
        return Prepared(conditional, unconditional, attention_mask, self.channel_mask(windows), lengths)

    def _scene(self, windows: Windows) -> Tensor:
        """(B, F, 3N + S + 1) normalised O, G and scale; zeros for a part that is not there."""
        there = windows.there.repeat_interleave(3, 1)[:, None].expand_as(windows.offset)
        scale = windows.scale[:, None, None].expand(-1, windows.offset.shape[1], 1)
        seen = (torch.cat((windows.offset, windows.state, scale), -1) - self.input_mean) / self.input_scale
        known = torch.cat((there, there.new_ones(*there.shape[:2], seen.shape[-1] - there.shape[-1])), -1)
        return seen * known

    def _encoded(self, seen: Tensor, windows: Windows, known: bool) -> Tensor:
        """(B, F, width) what a frame's token is told of its object, and of its contact map where that is known."""
        if not self.with_contact:
            return self.object_in(seen)
        contact = self.null.expand(*seen.shape[:2], -1)
        if known:
            assert windows.contact_m is not None
            normalised = (windows.contact_m - self.contact_mean) / self.contact_scale
            contact = self.contact_in(normalised * contact_channels(windows))
        if self.is_joint:
            return self.object_in(torch.cat((seen, contact), -1))
        return torch.cat((self.object_in(seen), contact), -1)

    def denoise(self, x: Tensor, steps: Tensor, known: Prepared, tokens: Tensor) -> Tensor:
        """``forward`` with what is prepared; tokens: its conditional or unconditional ones."""
        config, rows, width = self.config, self.config.transformer.frames_per_token, self.config.transformer.width
        number = (steps + 1) * config.diffusion_steps / TRAIN_STEPS - 1
        time = self.step_in(sinusoid(number, width))[:, None]
        x = x * self._size(steps) * known.mask
        frames = torch.cat((time, self.x_in(to_tokens(x, rows)) + tokens), 1)
        frames = self.drop(frames + sinusoid(torch.arange(frames.shape[1], device=x.device), width))
        found = to_frames(self.x_out(self.encoder(frames, known.attention_mask)[:, 1:]), x.shape[1], rows)
        if config.knot_frames:
            found = projected(found, known.lengths, config.knot_frames)
        return found * known.mask * config.signal_scale

    def _size(self, steps: Tensor) -> Tensor:
        """(B, 1, 1) factors that make noised numbers of any ``signal_scale`` as wide as 1; 1 where that is 1."""
        share = self.signal[steps][:, None, None]
        return (share * self.config.signal_scale**2 + 1 - share).rsqrt()

    def encode(self, values: Tensor) -> Tensor:
        """Metres (..., D) to normalised numbers."""
        return (values - self.mean) / self.scale * self.config.signal_scale

    def decode(self, x: Tensor) -> Tensor:
        """The inverse of ``encode``."""
        return x / self.config.signal_scale * self.scale + self.mean


class ContactModel(Denoiser):
    """Makes contact maps (B, F, 2N): of the left hand, then of the right (Sec. 3.2)."""

    def __init__(self, config: DenoiserConfig) -> None:
        super().__init__(config, config.features.contact_size, with_contact=False)

    def channel_mask(self, windows: Windows) -> Tensor:
        return contact_channels(windows)


class MotionModel(Denoiser):
    """Makes keypoints and vectors to the object (B, F, motion_size) for contact maps (Sec. 3.3)."""

    def __init__(self, config: DenoiserConfig) -> None:
        super().__init__(config, config.features.motion_size, with_contact=True)

    def channel_mask(self, windows: Windows) -> Tensor:
        return self.config.features.of_hands(windows.hands.bool())[:, None] & windows.frames[..., None]


def contact_channels(windows: Windows) -> Tensor:
    """(B, F, 2N) bool: values of a map that are there, of hands that take part."""
    own = windows.hands.bool()[..., None] & windows.there[:, None]
    return own.flatten(1)[:, None] & windows.frames[..., None]


def _layers(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    sizes = (inputs, *hidden)
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


@dataclass(frozen=True)
class Layout:
    """Where windows of ``length`` frames lie on a path of ``frames``; each half on the next one, or apart."""

    frames: int
    length: int
    overlapping: bool = True

    @cached_property
    def starts(self) -> list[int]:
        """First frames; only the last of windows that lie apart may reach beyond the path."""
        if not self.overlapping:
            return list(range(0, self.frames, self.length))
        last = max(self.frames - self.length, 0)
        return [*range(0, last, max(self.length // 2, 1)), last]

    def cut(self, path: Tensor) -> Tensor:
        """(B, frame, ...) to windows (B n, length, ...), zeros beyond the end."""
        spare = max(self.starts[-1] + self.length - self.frames, 0)
        padded = functional.pad(path.flatten(2), (0, 0, 0, spare)).unflatten(2, path.shape[2:])
        return torch.stack([padded[:, start : start + self.length] for start in self.starts], 1).flatten(0, 1)

    def joined(self, windows: Tensor) -> Tensor:
        """The path (B, frame, D) of windows (B n, length, D): the mean where they overlap, less towards their ends."""
        own = windows.unflatten(0, (-1, len(self.starts)))
        total = own.new_zeros(len(own), self.starts[-1] + self.length, own.shape[-1])
        weight = total.new_zeros(total.shape[1], 1)
        place = torch.arange(self.length, device=own.device, dtype=own.dtype)
        ramp = torch.minimum(place + 1, self.length - place)[:, None]
        for number, start in enumerate(self.starts):
            total[:, start : start + self.length] += ramp * own[:, number]
            weight[start : start + self.length] += ramp
        return (total / weight.clamp_min(1e-9))[:, : self.frames]


def layout_of(frames: int, window: int, overlapping: bool) -> Layout:
    """Windows on a path; a path shorter than a window is one, as long as it is."""
    return Layout(frames, min(window, frames), overlapping)


@dataclass(frozen=True)
class Asked:
    """Frames start to stop of a scene, with the hands (2,) that take part."""

    scene: Scene
    start: int
    stop: int
    hands: np.ndarray


def windows_of(asked: Sequence[Asked], length: int, config: DenoiserConfig) -> Windows:
    """What a network is told of windows, padded to ``length``."""

    def padded(rows: np.ndarray) -> np.ndarray:
        return np.concatenate((rows, np.zeros((length - len(rows), *rows.shape[1:]), rows.dtype)))

    stops = [min(one.stop, len(one.scene)) for one in asked]
    states = [one.scene.state(config.features.state, one.start, stop) for one, stop in zip(asked, stops, strict=True)]
    offsets = [
        one.scene.offset[one.start : stop].reshape(stop - one.start, -1) for one, stop in zip(asked, stops, strict=True)
    ]
    arrays = (
        np.stack([padded(rows.astype(np.float32)) for rows in offsets]),
        np.stack([padded(rows.astype(np.float32)) for rows in states]),
        np.array([one.scene.scale for one in asked], np.float32),
        np.stack([one.scene.there for one in asked]),
        np.stack([one.hands if config.told else np.ones(2, bool) for one in asked]),
        np.arange(length) < (np.array(stops) - [one.start for one in asked])[:, None],
    )
    return Windows(*(torch.from_numpy(array) for array in arrays))
