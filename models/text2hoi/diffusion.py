"""The motion generator: a Transformer that denoises both hands and the object together.

Text2HOI Sec. 3.2 and supplement, Tables S7-S9: tokens [condition] + (left, right, object) x frames, frame-wise and
agent-wise position codes, x0-prediction, masks by hand type and length. Each deviation is a switch of the config, off
by default: what stands for a motion (``motion_code``), contact as points to attend to, sentences read for their verb
(``verb_reading``), the condition in every token, codes that count to the end. Hand flags are explicit inputs beside
the masks.

Text2HOI hands the denoiser the contact map as 1,024 numbers in the order of the points, which means something else on
every object. ``contact_tokens`` are points that it can attend to: some of the touched and of the untouched surface,
spread out over it; neither their order nor the order of the sampled points enters.
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
from models.text2hoi.motion_code import MotionCode, MotionCodeConfig
from models.text2hoi.verb_reading import VerbReading

TOKEN_FEATURES = 13


def contact_tokens(
    points_m: Tensor, normals: Tensor, part: Tensor, contact: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """(B, 3 count, 13) features of points touched by the left hand, by the right, and by none; (B, 3 count) which are.

    points_m, normals (B, N, 3), part (B, N), contact (B, 2, N) bool. A kind with fewer points than ``count`` has all.
    """
    about, _ = normalised_points(points_m)
    kinds = torch.cat((contact, ~contact.any(1, keepdim=True)), 1)
    chosen, there = spread_out(points_m, kinds, count)
    own = torch.cat((about, points_m * 10, normals, part[..., None].to(points_m.dtype)), -1)
    rows = torch.arange(len(own), device=own.device)[:, None, None]
    kind = torch.eye(3, device=own.device)[:, None].expand(len(own), 3, count, 3)
    return torch.cat((own[rows, chosen], kind), -1).flatten(1, 2), there.flatten(1, 2)


def spread_out(points_m: Tensor, kinds: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """(B, S, count) rows of points far from each other among those of each kind (B, S, N) bool, and which are any.

    Farthest-point sampling (Eldar et al. 1997), from the point farthest from the middle of its kind.
    """
    weight = kinds.to(points_m.dtype)
    middle = weight @ points_m / weight.sum(-1, keepdim=True).clamp_min(1)
    apart = torch.cdist(middle, points_m).masked_fill(~kinds, -1.0)
    farthest = apart.argmax(-1)
    nearest, chosen, there = apart.clone().masked_fill(kinds, torch.inf), [], []
    for _ in range(count):
        there.append(nearest.gather(-1, farthest[..., None])[..., 0] > 0)
        chosen.append(farthest)
        picked = points_m.gather(1, farthest[..., None].expand(-1, -1, 3))
        nearest = torch.minimum(nearest, torch.cdist(picked, points_m)).masked_fill(~kinds, -1)
        farthest = nearest.argmax(-1)
    return torch.stack(chosen, -1), torch.stack(there, -1)


# An object counts as known if its F_obj is nearer to that of a training object than this share of their mean length.
SAME_OBJECT = 0.01
CONTACT_TOKENS = 12  # of each kind: touched by the left hand, by the right, by none


@dataclass(frozen=True)
class DiffusionConfig:
    """transformer: its sizes. point_net: as in the contact model it comes from. The defaults are the paper's.

    motion: what a token stands for. normalised: rows by mean and spread of the training clips, not metres and numbers
    as they are.
    contact_input: "map", the paper's raw numbers, or "tokens" of each kind (``contact_tokens``). scale_input: the
    object's size is told. told: hand flags and length are. object_dropout: share of the steps in which F_obj, the point
    network's summary of the object, is not told; of few objects it is a name. If any, it is told of the objects in
    training alone (their number, ``objects``, is set by training).
    text_input: a linear layer, or "verbs", a hidden layer that is told which of ``verbs`` verbs (set by training too)
    the sentence means. condition_everywhere: the condition is added to every token instead of being one. frames_to_go:
    tokens know how far it is to the end.
    signal_scale: spread of normalised rows beside the noise's 1; the smaller, the longer only the words can tell what
    is to happen (Chen 2023). input_gate: how much of the noised rows is let in depends on the timestep.
    """

    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    motion: MotionCodeConfig = field(default_factory=MotionCodeConfig)
    normalised: bool = False
    contact_input: Literal["map", "tokens"] = "map"
    scale_input: bool = True
    told: bool = False
    text_input: Literal["linear", "verbs"] = "linear"
    verbs: int = 1
    condition_everywhere: bool = False
    frames_to_go: bool = False
    signal_scale: float = 1.0
    input_gate: bool = False
    condition_dropout: float = 0.1
    object_dropout: float = 0.0
    objects: int = 0


@dataclass(frozen=True)
class Condition:
    """What a motion is generated for. text (B, 512); object (B, G): F_obj; points_m, normals (B, N, 3); part (B, N);
    contact (B, 2, N) 0 or 1 for each hand; active_hands (B, 2) hand flags; lengths (B,), and as plain values counts and
    sides (``RequestBatch``).
    """

    text: Tensor
    object: Tensor
    points_m: Tensor
    normals: Tensor
    part: Tensor
    contact: Tensor
    active_hands: Tensor
    lengths: Tensor
    counts: tuple[int, ...]
    sides: tuple[bool, bool]

    @classmethod
    def of(cls, batch: RequestBatch, object_feature: Tensor, text: Tensor, contact: Tensor) -> "Condition":
        """From a batch, with one sentence (B, 512) and the contact (B, 2, N) of each motion."""
        shape = batch.points_m, batch.normals, batch.part
        return cls(text, object_feature, *shape, contact, batch.active_hands, batch.lengths, batch.counts, batch.sides)


@dataclass(frozen=True)
class _Prepared:
    """A condition as the Transformer takes it, the same at every timestep.

    text, object, extent (B, width). points (B, C, width) contact tokens with their mask (B, C). hand_rows (B, 2, K),
    object_rows (B, L) bool: the rows of a motion that are there. sides: which hands are in any motion; the others'
    tokens are left out. codes (B, token, width), mask (B, token): of the tokens of hands and object, in this order.
    """

    text: Tensor
    object: Tensor
    extent: Tensor
    points: Tensor
    points_mask: Tensor
    hand_rows: Tensor
    object_rows: Tensor
    sides: tuple[int, ...]
    codes: Tensor
    mask: Tensor

    def twice(self) -> "_Prepared":
        """Every motion two times, one whole batch after the other."""
        own = {name: value for name, value in vars(self).items() if isinstance(value, Tensor) and value.ndim}
        return replace(self, **{name: torch.cat((value, value)) for name, value in own.items()})


class DiffusionModel(nn.Module):
    """``x0 = model(hands, object, timesteps, condition)`` in normalised rows of the motion code."""

    signal: Tensor

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        if config.object_dropout and (config.contact_input == "map" or config.scale_input):
            wanted = "neither contact_input: map nor scale_input beside object_dropout"
            raise BadInput("diffusion", wanted, "one of them", "set object_dropout: 0: it would hide them as well")
        self.config, self.code = config, MotionCode(config.motion)
        self.register_buffer("signal", alphas_cumprod(), persistent=False)
        width = config.transformer.width
        self.hand_rows = config.transformer.frames_per_token
        self.object_rows = self.hand_rows * config.motion.object_knots
        # Trained with the contact model and frozen here; kept so that a checkpoint of this model is enough to sample.
        self.object_net = PointNet(3, config.point_net).requires_grad_(False)
        self.hands_in = nn.ModuleList([nn.Linear(HAND_FEATURES * self.hand_rows, width) for _ in range(2)])
        self.object_in = nn.Linear(self.code.object_features * self.object_rows, width)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.gate_in = nn.Linear(width, width) if config.input_gate else None
        self.text_in = _text_layers(config)
        summary = config.point_net.widths[-1]
        body = summary + POINT_COUNT * (config.contact_input == "map") + config.scale_input
        self.object_condition_in = nn.Linear(body, width)
        # A parameter, though no gradient changes it: buffers are averaged over the parts of a batch.
        known = torch.zeros(config.objects, summary)
        self.known_objects = nn.Parameter(known, requires_grad=False) if config.objects else None
        self.points_in = _hidden_layer(TOKEN_FEATURES, width) if config.contact_input == "tokens" else None
        self.extent_in = nn.Linear(3, width) if config.told else None
        self.to_go_in = nn.Linear(2 * width, width) if config.frames_to_go else None
        self.encoder = Encoder(config.transformer, has_condition=True)
        self.hands_out = nn.ModuleList([nn.Linear(width, HAND_FEATURES * self.hand_rows) for _ in range(2)])
        self.object_out = nn.Linear(width, self.code.object_features * self.object_rows)

    @torch.no_grad()
    def object_feature(self, points_m: Tensor) -> Tensor:
        """F_obj (B, G) of object points (B, N, 3), metres."""
        self.object_net.eval()
        return self.object_net(normalised_points(points_m)[0])[0]

    def forward(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition, keep: Tensor | None = None
    ) -> Motion:
        """Clean hands (B, 2, K, 99) and object (B, L, 10 or 16) from noised ones at timesteps (B,).

        keep: (B, 3) factors 0 or 1 of words, touched points and the object's body, for condition dropout and guidance.
        Padding and hands that do not act neither enter nor influence anything; their outputs mean nothing.
        """
        return self.denoise(hands, objects, timesteps, self.prepare(condition), keep)

    def prepare(self, condition: Condition) -> _Prepared:
        """The part of ``forward`` that is the same at every timestep (Text2HOI eq. 2, plus hand flags and length)."""
        lengths = condition.lengths
        hand_rows, object_rows = self.code.rows(condition.counts, lengths.device)
        contact = condition.contact.bool() & condition.active_hands[..., None]
        points = condition.points_m.new_zeros(len(lengths), 0, self.config.transformer.width)
        points_mask = points.new_zeros(points.shape[:2], dtype=torch.bool)
        if self.points_in is not None:
            placed = condition.points_m - self.code.place_m(condition.points_m, condition.part)[:, None]
            points, points_mask = contact_tokens(placed, condition.normals, condition.part, contact, CONTACT_TOKENS)
            points = self.points_in(points)
        extent = torch.cat((condition.active_hands.float(), lengths[:, None] / MAX_FRAMES), -1)
        hand_rows = condition.active_hands[:, :, None] & hand_rows[:, None]
        sides = tuple(side for side in range(2) if condition.sides[side])
        masks = [attention_mask_of(hand_rows[:, side], self.hand_rows) for side in sides]
        masks.append(attention_mask_of(object_rows, self.object_rows))
        return _Prepared(
            self.text_in(condition.text),
            self._body(condition, contact),
            self.extent_in(extent) if self.extent_in is not None else points.new_zeros(()),
            points,
            points_mask,
            hand_rows,
            object_rows,
            sides,
            self._codes(lengths, [mask.shape[1] for mask in masks], sides),
            torch.cat(masks, 1),
        )

    def _body(self, condition: Condition, contact: Tensor) -> Tensor:
        """(B, width) what is told of the object: F_obj, the contact map and the scale (Table S7)."""
        config, body = self.config, [condition.object]
        if config.contact_input == "map":
            body.append(contact.any(1).float())
        if config.scale_input:
            body.append(normalised_points(condition.points_m)[1])
        return self.object_condition_in(torch.cat(body, -1)) * self._known(condition.object)

    def _known(self, summary: Tensor) -> Tensor:
        """(B, 1) 1 where the object with F_obj (B, G) was in training; all ones for a network told of every object."""
        if self.known_objects is None:
            return summary.new_ones(len(summary), 1)
        # By differences: as products, which a GPU rounds to ten bits, an object would be far from itself.
        apart = torch.cdist(summary, self.known_objects, compute_mode="donot_use_mm_for_euclid_dist")
        apart = apart.amin(1, keepdim=True)
        return (apart < SAME_OBJECT * self.known_objects.norm(dim=-1).mean()).to(summary.dtype)

    def learn_objects(self, summaries: Tensor) -> None:
        """Keeps F_obj (K, G) of the ``config.objects`` objects in training."""
        if self.known_objects is not None:
            self.known_objects.data[:] = summaries.reshape(self.known_objects.shape)

    def denoise(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, known: _Prepared, keep: Tensor | None = None
    ) -> Motion:
        """``forward`` for a condition that has been prepared."""
        size, spread = self._size(timesteps), self.config.signal_scale
        hands, objects = self._layers(hands * size[:, None], objects * size, timesteps, known, keep)
        return hands * spread, objects * spread

    def _size(self, timesteps: Tensor) -> Tensor:
        """(B, 1, 1) factors that make noised rows of ``signal_scale`` as wide as 1."""
        share = self.signal[timesteps][:, None, None]
        return (share * self.config.signal_scale**2 + 1 - share).rsqrt()

    def _layers(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, known: _Prepared, keep: Tensor | None
    ) -> Motion:
        k, wide = self.hand_rows, self.object_rows
        hands = hands * known.hand_rows[..., None]
        agents = [self.hands_in[side](to_tokens(hands[:, side], k)) for side in known.sides]
        agents.append(self.object_in(to_tokens(objects * known.object_rows[..., None], wide)))
        time = self._time(timesteps)
        if self.gate_in is not None:
            agents = [x * (1 + self.gate_in(time)[:, None]) for x in agents]
        first, points = self._condition(time, known, keep)
        moving = torch.cat(agents, 1) + known.codes
        if self.config.condition_everywhere:
            moving = moving + first
        x = torch.cat((moving, first, points), 1)
        points_mask = known.points_mask if keep is None else known.points_mask & (keep[:, 1:2] > 0)
        mask = torch.cat((known.mask, known.mask.new_ones(len(x), 1), points_mask), 1)
        *own, body = self.encoder(x, mask, first)[:, : moving.shape[1]].split([x.shape[1] for x in agents], 1)
        found = [hands.new_zeros(hands[:, 0].shape)] * 2
        for side, token in zip(known.sides, own, strict=True):
            found[side] = to_frames(self.hands_out[side](token), hands.shape[2], k)
        return torch.stack(found, 1), to_frames(self.object_out(body), objects.shape[1], wide)

    def _codes(self, lengths: Tensor, n_tokens: Sequence[int], sides: Sequence[int]) -> Tensor:
        """Position codes (B, token, width) of all tokens: agent, frame, frames to go and the share that is done."""
        config, width = self.config, self.config.transformer.width
        every = self.hand_rows * max(1, config.motion.knot_frames)
        place = torch.arange(max(n_tokens), device=lengths.device) * every
        codes = sinusoid(place, width).expand(len(lengths), -1, -1)
        if self.to_go_in is not None:
            to_go = (lengths[:, None] - place).clamp_min(0)
            done = place * MAX_FRAMES / lengths[:, None]
            codes = codes + self.to_go_in(torch.cat((sinusoid(to_go, width), sinusoid(done, width)), -1))
        own = agent_codes(width, lengths.device)
        return torch.cat([codes[:, :n] + own[agent] for agent, n in zip((*sides, 2), n_tokens, strict=True)], 1)

    def _time(self, timesteps: Tensor) -> Tensor:
        """(B, width) what is told of timesteps (B,)."""
        return self.step_in(sinusoid(timesteps, self.config.transformer.width))

    def _condition(self, time: Tensor, known: _Prepared, keep: Tensor | None) -> tuple[Tensor, Tensor]:
        """The condition token (B, 1, width) and the contact tokens: Text2HOI eq. 3."""
        text, body, points = known.text, known.object, known.points
        if keep is not None:
            text, body = text * keep[:, :1], body * keep[:, 2:]
        return (time + text + body + known.extent)[:, None], points


def _text_layers(config: DiffusionConfig) -> nn.Module:
    if config.text_input == "linear":
        return nn.Linear(TEXT_FEATURES, config.transformer.width)
    read = VerbReading(TEXT_FEATURES, config.verbs)
    return nn.Sequential(read, _hidden_layer(config.verbs, config.transformer.width))


def _hidden_layer(inputs: int, width: int) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width))


def guided(model: DiffusionModel, condition: Condition, guidance: float) -> Denoise:
    """The model as a denoiser for ``sample_motion``; classifier-free guidance (Ho and Salimans 2022) if not 1."""
    known = model.prepare(condition)

    def denoise(hands: Tensor, objects: Tensor, timesteps: Tensor) -> Motion:
        return model.denoise(hands, objects, timesteps, known)

    def denoise_guided(hands: Tensor, objects: Tensor, timesteps: Tensor) -> Motion:
        both = [torch.cat((x, x)) for x in (hands, objects, timesteps)]
        # Words are what is pushed; an object that is not there would be a motion of another kind altogether.
        keep = torch.ones(2 * len(hands), 3, device=hands.device)
        keep[len(hands) :, 0] = 0
        found = [own.chunk(2) for own in model.denoise(both[0], both[1], both[2], doubled, keep)]
        guided_hands, guided_objects = (without + guidance * (told - without) for told, without in found)
        return guided_hands, guided_objects

    doubled = known.twice() if guidance != 1 else known
    return denoise if guidance == 1 else denoise_guided


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
        """Hands (B, 2, F, 99) and object (B, F, 10), model frame, from noise (B, 2, K, 99) and (B, L, 10 or 16).

        generator: of DDPM's noise. The object's origin is at zero in the first frame.
        """
        denoise = guided(self.network, condition, sampler.guidance)
        device = condition.text.device
        coded = sample_motion(denoise, (send(noise[0], device), send(noise[1], device)), sampler, generator)
        return self._features(coded, condition)

    @torch.no_grad()
    def denoise_once(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition, generator: torch.Generator
    ) -> Motion:
        """Normalised rows of motions, noised to ``timesteps`` (B,), denoised by one call, placed as by ``sample``."""
        signal = alphas_cumprod(timesteps.device)
        noised = []
        for clean in (hands, objects):
            noise = torch.randn(clean.shape, generator=generator)
            noised.append(add_noise(clean, noise.to(clean.device), timesteps, signal))
        return self._features(self.network(noised[0], noised[1], timesteps, condition), condition)

    def _features(self, coded: Motion, condition: Condition) -> Motion:
        code, counts = self.network.code, condition.counts
        rows = code.settled(*self.normaliser.decode(*coded), counts)
        hands, objects = code.curves(*rows, counts)
        hands = code.in_world(hands, objects)
        objects = code.at_origin(proper_object(objects), condition.points_m, condition.part)
        return recentred(proper_hands(hands), objects)
