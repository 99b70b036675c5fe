"""The motion generator: a Transformer that denoises both hands and the object together.

Text2HOI Sec. 3.2 and supplement, Tables S7-S9: tokens [condition] + (left, right, object) x frames, frame-wise and
agent-wise position codes, x0-prediction, masks by hand type and length. Each deviation from the paper is a setting,
off by default; ``DiffusionConfig`` lists them.

Text2HOI passes the contact map as 1,024 numbers in the order of the sampled points, an order that differs between
objects. ``contact_tokens`` are points to attend to instead: touched and untouched points spread over the surface. The
result does not depend on the order of points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import RequestBatch
from hoidata.clips.features import HAND_FEATURES
from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.objects.sampling import POINT_COUNT
from models.common.features import TEXT_FEATURES, Normaliser, proper_hands, proper_object, recentred
from models.common.point_net import PointNet, PointNetConfig, normalised_points
from models.common.sampling import Denoise, Motion, SamplerConfig, add_noise, alphas_cumprod, sample_motion
from models.common.transformer import (
    Encoder,
    TransformerConfig,
    agent_codes,
    attention_mask_of,
    sinusoid,
    to_frames,
    to_tokens,
)
from models.text2hoi.motion_representation import MotionRepresentation, MotionRepresentationConfig
from models.text2hoi.verb_classifier import VerbClassifier

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

    Returns:
        Features (B, 3 count, 13), and the mask (B, 3 count) of those filled: a kind may have fewer points.
    """
    normalised, _ = normalised_points(points_m)
    kinds = torch.cat((contact, ~contact.any(1, keepdim=True)), 1)
    index, mask = spread_out(points_m, kinds, count)
    features = torch.cat((normalised, points_m * 10, normals, part[..., None].to(points_m.dtype)), -1)
    clip = torch.arange(len(features), device=features.device)[:, None, None]
    kind_one_hot = torch.eye(3, device=features.device)[:, None].expand(len(features), 3, count, 3)
    return torch.cat((features[clip, index], kind_one_hot), -1).flatten(1, 2), mask.flatten(1, 2)


def spread_out(points_m: Tensor, kinds: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Farthest-point sampling (Eldar et al. 1997) among the points of each kind.

    The first point is the one farthest from the centre of its kind.

    Args:
        points_m: (B, N, 3).
        kinds: (B, S, N) bool.

    Returns:
        Indices (B, S, count), and the mask (B, S, count) of those that exist.
    """
    weight = kinds.to(points_m.dtype)
    centre = weight @ points_m / weight.sum(-1, keepdim=True).clamp_min(1)
    from_centre = torch.cdist(centre, points_m).masked_fill(~kinds, -1.0)
    farthest = from_centre.argmax(-1)
    nearest, chosen, mask = from_centre.clone().masked_fill(kinds, torch.inf), [], []
    for _ in range(count):
        mask.append(nearest.gather(-1, farthest[..., None])[..., 0] > 0)
        chosen.append(farthest)
        picked = points_m.gather(1, farthest[..., None].expand(-1, -1, 3))
        nearest = torch.minimum(nearest, torch.cdist(picked, points_m)).masked_fill(~kinds, -1)
        farthest = nearest.argmax(-1)
    return torch.stack(chosen, -1), torch.stack(mask, -1)


# An object counts as a training object if its F_obj is closer to a stored one than this fraction of their mean norm.
SAME_OBJECT = 0.01
CONTACT_TOKENS = 12  # of each kind: touched by the left hand, by the right hand, by none


@dataclass(frozen=True)
class DiffusionConfig:
    """The denoiser's sizes and inputs; the defaults are the paper's."""

    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    # The contact network's point network, copied and frozen.
    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    motion: MotionRepresentationConfig = field(default_factory=MotionRepresentationConfig)
    # Standardise control points by mean and deviation over the training clips.
    normalised: bool = False
    # The contact map as 1,024 numbers (the paper), or as ``contact_tokens``.
    contact_input: Literal["map", "tokens"] = "map"
    # Condition on the object's size.
    scale_input: bool = True
    # Condition on hand flags and the number of frames.
    condition_on_hands_and_length: bool = False
    # A linear layer on text features (the paper), or a hidden layer on verb probabilities (``verb_classifier``).
    text_input: Literal["linear", "verb_probabilities"] = "linear"
    # Verbs in training; set by training.
    verb_count: int = 1
    # Add the condition to every token, in addition to the condition token.
    condition_every_token: bool = False
    # Position codes count to the end of the motion as well.
    frames_to_go: bool = False
    # Standard deviation of clean control points relative to the noise's 1. A smaller one hides the motion at more
    # timesteps, so the network relies more on the sentence (Chen 2023).
    signal_scale: float = 1.0
    # A gate on the noised input that depends on the timestep.
    input_gate: bool = False
    # Fraction of training steps without the sentence, and independently without contact and F_obj.
    condition_dropout: float = 0.1
    # Fraction of training steps without F_obj, the point network's feature of the object. Few objects can be identified
    # by it. If above 0, it is given for training objects only.
    object_dropout: float = 0.0
    # Objects in training; set by training.
    object_count: int = 0


@dataclass(frozen=True)
class Condition:
    """What B motions are generated for."""

    text: Tensor  # (B, 512) sentence features
    object: Tensor  # (B, G) F_obj
    points_m: Tensor  # (B, N, 3) in the object's frame
    normals: Tensor  # (B, N, 3)
    part: Tensor  # (B, N) 0 or 1
    contact: Tensor  # (B, 2, N) 0 or 1, by hand
    active_hands: Tensor  # (B, 2) hand flags
    lengths: Tensor  # (B,) frames
    counts: tuple[int, ...]  # ``lengths`` as plain numbers
    sides: tuple[bool, bool]  # whether each hand is active in any motion of the batch

    @classmethod
    def of(cls, batch: RequestBatch, object_feature: Tensor, text: Tensor, contact: Tensor) -> "Condition":
        """From a batch, one sentence (B, 512) and one contact map (B, 2, N) per motion."""
        names = "points_m", "normals", "part", "active_hands", "lengths", "counts", "sides"
        from_batch = {name: getattr(batch, name) for name in names}
        return cls(text=text, object=object_feature, contact=contact, **from_batch)


@dataclass(frozen=True)
class EncodedCondition:
    """A condition as the Transformer reads it: the same at every timestep. B motions, T motion tokens."""

    text: Tensor  # (B, width)
    object: Tensor  # (B, width)
    hand_flags_and_length: Tensor  # (B, width), or () zero without this input
    points: Tensor  # (B, C, width) contact tokens
    points_mask: Tensor  # (B, C) bool
    hand_mask: Tensor  # (B, 2, K) bool, control points of active hands
    object_mask: Tensor  # (B, L) bool, control points of the object
    sides: tuple[int, ...]  # hands active in any motion; the other hand has no tokens
    codes: Tensor  # (B, T, width) position codes: hands, then object
    mask: Tensor  # (B, T) bool

    def repeated_twice(self) -> "EncodedCondition":
        """The batch followed by itself, for classifier-free guidance."""
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, Tensor) and value.ndim}
        return replace(self, **{name: torch.cat((value, value)) for name, value in tensors.items()})


class DiffusionModel(nn.Module):
    """``x0 = model(hands, object, timesteps, condition)`` on normalised control points."""

    signal: Tensor

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        if config.object_dropout and (config.contact_input == "map" or config.scale_input):
            expected = "contact_input: tokens and scale_input: false with object_dropout"
            raise BadInput("diffusion", expected, "another value", "set object_dropout: 0, as it would hide these too")
        self.config, self.representation = config, MotionRepresentation(config.motion)
        self.register_buffer("signal", alphas_cumprod(), persistent=False)
        width = config.transformer.width
        self.hand_points_per_token = config.transformer.frames_per_token
        self.object_points_per_token = self.hand_points_per_token * config.motion.object_knots
        # Trained with the contact model and frozen here; kept so that a checkpoint of this model is enough to sample.
        self.object_net = PointNet(3, config.point_net).requires_grad_(False)
        self.hands_in = nn.ModuleList([nn.Linear(HAND_FEATURES * self.hand_points_per_token, width) for _ in range(2)])
        self.object_in = nn.Linear(self.representation.object_features * self.object_points_per_token, width)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.gate_in = nn.Linear(width, width) if config.input_gate else None
        self.text_in = _text_layers(config)
        summary = config.point_net.widths[-1]
        body = summary + POINT_COUNT * (config.contact_input == "map") + config.scale_input
        self.object_condition_in = nn.Linear(body, width)
        # A parameter without gradient, not a buffer: training averages buffers over micro-batches.
        features = torch.zeros(config.object_count, summary)
        self.known_objects = nn.Parameter(features, requires_grad=False) if config.object_count else None
        self.points_in = _hidden_layer(TOKEN_FEATURES, width) if config.contact_input == "tokens" else None
        self.extent_in = nn.Linear(3, width) if config.condition_on_hands_and_length else None
        self.to_go_in = nn.Linear(2 * width, width) if config.frames_to_go else None
        self.encoder = Encoder(config.transformer, has_condition=True)
        self.hands_out = nn.ModuleList([nn.Linear(width, HAND_FEATURES * self.hand_points_per_token) for _ in range(2)])
        self.object_out = nn.Linear(width, self.representation.object_features * self.object_points_per_token)

    @torch.no_grad()
    def object_feature(self, points_m: Tensor) -> Tensor:
        """F_obj (B, G) of object points (B, N, 3), metres."""
        self.object_net.eval()
        return self.object_net(normalised_points(points_m)[0])[0]

    def forward(
        self,
        hands: Tensor,
        objects: Tensor,
        timesteps: Tensor,
        condition: Condition,
        condition_mask: Tensor | None = None,
    ) -> Motion:
        """Predict clean control points from noised ones (x0-prediction).

        Outputs in the padding and of inactive hands are meaningless; their inputs are masked.

        Args:
            hands: (B, 2, K, 99) noised, normalised.
            objects: (B, L, 10 or 16) noised, normalised.
            timesteps: (B,) from 0 to 999.
            condition_mask: (B, 3) 0 or 1 for sentence, contact points and F_obj: condition dropout and guidance.
        """
        return self.denoise(hands, objects, timesteps, self.encode_condition(condition), condition_mask)

    def encode_condition(self, condition: Condition) -> EncodedCondition:
        """Encode what does not depend on the timestep (Text2HOI, Eq. 2, plus hand flags and length)."""
        lengths = condition.lengths
        hand_mask, object_mask = self.representation.valid_masks(condition.counts, lengths.device)
        contact = condition.contact.bool() & condition.active_hands[..., None]
        points = condition.points_m.new_zeros(len(lengths), 0, self.config.transformer.width)
        points_mask = points.new_zeros(points.shape[:2], dtype=torch.bool)
        if self.points_in is not None:
            origin_m = self.representation.reference_point_m(condition.points_m, condition.part)
            points_m = condition.points_m - origin_m[:, None]
            points, points_mask = contact_tokens(points_m, condition.normals, condition.part, contact, CONTACT_TOKENS)
            points = self.points_in(points)
        hand_flags_and_length = torch.cat((condition.active_hands.float(), lengths[:, None] / MAX_FRAMES), -1)
        hand_mask = condition.active_hands[:, :, None] & hand_mask[:, None]
        sides = tuple(side for side in range(2) if condition.sides[side])
        masks = [attention_mask_of(hand_mask[:, side], self.hand_points_per_token) for side in sides]
        masks.append(attention_mask_of(object_mask, self.object_points_per_token))
        return EncodedCondition(
            text=self.text_in(condition.text),
            object=self._body(condition, contact),
            hand_flags_and_length=(
                self.extent_in(hand_flags_and_length) if self.extent_in is not None else points.new_zeros(())
            ),
            points=points,
            points_mask=points_mask,
            hand_mask=hand_mask,
            object_mask=object_mask,
            sides=sides,
            codes=self._codes(lengths, [mask.shape[1] for mask in masks], sides),
            mask=torch.cat(masks, 1),
        )

    def _body(self, condition: Condition, contact: Tensor) -> Tensor:
        """(B, width) embedding of the object: F_obj, contact map and size (Table S7)."""
        config, body = self.config, [condition.object]
        if config.contact_input == "map":
            body.append(contact.any(1).float())
        if config.scale_input:
            body.append(normalised_points(condition.points_m)[1])
        return self.object_condition_in(torch.cat(body, -1)) * self._is_training_object(condition.object)

    def _is_training_object(self, summary: Tensor) -> Tensor:
        """(B, 1) 1 if the object with F_obj (B, G) was in training, else 0; ones without ``object_dropout``."""
        if self.known_objects is None:
            return summary.new_ones(len(summary), 1)
        # By differences: with matrix products, which a GPU rounds to ten bits, an object has a distance from itself.
        distance = torch.cdist(summary, self.known_objects, compute_mode="donot_use_mm_for_euclid_dist")
        distance = distance.amin(1, keepdim=True)
        return (distance < SAME_OBJECT * self.known_objects.norm(dim=-1).mean()).to(summary.dtype)

    def store_training_objects(self, summaries: Tensor) -> None:
        """Store F_obj (object, G) of the ``config.object_count`` training objects."""
        if self.known_objects is not None:
            self.known_objects.data[:] = summaries.reshape(self.known_objects.shape)

    def denoise(
        self,
        hands: Tensor,
        objects: Tensor,
        timesteps: Tensor,
        condition: EncodedCondition,
        condition_mask: Tensor | None = None,
    ) -> Motion:
        """``forward`` with an encoded condition."""
        scale = self._input_scale(timesteps)
        hands, objects = self._layers(hands * scale[:, None], objects * scale, timesteps, condition, condition_mask)
        return hands * self.config.signal_scale, objects * self.config.signal_scale

    def _input_scale(self, timesteps: Tensor) -> Tensor:
        """(B, 1, 1) factors that scale noised control points to unit variance (c_in of EDM, Karras et al. 2022)."""
        signal = self.signal[timesteps][:, None, None]
        return (signal * self.config.signal_scale**2 + 1 - signal).rsqrt()

    def _layers(
        self,
        hands: Tensor,
        objects: Tensor,
        timesteps: Tensor,
        condition: EncodedCondition,
        condition_mask: Tensor | None,
    ) -> Motion:
        hands, objects = hands * condition.hand_mask[..., None], objects * condition.object_mask[..., None]
        hand_tokens = [to_tokens(hands[:, side], self.hand_points_per_token) for side in condition.sides]
        agents = [self.hands_in[side](tokens) for side, tokens in zip(condition.sides, hand_tokens, strict=True)]
        agents.append(self.object_in(to_tokens(objects, self.object_points_per_token)))
        time = self._time(timesteps)
        if self.gate_in is not None:
            agents = [x * (1 + self.gate_in(time)[:, None]) for x in agents]
        condition_token, points = self._condition(time, condition, condition_mask)
        moving = torch.cat(agents, 1) + condition.codes
        if self.config.condition_every_token:
            moving = moving + condition_token
        x = torch.cat((moving, condition_token, points), 1)
        points_mask = condition.points_mask
        if condition_mask is not None:
            points_mask = points_mask & (condition_mask[:, 1:2] > 0)
        mask = torch.cat((condition.mask, condition.mask.new_ones(len(x), 1), points_mask), 1)
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
        codes = sinusoid(frame, width).expand(len(lengths), -1, -1)
        if self.to_go_in is not None:
            to_go = (lengths[:, None] - frame).clamp_min(0)
            progress = frame * MAX_FRAMES / lengths[:, None]
            codes = codes + self.to_go_in(torch.cat((sinusoid(to_go, width), sinusoid(progress, width)), -1))
        agents = agent_codes(width, lengths.device)
        return torch.cat([codes[:, :n] + agents[agent] for agent, n in zip((*sides, 2), n_tokens, strict=True)], 1)

    def _time(self, timesteps: Tensor) -> Tensor:
        """(B, width) embedding of timesteps (B,)."""
        return self.step_in(sinusoid(timesteps, self.config.transformer.width))

    def _condition(
        self, time: Tensor, condition: EncodedCondition, condition_mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The condition token (B, 1, width) and the contact tokens (Text2HOI, Eq. 3)."""
        text, body, points = condition.text, condition.object, condition.points
        if condition_mask is not None:
            text, body = text * condition_mask[:, :1], body * condition_mask[:, 2:]
        return (time + text + body + condition.hand_flags_and_length)[:, None], points


def _text_layers(config: DiffusionConfig) -> nn.Module:
    if config.text_input == "linear":
        return nn.Linear(TEXT_FEATURES, config.transformer.width)
    read = VerbClassifier(TEXT_FEATURES, config.verb_count)
    return nn.Sequential(read, _hidden_layer(config.verb_count, config.transformer.width))


def _hidden_layer(inputs: int, width: int) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width))


def guided(model: DiffusionModel, condition: Condition, guidance: float) -> Denoise:
    """The model as a denoiser for ``sample_motion``, with classifier-free guidance (Ho and Salimans 2022) unless 1."""
    encoded = model.encode_condition(condition)

    def denoise(hands: Tensor, objects: Tensor, timesteps: Tensor) -> Motion:
        return model.denoise(hands, objects, timesteps, encoded)

    def denoise_guided(hands: Tensor, objects: Tensor, timesteps: Tensor) -> Motion:
        both = [torch.cat((x, x)) for x in (hands, objects, timesteps)]
        # Only the sentence is dropped: without the object, the motion would be a different one.
        condition_mask = torch.ones(2 * len(hands), 3, device=hands.device)
        condition_mask[len(hands) :, 0] = 0
        outputs = [output.chunk(2) for output in model.denoise(both[0], both[1], both[2], doubled, condition_mask)]
        guided_hands, guided_objects = (
            unconditioned + guidance * (conditioned - unconditioned) for conditioned, unconditioned in outputs
        )
        return guided_hands, guided_objects

    doubled = encoded.repeated_twice() if guidance != 1 else encoded
    return denoise if guidance == 1 else denoise_guided


@dataclass(frozen=True)
class MotionGenerator:
    """A trained denoiser with its normalisation: from conditions to motions in metres."""

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
        """Hands (B, 2, F, 99) and object (B, F, 10) in the model frame; the object starts at the origin.

        Args:
            noise: (B, 2, K, 99) and (B, L, 10 or 16).
            generator: of the noise that DDPM adds.
        """
        denoise = guided(self.network, condition, sampler.guidance)
        device = condition.text.device
        points = sample_motion(denoise, (send(noise[0], device), send(noise[1], device)), sampler, generator)
        return self._features(points, condition)

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
        representation, counts = self.network.representation, condition.counts
        points = representation.snapped_to_rest(*self.normaliser.decode(*normalised), counts)
        hands, objects = representation.features_per_frame(*points, counts)
        hands = representation.in_world(hands, objects)
        objects = representation.at_origin(proper_object(objects), condition.points_m, condition.part)
        return recentred(proper_hands(hands), objects)
