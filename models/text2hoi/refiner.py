"""The hand refiner: moves generated hands out of the object and onto its surface.

Text2HOI Sec. 3.3 and supplement, Table S10: a Transformer over left- and right-hand tokens; the object stays. Each
deviation is a switch, off by default: everything seen and corrected in the object's frame, where the same touch always
looks the same; the displacement to the surface with its sign beside the attention map, without which inside and outside
look alike; and a residual that starts at zero, of whose layers only the last does, so that all learn from the first
step.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from hoidata.batches.requests import RequestBatch
from hoidata.clips.features import HAND_FEATURES, HAND_ROTATIONS_6D, WRIST
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import POINT_COUNT
from hoidata.objects.signed_distance_grid import DistanceFields
from models.common.features import (
    Hands,
    hands_in_object_frame,
    hands_in_world,
    object_hinge_rad,
    object_position_m,
    object_rotmat,
    place_points,
    proper_hands,
    to_object_frame,
)
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
    """transformer: its sizes. contact_map: read the raw contact map and the norms of the placed points.

    view: the frame of hands, joints and displacements. surface_input: signed distances and displacements are read too.
    output: the hands, or what is added to them; of that, one means wrist_reach_m for the wrist and rotation_reach for a
    6D number. knot_frames: the output becomes the nearest spline with a knot every so many frames (0: stays), so that
    corrections never jitter.
    """

    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    contact_map: bool = True
    view: Literal["world", "object"] = "world"
    surface_input: bool = False
    output: Literal["hands", "residual"] = "hands"
    wrist_reach_m: float = 1.0
    rotation_reach: float = 1.0
    knot_frames: int = 0


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
        inputs = HAND_FEATURES + 2 * JOINT_FEATURES + (JOINT_FEATURES + 21) * config.surface_input
        inputs += 2 * POINT_COUNT * config.contact_map
        self.hands_in = nn.ModuleList([nn.Linear(inputs * k, width) for _ in range(2)])
        self.encoder = Encoder(config.transformer)
        self.hands_out = nn.ModuleList([nn.Linear(width, HAND_FEATURES * k) for _ in range(2)])
        for layer in self.hands_out if config.output == "residual" else ():
            nn.init.zeros_(layer.weight)  # pyright: ignore[reportArgumentType]
            nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
        reach = torch.full((HAND_FEATURES,), config.rotation_reach)
        reach[WRIST] = config.wrist_reach_m
        self.register_buffer("reach", reach, persistent=False)

    def forward(self, coarse: CoarseMotion) -> Tensor:
        """In the world."""
        hands = self.corrected(coarse)
        return hands_in_world(hands, coarse.object) if self.config.view == "object" else hands

    def corrected(self, coarse: CoarseMotion) -> Tensor:
        """Refined hands (B, 2, F, 99) in the frame they are seen in.

        Hands that are absent, and padding, neither influence anything nor mean anything in the result.
        """
        k, n_frames = self.config.transformer.frames_per_token, coarse.hands.shape[2]
        local = self.seen(coarse.hands, coarse.object)
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
        parts.append(attention_map(offset).flatten(-2))
        if config.surface_input:
            towards = coarse.offset_m / (coarse.offset_m.norm(dim=-1, keepdim=True) + REACH_M)
            parts += [towards.flatten(-2) * 2, (coarse.distance_m / REACH_M).clamp(-2, 2)]
        if config.contact_map:
            shape = (*local.shape[:-1], POINT_COUNT)
            # In the object's frame the norms of the points do not change with the motion.
            own = coarse.asked.points_m[:, None] if config.view == "object" else place_points(coarse.asked, objects)
            norms = own.norm(dim=-1)
            parts += [norms[:, None].expand(shape), coarse.contact_map[:, None, None].expand(shape)]
        return torch.cat(parts, -1)


@torch.no_grad()
def refine(network: RefinerModel, coarse: CoarseMotion) -> Tensor:
    """Refined hands (B, 2, F, 99), metres, with proper rotations."""
    return proper_hands(network(coarse))


class Surface:
    """Joints and vertices of hand features, and their signed distances to each clip's object."""

    def __init__(self, hands: Hands, fields: DistanceFields) -> None:
        self.hands, self.fields = hands, fields

    @classmethod
    def of(cls, hands: Hands, objects: Iterable[ObjectModel], resolution: int, device: torch.device) -> "Surface":
        """Fields of all these objects, told apart by their names."""
        fields = DistanceFields([(model.name, model) for model in objects], resolution)
        return cls(hands.to(device), fields.to(device))

    def coarse(
        self, batch: RequestBatch, hands: Tensor, objects: Tensor, contact_map: Tensor, present: Tensor
    ) -> CoarseMotion:
        """The refiner's view of generated hands (B, 2, F, 99) and object (B, F, 10) with contact maps (B, N).

        present: (B, 2, F) bool, the frames in which a hand is there.
        """
        joints = self.hands.joints(hands, batch.betas, batch.template_m)
        local, distance, offset = self.measure(batch, joints, objects)
        return CoarseMotion(hands, objects, local, distance, offset, present, batch, contact_map)

    def measure(self, batch: RequestBatch, points_m: Tensor, objects: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """For points (B, 2, F, P, 3) of the model frame and objects (B, F, 10): the points in the object's frame, their
        signed distance (B, 2, F, P), and the offset to the nearest surface point (B, 2, F, P, 3)."""
        local = to_object_frame(points_m, objects[:, None])
        rows = self.fields.rows([model.name for model in batch.objects])
        hinge = object_hinge_rad(objects) * batch.articulated[:, None]
        both_sides = local.transpose(1, 2).flatten(2, 3)
        distance, offset = self.fields.query(rows, both_sides, hinge)
        shape = (len(local), local.shape[2], 2, local.shape[3])
        return local, distance.reshape(shape).transpose(1, 2), offset.reshape(*shape, 3).transpose(1, 2)
