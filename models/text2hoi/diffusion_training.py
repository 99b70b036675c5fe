"""Training of the diffusion network: its losses and its validation (Text2HOI, Eq. 4-7).

Its checkpoint stores how training clips move: usual ranges of each verb, and which way is up for each object.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from cachetools import LRUCache, cachedmethod
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from hoidata.actions.action import Actions
from hoidata.annotation.vocabulary import Vocabulary
from hoidata.batches.dataset import ClipBatch, ClipSample
from hoidata.clips.features import GLOBAL_ORIENT_6D
from hoidata.devices import send
from hoidata.geometry.rotations import rot6d_to_rotmat
from hoidata.hands import HandPair
from hoidata.metrics.verb_ranges import VerbRanges, object_ups, training_ranges
from hoidata.store.annotated import AnnotatedStore
from models.common import losses
from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus, any_form
from models.common.family import ClipObjective, Losses, Network, Objective, Setup
from models.common.features import Hands, Normaliser, object_rotmat, place_points, to_object_frame
from models.common.sampling import TRAIN_STEPS, Motion, add_noise, alphas_cumprod
from models.text2hoi.contact_training import CONTACT, ContactNetwork, SampleContact, contact_sampler
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.motion_representation import EncodedClip, MotionRepresentation

TOUCH_WEIGHT = 4.0
DISTANCE_ENTRIES = 8192  # of a batch, in Eq. 6
MAX_CACHED_CLIPS = 16_384  # of about 150 kB each, at most
VALIDATION_STEPS = (100, 300, 500, 700, 900)


@dataclass(frozen=True)
class DiffusionLossConfig:
    """Loss terms and their weights relative to the simple loss (weight 1); the defaults are the paper's."""

    # Eq. 6, distances between joints and object points.
    distance_weight: float = 1.0
    # Eq. 7, orientation of hands relative to the object.
    orientation_weight: float = 1.0
    # Huber error of joints in the object's frame; touching joints weigh ``1 + TOUCH_WEIGHT``.
    joint_weight: float = 0.0
    # Frames per clip on which losses of geometry are computed.
    frames: int = 8
    # The contact map given as condition: sampled by the contact network, as at inference, or a random subset of the
    # clip's recorded touched points, because sampled maps may be as sparse.
    contact: Literal["estimated", "recorded"] = "estimated"


@dataclass(frozen=True)
class _Target:
    """The recorded motions of a batch: B clips, K and L control points, F frames."""

    hands: Tensor  # (B, 2, K, 99) normalised
    object: Tensor  # (B, L, 10 or 16) normalised
    hand_mask: Tensor  # (B, 2, K) bool
    object_mask: Tensor  # (B, L) bool
    joints_m: Tensor  # (B, 2, F, 21, 3) in the object's frame
    touching: Tensor  # (B, 2, F, 21) bool, joints within the contact threshold


class Targets:
    """Encodes recorded clips as training targets, with a cache of clips; of a long clip, of its windows."""

    def __init__(self, representation: MotionRepresentation, normaliser: Normaliser, device: torch.device) -> None:
        self.representation, self.normaliser, self.device = representation, normaliser, device
        self.encoded = LRUCache(MAX_CACHED_CLIPS)

    def of(self, batch: ClipBatch) -> _Target:
        """Targets of a batch's clips, padded."""
        clips, joints, touching = zip(*[self._clip(sample) for sample in batch.samples], strict=True)
        hands, objects = self.normaliser.encode(
            self._padded([clip.hands for clip in clips], 1), self._padded([clip.object for clip in clips], 0)
        )
        return _Target(
            hands=hands,
            object=objects,
            hand_mask=self._padded([clip.present for clip in clips], 1),
            object_mask=self.representation.valid_masks(batch.counts, self.device)[1],
            joints_m=self._padded(joints, 1),
            touching=self._padded(touching, 1),
        )

    @cachedmethod(lambda self: self.encoded, key=lambda self, sample: sample.key)
    def _clip(self, sample: ClipSample) -> tuple[EncodedClip, Tensor, Tensor]:
        joints, objects = torch.from_numpy(sample.joints_m), self.representation.object_features_of(sample)
        touching = torch.zeros(joints.shape[:3], dtype=torch.bool)
        near = (sample.distances.side, sample.distances.frame, sample.distances.joint)
        touching[tuple(torch.from_numpy(column).long() for column in near)] = True
        return self.representation.encode(sample), to_object_frame(joints, objects[None].expand(2, -1, -1)), touching

    def _padded(self, tensors: Sequence[Tensor], axis: int) -> Tensor:
        if not axis:
            return send(pad_sequence(list(tensors), batch_first=True), self.device)
        return self._padded([tensor.transpose(0, axis) for tensor in tensors], 0).transpose(1, axis + 1)


class DiffusionObjective(ClipObjective):
    """Losses of the diffusion network: Text2HOI, Eq. 4-7, and the terms that :class:`DiffusionLossConfig` adds."""

    network: DiffusionModel

    def __init__(
        self,
        network: DiffusionModel,
        weights: DiffusionLossConfig,
        corpus: Corpus,
        hands: Hands,
        normaliser: Normaliser,
        device: torch.device,
        sample_contact: SampleContact | None = None,
    ) -> None:
        """sample_contact: samples contact maps for a batch; if None, the recorded maps are the condition."""
        super().__init__(network, corpus, device)
        self.weights, self.sample_contact = weights, sample_contact
        self.hands, self.normaliser = hands.to(device), normaliser.to(device)
        self.signal = alphas_cumprod(device)
        self.frames, self.entries = weights.frames, DISTANCE_ENTRIES if weights.distance_weight > 0 else 0
        self.targets = Targets(network.representation, self.normaliser, device)
        is_normalised = network.config.signal_scale is not None
        scales = losses.feature_weights(is_normalised, device, network.representation.object_features)
        self.hand_weights, self.object_weights = (scale / network.signal_scale**2 for scale in scales)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        weights, target = self.weights, self.targets.of(batch)
        steps = send(torch.randint(TRAIN_STEPS, (len(batch),), generator=generator), self.device)
        text = any_form(batch, generator)
        contact = self._contact_maps(batch, text, generator)
        if self.sample_contact is None:
            contact = contact * send(random_subset(contact.shape, generator), self.device)
        predicted = self._denoised(self.network, batch, target, text, contact, steps, generator)
        terms = {"simple": self._simple(predicted, target)}
        factors = {"simple": 1.0, "joints": weights.joint_weight}
        factors |= {"distance_map": weights.distance_weight, "relative_orientation": weights.orientation_weight}
        if weights.distance_weight or weights.orientation_weight or weights.joint_weight:
            terms |= self._geometry(predicted, batch, target)
        total = sum((factors[name] * term for name, term in terms.items()), torch.zeros(()))
        return {"total": total, **terms}

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, DiffusionModel)
        generator = torch.Generator().manual_seed(0)
        batch, total = self.held_out, torch.zeros((), device=self.device)
        target = self.targets.of(batch)
        for step in VALIDATION_STEPS:
            steps = torch.full((len(batch),), step, device=self.device)
            inputs = batch.text[:, 0], self._contact_maps(batch, batch.text[:, 0], generator)
            predicted = self._denoised(network, batch, target, *inputs, steps, generator)
            total += self._simple(predicted, target)
        return total / len(VALIDATION_STEPS)

    def _contact_maps(self, batch: ClipBatch, text: Tensor, generator: torch.Generator) -> Tensor:
        """(B, 2, N) the contact maps that are the condition: estimated probabilities, or the recorded maps."""
        return batch.contact if self.sample_contact is None else self.sample_contact(batch, text, generator)

    def _denoised(
        self,
        network: DiffusionModel,
        batch: ClipBatch,
        target: _Target,
        text: Tensor,
        contact: Tensor,
        steps: Tensor,
        generator: torch.Generator,
    ) -> Motion:
        clean = target.hands, target.object
        noise = [send(torch.randn(part.shape, generator=generator), self.device) for part in clean]
        noised = [add_noise(part, sample, steps, self.signal) for part, sample in zip(clean, noise, strict=True)]
        return network(*noised, steps, Condition(batch, text, [sample.verb for sample in batch.samples], contact))

    def _simple(self, predicted: Motion, target: _Target) -> Tensor:
        """Text2HOI, Eq. 5: squared error of control points."""
        hands = (predicted[0] - target.hands).square() @ self.hand_weights
        objects = (predicted[1] - target.object).square() @ self.object_weights
        return losses.masked_mean(hands, target.hand_mask) + losses.masked_mean(objects, target.object_mask)

    def _geometry(self, predicted: Motion, batch: ClipBatch, target: _Target) -> Losses:
        """Losses of joints, distances and orientations, on some frames of each clip; only those with a weight."""
        weights, representation, terms = self.weights, self.network.representation, Losses()
        chosen = batch.chosen
        points = self.normaliser.decode(*predicted)
        hand_features, object_features = representation.features_per_frame(*points, batch.counts)
        hand_features = losses.take_frames(hand_features, chosen, 2)
        object_features = losses.take_frames(object_features, chosen, 1)
        present = losses.take_frames(batch.present, chosen, 2)
        if weights.joint_weight:
            local = representation.in_object_frame(hand_features, object_features)
            joints = self.hands.joints(local, batch.betas, batch.template_m)
            true, touching = (losses.take_frames(part, chosen, 2) for part in (target.joints_m, target.touching))
            terms["joints"] = losses.joint_loss(joints, true, present, 1 + TOUCH_WEIGHT * touching)
        hands = representation.in_world(hand_features, object_features)
        if weights.distance_weight:
            joints = self.hands.joints(hands, batch.betas, batch.template_m)
            points = place_points(batch, representation.at_origin(object_features, batch.points_m, batch.part))
            entries = batch.entries, batch.entry_distance_m
            terms["distance_map"] = losses.distance_map_loss(joints, points, *entries)
        if weights.orientation_weight:
            true = losses.take_frames(batch.hands, chosen, 2), losses.take_frames(batch.object, chosen, 1)
            hand_rotmats = [rot6d_to_rotmat(part[..., GLOBAL_ORIENT_6D]) for part in (hands, true[0])]
            object_rotmats = object_rotmat(object_features), object_rotmat(true[1])
            terms["relative_orientation"] = losses.relative_orientation_loss(
                hand_rotmats[0], object_rotmats[0], hand_rotmats[1], object_rotmats[1], present
            )
        return terms


def random_subset(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Random mask (B, ...) bool: of each clip a fraction between 0.2 and 1 is True, sampled uniformly."""
    fraction = 0.2 + 0.8 * torch.rand(shape[0], *[1] * (len(shape) - 1), generator=generator)
    return torch.rand(*shape, generator=generator) < fraction


def motion_generator(checkpoint: Checkpoint) -> MotionGenerator:
    """The motion generator of a diffusion checkpoint."""
    assert isinstance(checkpoint.network, DiffusionModel)
    assert checkpoint.normaliser is not None
    return MotionGenerator(checkpoint.network, checkpoint.normaliser)


def _results(annotated: AnnotatedStore) -> dict[str, Any]:
    return {"actions": training_ranges(annotated).record, "object_ups": object_ups(annotated)}


def verb_ranges(checkpoint: Checkpoint, hands: HandPair) -> VerbRanges | None:
    """The usual ranges of a checkpoint's training clips; None if it has none."""
    record, facts = checkpoint.info["results"].get("actions"), checkpoint.facts
    return None if record is None else VerbRanges(Actions.read(record), facts["contact_threshold_m"], hands)


def _diffusion_objective(setup: Setup) -> tuple[Objective, Normaliser]:
    contact = setup.trained["contact"].network
    assert isinstance(contact, ContactNetwork)
    config = replace(setup.network, point_net=contact.config.point_net)
    if config.verb_input:
        config = replace(config, verbs=tuple(Vocabulary.of(setup.corpus.train).verb_names))
    network = DiffusionModel(config).to(setup.device)
    if network.object_net is not None:
        network.object_net.load_state_dict(contact.object_net.state_dict())
    normaliser = Normaliser.identity(network.representation.object_features)
    if config.signal_scale is not None:
        clips = [network.representation.encode(sample) for sample in setup.corpus.train]
        normaliser = Normaliser.of([(clip.hands, clip.object, clip.present) for clip in clips])
        normaliser = normaliser.scaled_to(config.signal_scale)
    normaliser = normaliser.to(setup.device)
    sample_contact = None
    if setup.loss.contact == "estimated":
        sample_contact = contact_sampler(setup.trained["contact"], is_binary=network.config.contact_input == "tokens")
    objective = DiffusionObjective(
        network,
        weights=setup.loss,
        corpus=setup.corpus,
        hands=setup.hands,
        normaliser=normaliser,
        device=setup.device,
        sample_contact=sample_contact,
    )
    return objective, normaliser


DIFFUSION = Network(
    "diffusion",
    DiffusionConfig,
    build=DiffusionModel,
    objective=_diffusion_objective,
    loss=DiffusionLossConfig,
    needs=(CONTACT.name,),
    results=lambda network, corpus: _results(corpus.annotated),
)
