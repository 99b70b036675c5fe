"""Training of the hand refiner on motions of the frozen generator (Text2HOI, Eq. 8-11)."""

from dataclasses import dataclass

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
from models.common.sampling import TRAIN_STEPS, add_noise, alphas_cumprod
from models.text2hoi.contact_training import CONTACT, SampleContact, contact_sampler
from models.text2hoi.diffusion import Condition, MotionGenerator
from models.text2hoi.diffusion_training import DIFFUSION, Targets, motion_generator
from models.text2hoi.refiner import NOISE_STEPS, CoarseMotion, NoisedHands, RefinerConfig, RefinerModel, Surface

MAX_BATCH_SIZE = 32  # of generated motions
COARSE_MOTIONS = 4  # per training clip
VERTEX_STEP = 3  # every third vertex of a hand counts in Eq. 10
RESIDUAL_UNIT_M = 0.01  # length unit of Eq. 10 and 11 for a network that predicts corrections
PER_HAND = ("hands", "joints_m", "distance_m", "offset_m")


@dataclass(frozen=True)
class RefinerLossConfig:
    """Weights of the loss terms relative to Eq. 9 (weight 1)."""

    # Eq. 10, depth of vertices inside the object.
    penetration_weight: float = 1.0
    # Eq. 11, distance of joints from the surface.
    contact_weight: float = 5.0
    # Frames per clip on which Eq. 10 and 11 are computed.
    frames: int = 8


@dataclass(frozen=True)
class _Coarse:
    """One coarse motion of a clip of F frames, and its targets; frames come first."""

    view: dict[str, Tensor]  # fields of :class:`CoarseMotion` with a frame axis, (F, ...)
    contact_map: Tensor  # (N,) that conditions the refiner
    target: Tensor  # (F, 2, 99) recorded hands in the refiner's view
    true_distance_m: Tensor  # (F, 2, 21) of recorded joints to the surface


@dataclass(frozen=True)
class _Comparison:
    """A batch of coarse motions and their targets; the hand axis comes before frames."""

    batch: ClipBatch
    coarse: CoarseMotion
    target: Tensor  # (B, 2, F, 99) recorded hands in the refiner's view
    true_distance_m: Tensor  # (B, 2, F, 21) of recorded joints to the surface


class RefinerObjective:
    """Losses of the refiner: Text2HOI, Eq. 9-11.

    A coarse motion is a recorded clip that was noised and denoised once; the target is the recorded hands. For a
    network that predicts corrections, squared errors are averaged instead of summed, Eq. 10 and 11 are in centimetres,
    and touching joints are pulled to their recorded distance instead of onto the surface. A diffusion model is also
    given noised recorded hands.
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
        sample_contact: SampleContact,
    ) -> None:
        """sample_contact: samples contact maps, which condition coarse motions and refiner."""
        self.network, self.weights, self.device, self.sample_contact = network, weights, device, sample_contact
        self.frames = weights.frames
        self.generator, self.surface = generator, surface
        self.targets = Targets(generator.network.representation, generator.normaliser, device)
        self.alphas_bar = alphas_cumprod(device)
        self.vertices = torch.arange(0, 778, VERTEX_STEP, device=device)
        random = torch.Generator().manual_seed(seed)
        train, held_out = list(corpus.train), corpus.held_out
        self.pool: dict[str, list[_Coarse]] = {sample.clip_id: [] for sample in train}
        for _ in range(COARSE_MOTIONS):
            for sample, coarse in zip(train, self._coarse_motions(train, random), strict=True):
                self.pool[sample.clip_id].append(coarse)
        self.held_out: _Comparison | None = None
        if held_out:
            motions = self._coarse_motions(held_out, torch.Generator().manual_seed(0))
            lengths = [sample.length for sample in held_out]
            selection = FrameSelection.drawn(lengths, self.frames, 0, np.random.default_rng(0))
            self.held_out = self._batch(collate(held_out, selection).to(device), motions)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> dict[str, Tensor]:
        random, pools = np.random.default_rng(generator.initial_seed()), [self.pool[s.clip_id] for s in batch.samples]
        motions = [pool[random.integers(len(pool))] for pool in pools]
        return self._losses(self.network, self._batch(batch, motions), generator)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, RefinerModel)
        assert self.held_out is not None
        return self._losses(network, self.held_out, torch.Generator().manual_seed(0))["total"]

    def _losses(self, network: RefinerModel, comparison: _Comparison, generator: torch.Generator) -> dict[str, Tensor]:
        batch, coarse, weights = comparison.batch, comparison.coarse, self.weights
        refined = network(coarse, self._noised(comparison.target, generator) if network.is_diffusion else None)
        change = (network.in_view(refined, coarse.object) - comparison.target) / network.reach
        simple = losses.masked_mean(change.square(), coarse.present[..., None])
        simple = simple if network.is_residual else simple * change.shape[-1]
        chosen = batch.chosen
        present, true_distance = (
            losses.take_frames(part, chosen, 2) for part in (coarse.present, comparison.true_distance_m)
        )
        vertex_distance, joint_distance = self._distances(
            batch, losses.take_frames(refined, chosen, 2), coarse.object, chosen
        )
        unit_m = RESIDUAL_UNIT_M if network.is_residual else 1.0
        penetration = losses.penetration_loss(vertex_distance, present, unit_m)
        if network.is_residual:
            contact = losses.contact_loss(joint_distance, true_distance, present, batch.contact_threshold_m, unit_m)
        else:
            contact = losses.surface_loss(joint_distance, present, batch.contact_threshold_m, unit_m)
        total = simple + weights.penetration_weight * penetration + weights.contact_weight * contact
        return {"total": total, "simple": simple, "penetration": penetration, "contact": contact}

    def _noised(self, target: Tensor, generator: torch.Generator) -> NoisedHands:
        """Recorded hands at random timesteps (Eq. 1)."""
        steps = send(torch.randint(NOISE_STEPS, (len(target),), generator=generator), self.device)
        noise = send(torch.randn(target.shape, generator=generator), self.device)
        return NoisedHands(add_noise(target, noise, steps, self.alphas_bar), steps)

    def _distances(self, batch: ClipBatch, hands: Tensor, objects: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances of some vertices (B, 2, K, V) and the joints (B, 2, K, 21) of hands in the chosen frames."""
        vertices, joints = self.surface.hands.vertices(hands, batch.betas, batch.template_m)
        points = torch.cat((vertices[..., self.vertices, :], joints), -2)
        distance = self.surface.distance(batch, points, losses.take_frames(objects, chosen, 1))
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
        contact_map = torch.stack([motion.contact_map for motion in motions])
        common = {"present": batch.present, "batch": batch, "contact_map": contact_map}
        return _Comparison(batch, CoarseMotion(object=objects, **hands, **common), target, true_distance)

    @torch.no_grad()
    def _coarse_motions(self, samples: list[ClipSample], random: torch.Generator) -> list[_Coarse]:
        """One coarse motion of every clip, in their order; generated in batches of similar length."""
        order = sorted(range(len(samples)), key=lambda index: samples[index].length)
        motions: dict[int, _Coarse] = {}
        for start in range(0, len(order), MAX_BATCH_SIZE):
            indices = order[start : start + MAX_BATCH_SIZE]
            batch = collate([samples[index] for index in indices]).to(self.device)
            hands, objects, contact_map = self._generate(batch, random)
            coarse = self.surface.coarse(batch, hands, objects, contact_map, batch.present)
            target = self.network.in_view(batch.hands, batch.object).transpose(1, 2)
            true_distance = self.surface.distance(batch, batch.joints_m, batch.object).transpose(1, 2)
            view = {name: getattr(coarse, name).transpose(1, 2) for name in PER_HAND} | {"object": objects}
            for position, index in enumerate(indices):
                stop = samples[index].length
                parts = {name: tensor[position, :stop].clone() for name, tensor in view.items()}
                targets = target[position, :stop].clone(), true_distance[position, :stop].clone()
                motions[index] = _Coarse(parts, contact_map[position].clone(), *targets)
        return [motions[index] for index in range(len(samples))]

    def _generate(self, batch: ClipBatch, random: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Hands (B, 2, F, 99), objects (B, F, 10), and the contact maps (B, N) for the refiner."""
        text = any_form(batch, random)
        contact = self.sample_contact(batch, text, random)
        condition = Condition(batch, text, [sample.verb for sample in batch.samples], contact)
        targets = self.targets.of(batch)
        steps = send(torch.randint(TRAIN_STEPS, (len(batch),), generator=random), self.device)
        motion = self.generator.denoise_once(targets.hands, targets.object, steps, condition, random)
        return *motion, contact.float().amax(1)


def _refiner_objective(setup: Setup) -> tuple[Objective, None]:
    generator = motion_generator(setup.trained["diffusion"])
    network = RefinerModel(setup.network).to(setup.device)
    models = [sample.object_model for sample in (*setup.corpus.train, *setup.corpus.held_out)]
    is_binary = generator.network.config.contact_input == "tokens"
    objective = RefinerObjective(
        network,
        weights=setup.loss,
        corpus=setup.corpus,
        generator=generator,
        surface=Surface.of(setup.hands, models, setup.device),
        device=setup.device,
        seed=setup.seed,
        sample_contact=contact_sampler(setup.trained["contact"], is_binary),
    )
    return objective, None


REFINER = Network(
    "refiner",
    RefinerConfig,
    build=RefinerModel,
    objective=_refiner_objective,
    loss=RefinerLossConfig,
    needs=(CONTACT.name, DIFFUSION.name),
    crop="start",
)
