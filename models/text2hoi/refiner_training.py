"""Training of the hand refiner on motions made by the frozen generator (Text2HOI eq. 8-11)."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from hoidata.batches.dataset import ClipBatch, ClipSample, collate
from hoidata.batches.sight import Sight
from hoidata.devices import send
from models.common import losses
from models.common.corpus import Corpus, any_form
from models.common.family import Network, Objective, Setup
from models.common.sampling import TRAIN_STEPS, SamplerConfig, draw_motion
from models.text2hoi.diffusion import Condition, MotionGenerator
from models.text2hoi.diffusion_training import DIFFUSION, Targets, motion_generator
from models.text2hoi.refiner import CoarseMotion, RefinerConfig, RefinerModel, Surface

GENERATED_AT_ONCE = 32
PER_HAND = ("hands", "joints_m", "distance_m", "offset_m")


@dataclass(frozen=True)
class RefinerLossConfig:
    """Weights of eq. 10 and 11 beside eq. 9 (1), with lengths in ``unit_m``.

    weighting: eq. 9 is the sum of a frame's squared errors; "even" counts their mean. touch: joints near the surface
    are drawn onto it, as in the paper, or those that truly touch to where they truly are. generated: coarse motions are
    clips denoised once, whose hands they are to get back, or only half of them; see :class:`RefinerObjective`.
    exchanged: the other half is made for contact maps of other clips of the object by the same hands, as no generator
    knows by heart. frames, vertices: how many frames per clip and vertices per hand the surface losses see. samples:
    coarse motions made per training clip, sampled ones in ``sampler_steps``. field_resolution: of the grids.
    """

    penetration_weight: float = 1.0
    contact_weight: float = 5.0
    unit_m: float = 1.0
    weighting: Literal["sum", "even"] = "sum"
    touch: Literal["surface", "truth"] = "surface"
    generated: Literal["once", "half"] = "once"
    exchanged: bool = False
    frames: int = 8
    vertices: int = 259
    samples: int = 4
    sampler_steps: int = 10
    field_resolution: int = 40


@dataclass(frozen=True)
class _Coarse:
    """One generated motion of a clip as the refiner sees it, frame first, and the hands to stay near.

    view: the tensors of :class:`CoarseMotion` that have frames, by name, (F, ...). target: (F, 2, 99), as the network
    sees hands. true_distance_m: (F, 2, 21) of the joints to the surface in the clip itself.
    """

    view: dict[str, Tensor]
    target: Tensor
    true_distance_m: Tensor


@dataclass(frozen=True)
class _Comparison:
    """A batch of coarse motions with what they are compared with; side before frame."""

    batch: ClipBatch
    coarse: CoarseMotion
    target: Tensor
    true_distance_m: Tensor


class RefinerObjective:
    """Half of the coarse motions are clips noised and denoised once: they are to go back to the clip's own hands
    relative to the object. The others are sampled from noise, as in use, where no true hands exist: they are to stay
    near themselves. All are to touch as the clip does, and not to penetrate."""

    entries = 0

    def __init__(
        self,
        network: RefinerModel,
        weights: RefinerLossConfig,
        corpus: Corpus,
        generator: MotionGenerator,
        surface: Surface,
        device: torch.device,
        seed: int,
    ) -> None:
        self.network, self.weights, self.device = network, weights, device
        self.frames = weights.frames
        self.generator, self.surface = generator, surface
        self.targets = Targets(generator.network.code, generator.normaliser, device)
        self.vertices = torch.arange(0, 778, max(1, 778 // weights.vertices), device=device)
        draws = torch.Generator().manual_seed(seed)
        train, held_out = list(corpus.train), corpus.held_out
        self.alike: dict[tuple[str, str], list[np.ndarray]] = {}
        for sample in train:
            self.alike.setdefault((sample.object_key, sample.hand_type), []).append(sample.contact)
        half = weights.generated == "half"
        kinds = ["sampled" if half and number % 2 else "once" for number in range(weights.samples)]
        self.pool = {sample.clip_id: [] for sample in train}
        for kind in kinds:
            for sample, coarse in zip(train, self._make(train, kind, draws), strict=True):
                self.pool[sample.clip_id].append(coarse)
        self.held_out: _Comparison | None = None
        if held_out:
            held = self._make(held_out, kinds[-1], torch.Generator().manual_seed(0))
            self.held_out = self._batch(collate(held_out, self._sight(held_out)).to(device), held)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> dict[str, Tensor]:
        numbers = np.random.default_rng(generator.initial_seed()).integers(self.weights.samples, size=len(batch))
        motions = [self.pool[sample.clip_id][n] for sample, n in zip(batch.samples, numbers, strict=True)]
        return self._losses(self.network, self._batch(batch, motions))

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, RefinerModel)
        assert self.held_out is not None
        return self._losses(network, self.held_out)["total"]

    def _sight(self, samples: list[ClipSample]) -> Sight:
        return Sight.drawn([sample.length for sample in samples], self.frames, 0, np.random.default_rng(0))

    def _losses(self, network: RefinerModel, seen: _Comparison) -> dict[str, Tensor]:
        batch, coarse, weights = seen.batch, seen.coarse, self.weights
        refined = network(coarse)
        change = (network.seen(refined, coarse.object) - seen.target) / network.reach
        simple = losses.masked_mean(change.square(), coarse.present[..., None])
        simple = simple * change.shape[-1] if weights.weighting == "sum" else simple
        chosen = batch.chosen
        present, true = (losses.take_frames(part, chosen, 2) for part in (coarse.present, seen.true_distance_m))
        skin, inner = self._distances(batch, losses.take_frames(refined, chosen, 2), coarse.object, chosen)
        penetration = losses.penetration_loss(skin, present, weights.unit_m)
        if weights.touch == "surface":
            contact = losses.surface_loss(inner, present, batch.contact_threshold_m, weights.unit_m)
        else:
            contact = losses.contact_loss(inner, true, present, batch.contact_threshold_m, weights.unit_m)
        total = simple + weights.penetration_weight * penetration
        total = total + weights.contact_weight * contact
        return {"total": total, "simple": simple, "penetration": penetration, "contact": contact}

    def _distances(self, batch: ClipBatch, hands: Tensor, objects: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances of some vertices (B, 2, K, V) and the joints (B, 2, K, 21) of hands in the chosen frames."""
        vertices, joints = self.surface.hands.vertices(hands, batch.betas, batch.template_m)
        points = torch.cat((vertices[..., self.vertices, :], joints), -2)
        _, distance, _ = self.surface.measure(batch, points, losses.take_frames(objects, chosen, 1))
        skin, inner = distance.split([len(self.vertices), joints.shape[-2]], -1)
        return skin, inner

    def _batch(self, batch: ClipBatch, motions: list[_Coarse]) -> _Comparison:
        padded = {
            name: pad_sequence([motion.view[name] for motion in motions], batch_first=True) for name in motions[0].view
        }
        objects = padded.pop("object")
        hands = {name: tensor.transpose(1, 2) for name, tensor in padded.items()}
        target, true = (
            pad_sequence([getattr(motion, name) for motion in motions], batch_first=True).transpose(1, 2)
            for name in ("target", "true_distance_m")
        )
        common = {"present": batch.present, "asked": batch, "contact_map": batch.contact_map}
        return _Comparison(batch, CoarseMotion(object=objects, **hands, **common), target, true)

    @torch.no_grad()
    def _make(self, samples: list[ClipSample], kind: str, draws: torch.Generator) -> list[_Coarse]:
        """One coarse motion of every sample, in the samples' order; made in batches of like length."""
        order = sorted(range(len(samples)), key=lambda index: samples[index].length)
        made: dict[int, _Coarse] = {}
        for start in range(0, len(order), GENERATED_AT_ONCE):
            rows = order[start : start + GENERATED_AT_ONCE]
            batch = collate([samples[index] for index in rows]).to(self.device)
            hands, objects = self._generate(batch, kind, draws)
            coarse = self.surface.coarse(batch, hands, objects, batch.contact_map, batch.present)
            own = (batch.hands, batch.object) if kind == "once" else (hands, objects)
            target = self.network.seen(*own).transpose(1, 2)
            true = self.surface.measure(batch, batch.joints_m, batch.object)[1].transpose(1, 2)
            view = {name: getattr(coarse, name).transpose(1, 2) for name in PER_HAND} | {"object": objects}
            for row, index in enumerate(rows):
                stop = samples[index].length
                parts = {name: tensor[row, :stop].clone() for name, tensor in view.items()}
                made[index] = _Coarse(parts, target[row, :stop].clone(), true[row, :stop].clone())
        return [made[index] for index in range(len(samples))]

    def _exchanged(self, batch: ClipBatch, draws: torch.Generator) -> Tensor:
        """(B, 2, N) bool: for every clip the contact of a training clip of its object by the same hands, or its own."""
        chosen = []
        for sample in batch.samples:
            alike = self.alike.get((sample.object_key, sample.hand_type)) or [sample.contact]
            chosen.append(torch.from_numpy(alike[int(torch.randint(len(alike), (), generator=draws))]))
        return send(torch.stack(chosen), self.device)

    def _generate(self, batch: ClipBatch, kind: str, draws: torch.Generator) -> tuple[Tensor, Tensor]:
        text = any_form(batch, draws)
        network = self.generator.network
        condition = Condition.of(batch, network.object_feature(batch.points_m), text, batch.contact)
        rows = self.targets.of(batch)
        if kind == "sampled":
            if self.weights.exchanged:
                condition = replace(condition, contact=self._exchanged(batch, draws))
            sampler = SamplerConfig(steps=self.weights.sampler_steps)
            noise = draw_motion(rows.hands.shape, rows.object.shape, draws)
            return self.generator.sample(condition, sampler, noise, draws)
        steps = send(torch.randint(TRAIN_STEPS, (len(batch),), generator=draws), self.device)
        return self.generator.denoise_once(rows.hands, rows.object, steps, condition, draws)


def _refiner_objective(setup: Setup) -> tuple[Objective, None]:
    generator = motion_generator(setup.trained["diffusion"])
    network = RefinerModel(setup.network).to(setup.device)
    models = [sample.object_model for sample in (*setup.corpus.train, *setup.corpus.held_out)]
    surface = Surface.of(setup.hands, models, setup.loss.field_resolution, setup.device)
    return RefinerObjective(network, setup.loss, setup.corpus, generator, surface, setup.device, setup.seed), None


REFINER = Network(
    "refiner", RefinerConfig, RefinerModel, _refiner_objective, RefinerLossConfig, needs=(DIFFUSION.name,), crop="start"
)
