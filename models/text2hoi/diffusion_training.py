"""Training of the diffusion network: its losses and its validation (Text2HOI, Eq. 4-7)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from cachetools import LRUCache, cachedmethod
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from hoidata.batches.dataset import ClipBatch, ClipSample, collate
from hoidata.clips.features import (
    GLOBAL_ORIENT_6D,
    HAND_FEATURES,
    HAND_POSE_6D,
    OBJECT_FEATURES,
    OBJECT_HINGE,
    OBJECT_POSITION,
    OBJECT_ROTATION_6D,
    WRIST,
)
from hoidata.devices import send
from hoidata.geometry.rotations import rot6d_to_rotmat
from models.common import losses
from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus, any_form
from models.common.family import Losses, Network, Objective, Setup
from models.common.features import OBJECT_START_6D, Hands, Normaliser, object_rotmat, place_points, to_object_frame
from models.common.sampling import TRAIN_STEPS, Motion, add_noise, alphas_cumprod
from models.text2hoi.contact_training import CONTACT, ContactNetwork, SampleContact, contact_sampler
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.motion_representation import EncodedClip, MotionRepresentation
from models.text2hoi.verb_check import action_results
from models.text2hoi.verb_classifier import Sentences, fit_verb_classifiers

TOUCH_WEIGHT = 4.0
MAX_CACHED_CLIPS = 16_384  # of about 150 kB each, at most
VALIDATION_STEPS = (100, 300, 500, 700, 900)
HAND_GROUPS = (WRIST, GLOBAL_ORIENT_6D, HAND_POSE_6D)
OBJECT_GROUPS = (OBJECT_POSITION, OBJECT_ROTATION_6D, slice(OBJECT_HINGE, OBJECT_HINGE + 1), OBJECT_START_6D)


@dataclass(frozen=True)
class DiffusionLossConfig:
    """Loss terms and their weights relative to the simple loss (weight 1); the defaults are the paper's."""

    # Eq. 6, distances between joints and object points.
    distance_weight: float = 1.0
    # Eq. 7, orientation of hands relative to the object.
    orientation_weight: float = 1.0
    # Frames per clip on which losses of geometry are computed.
    frames: int = 8
    # Distance entries per batch in Eq. 6.
    entries: int = 8192
    # The contact map given as condition: sampled by the contact network, as at inference, or the clip's recorded one.
    contact: Literal["estimated", "recorded"] = "estimated"
    # Squared errors of a frame (Eq. 5) are summed, or averaged with equal weight of wrist, palm and fingers, and of the
    # object's position, rotation and hinge.
    weighting: Literal["sum", "equal_groups"] = "sum"
    # Squared error of differences between neighbouring control points.
    velocity_weight: float = 0.0
    # Huber error of joints in the object's frame; touching joints weigh ``1 + TOUCH_WEIGHT``.
    joint_weight: float = 0.0
    # Condition on a random subset of a clip's touched points, because sampled contact maps may be as sparse.
    subsample_contact: bool = False


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


class DiffusionObjective:
    """Losses of the diffusion network: Text2HOI, Eq. 4-7, and the terms that :class:`DiffusionLossConfig` adds."""

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
        self.network, self.weights, self.device, self.sample_contact = network, weights, device, sample_contact
        self.hands, self.normaliser = hands.to(device), normaliser.to(device)
        self.signal = alphas_cumprod(device)
        self.frames, self.entries = weights.frames, weights.entries if weights.distance_weight > 0 else 0
        self.targets = Targets(network.representation, self.normaliser, device)
        scales = feature_weights(weights.weighting, device, network.representation.object_features)
        self.hand_weights, self.object_weights = (scale / network.config.signal_scale**2 for scale in scales)
        self.features: dict[str, Tensor] = {}
        self.corpus = corpus

    @cached_property
    def held_out(self) -> ClipBatch:
        return collate(self.corpus.held_out).to(self.device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        weights, target = self.weights, self.targets.of(batch)
        steps = send(torch.randint(TRAIN_STEPS, (len(batch),), generator=generator), self.device)
        condition_mask = self.sample_condition_mask(len(batch), generator)
        text = any_form(batch, generator)
        contact = self._contact_maps(batch, text, generator)
        if weights.subsample_contact:
            contact = contact.bool() & send(random_subset(contact.shape, generator), self.device)
        predicted = self._denoised(self.network, batch, target, text, contact, steps, generator, condition_mask.float())
        terms = {"simple": self._simple(predicted, target)}
        factors = {"simple": 1.0, "velocity": weights.velocity_weight, "joints": weights.joint_weight}
        factors |= {"distance_map": weights.distance_weight, "relative_orientation": weights.orientation_weight}
        if weights.velocity_weight:
            terms["velocity"] = self._velocity(predicted, target)
        if weights.distance_weight or weights.orientation_weight or weights.joint_weight:
            terms |= self._geometry(predicted, batch, target)
        total = sum((factors[name] * term for name, term in terms.items()), torch.zeros(()))
        return {"total": total, **terms}

    def sample_condition_mask(self, n: int, generator: torch.Generator) -> Tensor:
        """(n, 3) bool: whether each clip is conditioned on sentence, contact points and F_obj (condition dropout)."""
        config = self.network.config
        mask = torch.rand(n, 2, generator=generator) >= config.condition_dropout
        # Without contact points, F_obj is dropped as well.
        body = mask[:, 1:]
        if config.object_dropout:
            body = body & (torch.rand(n, 1, generator=generator) >= config.object_dropout)
        return torch.cat((mask, body), 1)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, DiffusionModel)
        generator = torch.Generator().manual_seed(0)
        batch, total = self.held_out, torch.zeros((), device=self.device)
        target = self.targets.of(batch)
        for step in VALIDATION_STEPS:
            steps = torch.full((len(batch),), step, device=self.device)
            inputs = batch.text[:, 0], self._contact_maps(batch, batch.text[:, 0], generator)
            predicted = self._denoised(network, batch, target, *inputs, steps, generator, None)
            total += self._simple(predicted, target)
        return total / len(VALIDATION_STEPS)

    def _contact_maps(self, batch: ClipBatch, text: Tensor, generator: torch.Generator) -> Tensor:
        """(B, 2, N) bool: the contact maps that are the condition."""
        return batch.contact if self.sample_contact is None else self.sample_contact(batch, text, generator).bool()

    def _denoised(
        self,
        network: DiffusionModel,
        batch: ClipBatch,
        target: _Target,
        text: Tensor,
        contact: Tensor,
        steps: Tensor,
        generator: torch.Generator,
        condition_mask: Tensor | None,
    ) -> Motion:
        clean = target.hands, target.object
        noise = [send(torch.randn(part.shape, generator=generator), self.device) for part in clean]
        noised = [add_noise(part, sample, steps, self.signal) for part, sample in zip(clean, noise, strict=True)]
        condition = Condition.of(batch, self._object_features(network, batch), text, contact)
        condition_mask = None if condition_mask is None else send(condition_mask, self.device)
        return network(*noised, steps, condition, condition_mask)

    def _object_features(self, network: DiffusionModel, batch: ClipBatch) -> Tensor:
        """F_obj (B, G) of every clip; computed once per object, since the point network is frozen."""
        keys = [sample.object_key for sample in batch.samples]
        for index, key in enumerate(keys):
            if key not in self.features:
                self.features[key] = network.object_feature(batch.points_m[index : index + 1])[0]
        return torch.stack([self.features[key] for key in keys])

    def _simple(self, predicted: Motion, target: _Target) -> Tensor:
        """Text2HOI, Eq. 5: squared error of control points."""
        hands = (predicted[0] - target.hands).square() @ self.hand_weights
        objects = (predicted[1] - target.object).square() @ self.object_weights
        return losses.masked_mean(hands, target.hand_mask) + losses.masked_mean(objects, target.object_mask)

    def _velocity(self, predicted: Motion, target: _Target) -> Tensor:
        """Squared error of the differences between neighbouring control points."""
        hands = (predicted[0] - target.hands).diff(dim=-2).square() @ self.hand_weights
        objects = (predicted[1] - target.object).diff(dim=-2).square() @ self.object_weights
        # A difference counts if both control points are valid.
        both = target.hand_mask[..., 1:] & target.hand_mask[..., :-1]
        return losses.masked_mean(hands, both) + losses.masked_mean(objects, target.object_mask[:, 1:])

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


def feature_weights(
    weighting: str, device: torch.device, object_features: int = OBJECT_FEATURES
) -> tuple[Tensor, Tensor]:
    """Loss weights of a hand's 99 and an object's 10 or 16 features: ones for "sum", else summing to one."""
    weights, object_groups = [], [group for group in OBJECT_GROUPS if group.stop <= object_features]
    for size, groups in ((HAND_FEATURES, HAND_GROUPS), (object_features, object_groups)):
        weight = torch.ones(size, device=device)
        for group in groups if weighting == "equal_groups" else ():
            weight[group] = 1 / (len(groups) * (group.stop - group.start))
        weights.append(weight)
    return weights[0], weights[1]


def motion_generator(checkpoint: Checkpoint) -> MotionGenerator:
    """The motion generator of a diffusion checkpoint."""
    assert isinstance(checkpoint.network, DiffusionModel)
    assert checkpoint.normaliser is not None
    return MotionGenerator(checkpoint.network, checkpoint.normaliser)


def _diffusion_objective(setup: Setup) -> tuple[Objective, Normaliser]:
    contact = setup.trained["contact"].network
    assert isinstance(contact, ContactNetwork)
    train, config = setup.corpus.train, setup.network
    sentences = Sentences.of(train if config.text_input == "verb_probabilities" else ())
    points = {sample.object_key: sample.points.points_m for sample in (train if config.object_dropout else ())}
    counts = {"verb_count": sentences.n_verbs, "object_count": len(points)}
    network = DiffusionModel(replace(config, point_net=contact.config.point_net, **counts))
    fit_verb_classifiers(network, sentences)
    network.object_net.load_state_dict(contact.object_net.state_dict())
    if points:
        network.store_training_objects(network.object_feature(torch.from_numpy(np.stack(list(points.values())))))
    network = network.to(setup.device)
    clips = [network.representation.encode(sample) for sample in setup.corpus.train]
    normaliser = Normaliser.identity(network.representation.object_features)
    if network.config.normalised:
        normaliser = Normaliser.of([(clip.hands, clip.object, clip.present) for clip in clips])
    normaliser = normaliser.scaled_to(network.config.signal_scale).to(setup.device)
    sample_contact = contact_sampler(setup.trained["contact"]) if setup.loss.contact == "estimated" else None
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
    results=action_results,
)
