"""Training of the hand refiner on motions of the frozen generator (Text2HOI, Eq. 8-11)."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from hoidata.batches.dataset import ClipBatch, ClipSample, collate
from hoidata.batches.frame_selection import FrameSelection
from hoidata.devices import send
from models.common import losses
from models.common.corpus import Corpus, any_form
from models.common.family import Network, Objective, Setup
from models.common.sampling import TRAIN_STEPS, SamplerConfig, draw_motion
from models.text2hoi.diffusion import Condition, MotionGenerator
from models.text2hoi.diffusion_training import DIFFUSION, Targets, motion_generator
from models.text2hoi.refiner import CoarseMotion, RefinerConfig, RefinerModel, Surface

MAX_BATCH_SIZE = 32  # of generated motions
PER_HAND = ("hands", "joints_m", "distance_m", "offset_m")


@dataclass(frozen=True)
class RefinerLossConfig:
    """Loss terms and their weights relative to Eq. 9 (weight 1), and the coarse motions to train on."""

    # Eq. 10, depth of vertices inside the object.
    penetration_weight: float = 1.0
    # Eq. 11, distance of joints from the surface.
    contact_weight: float = 5.0
    # Length unit of Eq. 10 and 11.
    unit_m: float = 1.0
    # Squared errors of a frame (Eq. 9) are summed (the paper) or averaged.
    weighting: Literal["sum", "mean"] = "sum"
    # Joints near the surface are pulled onto it (the paper), or touching joints to their recorded distance.
    contact_target: Literal["surface", "recorded"] = "surface"
    # Coarse motions are recorded clips, noised and denoised once, with the recorded hands as target; or every second
    # one is sampled from noise, with itself as target (:class:`RefinerObjective`).
    coarse_motions: Literal["denoised_once", "half_sampled"] = "denoised_once"
    # Sample coarse motions for contact maps of other clips with the same object and hand type. The clip's map would
    # reproduce the training clip.
    swap_contact_maps: bool = False
    # Frames per clip on which Eq. 10 and 11 are computed.
    frames: int = 8
    # Vertices per hand in Eq. 10.
    vertices: int = 259
    # Coarse motions per training clip.
    samples: int = 4
    # Denoiser calls of a sampled coarse motion.
    sampler_steps: int = 10
    # Grid points of the distance grids along each axis.
    field_resolution: int = 40


@dataclass(frozen=True)
class _Coarse:
    """One coarse motion of a clip of F frames, and its targets; frames come first."""

    view: dict[str, Tensor]  # fields of :class:`CoarseMotion` with a frame axis, (F, ...)
    target: Tensor  # (F, 2, 99) hands in the refiner's view
    true_distance_m: Tensor  # (F, 2, 21) of recorded joints to the surface


@dataclass(frozen=True)
class _Comparison:
    """A batch of coarse motions and their targets; the hand axis comes before frames."""

    batch: ClipBatch
    coarse: CoarseMotion
    target: Tensor  # (B, 2, F, 99) hands in the refiner's view
    true_distance_m: Tensor  # (B, 2, F, 21) of recorded joints to the surface


class RefinerObjective:
    """Losses of the refiner: Text2HOI, Eq. 9-11.

    For a recorded clip that was noised and denoised once, the target is the recorded hands relative to the object. A
    motion sampled from noise has no recorded hands; its target is itself. All motions are trained to touch where the
    clip does, and not to penetrate.
    """

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
        self.targets = Targets(generator.network.representation, generator.normaliser, device)
        self.vertices = torch.arange(0, 778, max(1, 778 // weights.vertices), device=device)
        random = torch.Generator().manual_seed(seed)
        train, held_out = list(corpus.train), corpus.held_out
        self.contact_maps: dict[tuple[str, str], list[np.ndarray]] = {}
        for sample in train:
            self.contact_maps.setdefault((sample.object_key, sample.hand_type), []).append(sample.contact)
        half = weights.coarse_motions == "half_sampled"
        kinds = ["sampled" if half and number % 2 else "denoised" for number in range(weights.samples)]
        self.pool = {sample.clip_id: [] for sample in train}
        for kind in kinds:
            for sample, coarse in zip(train, self._coarse_motions(train, kind, random), strict=True):
                self.pool[sample.clip_id].append(coarse)
        self.held_out: _Comparison | None = None
        if held_out:
            motions = self._coarse_motions(held_out, kinds[-1], torch.Generator().manual_seed(0))
            self.held_out = self._batch(collate(held_out, self._selection(held_out)).to(device), motions)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> dict[str, Tensor]:
        numbers = np.random.default_rng(generator.initial_seed()).integers(self.weights.samples, size=len(batch))
        motions = [self.pool[sample.clip_id][n] for sample, n in zip(batch.samples, numbers, strict=True)]
        return self._losses(self.network, self._batch(batch, motions))

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, RefinerModel)
        assert self.held_out is not None
        return self._losses(network, self.held_out)["total"]

    def _selection(self, samples: list[ClipSample]) -> FrameSelection:
        return FrameSelection.drawn([sample.length for sample in samples], self.frames, 0, np.random.default_rng(0))

    def _losses(self, network: RefinerModel, comparison: _Comparison) -> dict[str, Tensor]:
        batch, coarse, weights = comparison.batch, comparison.coarse, self.weights
        refined = network(coarse)
        change = (network.in_view(refined, coarse.object) - comparison.target) / network.reach
        simple = losses.masked_mean(change.square(), coarse.present[..., None])
        simple = simple * change.shape[-1] if weights.weighting == "sum" else simple
        chosen = batch.chosen
        present, true_distance = (
            losses.take_frames(part, chosen, 2) for part in (coarse.present, comparison.true_distance_m)
        )
        vertex_distance, joint_distance = self._distances(
            batch, losses.take_frames(refined, chosen, 2), coarse.object, chosen
        )
        penetration = losses.penetration_loss(vertex_distance, present, weights.unit_m)
        if weights.contact_target == "surface":
            contact = losses.surface_loss(joint_distance, present, batch.contact_threshold_m, weights.unit_m)
        else:
            contact = losses.contact_loss(
                joint_distance, true_distance, present, batch.contact_threshold_m, weights.unit_m
            )
        total = simple + weights.penetration_weight * penetration
        total = total + weights.contact_weight * contact
        return {"total": total, "simple": simple, "penetration": penetration, "contact": contact}

    def _distances(self, batch: ClipBatch, hands: Tensor, objects: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances of some vertices (B, 2, K, V) and the joints (B, 2, K, 21) of hands in the chosen frames."""
        vertices, joints = self.surface.hands.vertices(hands, batch.betas, batch.template_m)
        points = torch.cat((vertices[..., self.vertices, :], joints), -2)
        _, distance, _ = self.surface.measure(batch, points, losses.take_frames(objects, chosen, 1))
        vertex_distance, joint_distance = distance.split([len(self.vertices), joints.shape[-2]], -1)
        return vertex_distance, joint_distance

    def _batch(self, batch: ClipBatch, motions: list[_Coarse]) -> _Comparison:
        padded = {
            name: pad_sequence([motion.view[name] for motion in motions], batch_first=True) for name in motions[0].view
        }
        objects = padded.pop("object")
        hands = {name: tensor.transpose(1, 2) for name, tensor in padded.items()}
        target, true_distance = (
            pad_sequence([getattr(motion, name) for motion in motions], batch_first=True).transpose(1, 2)
            for name in ("target", "true_distance_m")
        )
        common = {"present": batch.present, "batch": batch, "contact_map": batch.contact_map}
        return _Comparison(batch, CoarseMotion(object=objects, **hands, **common), target, true_distance)

    @torch.no_grad()
    def _coarse_motions(self, samples: list[ClipSample], kind: str, random: torch.Generator) -> list[_Coarse]:
        """One coarse motion of every clip, in their order; generated in batches of similar length."""
        order = sorted(range(len(samples)), key=lambda index: samples[index].length)
        motions: dict[int, _Coarse] = {}
        for start in range(0, len(order), MAX_BATCH_SIZE):
            indices = order[start : start + MAX_BATCH_SIZE]
            batch = collate([samples[index] for index in indices]).to(self.device)
            hands, objects = self._generate(batch, kind, random)
            coarse = self.surface.coarse(batch, hands, objects, batch.contact_map, batch.present)
            target_motion = (batch.hands, batch.object) if kind == "denoised" else (hands, objects)
            target = self.network.in_view(*target_motion).transpose(1, 2)
            true_distance = self.surface.measure(batch, batch.joints_m, batch.object)[1].transpose(1, 2)
            view = {name: getattr(coarse, name).transpose(1, 2) for name in PER_HAND} | {"object": objects}
            for position, index in enumerate(indices):
                stop = samples[index].length
                parts = {name: tensor[position, :stop].clone() for name, tensor in view.items()}
                motions[index] = _Coarse(parts, target[position, :stop].clone(), true_distance[position, :stop].clone())
        return [motions[index] for index in range(len(samples))]

    def _swapped_contact(self, batch: ClipBatch, random: torch.Generator) -> Tensor:
        """Contact maps (B, 2, N) bool of random training clips with the same object and hand type; else the clips'."""
        chosen = []
        for sample in batch.samples:
            contact_maps = self.contact_maps.get((sample.object_key, sample.hand_type)) or [sample.contact]
            chosen.append(torch.from_numpy(contact_maps[int(torch.randint(len(contact_maps), (), generator=random))]))
        return send(torch.stack(chosen), self.device)

    def _generate(self, batch: ClipBatch, kind: str, random: torch.Generator) -> tuple[Tensor, Tensor]:
        text = any_form(batch, random)
        network = self.generator.network
        condition = Condition.of(batch, network.object_feature(batch.points_m), text, batch.contact)
        targets = self.targets.of(batch)
        if kind == "sampled":
            if self.weights.swap_contact_maps:
                condition = replace(condition, contact=self._swapped_contact(batch, random))
            sampler = SamplerConfig(steps=self.weights.sampler_steps)
            noise = draw_motion(targets.hands.shape, targets.object.shape, random)
            return self.generator.sample(condition, sampler, noise, random)
        steps = send(torch.randint(TRAIN_STEPS, (len(batch),), generator=random), self.device)
        return self.generator.denoise_once(targets.hands, targets.object, steps, condition, random)


def _refiner_objective(setup: Setup) -> tuple[Objective, None]:
    generator = motion_generator(setup.trained["diffusion"])
    network = RefinerModel(setup.network).to(setup.device)
    models = [sample.object_model for sample in (*setup.corpus.train, *setup.corpus.held_out)]
    surface = Surface.of(setup.hands, models, setup.loss.field_resolution, setup.device)
    objective = RefinerObjective(
        network,
        weights=setup.loss,
        corpus=setup.corpus,
        generator=generator,
        surface=surface,
        device=setup.device,
        seed=setup.seed,
    )
    return objective, None


REFINER = Network(
    "refiner",
    RefinerConfig,
    build=RefinerModel,
    objective=_refiner_objective,
    loss=RefinerLossConfig,
    needs=(DIFFUSION.name,),
    crop="start",
)
