"""Training of the diffusion network: what one step and one validation are."""

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
from models.text2hoi.contact_training import CONTACT, ContactNetwork, DrawContact, contact_drawer
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.motion_code import CodedClip, MotionCode
from models.text2hoi.verb_check import action_results
from models.text2hoi.verb_reading import Sentences, learn_verbs

TOUCH_WEIGHT = 4.0
MOST_CLIPS = 16_384  # whose rows are kept: at most some 150 kB each
VALIDATION_STEPS = (100, 300, 500, 700, 900)
HAND_GROUPS = (WRIST, GLOBAL_ORIENT_6D, HAND_POSE_6D)
OBJECT_GROUPS = (OBJECT_POSITION, OBJECT_ROTATION_6D, slice(OBJECT_HINGE, OBJECT_HINGE + 1), OBJECT_START_6D)


@dataclass(frozen=True)
class DiffusionLossConfig:
    """Weights beside the simple loss (1): eq. 6 and eq. 7. frames: how many of a clip they see; entries: of eq. 6.

    contact: the map a motion is shown: drawn from the contact network, as in use, or the clip's own. weighting: eq. 5
    is the sum of a frame's squared errors; "grouped" counts wrist, palm and fingers alike, and the object's position,
    rotation and hinge. velocity_weight: of the same error of differences of rows. joint_weight: of joints in the
    object's frame, those that touch counting ``TOUCH_WEIGHT`` more. thin_contact: each clip is shown a share of its
    touched points, as a drawn contact map may be as sparse, and no two steps the same.
    """

    distance_weight: float = 1.0
    orientation_weight: float = 1.0
    frames: int = 8
    entries: int = 8192
    contact: Literal["estimated", "recorded"] = "estimated"
    weighting: Literal["sum", "grouped"] = "sum"
    velocity_weight: float = 0.0
    joint_weight: float = 0.0
    thin_contact: bool = False


@dataclass(frozen=True)
class _Target:
    """What a batch of clips is to become: normalised rows, which are there, true joints in the object's frame, touch.

    hands (B, 2, K, 99), object (B, L, 10 or 16); present (B, 2, K), there (B, L); joints_m (B, 2, F, 21, 3), touching
    (B, 2, F, 21) bool.
    """

    hands: Tensor
    object: Tensor
    present: Tensor
    there: Tensor
    joints_m: Tensor
    touching: Tensor


class Targets:
    """The rows of clips, worked out once for each as long as there is room; of a long clip once for each window."""

    def __init__(self, code: MotionCode, normaliser: Normaliser, device: torch.device) -> None:
        self.code, self.normaliser, self.device = code, normaliser, device
        self.made = LRUCache(MOST_CLIPS)

    def of(self, batch: ClipBatch) -> _Target:
        """Of a batch's clips, padded."""
        coded, joints, touching = zip(*[self._clip(sample) for sample in batch.samples], strict=True)
        hands, objects = self.normaliser.encode(
            self._padded([own.hands for own in coded], 1), self._padded([own.object for own in coded], 0)
        )
        present, there = self._padded([own.present for own in coded], 1), self.code.rows(batch.counts, self.device)[1]
        return _Target(hands, objects, present, there, self._padded(joints, 1), self._padded(touching, 1))

    @cachedmethod(lambda self: self.made, key=lambda self, sample: sample.key)
    def _clip(self, sample: ClipSample) -> tuple[CodedClip, Tensor, Tensor]:
        joints, thing = torch.from_numpy(sample.joints_m), self.code.placed(sample)
        touching = torch.zeros(joints.shape[:3], dtype=torch.bool)
        near = (sample.distances.side, sample.distances.frame, sample.distances.joint)
        touching[tuple(torch.from_numpy(column).long() for column in near)] = True
        return self.code.encode(sample), to_object_frame(joints, thing[None].expand(2, -1, -1)), touching

    def _padded(self, rows: Sequence[Tensor], axis: int) -> Tensor:
        if not axis:
            return send(pad_sequence(list(rows), batch_first=True), self.device)
        return self._padded([row.transpose(0, axis) for row in rows], 0).transpose(1, axis + 1)


class DiffusionObjective:
    """Text2HOI eq. 4-7, and what the switches of :class:`DiffusionLossConfig` add."""

    def __init__(
        self,
        network: DiffusionModel,
        weights: DiffusionLossConfig,
        corpus: Corpus,
        hands: Hands,
        normaliser: Normaliser,
        device: torch.device,
        drawn: DrawContact | None = None,
    ) -> None:
        """drawn: draws contact maps for the motions of a batch; without it the clips' own are shown."""
        self.network, self.weights, self.device, self.drawn = network, weights, device, drawn
        self.hands, self.normaliser = hands.to(device), normaliser.to(device)
        self.signal = alphas_cumprod(device)
        self.frames, self.entries = weights.frames, weights.entries if weights.distance_weight > 0 else 0
        self.targets = Targets(network.code, self.normaliser, device)
        shares = feature_shares(weights.weighting, device, network.code.object_features)
        self.hand_shares, self.object_shares = (share / network.config.signal_scale**2 for share in shares)
        self.features: dict[str, Tensor] = {}
        self.corpus = corpus

    @cached_property
    def held_out(self) -> ClipBatch:
        return collate(self.corpus.held_out).to(self.device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        weights, target = self.weights, self.targets.of(batch)
        steps = send(torch.randint(TRAIN_STEPS, (len(batch),), generator=generator), self.device)
        keep = self.kept(len(batch), generator)
        text = any_form(batch, generator)
        contact = self._shown(batch, text, generator)
        if weights.thin_contact:
            contact = contact.bool() & send(thinned(contact.shape, generator), self.device)
        predicted = self._denoised(self.network, batch, target, text, contact, steps, generator, keep.float())
        found = {"simple": self._simple(predicted, target)}
        factors = {"simple": 1.0, "velocity": weights.velocity_weight, "joints": weights.joint_weight}
        factors |= {"distance_map": weights.distance_weight, "relative_orientation": weights.orientation_weight}
        if weights.velocity_weight:
            found["velocity"] = self._velocity(predicted, target)
        if weights.distance_weight or weights.orientation_weight or weights.joint_weight:
            found |= self._geometry(predicted, batch, target)
        return {"total": sum((factors[name] * found[name] for name in found), torch.zeros(())), **found}

    def kept(self, n: int, generator: torch.Generator) -> Tensor:
        """(n, 3) bool: whether words, touched points and the object's body are told."""
        config = self.network.config
        keep = torch.rand(n, 2, generator=generator) >= config.condition_dropout
        body = keep[:, 1:]
        if config.object_dropout:
            body = body & (torch.rand(n, 1, generator=generator) >= config.object_dropout)
        return torch.cat((keep, body), 1)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, DiffusionModel)
        generator = torch.Generator().manual_seed(0)
        held, total = self.held_out, torch.zeros((), device=self.device)
        target = self.targets.of(held)
        for step in VALIDATION_STEPS:
            steps = torch.full((len(held),), step, device=self.device)
            seen = held.text[:, 0], self._shown(held, held.text[:, 0], generator)
            predicted = self._denoised(network, held, target, *seen, steps, generator, None)
            total += self._simple(predicted, target)
        return total / len(VALIDATION_STEPS)

    def _shown(self, batch: ClipBatch, text: Tensor, generator: torch.Generator) -> Tensor:
        """(B, 2, N) bool: the contact maps that motions are shown."""
        return batch.contact if self.drawn is None else self.drawn(batch, text, generator).bool()

    def _denoised(
        self,
        network: DiffusionModel,
        batch: ClipBatch,
        target: _Target,
        text: Tensor,
        contact: Tensor,
        steps: Tensor,
        generator: torch.Generator,
        keep: Tensor | None,
    ) -> Motion:
        clean = target.hands, target.object
        noise = [send(torch.randn(part.shape, generator=generator), self.device) for part in clean]
        noised = [add_noise(part, add, steps, self.signal) for part, add in zip(clean, noise, strict=True)]
        condition = Condition.of(batch, self._object_features(network, batch), text, contact)
        return network(noised[0], noised[1], steps, condition, None if keep is None else send(keep, self.device))

    def _object_features(self, network: DiffusionModel, batch: ClipBatch) -> Tensor:
        """F_obj of every clip; computed once per object, since the point network is frozen."""
        keys = [sample.object_key for sample in batch.samples]
        for row, key in enumerate(keys):
            if key not in self.features:
                self.features[key] = network.object_feature(batch.points_m[row : row + 1])[0]
        return torch.stack([self.features[key] for key in keys])

    def _simple(self, predicted: Motion, target: _Target) -> Tensor:
        hands = (predicted[0] - target.hands).square() @ self.hand_shares
        objects = (predicted[1] - target.object).square() @ self.object_shares
        return losses.masked_mean(hands, target.present) + losses.masked_mean(objects, target.there)

    def _velocity(self, predicted: Motion, target: _Target) -> Tensor:
        """The same error of the differences between neighbouring rows."""
        hands = (predicted[0] - target.hands).diff(dim=-2).square() @ self.hand_shares
        objects = (predicted[1] - target.object).diff(dim=-2).square() @ self.object_shares
        both = target.present[..., 1:] & target.present[..., :-1]
        return losses.masked_mean(hands, both) + losses.masked_mean(objects, target.there[:, 1:])

    def _geometry(self, predicted: Motion, batch: ClipBatch, target: _Target) -> Losses:
        """The losses with a weight that look at poses, on some frames of each clip."""
        weights, code, found = self.weights, self.network.code, Losses()
        chosen = batch.chosen
        rows = self.normaliser.decode(*predicted)
        curves = code.curves(*rows, batch.counts)
        own, moved = losses.take_frames(curves[0], chosen, 2), losses.take_frames(curves[1], chosen, 1)
        present = losses.take_frames(batch.present, chosen, 2)
        if weights.joint_weight:
            joints = self.hands.joints(code.in_object_frame(own, moved), batch.betas, batch.template_m)
            true, touching = (losses.take_frames(part, chosen, 2) for part in (target.joints_m, target.touching))
            found["joints"] = losses.joint_loss(joints, true, present, 1 + TOUCH_WEIGHT * touching)
        hands = code.in_world(own, moved)
        if weights.distance_weight:
            joints = self.hands.joints(hands, batch.betas, batch.template_m)
            points = place_points(batch, code.at_origin(moved, batch.points_m, batch.part))
            given = batch.entries, batch.entry_distance_m
            found["distance_map"] = losses.distance_map_loss(joints, points, *given)
        if weights.orientation_weight:
            true = losses.take_frames(batch.hands, chosen, 2), losses.take_frames(batch.object, chosen, 1)
            turns = [rot6d_to_rotmat(part[..., GLOBAL_ORIENT_6D]) for part in (hands, true[0])]
            bodies = object_rotmat(moved), object_rotmat(true[1])
            found["relative_orientation"] = losses.relative_orientation_loss(
                turns[0], bodies[0], turns[1], bodies[1], present
            )
        return found


def thinned(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """(B, ...) bool: of each clip a share between a fifth and all is True."""
    share = 0.2 + 0.8 * torch.rand(shape[0], *[1] * (len(shape) - 1), generator=generator)
    return torch.rand(*shape, generator=generator) < share


def feature_shares(
    weighting: str, device: torch.device, object_features: int = OBJECT_FEATURES
) -> tuple[Tensor, Tensor]:
    """Shares of a hand's 99 and an object's 10 or 16 numbers in the loss; each sums to one, but for "sum"."""
    shares, object_groups = [], [group for group in OBJECT_GROUPS if group.stop <= object_features]
    for size, groups in ((HAND_FEATURES, HAND_GROUPS), (object_features, object_groups)):
        share = torch.ones(size, device=device)
        for group in groups if weighting == "grouped" else ():
            share[group] = 1 / (len(groups) * (group.stop - group.start))
        shares.append(share)
    return shares[0], shares[1]


def motion_generator(checkpoint: Checkpoint) -> MotionGenerator:
    """The motion generator of a diffusion checkpoint."""
    assert isinstance(checkpoint.network, DiffusionModel)
    assert checkpoint.normaliser is not None
    return MotionGenerator(checkpoint.network, checkpoint.normaliser)


def _diffusion_objective(setup: Setup) -> tuple[Objective, Normaliser]:
    contact = setup.trained["contact"].network
    assert isinstance(contact, ContactNetwork)
    train, told = setup.corpus.train, setup.network
    sentences = Sentences.of(train if told.text_input == "verbs" else ())
    points = {sample.object_key: sample.points.points_m for sample in (train if told.object_dropout else ())}
    counted = {"verbs": sentences.n_verbs, "objects": len(points)}
    network = DiffusionModel(replace(told, point_net=contact.config.point_net, **counted))
    learn_verbs(network, sentences)
    network.object_net.load_state_dict(contact.object_net.state_dict())
    if points:
        network.learn_objects(network.object_feature(torch.from_numpy(np.stack(list(points.values())))))
    network = network.to(setup.device)
    coded = [network.code.encode(sample) for sample in setup.corpus.train]
    normaliser = Normaliser.nothing(network.code.object_features)
    if network.config.normalised:
        normaliser = Normaliser.of([(own.hands, own.object, own.present) for own in coded])
    normaliser = normaliser.spread_to(network.config.signal_scale).to(setup.device)
    drawn = contact_drawer(setup.trained["contact"]) if setup.loss.contact == "estimated" else None
    given = setup.loss, setup.corpus, setup.hands, normaliser, setup.device, drawn
    return DiffusionObjective(network, *given), normaliser


DIFFUSION = Network(
    "diffusion",
    DiffusionConfig,
    DiffusionModel,
    _diffusion_objective,
    DiffusionLossConfig,
    needs=(CONTACT.name,),
    results=action_results,
)
