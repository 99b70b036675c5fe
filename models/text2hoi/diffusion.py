"""The motion generator: a Transformer that denoises both hands and the object together.

Text2HOI Sec. 3.2 and supplement, Tables S7-S9: tokens [condition] + (left, right, object) x frames, frame-wise and
agent-wise position codes, x0-prediction, masks by hand type and length. Deviations, switchable in the config: tokens of
several frames, codes that count the frames left to the end, and contact given by its moments instead of the raw map,
whose order of points means something different on every object. Hand flags are explicit inputs beside the masks.
"""

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import RequestBatch
from hoidata.clips.features import HAND_FEATURES, OBJECT_FEATURES
from models.common.features import Normaliser, proper_hands, proper_object, scaled_text
from models.common.point_net import PointNet, PointNetConfig, normalised_points
from models.common.sampling import Denoise, Motion, SamplerConfig, add_noise, alphas_cumprod, sample_motion
from models.common.transformer import (
    Encoder,
    TransformerConfig,
    agent_codes,
    attention_mask_of,
    sinusoid,
    smoothed,
    to_frames,
    to_tokens,
)

CONTACT_MOMENTS = 13


@dataclass(frozen=True)
class DiffusionConfig:
    """transformer: its sizes. point_net: as in the contact model it comes from. The defaults are the paper's.

    smoothing_frames: samples are smoothed over time by a Gaussian of this deviation: a small model, trained for
    minutes, lets some of the noise it starts from through.
    """

    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    points: int = 1024
    text: int = 512
    contact_input: Literal["map", "moments"] = "map"
    frames_to_go: bool = False
    condition_dropout: float = 0.1
    smoothing_frames: float = 0.0


@dataclass(frozen=True)
class Condition:
    """What a motion is generated for. text (B, 512); object (B, G): F_obj; points_m, normals (B, N, 3);
    contact_map (B, N); active_hands (B, 2) hand flags; frames (B, F) True up to each length."""

    text: Tensor
    object: Tensor
    points_m: Tensor
    normals: Tensor
    contact_map: Tensor
    active_hands: Tensor
    frames: Tensor

    @classmethod
    def of(cls, batch: RequestBatch, object_feature: Tensor, text: Tensor, contact_map: Tensor) -> "Condition":
        """From a batch, with one sentence (B, 512) and one contact map (B, N) of each motion."""
        return cls(text, object_feature, batch.points_m, batch.normals, contact_map, batch.active_hands, batch.frames)

    def repeat(self, count: int) -> "Condition":
        """Every clip ``count`` times in a row."""
        return Condition(*(getattr(self, name).repeat_interleave(count, 0) for name in self.__dataclass_fields__))


def contact_moments(points_m: Tensor, normals: Tensor, contact_map: Tensor) -> Tensor:
    """(B, 13) summary of a contact map (B, N) that does not depend on the order of the points.

    Mean and spread of the touched points about the object's centre, in units of its size and in metres (mean), their
    mean normal, and the share of points touched.
    """
    points, scale = normalised_points(points_m)
    weight = contact_map / contact_map.sum(1, keepdim=True).clamp_min(1.0)
    mean = (weight[..., None] * points).sum(1)
    spread = (weight[..., None] * (points - mean[:, None]).square()).sum(1).clamp_min(1e-8).sqrt()
    normal = (weight[..., None] * normals).sum(1)
    return torch.cat((mean, spread, normal, mean * scale * 10, contact_map.mean(1, keepdim=True)), -1)


class DiffusionModel(nn.Module):
    """``x0 = model(hands, object, timesteps, condition)`` in normalised features."""

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        self.config = config
        width, per_token = config.transformer.width, config.transformer.frames_per_token
        # Trained with the contact model and frozen here; kept so that a checkpoint of this model is enough to sample.
        self.object_net = PointNet(3, config.point_net).requires_grad_(False)
        self.hands_in = nn.ModuleList([nn.Linear(HAND_FEATURES * per_token, width) for _ in range(2)])
        self.object_in = nn.Linear(OBJECT_FEATURES * per_token, width)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.text_in = nn.Linear(config.text, width)
        contact = config.points if config.contact_input == "map" else CONTACT_MOMENTS
        self.object_condition_in = nn.Linear(config.point_net.widths[-1] + contact + 1, width)
        self.extent_in = nn.Linear(3, width)
        self.to_go_in = nn.Linear(width, width) if config.frames_to_go else None
        self.encoder = Encoder(config.transformer)
        self.hands_out = nn.ModuleList([nn.Linear(width, HAND_FEATURES * per_token) for _ in range(2)])
        self.object_out = nn.Linear(width, OBJECT_FEATURES * per_token)

    @torch.no_grad()
    def object_feature(self, points_m: Tensor) -> Tensor:
        """F_obj (B, G) of object points (B, N, 3), metres."""
        self.object_net.eval()
        return self.object_net(normalised_points(points_m)[0])[0]

    def forward(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition, keep: Tensor | None = None
    ) -> Motion:
        """Clean hands (B, 2, F, 99) and object (B, F, 10) from noised ones at timesteps (B,).

        keep: (B, 2) factors 0 or 1 of the text and object conditions, for condition dropout and guidance.
        Padding and hands that do not act neither enter nor influence anything; their outputs mean nothing.
        """
        n_frames, k = hands.shape[2], self.config.transformer.frames_per_token
        frames = condition.frames
        attended = (
            torch.cat((condition.active_hands, torch.ones_like(condition.active_hands[:, :1])), 1)[:, :, None]
            & frames[:, None]
        )
        objects = objects * frames[..., None]
        hands = hands * attended[:, :2, :, None]
        agents = [layer(to_tokens(hands[:, side], k)) for side, layer in enumerate(self.hands_in)]
        tokens = torch.stack((*agents, self.object_in(to_tokens(objects, k))), 1)
        tokens = tokens + self._codes(frames, tokens.shape[2])
        first = self._condition(timesteps, condition, keep)[:, None]
        attention_mask = attention_mask_of(attended, k)
        x = torch.cat((first, tokens.flatten(1, 2)), 1)
        x = self.encoder(x, torch.cat((attention_mask.new_ones(len(attention_mask), 1), attention_mask.flatten(1)), 1))
        left, right, body = x[:, 1:].unflatten(1, tokens.shape[1:3]).unbind(1)
        both = [to_frames(layer(t), n_frames, k) for layer, t in zip(self.hands_out, (left, right), strict=True)]
        return torch.stack(both, 1), to_frames(self.object_out(body), n_frames, k)

    def _codes(self, frames: Tensor, n_tokens: int) -> Tensor:
        """Position codes (B or 1, 3, token, width): by frame, by agent, and by frames to go."""
        width, k = self.config.transformer.width, self.config.transformer.frames_per_token
        place = torch.arange(n_tokens, device=frames.device) * k
        codes = sinusoid(place, width)[None, None] + agent_codes(width, frames.device)[None, :, None]
        if self.to_go_in is not None:
            to_go = frames.sum(1)[:, None] - place
            codes = codes + self.to_go_in(sinusoid(to_go.clamp_min(0), width))[:, None]
        return codes

    def _condition(self, timesteps: Tensor, condition: Condition, keep: Tensor | None) -> Tensor:
        """The condition token (B, width): Text2HOI eq. 2 and 3, plus hand flags and length."""
        _, scale = normalised_points(condition.points_m)
        contact = condition.contact_map
        if self.config.contact_input == "moments":
            contact = contact_moments(condition.points_m, condition.normals, condition.contact_map)
        text = self.text_in(scaled_text(condition.text))
        body = self.object_condition_in(torch.cat((condition.object, contact, scale), -1))
        if keep is not None:
            text, body = text * keep[:, :1], body * keep[:, 1:]
        length = condition.frames.sum(1, keepdim=True) / MAX_FRAMES
        extent = self.extent_in(torch.cat((condition.active_hands.float(), length), -1))
        time = self.step_in(sinusoid(timesteps, self.config.transformer.width))
        return time + text + body + extent


def guided(model: DiffusionModel, condition: Condition, guidance: float) -> Denoise:
    """The model as a denoiser for ``sample_motion``; classifier-free guidance (Ho and Salimans 2022) if not 1."""

    def denoise(hands: Tensor, objects: Tensor, timesteps: Tensor) -> Motion:
        conditional = model(hands, objects, timesteps, condition)
        if guidance == 1:
            return conditional
        unconditional = model(hands, objects, timesteps, condition, hands.new_zeros(len(hands), 2))
        return (
            unconditional[0] + guidance * (conditional[0] - unconditional[0]),
            unconditional[1] + guidance * (conditional[1] - unconditional[1]),
        )

    return denoise


@dataclass(frozen=True)
class MotionGenerator:
    """A trained denoiser with the normalisation it belongs to: conditions in, motions in metres out."""

    network: DiffusionModel
    normaliser: Normaliser

    @torch.no_grad()
    def sample(
        self,
        condition: Condition,
        sampler: SamplerConfig,
        noise: Motion,
        generator: torch.Generator | list[torch.Generator],
    ) -> Motion:
        """Hands (B, 2, F, 99) and object (B, F, 10), model frame, from noise of these shapes; generator: of DDPM's."""
        denoise = guided(self.network, condition, sampler.guidance)
        device = condition.text.device
        hands, objects = sample_motion(denoise, (noise[0].to(device), noise[1].to(device)), sampler, generator)
        width = self.network.config.smoothing_frames
        return self._features((smoothed(hands, condition.frames, width), smoothed(objects, condition.frames, width)))

    @torch.no_grad()
    def denoise_once(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition, generator: torch.Generator
    ) -> Motion:
        """Given motions, noised to ``timesteps`` (B,) and denoised by a single call."""
        signal = alphas_cumprod(timesteps.device)
        noised = []
        for clean in self.normaliser.encode(hands, objects):
            noise = torch.randn(clean.shape, generator=generator)
            noised.append(add_noise(clean, noise.to(clean.device), timesteps, signal))
        return self._features(self.network(noised[0], noised[1], timesteps, condition))

    def _features(self, motion: Motion) -> Motion:
        hands, objects = self.normaliser.decode(*motion)
        return proper_hands(hands), proper_object(objects)
