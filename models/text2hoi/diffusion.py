"""The motion generator: a Transformer that denoises both hands and the object together.

Text2HOI Sec. 3.2 and supplement, Tables S7-S9: tokens [condition] + (left, right, object) x frames, frame-wise and
agent-wise position codes, x0-prediction, masks by hand type and length. Each deviation from the paper is a setting,
off by default; ``DiffusionConfig`` lists them.

Text2HOI passes F_obj, the object's scale, and the contact map as 1,024 numbers in the order of the sampled points, an
order that differs between objects. ``contact_tokens`` are points to attend to instead: touched and untouched points
spread over the surface, in metres. The result does not depend on the order of points.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import RequestBatch
from hoidata.clips.features import HAND_FEATURES
from hoidata.objects.sampling import POINT_COUNT
from models.common.features import TEXT_FEATURES, Normaliser, proper_hands, proper_object, recentred, verb_one_hot
from models.common.point_net import PointNet, PointNetConfig, normalised_points, spread_out
from models.common.sampling import Motion, SamplerConfig, add_noise, alphas_cumprod, sample_motion
from models.common.transformer import (
    Encoder,
    TransformerConfig,
    agent_codes,
    attention_mask_of,
    sinusoid,
    to_frames,
    to_tokens,
)
from models.text2hoi.motion_representation import OBJECT_KNOTS, MotionRepresentation, MotionRepresentationConfig

TOKEN_FEATURES = 13


def contact_tokens(
    points_m: Tensor, normals: Tensor, part: Tensor, contact: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """Features of points touched by the left hand, by the right hand and by none, spread over the surface.

    Args:
        points_m: (B, N, 3) in the object's frame.
        normals: (B, N, 3).
        part: (B, N) 0 or 1.
        contact: (B, 2, N) bool, by hand.
        count: points of each of the three kinds.

    Returns features (B, 3 count, 13), and the mask (B, 3 count) of those filled: a kind may have fewer points.
    """
    normalised, _ = normalised_points(points_m)
    kinds = torch.cat((contact, ~contact.any(1, keepdim=True)), 1)
    index, mask = spread_out(points_m, kinds, count)
    features = torch.cat((normalised, points_m * 10, normals, part[..., None].to(points_m.dtype)), -1)
    clip = torch.arange(len(features), device=features.device)[:, None, None]
    kind_one_hot = torch.eye(3, device=features.device)[:, None].expand(len(features), 3, count, 3)
    return torch.cat((features[clip, index], kind_one_hot), -1).flatten(1, 2), mask.flatten(1, 2)


CONTACT_TOKENS = 12  # of each kind: touched by the left hand, by the right hand, by none


@dataclass(frozen=True)
class DiffusionConfig:
    """The denoiser's sizes and inputs; the defaults are the paper's."""

    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    # The contact network's point network, copied and frozen.
    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    motion: MotionRepresentationConfig = field(default_factory=MotionRepresentationConfig)
    # Standardise control points over the training clips to this deviation, relative to the noise's 1; None: do not. A
    # small one hides the motion at more timesteps, so the network relies more on the sentence (Chen 2023).
    signal_scale: float | None = None
    # Object and contact as F_obj, probabilities of 1,024 points and scale (the paper), or as ``contact_tokens``.
    contact_input: Literal["map", "tokens"] = "map"
    # Condition on the verb that the grammar finds in the sentence, in addition to the sentence's features.
    verb_input: bool = False
    # Verbs of the training clips; set by training with ``verb_input``.
    verbs: tuple[str, ...] = ()
    # Position codes count to the end of the motion as well.
    frames_to_go: bool = False
    # Inputs that are zero, for the rows of Text2HOI's Table 2.
    zero_inputs: tuple[Literal["contact_map", "scale", "frame_codes", "agent_codes"], ...] = ()


def is_paper(config: DiffusionConfig) -> bool:
    """Whether all inputs and the motion representation are the paper's; layer sizes do not count."""
    return config == DiffusionConfig(transformer=config.transformer, point_net=config.point_net)


@dataclass(frozen=True)
class Condition:
    """What B motions are generated for."""

    batch: RequestBatch  # objects, hands and lengths
    text: Tensor  # (B, 512) sentence features
    verbs: Sequence[str | None]  # B verbs of the sentences
    contact: Tensor  # (B, 2, N) by hand: probabilities for a contact map, 0 or 1 for contact tokens


@dataclass(frozen=True)
class EncodedCondition:
    """A condition as the Transformer reads it: the same at every timestep. B motions, T motion tokens."""

    token: Tensor  # (B, 1, width) sentence and object; the timestep is added
    points: Tensor  # (B, C, width) contact tokens
    points_mask: Tensor  # (B, C) bool
    hand_mask: Tensor  # (B, 2, K) bool, control points of active hands
    object_mask: Tensor  # (B, L) bool, control points of the object
    sides: tuple[int, ...]  # hands active in any motion; the other hand has no tokens
    codes: Tensor  # (B, T, width) position codes: hands, then object
    mask: Tensor  # (B, T) bool


class DiffusionModel(nn.Module):
    """``x0 = model(hands, object, timesteps, condition)`` on normalised control points."""

    signal: Tensor

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        self.config, self.representation = config, MotionRepresentation(config.motion)
        self.signal_scale = config.signal_scale or 1.0
        self.register_buffer("signal", alphas_cumprod(), persistent=False)
        width, has_map = config.transformer.width, config.contact_input == "map"
        self.hand_points_per_token = config.transformer.frames_per_token
        self.object_points_per_token = self.hand_points_per_token * (OBJECT_KNOTS if config.motion.knot_frames else 1)
        hand_inputs = HAND_FEATURES * self.hand_points_per_token
        object_inputs = self.representation.object_features * self.object_points_per_token
        self.hands_in = nn.ModuleList([nn.Linear(hand_inputs, width) for _ in range(2)])
        self.object_in = nn.Linear(object_inputs, width)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.text_in = nn.Linear(TEXT_FEATURES, width)
        self.verb_in = nn.Linear(len(config.verbs), width, bias=False) if config.verbs else None
        # Trained with the contact model and frozen here; kept so that a checkpoint of this model is enough to sample.
        self.object_net = PointNet(3, config.point_net).requires_grad_(False) if has_map else None
        body = config.point_net.widths[-1] + POINT_COUNT + 1
        self.object_condition_in = nn.Linear(body, width) if has_map else None
        layers = nn.Linear(TOKEN_FEATURES, width), nn.GELU(), nn.Linear(width, width)
        self.points_in = None if has_map else nn.Sequential(*layers)
        self.to_go_in = nn.Linear(2 * width, width) if config.frames_to_go else None
        self.encoder = Encoder(config.transformer, has_condition=True)
        self.hands_out = nn.ModuleList([nn.Linear(width, hand_inputs) for _ in range(2)])
        self.object_out = nn.Linear(width, object_inputs)

    def forward(self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition) -> Motion:
        """Predict clean control points from noised ones (x0-prediction).

        Outputs in the padding and of inactive hands are meaningless; their inputs are masked.

        Args:
            hands: (B, 2, K, 99) noised, normalised.
            objects: (B, L, 10 or 16) noised, normalised.
            timesteps: (B,) from 0 to 999.
        """
        return self.denoise(hands, objects, timesteps, self.encode_condition(condition))

    def encode_condition(self, condition: Condition) -> EncodedCondition:
        """Encode what does not depend on the timestep (Text2HOI, Eq. 3)."""
        batch, token = condition.batch, self.text_in(condition.text)
        if self.verb_in is not None:
            token = token + self.verb_in(verb_one_hot(condition.verbs, self.config.verbs, token.device))
        contact = condition.contact * batch.active_hands[..., None]
        points = token.new_zeros(len(token), 0, self.config.transformer.width)
        points_mask = points.new_zeros(points.shape[:2], dtype=torch.bool)
        if self.points_in is None:
            token = token + self._object_condition(batch, contact)
        else:
            points_m = batch.points_m - self.representation.reference_point_m(batch.points_m, batch.part)[:, None]
            surface = points_m, batch.normals, batch.part
            points, points_mask = contact_tokens(*surface, contact.bool(), CONTACT_TOKENS)
            points = self.points_in(points)
        hand_mask, object_mask = self.representation.valid_masks(batch.counts, token.device)
        hand_mask = batch.active_hands[:, :, None] & hand_mask[:, None]
        sides = tuple(side for side in range(2) if batch.sides[side])
        masks = [attention_mask_of(hand_mask[:, side], self.hand_points_per_token) for side in sides]
        masks.append(attention_mask_of(object_mask, self.object_points_per_token))
        return EncodedCondition(
            token=token[:, None],
            points=points,
            points_mask=points_mask,
            hand_mask=hand_mask,
            object_mask=object_mask,
            sides=sides,
            codes=self._codes(batch.lengths, [mask.shape[1] for mask in masks], sides),
            mask=torch.cat(masks, 1),
        )

    def _object_condition(self, batch: RequestBatch, contact: Tensor) -> Tensor:
        """(B, width) embedding of F_obj, contact map and scale (Table S7)."""
        assert self.object_net is not None
        assert self.object_condition_in is not None
        points, scale = self.config.point_net.normalised(batch.points_m, batch.scale_m)
        with torch.no_grad():
            feature = self.object_net.eval()(points)[0]
        inputs = feature, self._used(contact.float().amax(1), "contact_map"), self._used(scale, "scale")
        return self.object_condition_in(torch.cat(inputs, -1))

    def _used(self, values: Tensor, name: str) -> Tensor:
        """The input, or zeros."""
        return torch.zeros_like(values) if name in self.config.zero_inputs else values

    def denoise(self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: EncodedCondition) -> Motion:
        """``forward`` with an encoded condition."""
        # Noised control points get unit variance (c_in of EDM, Karras et al. 2022).
        signal = self.signal[timesteps][:, None, None]
        scale = (signal * self.signal_scale**2 + 1 - signal).rsqrt()
        hands, objects = self._layers(hands * scale[:, None], objects * scale, timesteps, condition)
        return hands * self.signal_scale, objects * self.signal_scale

    def _layers(self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: EncodedCondition) -> Motion:
        """Tokens (Text2HOI, Sec. 3.2.3, Eq. 2), encoder, and linear layers per hand and object (Tables S8, S9)."""
        hands, objects = hands * condition.hand_mask[..., None], objects * condition.object_mask[..., None]
        hand_tokens = [to_tokens(hands[:, side], self.hand_points_per_token) for side in condition.sides]
        agents = [self.hands_in[side](tokens) for side, tokens in zip(condition.sides, hand_tokens, strict=True)]
        agents.append(self.object_in(to_tokens(objects, self.object_points_per_token)))
        time = self.step_in(sinusoid(timesteps, self.config.transformer.width))
        condition_token = condition.token + time[:, None]
        moving = torch.cat(agents, 1) + condition.codes
        x = torch.cat((moving, condition_token, condition.points), 1)
        mask = torch.cat((condition.mask, condition.mask.new_ones(len(x), 1), condition.points_mask), 1)
        encoded = self.encoder(x, mask, condition_token)[:, : moving.shape[1]]
        *hand_tokens, object_tokens = encoded.split([tokens.shape[1] for tokens in agents], 1)
        clean = [torch.zeros_like(hands[:, 0])] * 2
        for side, tokens in zip(condition.sides, hand_tokens, strict=True):
            clean[side] = to_frames(self.hands_out[side](tokens), hands.shape[2], self.hand_points_per_token)
        clean_object = to_frames(self.object_out(object_tokens), objects.shape[1], self.object_points_per_token)
        return torch.stack(clean, 1), clean_object

    def _codes(self, lengths: Tensor, n_tokens: Sequence[int], sides: Sequence[int]) -> Tensor:
        """Position codes (B, T, width) of agent and frame; with ``frames_to_go`` also of frames left and progress."""
        config, width = self.config, self.config.transformer.width
        token_frames = self.hand_points_per_token * max(1, config.motion.knot_frames)
        frame = torch.arange(max(n_tokens), device=lengths.device) * token_frames
        codes = self._used(sinusoid(frame, width), "frame_codes").expand(len(lengths), -1, -1)
        if self.to_go_in is not None:
            to_go = (lengths[:, None] - frame).clamp_min(0)
            progress = frame * MAX_FRAMES / lengths[:, None]
            codes = codes + self.to_go_in(torch.cat((sinusoid(to_go, width), sinusoid(progress, width)), -1))
        agents = self._used(agent_codes(width, lengths.device), "agent_codes")
        return torch.cat([codes[:, :n] + agents[agent] for agent, n in zip((*sides, 2), n_tokens, strict=True)], 1)


@dataclass(frozen=True)
class MotionGenerator:
    """A trained denoiser with its normalisation: from conditions to motions in metres."""

    network: DiffusionModel
    normaliser: Normaliser

    @torch.no_grad()
    def sample(self, condition: Condition, sampler: SamplerConfig, draw: Callable[[], Motion]) -> Motion:
        """Hands (B, 2, F, 99) and object (B, F, 10) in the model frame; the object starts at the origin.

        draw: standard normal noise (B, 2, K, 99) and (B, L, 10 or 16), as in ``sample_motion``.
        """
        encoded, device = self.network.encode_condition(condition), condition.text.device

        def denoise(hands: Tensor, objects: Tensor, timesteps: Tensor) -> Motion:
            return self.network.denoise(hands, objects, timesteps, encoded)

        return self._features(sample_motion(denoise, draw, sampler, device), condition)

    @torch.no_grad()
    def denoise_once(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition, generator: torch.Generator
    ) -> Motion:
        """Noise normalised control points to ``timesteps`` (B,), denoise them in one call, and decode as ``sample``."""
        signal = alphas_cumprod(timesteps.device)
        noised = []
        for clean in (hands, objects):
            noise = torch.randn(clean.shape, generator=generator)
            noised.append(add_noise(clean, noise.to(clean.device), timesteps, signal))
        return self._features(self.network(noised[0], noised[1], timesteps, condition), condition)

    def _features(self, normalised: Motion, condition: Condition) -> Motion:
        representation, batch = self.network.representation, condition.batch
        hands, objects = representation.features_per_frame(*self.normaliser.decode(*normalised), batch.counts)
        hands = representation.in_world(hands, objects)
        objects = representation.at_origin(proper_object(objects), batch.points_m, batch.part)
        return recentred(proper_hands(hands), objects)
