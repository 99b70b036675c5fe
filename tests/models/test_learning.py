"""The networks overfit two clips within minutes, and distinguish them by their sentences."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal
from unittest.mock import patch

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, ClipSample, collate
from hoidata.clips.features import WRIST
from hoidata.contact.maps import f1_score
from models.common.contact_maps import best_threshold, true_maps
from models.common.corpus import Corpus
from models.common.family import Network, Objective, Setup
from models.common.features import Hands
from models.common.sampling import Motion, SamplerConfig
from models.common.training import TrainingConfig, TrainingSpec, fit
from models.registry import load_network
from models.text2hoi.contact_training import contact_probabilities
from models.text2hoi.diffusion import Condition, MotionGenerator
from models.text2hoi.diffusion_training import Targets
from models.text2hoi.refiner import RefinerModel, Surface, refine
from models.text2hoi.refiner_training import RefinerObjective, _Coarse, _Comparison
from pipelines.stages.base import load_settings
from pipelines.stages.train import TrainParams
from tests.models.conftest import two_clips

DELIVERED = load_settings(TrainParams, "train")
Preset = Literal["paper", "ours"]
PRESETS: tuple[Preset, ...] = ("ours", "paper")
# Steps, clips in a batch, and learning rate.
BUDGETS: Mapping[tuple[str, Preset], tuple[int, int, float]] = {
    ("contact", "ours"): (400, 4, 2e-3),
    ("contact", "paper"): (400, 4, 2e-3),
    ("length", "ours"): (1500, 2, 2e-3),
    ("length", "paper"): (1500, 2, 2e-3),
    ("diffusion", "ours"): (600, 2, 1e-3),
    ("diffusion", "paper"): (1000, 2, 2e-3),
    ("refiner", "ours"): (800, 2, 2e-3),
    ("refiner", "paper"): (1200, 2, 1e-3),
}


@dataclass(frozen=True)
class Learnt:
    """Networks trained on two clips of one box and one hand that differ in verb, length and path."""

    preset: Preset
    corpus: Corpus
    clips: list[ClipSample]
    networks: dict[str, nn.Module]
    generator: MotionGenerator
    hands: Hands


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[Corpus, Hands]:
    corpus = two_clips(tmp_path_factory.mktemp("two"))
    return corpus, Hands(corpus.annotated.store.hand_pair())


@pytest.fixture(scope="module", params=PRESETS)
def learnt(two: tuple[Corpus, Hands], request: pytest.FixtureRequest) -> Learnt:
    (corpus, hands), trained, normaliser = two, dict[str, Any](), None
    for name in ("contact", "length", "diffusion"):
        network = load_network(name)
        module, normaliser = learn(network, corpus, hands, trained, request.param)
        trained[name] = SimpleNamespace(network=module, info={"results": network.results(module, corpus)})
    networks = {name: module.network for name, module in trained.items()}
    generator = MotionGenerator(networks["diffusion"], normaliser)
    clips = list(corpus.train)
    return Learnt(request.param, corpus, clips=clips, networks=networks, generator=generator, hands=hands)


def learn(
    network: Network, corpus: Corpus, hands: Hands, trained: Mapping[str, Any], preset: Preset
) -> tuple[nn.Module, Any]:
    """The network trained with the project's settings, except for the budget, and without dropout."""
    spec = TrainingSpec.of(network, replace(DELIVERED, preset=preset).of(network.name))
    dropouts = {"dropout": 0.0} if network.name == "length" else {}
    torch.manual_seed(0)
    loss = replace(spec.loss, points=1024) if network.name == "contact" else spec.loss
    setup = Setup(
        network=replace(spec.network, **dropouts),
        loss=loss,
        seed=0,
        corpus=corpus,
        hands=hands,
        device=torch.device("cpu"),
        trained=dict(trained),
    )
    objective, normaliser = network.objective(setup)
    training = overfitting(spec.training, network.name, preset)
    return fit_quickly(objective, corpus, training), normaliser


def fit_quickly(objective: Objective, corpus: Corpus, training: TrainingConfig) -> nn.Module:
    """``fit`` with a beta2 of 0.95, because features of `paper` are not normalised.

    Gradients are large in the first hundred steps, and a beta2 of 0.999 would divide by them for a thousand steps.
    """
    with patch.object(torch.optim, "AdamW", partial(torch.optim.AdamW, betas=(0.9, 0.95))):
        return fit(objective, corpus, training, 0, torch.device("cpu"))[0]


def overfitting(training: TrainingConfig, network: str, preset: Preset) -> TrainingConfig:
    """Training settings with a budget that suffices to overfit two clips."""
    steps, size, rate = BUDGETS[network, preset]
    budget = {"steps": steps, "batch": size, "learning_rate": rate, "warmup": 100, "validate_every": steps}
    usual = {"schedule": "cosine", "ema_decay": 0.98, "weight_decay": 0.0, "keep_best": False}
    return replace(training, **budget, **usual, augmented_copies=0)


@pytest.mark.long
def test_contact_and_length_networks_overfit_two_clips(learnt: Learnt) -> None:
    networks, clips = learnt.networks, learnt.clips
    batch, maps = collate(clips), true_maps(clips)
    probabilities = contact_probabilities(networks["contact"], clips, 16, 0)  # pyright: ignore[reportArgumentType]
    threshold = best_threshold(probabilities, maps)
    assert (
        min(f1_score(probability >= threshold, true) for probability, true in zip(probabilities, maps, strict=True))
        >= 0.95
    )
    verbs = [clip.verb for clip in clips]
    frames = networks["length"].expected_frames(batch.text[:, 0], verbs)  # pyright: ignore[reportCallIssue]
    torch.testing.assert_close(frames, batch.lengths.float(), atol=1.0, rtol=0)
    swapped = networks["length"].expected_frames(batch.text.flip(0)[:, 0], verbs[::-1])  # pyright: ignore[reportCallIssue]
    torch.testing.assert_close(swapped, frames.flip(0))


@pytest.mark.long
def test_the_diffusion_network_overfits_two_clips(learnt: Learnt) -> None:
    batch = collate(learnt.clips)
    targets = Targets(learnt.generator.network.representation, learnt.generator.normaliser, torch.device("cpu")).of(
        batch
    )
    steps, generator = torch.full((2,), 100), torch.Generator().manual_seed(0)
    motion = learnt.generator.denoise_once(targets.hands, targets.object, steps, condition(batch, [0, 1]), generator)
    assert joint_error_m(learnt, batch, *motion) < 0.005


@pytest.mark.long
def test_swapped_sentences_swap_the_paths_of_the_object(learnt: Learnt) -> None:
    batch = collate(learnt.clips)
    representation, generator = learnt.generator.network.representation, torch.Generator().manual_seed(0)
    sizes = representation.sizes(int(batch.lengths.max()))
    shapes = (2, 2, sizes[0], 99), (2, sizes[1], representation.object_features)
    noise = torch.randn(shapes[0], generator=generator), torch.randn(shapes[1], generator=generator)
    for order, verbs in (([0, 1], [0, 1]), ([1, 0], [1, 0])):
        # The sentence and its length are swapped; the contact is not.
        counts = tuple(batch.counts[index] for index in order)
        swapped = condition(replace(batch, lengths=batch.lengths[order], counts=counts), order)
        _, objects = learnt.generator.sample(swapped, SamplerConfig(), lambda: noise)
        # The box is lifted along z or passed along x, by 20 cm.
        last = torch.stack([path[n - 1, :3] for path, n in zip(objects, batch.lengths[order], strict=True)])
        assert [int(end[2] < end[0]) for end in last] == verbs


@dataclass(frozen=True)
class Planted(MotionGenerator):
    """A generator whose wrists are off by 10 mm and all else is correct; sign -1: in the opposite direction."""

    sign: int = 1

    def denoise_once(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition, generator: torch.Generator
    ) -> Motion:
        del timesteps
        hands_m, objects_m = self._features((hands, objects), condition)
        return planted(hands_m, self.sign, generator), objects_m


def planted(hands: Tensor, sign: int, generator: torch.Generator) -> Tensor:
    """Hands (B, 2, F, 99) with wrists moved by 10 mm in a direction that changes over 64 frames."""
    first, last = torch.randn(2, *hands.shape[:2], 1, 3, generator=generator)
    fraction = torch.arange(hands.shape[2])[:, None] / 64
    direction = torch.nn.functional.normalize(first + (last - first) * fraction, dim=-1)
    return torch.cat((hands[..., :3] + sign * 0.01 * direction, hands[..., 3:]), -1)


class Opposed(RefinerObjective):
    """Every step has each noise and its opposite, so that everything else cancels in the gradient.

    The inputs of `paper` are thousands of large numbers, in which noise of millimetres is not found otherwise.
    """

    opposite: Mapping[str, list[_Coarse]]

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> dict[str, Tensor]:
        terms, pool = super().losses(batch, generator), self.pool
        self.pool = dict(self.opposite)
        opposite_terms = super().losses(batch, generator)
        self.pool = pool
        return {name: (terms[name] + opposite_terms[name]) / 2 for name in terms}


@pytest.mark.long
def test_the_refiner_removes_four_fifths_of_added_noise(learnt: Learnt) -> None:
    network, clips = load_network("refiner"), learnt.clips
    spec = TrainingSpec.of(network, replace(DELIVERED, preset=learnt.preset).of("refiner"))
    # Eq. 9 only: contact and penetration also move fingers, and do not determine the wrist.
    loss = replace(spec.loss, penetration_weight=0.0, contact_weight=0.0)
    generator = Planted(learnt.generator.network, learnt.generator.normaliser)
    surface = Surface.of(learnt.hands, [clips[0].object_model], torch.device("cpu"))
    torch.manual_seed(0)
    objective = Opposed(
        RefinerModel(spec.network),
        weights=loss,
        corpus=learnt.corpus,
        generator=generator,
        surface=surface,
        device=torch.device("cpu"),
        seed=0,
        sample_contact=lambda batch, text, random: batch.contact.float(),
    )
    objective.opposite = noisy(objective, replace(generator, sign=-1), clips)
    objective.pool = noisy(objective, generator, clips)
    training = overfitting(spec.training, "refiner", learnt.preset)
    refiner = fit_quickly(objective, learnt.corpus, training)
    batch, random = collate(clips), torch.Generator().manual_seed(2)
    errors_m = np.mean(
        [wrists_off_m(refiner, objective._batch(batch, objective._coarse_motions(clips, random))) for _ in range(16)],
        axis=0,
    )
    assert errors_m[0] == pytest.approx(0.01, rel=0.03)  # 10 mm, and the error of the motion representation
    assert errors_m[1] <= 0.2 * errors_m[0]


@pytest.mark.long
@pytest.mark.parametrize("learnt", ["paper"], indirect=True)
def test_a_diffusion_refiner_overfits_two_clips(learnt: Learnt) -> None:
    clips, settings = learnt.clips, replace(DELIVERED, preset=learnt.preset)
    spec = TrainingSpec.of(load_network("refiner"), settings.of("refiner"))
    torch.manual_seed(0)
    objective = RefinerObjective(
        RefinerModel(replace(spec.network, output="diffusion")),
        weights=replace(spec.loss, penetration_weight=0.0, contact_weight=0.0),
        corpus=learnt.corpus,
        generator=Planted(learnt.generator.network, learnt.generator.normaliser),
        surface=Surface.of(learnt.hands, [clips[0].object_model], torch.device("cpu")),
        device=torch.device("cpu"),
        seed=0,
        sample_contact=lambda batch, text, random: batch.contact.float(),
    )
    refiner = fit_quickly(objective, learnt.corpus, overfitting(spec.training, "refiner", learnt.preset))
    comparison = objective._batch(collate(clips), [objective.pool[clip.clip_id][0] for clip in clips])
    random = torch.Generator().manual_seed(3)
    refined = refine(refiner, comparison.coarse, lambda: torch.randn(comparison.target.shape, generator=random))
    before_m, after_m = (
        float((hands - comparison.target)[..., WRIST].norm(dim=-1)[comparison.coarse.present].mean())
        for hands in (comparison.coarse.hands, refined)
    )
    assert before_m == pytest.approx(0.01, rel=0.1)
    assert after_m <= 0.5 * before_m


def noisy(objective: RefinerObjective, generator: Planted, clips: list[ClipSample]) -> dict[str, list[_Coarse]]:
    """A thousand coarse motions per clip; a network would memorise the noise of 60."""
    objective.generator, random = generator, torch.Generator().manual_seed(1)
    motions = [motion for _ in range(64) for motion in objective._coarse_motions(clips * 16, random)]
    return {clip.clip_id: motions[index :: len(clips)] for index, clip in enumerate(clips)}


@torch.no_grad()
def wrists_off_m(refiner: RefinerModel, comparison: _Comparison) -> list[float]:
    """Mean distance of wrists from the clips', before and after refinement, in the refiner's view."""
    before, after = (
        refiner.in_view(comparison.coarse.hands, comparison.coarse.object),
        refiner.corrected(comparison.coarse),
    )
    distances = [(hands - comparison.target)[..., WRIST].norm(dim=-1) for hands in (before, after)]
    return [float(distance[comparison.coarse.present].mean()) for distance in distances]


def condition(batch: ClipBatch, order: list[int]) -> Condition:
    """The batch with the sentences in another order."""
    verbs = [batch.samples[index].verb for index in order]
    return Condition(batch, batch.text[order][:, 0], verbs, batch.contact)


def joint_error_m(learnt: Learnt, batch: ClipBatch, hands: Tensor, objects: Tensor) -> float:
    del objects
    joints = learnt.hands.joints(hands, batch.betas, batch.template_m)
    return float((joints - batch.joints_m).norm(dim=-1)[batch.present].mean())
