"""The hand refiner: moves generated hands out of the object and onto its surface.

Text2HOI Sec. 3.3 and supplement, Table S10: a Transformer over left- and right-hand tokens gives a residual on the
coarse hands; the object stays. Deviations: everything is seen and corrected in the object's frame, where the same
touch always looks the same; the displacement to the surface enters with its sign beside the attention map, without
which inside and outside look alike; only the output layers start at zero (a residual of zero), so every layer learns
from the first step.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from hoidata.clips.features import HAND_FEATURES, HAND_ROTATIONS_6D, WRIST
from models.common.features import hands_in_object_frame, hands_in_world, proper_hands
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
ATTENTION_RATE_PER_M = 50.0
REACH_M = 0.05


@dataclass(frozen=True)
class RefinerConfig:
    """transformer: its sizes. contact_map: also read the raw contact map and the norms of the placed points (paper).

    wrist_reach_m, rotation_reach: what an output of one means for the wrist and for a 6D number. knot_frames: the
    residual becomes the nearest spline with a knot every so many frames (0: stays), so that corrections never jitter.
    """

    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    contact_map: bool = True
    points: int = 1024
    wrist_reach_m: float = 0.05
    rotation_reach: float = 0.3
    knot_frames: int = 0


@dataclass(frozen=True)
class CoarseMotion:
    """What the refiner sees: hands (B, 2, F, 99) and object (B, F, 10) in metres; and in the object's frame joints_m
    (B, 2, F, 21, 3), their signed distance_m (B, 2, F, 21) and offset_m to the nearest surface point (B, 2, F, 21, 3).

    present (B, 2, F) masks; points_m (B, N, 3) the object's sampled points; contact_map (B, N) the contact map; counts:
    how many frames each motion has.
    """

    hands: Tensor
    object: Tensor
    joints_m: Tensor
    distance_m: Tensor
    offset_m: Tensor
    present: Tensor
    points_m: Tensor
    contact_map: Tensor
    counts: tuple[int, ...]


def attention_map(offset_m: Tensor) -> Tensor:
    """exp(-50 |D|) per axis of the displacement to the nearest surface point (Text2HOI Sec. 3.3; GRIP)."""
    return torch.exp(-ATTENTION_RATE_PER_M * offset_m.abs())


class RefinerModel(nn.Module):
    """Refined hands (B, 2, F, 99), metres, from a :class:`CoarseMotion`."""

    reach: Tensor

    def __init__(self, config: RefinerConfig) -> None:
        super().__init__()
        self.config = config
        width, k = config.transformer.width, config.transformer.frames_per_token
        inputs = HAND_FEATURES + 3 * JOINT_FEATURES + 21 + (2 * config.points if config.contact_map else 0)
        self.hands_in = nn.ModuleList([nn.Linear(inputs * k, width) for _ in range(2)])
        self.encoder = Encoder(config.transformer)
        self.hands_out = nn.ModuleList([nn.Linear(width, HAND_FEATURES * k) for _ in range(2)])
        for layer in self.hands_out:
            nn.init.zeros_(layer.weight)  # pyright: ignore[reportArgumentType]
            nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
        reach = torch.full((HAND_FEATURES,), config.rotation_reach)
        reach[WRIST] = config.wrist_reach_m
        self.register_buffer("reach", reach, persistent=False)

    def forward(self, coarse: CoarseMotion) -> Tensor:
        """Hands that are absent, and padding, neither influence anything nor mean anything in the result."""
        k, n_frames = self.config.transformer.frames_per_token, coarse.hands.shape[2]
        local = hands_in_object_frame(coarse.hands, coarse.object)
        inputs = self._inputs(coarse, local) * coarse.present[..., None]
        agents = [layer(to_tokens(inputs[:, side], k)) for side, layer in enumerate(self.hands_in)]
        tokens = torch.stack(agents, 1)
        place = torch.arange(tokens.shape[2], device=tokens.device) * k
        width = self.config.transformer.width
        tokens = tokens + sinusoid(place, width) + agent_codes(width, tokens.device)[:2, None]
        attention_mask = attention_mask_of(coarse.present, k).flatten(1)
        # A clip without any present hand still needs one key to attend to; its result is masked anyway.
        attention_mask[:, 0] |= ~attention_mask.any(1)
        both = self.encoder(tokens.flatten(1, 2), attention_mask).unflatten(1, tokens.shape[1:3]).unbind(1)
        change = [to_frames(layer(x), n_frames, k) for layer, x in zip(self.hands_out, both, strict=True)]
        residual = torch.stack(change, 1)
        if self.config.knot_frames:
            residual = projected(residual, list(coarse.counts), self.config.knot_frames)
        return hands_in_world(local + residual * self.reach, coarse.object)

    def _inputs(self, coarse: CoarseMotion, local: Tensor) -> Tensor:
        scaled = torch.cat((local[..., WRIST] * 10, local[..., HAND_ROTATIONS_6D]), -1)
        offset = coarse.offset_m / (coarse.offset_m.norm(dim=-1, keepdim=True) + REACH_M)
        parts = [
            scaled,
            (coarse.joints_m * 10).flatten(-2),
            attention_map(coarse.offset_m).flatten(-2),
            offset.flatten(-2) * 2,
            (coarse.distance_m / REACH_M).clamp(-2, 2),
        ]
        if self.config.contact_map:
            shape = (*local.shape[:-1], self.config.points)
            # In the object's frame the norms of the points do not change with the motion.
            norms = coarse.points_m.norm(dim=-1)[:, None, None].expand(shape)
            parts += [norms, coarse.contact_map[:, None, None].expand(shape)]
        return torch.cat(parts, -1)


@torch.no_grad()
def refine(network: RefinerModel, coarse: CoarseMotion) -> Tensor:
    """Refined hands (B, 2, F, 99), metres, with proper rotations."""
    return proper_hands(network(coarse))
