"""Training of the diffusion network: what one step and one validation are."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, collate
from hoidata.clips.features import GLOBAL_ORIENT_6D
from hoidata.geometry.rotations import rot6d_to_rotmat
from models.common import losses
from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus, any_form
from models.common.family import Losses, Network, Objective, Setup
from models.common.features import Hands, Normaliser, object_rotmat, place_points
from models.common.sampling import TRAIN_STEPS, add_noise, alphas_cumprod
from models.text2hoi.contact import ContactModel
from models.text2hoi.contact_training import CONTACT
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel, MotionGenerator

VALIDATION_STEPS = (100, 300, 500, 700, 900)


@dataclass(frozen=True)
class DiffusionLossConfig:
    """Weights beside the simple loss (1): eq. 6 in contact thresholds, eq. 7. frames: how many of a clip they see."""

    distance_weight: float = 1.0
    orientation_weight: float = 1.0
    frames: int = 8
    entries: int = 8192


class DiffusionObjective:
    """Text2HOI eq. 4-7."""

    def __init__(
        self,
        network: DiffusionModel,
        weights: DiffusionLossConfig,
        corpus: Corpus,
        hands: Hands,
        normaliser: Normaliser,
        device: torch.device,
    ) -> None:
        self.network, self.weights, self.device = network, weights, device
        self.hands, self.normaliser = hands.to(device), normaliser.to(device)
        self.signal = alphas_cumprod(device)
        self.frames, self.entries = weights.frames, weights.entries if weights.distance_weight > 0 else 0
        self.features: dict[str, Tensor] = {}
        self.held_out = collate(corpus.held_out).to(device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        steps = torch.randint(TRAIN_STEPS, (len(batch),), generator=generator).to(self.device)
        keep = torch.rand(len(batch), 2, generator=generator) >= self.network.config.condition_dropout
        predicted = self._denoised(self.network, batch, any_form(batch, generator), steps, generator, keep.float())
        simple = self._simple(predicted, batch)
        distance, orientation = self._geometry(predicted, batch)
        total = simple + self.weights.distance_weight * distance + self.weights.orientation_weight * orientation
        return {"total": total, "simple": simple, "distance_map": distance, "relative_orientation": orientation}

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, DiffusionModel)
        generator = torch.Generator().manual_seed(0)
        held, total = self.held_out, torch.zeros((), device=self.device)
        for step in VALIDATION_STEPS:
            steps = torch.full((len(held),), step, device=self.device)
            total += self._simple(self._denoised(network, held, held.text[:, 0], steps, generator, None), held)
        return total / len(VALIDATION_STEPS)

    def _denoised(
        self,
        network: DiffusionModel,
        batch: ClipBatch,
        text: Tensor,
        steps: Tensor,
        generator: torch.Generator,
        keep: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        clean = self.normaliser.encode(batch.hands, batch.object)
        noise = [torch.randn(part.shape, generator=generator).to(self.device) for part in clean]
        noised = [add_noise(part, add, steps, self.signal) for part, add in zip(clean, noise, strict=True)]
        condition = Condition.of(batch, self._object_features(network, batch), text, batch.contact_map)
        return network(*noised, steps, condition, None if keep is None else keep.to(self.device))

    def _object_features(self, network: DiffusionModel, batch: ClipBatch) -> Tensor:
        """F_obj of every clip; computed once per object, since the point network is frozen."""
        keys = [sample.object_key for sample in batch.samples]
        for row, key in enumerate(keys):
            if key not in self.features:
                self.features[key] = network.object_feature(batch.points_m[row : row + 1])[0]
        return torch.stack([self.features[key] for key in keys])

    def _simple(self, predicted: tuple[Tensor, Tensor], batch: ClipBatch) -> Tensor:
        hands, objects = self.normaliser.encode(batch.hands, batch.object)
        return losses.simple_loss(predicted[0], hands, batch.present) + losses.simple_loss(
            predicted[1], objects, batch.frames
        )

    def _geometry(self, predicted: tuple[Tensor, Tensor], batch: ClipBatch) -> tuple[Tensor, Tensor]:
        """Distance-map and relative-orientation losses on the batch's chosen frames (B, K)."""
        chosen = batch.chosen
        hands, objects = self.normaliser.decode(*predicted)
        hands, objects = losses.take_frames(hands, chosen, 2), losses.take_frames(objects, chosen, 1)
        true_hands = losses.take_frames(batch.hands, chosen, 2)
        true_object = losses.take_frames(batch.object, chosen, 1)
        present = losses.take_frames(batch.present, chosen, 2)
        orientation = losses.relative_orientation_loss(
            rot6d_to_rotmat(hands[..., GLOBAL_ORIENT_6D]),
            object_rotmat(objects),
            rot6d_to_rotmat(true_hands[..., GLOBAL_ORIENT_6D]),
            object_rotmat(true_object),
            present,
        )
        if not self.weights.distance_weight:
            return orientation.new_zeros(()), orientation
        joints = self.hands.joints(hands, batch.betas, batch.template_m)
        points, scale_m = place_points(batch, objects), batch.contact_threshold_m
        distance = losses.distance_map_loss(joints, points, batch.entries, batch.entry_distance_m, scale_m)
        return distance, orientation


def motion_generator(checkpoint: Checkpoint) -> MotionGenerator:
    """The motion generator of a diffusion checkpoint."""
    assert isinstance(checkpoint.network, DiffusionModel)
    assert checkpoint.normaliser is not None
    return MotionGenerator(checkpoint.network, checkpoint.normaliser)


def _diffusion_objective(setup: Setup) -> tuple[Objective, Normaliser]:
    contact = setup.trained["contact"].network
    assert isinstance(contact, ContactModel)
    network = DiffusionModel(replace(setup.network, point_net=contact.config.point_net)).to(setup.device)
    network.object_net.load_state_dict(contact.object_net.state_dict())
    normaliser = Normaliser.of(list(setup.corpus.train)).to(setup.device)
    return DiffusionObjective(network, setup.loss, setup.corpus, setup.hands, normaliser, setup.device), normaliser


DIFFUSION = Network(
    "diffusion", DiffusionConfig, DiffusionModel, _diffusion_objective, DiffusionLossConfig, needs=(CONTACT.name,)
)
