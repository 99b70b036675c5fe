"""The hand refiner: moves generated hands out of the object and onto its surface.

Text2HOI Sec. 3.3 and supplement, Table S10: a Transformer over left- and right-hand tokens; the object stays. Each
deviation is a switch, off by default: everything seen and corrected in the object's frame, where the same touch always
looks the same; the displacement to the surface with its sign beside the attention map, without which inside and outside
look alike; a residual that starts at zero, of whose layers only the last does, so that all learn from the first step;
and, as the rival of the supplement's Sec. 8, a refiner that is a diffusion model.
"""

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from hoidata.batches.requests import RequestBatch
from hoidata.clips.features import HAND_FEATURES, HAND_ROTATIONS_6D, WRIST
from hoidata.errors import BadInput
from models.common.features import (
    hands_in_object_frame,
    hands_in_world,
    object_position_m,
    object_rotmat,
    place_points,
    proper_hands,
)
from models.common.sampling import TRAIN_STEPS, SamplerConfig, add_noise, alphas_cumprod, sample
from models.common.spline import projected
from models.common.transformer import (
    Encoder,
    TransformerConfig,
    agent_codes,
    attention_mask_of,
    sinusoid,
    to_frames,
    to_tokens,
)

JOINT_FEATURES = 63
SAMPLER = SamplerConfig()  # of a refiner that is a diffusion model
ATTENTION_RATE_PER_M = 50.0
REACH_M = 0.05


@dataclass(frozen=True)
class RefinerConfig:
    """transformer: its sizes. contact_map: read the raw contact map and the norms of the placed points.

    view: the frame of hands, joints and displacements. attention: of displacements per axis, or of their squares
    (released). surface_input: signed distances and displacements are read too. output: the hands, or what is added to
    them; of that, one means wrist_reach_m for the wrist and rotation_reach for a 6D number. knot_frames: the output
    becomes the nearest spline with a knot every so many frames (0: stays), so that corrections never jitter.
    noise_steps: of a refiner that is a diffusion model (Table S1): by how many of the 1,000 steps it noises coarse
    hands before it denoises them; 0: it is none.
    """

    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    contact_map: bool = True
    points: int = 1024
    view: Literal["world", "object"] = "world"
    attention: Literal["absolute", "square"] = "absolute"
    surface_input: bool = False
    output: Literal["hands", "residual"] = "hands"
    wrist_reach_m: float = 1.0
    rotation_reach: float = 1.0
    knot_frames: int = 0
    noise_steps: int = 0


@dataclass(frozen=True)
class NoisedHands:
    """What a refiner that is a diffusion model denoises: hands (B, 2, F, 99) in the frame they are seen in, at
    timesteps (B,)."""

    hands: Tensor
    timesteps: Tensor


@dataclass(frozen=True)
class CoarseMotion:
    """What the refiner sees: hands (B, 2, F, 99) and object (B, F, 10) in metres; and in the object's frame joints_m
    (B, 2, F, 21, 3), their signed distance_m (B, 2, F, 21) and offset_m to the nearest surface point (B, 2, F, 21, 3).

    present (B, 2, F) masks; asked: the motions' objects and lengths; contact_map (B, N) the contact map.
    """

    hands: Tensor
    object: Tensor
    joints_m: Tensor
    distance_m: Tensor
    offset_m: Tensor
    present: Tensor
    asked: RequestBatch
    contact_map: Tensor


def attention_map(offset_m: Tensor, kind: str = "absolute") -> Tensor:
    """exp(-50 |D|) per axis of the displacement to the nearest surface point (Text2HOI Sec. 3.3; GRIP)."""
    return torch.exp(-ATTENTION_RATE_PER_M * (offset_m.abs() if kind == "absolute" else offset_m.square()))


class RefinerModel(nn.Module):
    """Refined hands (B, 2, F, 99), metres, from a :class:`CoarseMotion`."""

    reach: Tensor

    def __init__(self, config: RefinerConfig) -> None:
        super().__init__()
        if config.noise_steps and not SAMPLER.steps <= config.noise_steps <= TRAIN_STEPS:
            wanted = f"noise_steps 0, or {SAMPLER.steps} to {TRAIN_STEPS}"
            raise BadInput("refiner", wanted, str(config.noise_steps), "set it so")
        self.config = config
        width, k = config.transformer.width, config.transformer.frames_per_token
        inputs = HAND_FEATURES + 2 * JOINT_FEATURES + (JOINT_FEATURES + 21) * config.surface_input
        inputs += 2 * config.points * config.contact_map
        if config.noise_steps:
            inputs += HAND_FEATURES
            self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.hands_in = nn.ModuleList([nn.Linear(inputs * k, width) for _ in range(2)])
        self.encoder = Encoder(config.transformer)
        self.hands_out = nn.ModuleList([nn.Linear(width, HAND_FEATURES * k) for _ in range(2)])
        for layer in self.hands_out if config.output == "residual" else ():
            nn.init.zeros_(layer.weight)  # pyright: ignore[reportArgumentType]
            nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
        reach = torch.full((HAND_FEATURES,), config.rotation_reach)
        reach[WRIST] = config.wrist_reach_m
        self.register_buffer("reach", reach, persistent=False)

    def forward(self, coarse: CoarseMotion, noised: NoisedHands | None = None) -> Tensor:
        """In the world; ``noised`` as in :meth:`corrected`."""
        hands = self.corrected(coarse, noised)
        return hands_in_world(hands, coarse.object) if self.config.view == "object" else hands

    def corrected(self, coarse: CoarseMotion, noised: NoisedHands | None = None) -> Tensor:
        """Refined hands (B, 2, F, 99) in the frame they are seen in; ``noised`` is for diffusion models.

        Hands that are absent, and padding, neither influence anything nor mean anything in the result.
        """
        k, n_frames = self.config.transformer.frames_per_token, coarse.hands.shape[2]
        local = self.seen(coarse.hands, coarse.object)
        inputs = self._inputs(coarse, local)
        if noised is not None:
            inputs = torch.cat((inputs, noised.hands), -1)
        inputs = inputs * coarse.present[..., None]
        agents = [layer(to_tokens(inputs[:, side], k)) for side, layer in enumerate(self.hands_in)]
        tokens = torch.stack(agents, 1)
        place = torch.arange(tokens.shape[2], device=tokens.device) * k
        width = self.config.transformer.width
        tokens = tokens + sinusoid(place, width) + agent_codes(width, tokens.device)[:2, None]
        if noised is not None:
            tokens = tokens + self.step_in(sinusoid(noised.timesteps, width))[:, None, None]
        attention_mask = attention_mask_of(coarse.present, k).flatten(1)
        # A clip without any present hand still needs one key to attend to; its result is masked anyway.
        attention_mask[:, 0] |= ~attention_mask.any(1)
        both = self.encoder(tokens.flatten(1, 2), attention_mask).unflatten(1, tokens.shape[1:3]).unbind(1)
        change = [to_frames(layer(x), n_frames, k) for layer, x in zip(self.hands_out, both, strict=True)]
        residual = torch.stack(change, 1)
        if self.config.knot_frames:
            residual = projected(residual, list(coarse.asked.counts), self.config.knot_frames)
        return local + residual * self.reach if self.config.output == "residual" else residual

    def seen(self, hands: Tensor, objects: Tensor) -> Tensor:
        """Hands (B, 2, F, 99) of the world in the frame they are seen in, beside objects (B, F, 10)."""
        return hands_in_object_frame(hands, objects) if self.config.view == "object" else hands

    def _inputs(self, coarse: CoarseMotion, local: Tensor) -> Tensor:
        """(B, 2, F, D) all that is read: hands, joints, attention map, and what the config adds."""
        config, objects = self.config, coarse.object
        joints, offset = coarse.joints_m, coarse.offset_m
        if config.view == "world":
            turn = object_rotmat(objects)[:, None].transpose(-1, -2)
            joints, offset = joints @ turn + object_position_m(objects)[:, None, :, None], offset @ turn
        scale = 10 if config.view == "object" else 1
        parts = [local[..., WRIST] * scale, local[..., HAND_ROTATIONS_6D], (joints * scale).flatten(-2)]
        parts.append(attention_map(offset, config.attention).flatten(-2))
        if config.surface_input:
            towards = coarse.offset_m / (coarse.offset_m.norm(dim=-1, keepdim=True) + REACH_M)
            parts += [towards.flatten(-2) * 2, (coarse.distance_m / REACH_M).clamp(-2, 2)]
        if config.contact_map:
            shape = (*local.shape[:-1], config.points)
            # In the object's frame the norms of the points do not change with the motion.
            own = coarse.asked.points_m[:, None] if config.view == "object" else place_points(coarse.asked, objects)
            norms = own.norm(dim=-1)
            parts += [norms[:, None].expand(shape), coarse.contact_map[:, None, None].expand(shape)]
        return torch.cat(parts, -1)


@torch.no_grad()
def refine(network: RefinerModel, coarse: CoarseMotion, noise: Tensor | None = None) -> Tensor:
    """Refined hands (B, 2, F, 99), metres, with proper rotations.

    noise: (B, 2, F, 99), which a refiner that is a diffusion model begins with; others need none.
    """
    if noise is None:
        return proper_hands(network(coarse))
    hands = network.seen(coarse.hands, coarse.object)
    first = network.config.noise_steps
    steps = torch.full((len(hands),), first - 1, device=hands.device)
    noised = add_noise(hands, noise.to(hands), steps, alphas_cumprod(hands.device))

    def denoise(x: Tensor, steps: Tensor) -> Tensor:
        return network.corrected(coarse, NoisedHands(x, steps))

    clean = sample(denoise, noised, SAMPLER, [], first)
    return proper_hands(hands_in_world(clean, coarse.object) if network.config.view == "object" else clean)
