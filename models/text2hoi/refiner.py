"""The hand refiner: moves generated hands out of the object and onto its surface.

Text2HOI, Sec. 3.3 and supplement, Table S10: a Transformer over left- and right-hand tokens; the object does not move.

``output: residual`` deviates from the paper:

- Hands, joints and displacements are in the object's frame, where the same contact has the same features.
- The signed displacement to the surface is an input, since the attention map is the same inside and outside. The
  contact map and the points' norms are not.
- The network predicts a correction that starts at zero, projected to splines so that it does not jitter.

``output: diffusion`` is the diffusion-based refiner of the supplement's Table S1: it noises coarse hands by half of the
steps and denoises them, with the inputs of the paper's refiner as the condition.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from hoidata.batches.requests import RequestBatch
from hoidata.clips.features import HAND_FEATURES, HAND_ROTATIONS_6D, OBJECT_HINGE, OBJECT_POSITION, WRIST
from hoidata.devices import send
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import POINT_COUNT
from hoidata.objects.signed_distance_grid import DistanceFields
from models.common.features import (
    Hands,
    hands_in_object_frame,
    hands_in_world,
    object_rotmat,
    place_points,
    proper_hands,
    to_object_frame,
)
from models.common.sampling import SamplerConfig, add_noise, alphas_cumprod, sample
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
WRIST_UNIT_M, ROTATION_UNIT = 0.05, 0.3  # corrections of the wrist and of 6D rotations for a network output of one
KNOT_FRAMES = 4  # frames between the knots of a correction
FIELD_RESOLUTION = 48  # points of the distance grids along each axis
NOISE_STEPS = 500  # of 1,000, to which a diffusion model noises coarse hands
DIFFUSION_SAMPLER = SamplerConfig("ddim", 20)  # from step NOISE_STEPS to 0


@dataclass(frozen=True)
class RefinerConfig:
    """Sizes and inputs of the refiner; the defaults are the paper's."""

    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    # Predict the hands in the world, a correction in the object's frame, or the hands in the world from noised ones.
    output: Literal["hands", "residual", "diffusion"] = "hands"


@dataclass(frozen=True)
class NoisedHands:
    """Noised hands at a timestep, an input of a diffusion model."""

    hands: Tensor  # (B, 2, F, 99) metres, model frame
    steps: Tensor  # (B,) timesteps, below NOISE_STEPS


@dataclass(frozen=True)
class CoarseMotion:
    """The refiner's input: B generated motions of F frames, relative to the object's surface."""

    hands: Tensor  # (B, 2, F, 99) metres, model frame
    object: Tensor  # (B, F, 10) metres, model frame
    joints_m: Tensor  # (B, 2, F, 21, 3) in the object's frame
    distance_m: Tensor  # (B, 2, F, 21) signed distance of joints to the surface, negative inside
    offset_m: Tensor  # (B, 2, F, 21, 3) from joints to the nearest surface point, in the object's frame
    present: Tensor  # (B, 2, F) bool, frames with each hand
    batch: RequestBatch  # objects and lengths of the motions
    contact_map: Tensor  # (B, N) probabilities, or 0 or 1


def attention_map(offset_m: Tensor) -> Tensor:
    """exp(-50 |D|) per axis of the displacement D to the nearest surface point (Text2HOI, Sec. 3.3; GRIP)."""
    return torch.exp(-ATTENTION_RATE_PER_M * offset_m.abs())


class RefinerModel(nn.Module):
    """Refined hands (B, 2, F, 99), metres, from a :class:`CoarseMotion`."""

    reach: Tensor

    def __init__(self, config: RefinerConfig) -> None:
        super().__init__()
        self.config, self.is_residual = config, config.output == "residual"
        self.is_diffusion = config.output == "diffusion"
        width, frames_per_token = config.transformer.width, config.transformer.frames_per_token
        inputs = HAND_FEATURES + 2 * JOINT_FEATURES + (JOINT_FEATURES + 21 if self.is_residual else 2 * POINT_COUNT)
        if self.is_diffusion:
            inputs += HAND_FEATURES
            self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.hands_in = nn.ModuleList([nn.Linear(inputs * frames_per_token, width) for _ in range(2)])
        self.encoder = Encoder(config.transformer)
        self.hands_out = nn.ModuleList([nn.Linear(width, HAND_FEATURES * frames_per_token) for _ in range(2)])
        # Only the last layer is zero, so that all layers learn from the first step.
        for layer in self.hands_out if self.is_residual else ():
            nn.init.zeros_(layer.weight)  # pyright: ignore[reportArgumentType]
            nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
        reach = torch.full((HAND_FEATURES,), ROTATION_UNIT if self.is_residual else 1.0)
        reach[WRIST] = WRIST_UNIT_M if self.is_residual else 1.0
        self.register_buffer("reach", reach, persistent=False)

    def forward(self, coarse: CoarseMotion, noised: NoisedHands | None = None) -> Tensor:
        """Refined hands (B, 2, F, 99) in the world; ``noised`` is what a diffusion model denoises."""
        hands = self.corrected(coarse, noised)
        return hands_in_world(hands, coarse.object) if self.is_residual else hands

    def corrected(self, coarse: CoarseMotion, noised: NoisedHands | None = None) -> Tensor:
        """Refined hands (B, 2, F, 99) in the frame of ``in_view``; ``noised`` as in ``forward``.

        Absent hands and padding are masked; their outputs are meaningless.
        """
        assert self.is_diffusion == (noised is not None)
        frames_per_token, n_frames = self.config.transformer.frames_per_token, coarse.hands.shape[2]
        local = self.in_view(coarse.hands, coarse.object)
        inputs = self._inputs(coarse, local)
        inputs = (inputs if noised is None else torch.cat((inputs, noised.hands), -1)) * coarse.present[..., None]
        agents = [layer(to_tokens(inputs[:, side], frames_per_token)) for side, layer in enumerate(self.hands_in)]
        tokens = torch.stack(agents, 1)
        frame = torch.arange(tokens.shape[2], device=tokens.device) * frames_per_token
        width = self.config.transformer.width
        tokens = tokens + sinusoid(frame, width) + agent_codes(width, tokens.device)[:2, None]
        if noised is not None:
            tokens = tokens + self.step_in(sinusoid(noised.steps, width))[:, None, None]
        attention_mask = attention_mask_of(coarse.present, frames_per_token).flatten(1)
        # A clip without any present hand still needs one key to attend to; its result is masked anyway.
        attention_mask[:, 0] |= ~attention_mask.any(1)
        encoded = self.encoder(tokens.flatten(1, 2), attention_mask).unflatten(1, tokens.shape[1:3]).unbind(1)
        change = [
            to_frames(layer(x), n_frames, frames_per_token) for layer, x in zip(self.hands_out, encoded, strict=True)
        ]
        residual = torch.stack(change, 1)
        if not self.is_residual:
            return residual
        return local + projected(residual, list(coarse.batch.counts), KNOT_FRAMES) * self.reach

    def in_view(self, hands: Tensor, objects: Tensor) -> Tensor:
        """World hands (B, 2, F, 99) in the network's frame: the world, or the object (B, F, 10) for a residual."""
        return hands_in_object_frame(hands, objects) if self.is_residual else hands

    def _inputs(self, coarse: CoarseMotion, local: Tensor) -> Tensor:
        """Input features (B, 2, F, D): hands, joints, attention map, and displacements or object points."""
        joints, offset = coarse.joints_m, coarse.offset_m
        if self.is_residual:
            # Metres near the object are small numbers; ten times as large they are comparable to rotations.
            parts = [local[..., WRIST] * 10, local[..., HAND_ROTATIONS_6D], (joints * 10).flatten(-2)]
            # Bounded direction to the surface: a unit vector far away, zero on the surface.
            direction = offset / (offset.norm(dim=-1, keepdim=True) + REACH_M)
            distance = (coarse.distance_m / REACH_M).clamp(-2, 2)
            return torch.cat((*parts, attention_map(offset).flatten(-2), direction.flatten(-2) * 2, distance), -1)
        rotation_transposed = object_rotmat(coarse.object)[:, None].transpose(-1, -2)
        joints = joints @ rotation_transposed + coarse.object[..., OBJECT_POSITION][:, None, :, None]
        shape = (*local.shape[:-1], POINT_COUNT)
        norms = place_points(coarse.batch, coarse.object).norm(dim=-1)[:, None].expand(shape)
        contact_map = coarse.contact_map[:, None, None].expand(shape)
        attention = attention_map(offset @ rotation_transposed)
        return torch.cat((local, joints.flatten(-2), attention.flatten(-2), norms, contact_map), -1)


@torch.no_grad()
def refine(network: RefinerModel, coarse: CoarseMotion, draw: Callable[[], Tensor]) -> Tensor:
    """Refined hands (B, 2, F, 99), metres, with proper rotations.

    draw: standard normal noise (B, 2, F, 99), which only a diffusion model uses.
    """
    if not network.is_diffusion:
        return proper_hands(network(coarse))
    device = coarse.hands.device
    last = torch.full((len(coarse.hands),), NOISE_STEPS - 1, device=device)
    noised = add_noise(coarse.hands, send(draw(), device), last, alphas_cumprod(device))

    def denoise(hands: Tensor, steps: Tensor) -> Tensor:
        return network(coarse, NoisedHands(hands, steps))

    refined = sample(denoise, noised, DIFFUSION_SAMPLER, lambda: send(draw(), device), start=NOISE_STEPS)
    return proper_hands(refined)


class Surface:
    """Signed distances of hand joints and vertices to each clip's object."""

    def __init__(self, hands: Hands, fields: DistanceFields) -> None:
        self.hands, self.fields = hands, fields

    @classmethod
    def of(cls, hands: Hands, objects: Iterable[ObjectModel], device: torch.device) -> "Surface":
        """Distance grids of these objects, one per name."""
        fields = DistanceFields([(model.name, model) for model in objects], FIELD_RESOLUTION)
        return cls(hands.to(device), fields.to(device))

    def coarse(
        self, batch: RequestBatch, hands: Tensor, objects: Tensor, contact_map: Tensor, present: Tensor
    ) -> CoarseMotion:
        """The refiner's input from generated hands (B, 2, F, 99) and objects (B, F, 10) in the model frame.

        contact_map: (B, N), from 0 to 1. present: (B, 2, F) bool, frames with each hand.
        """
        joints = self.hands.joints(hands, batch.betas, batch.template_m)
        local, distance, offset = self.measure(batch, joints, objects)
        return CoarseMotion(
            hands=hands,
            object=objects,
            joints_m=local,
            distance_m=distance,
            offset_m=offset,
            present=present,
            batch=batch,
            contact_map=contact_map,
        )

    def measure(self, batch: RequestBatch, points_m: Tensor, objects: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions of hand points relative to the object.

        points_m: (B, 2, F, P, 3) in the model frame. objects: (B, F, 10).
        Returns the points in the object's frame (B, 2, F, P, 3), their signed distance (B, 2, F, P) to its surface, and
        the offset (B, 2, F, P, 3) to the nearest surface point, all in metres.
        """
        local, *query = self._query(batch, points_m, objects)
        distance, offset = self.fields.query(*query)
        shape = (len(local), local.shape[2], 2, local.shape[3])
        return local, distance.reshape(shape).transpose(1, 2), offset.reshape(*shape, 3).transpose(1, 2)

    def distance(self, batch: RequestBatch, points_m: Tensor, objects: Tensor) -> Tensor:
        """The distances of ``measure``, computed without the offsets."""
        local, *query = self._query(batch, points_m, objects)
        shape = (len(local), local.shape[2], 2, local.shape[3])
        return self.fields.distance(*query).reshape(shape).transpose(1, 2)

    def _query(self, batch: RequestBatch, points_m: Tensor, objects: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Points in the object's frame (B, 2, F, P, 3), and the arguments of ``DistanceFields.query``."""
        local = to_object_frame(points_m, objects[:, None])
        rows = self.fields.rows([model.name for model in batch.objects])
        hinge = objects[..., OBJECT_HINGE] * batch.articulated[:, None]
        return local, rows, local.transpose(1, 2).flatten(2, 3), hinge
