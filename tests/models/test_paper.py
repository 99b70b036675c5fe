"""Preset `paper` does what Text2HOI's text says; in `ours`, contact follows the size of the object."""

import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hoidata.annotation.encoders import load_encoder, not_clip_note
from hoidata.annotation.hand_choice import TEMPLATES
from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset, collate
from hoidata.batches.frame_selection import FrameSelection
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.metrics.evaluate import evaluate_store
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.distances import DistanceEntries
from models.common.augmentation import scaled_contact
from models.common.checkpoints import load_checkpoint
from models.common.corpus import Corpus
from models.common.family import Setup, Sources
from models.common.features import Hands, Normaliser
from models.common.predicting import PredictionConfig, requests_for, sample_family
from models.common.sampling import SamplerConfig
from models.common.training import TrainingSpec
from models.common.transformer import agent_codes, sinusoid
from models.registry import load_family, load_network
from models.text2hoi import refiner_training
from models.text2hoi.contact import AnchoredContact, ContactLossConfig, ContactModel
from models.text2hoi.contact_training import ContactObjective, contact_sampler
from models.text2hoi.diffusion import DiffusionModel, MotionGenerator
from models.text2hoi.diffusion_training import DiffusionObjective
from models.text2hoi.generation import Generator, MotionOptions
from models.text2hoi.length import LengthConfig, LengthModel, LengthObjective
from models.text2hoi.refiner import RefinerModel, Surface
from models.text2hoi.refiner_training import RefinerObjective
from models.text2hoi.sampler import SamplingConfig, Text2Hoi
from tests.models.test_fidelity import CPU, spec
from tests.models.test_training import user_box
from tests.models.toy import PAPER, SMALL_TRANSFORMER

HANDS = load_embedded_hands()
CONTACT = spec("contact", size="small").network
SMALL = replace(CONTACT, decoder_widths=(32, 16, 8), latent=8)
OURS = replace(spec("contact", "ours", "small").network, decoder_widths=(32, 16, 8))


def seeded(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


def training_batch(clips: list[ClipSample]) -> ClipBatch:
    """The clips with the frames and entries that losses of geometry need."""
    return collate(clips, FrameSelection.drawn([clip.length for clip in clips], 5, 2000, np.random.default_rng(0)))


def diffusion_network() -> DiffusionModel:
    config = spec("diffusion").network
    transformer = replace(config.transformer, **SMALL_TRANSFORMER)
    return DiffusionModel(replace(config, transformer=transformer, point_net=SMALL.point_net))


def diffusion_objective(annotated: AnnotatedStore, **more: Any) -> DiffusionObjective:
    arguments = Corpus.of(annotated, 0), Hands(HANDS), Normaliser.identity(), CPU
    return DiffusionObjective(diffusion_network(), spec("diffusion").loss, *arguments, **more)


def refiner_objective(annotated: AnnotatedStore, sample_contact: Any) -> RefinerObjective:
    corpus, network = Corpus.of(annotated, 0), spec("refiner").network
    return RefinerObjective(
        RefinerModel(replace(network, transformer=replace(network.transformer, **SMALL_TRANSFORMER))),
        weights=spec("refiner").loss,
        corpus=corpus,
        generator=MotionGenerator(diffusion_network(), Normaliser.identity()),
        surface=Surface.of(Hands(HANDS), [sample.object_model for sample in corpus.train], CPU),
        device=CPU,
        seed=0,
        sample_contact=sample_contact,
    )


# --- contact maps


@pytest.mark.parametrize("network", [ContactModel(SMALL), AnchoredContact(OURS)], ids=["paper", "ours"])
@pytest.mark.parametrize("changed", ["text", "scale"])
def test_text_and_scale_change_the_map(network: ContactModel | AnchoredContact, changed: str, batch: ClipBatch) -> None:
    latents = network.eval().draw_latents(1, len(batch), seeded())
    text, other = batch.text[:, 0], batch
    before = network.sample(batch, text, latents)
    if changed == "text":
        text = text.roll(1, 0) if isinstance(network, ContactModel) else text.roll(7, 1)
    else:
        other = replace(batch, points_m=batch.points_m * 2, scale_m=batch.scale_m * 2)
    assert (network.sample(other, text, latents) - before).abs().amax((1, 2, 3)).min() > 1e-6


def test_estimated_maps_are_probabilities_in_training(
    annotated: AnnotatedStore, batch: ClipBatch, paper_trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = load_checkpoint(paper_trained / "contact", load_network("contact"))
    sample_contact = contact_sampler(checkpoint, is_binary=False)
    network, latents = checkpoint.network, seeded(5)
    expected = network.sample(batch, batch.text[:, 0], network.draw_latents(1, len(batch), latents))[:, 0]
    torch.testing.assert_close(sample_contact(batch, batch.text[:, 0], seeded(5)), expected)
    tested, conditions = diffusion_objective(annotated, sample_contact=sample_contact), list[Any]()
    tested.network.register_forward_pre_hook(lambda _, inputs: conditions.append(inputs[3]))
    tested.losses(training_batch(list(HoiDataset(annotated, "train"))), seeded())
    assert spec("diffusion").loss.contact == "estimated"
    assert is_fractional(conditions[0].contact)
    inputs = list[Tensor]()
    tested.network.object_condition_in.register_forward_pre_hook(lambda _, layer_inputs: inputs.append(layer_inputs[0]))
    tested.network.encode_condition(conditions[0])
    width = SMALL.point_net.widths[-1]
    torch.testing.assert_close(inputs[0][:, width : width + 1024], conditions[0].contact.amax(1))


def test_the_denoiser_has_the_contact_networks_point_network_frozen(paper_trained: Path) -> None:
    contact, diffusion = (load_checkpoint(paper_trained / n, load_network(n)).network for n in ("contact", "diffusion"))
    torch.testing.assert_close(diffusion.object_net.state_dict(), contact.object_net.state_dict())
    assert not any(weight.requires_grad for weight in diffusion.object_net.parameters())


def is_fractional(contact: Tensor) -> bool:
    return bool(((contact > 0.01) & (contact < 0.99)).float().mean() > 0.1)


def test_generated_motions_and_refiner_are_conditioned_on_probabilities(
    paper_trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    conditions, sample, coarse = list[Tensor](), MotionGenerator.sample, Surface.coarse
    monkeypatch.setattr(
        MotionGenerator, "sample", lambda self, *inputs: conditions.append(inputs[0].contact) or sample(self, *inputs)
    )
    monkeypatch.setattr(Surface, "coarse", lambda self, *inputs: conditions.append(inputs[3]) or coarse(self, *inputs))
    config = SamplingConfig(sampler=SamplerConfig(steps=2))
    generator = Generator.load(paper_trained, HANDS, load_encoder("hash"), sampling=config)
    motion = generator.generate("Lift a box with both hands.", user_box(), MotionOptions(frames=9))[0]
    assert len(conditions) == 2
    assert all(map(is_fractional, conditions))
    assert motion.contact.dtype == bool
    assert 0 < motion.contact.sum() <= 1024
    assert motion.evidence["refine"] == "network"


def test_the_refiner_learns_from_predicted_maps(annotated: AnnotatedStore) -> None:
    assert load_network("refiner").needs == ("contact", "diffusion")
    conditions, denoise_once = list[Tensor](), MotionGenerator.denoise_once

    def sample_contact(batch: ClipBatch, text: Tensor, generator: torch.Generator) -> Tensor:
        del text, generator
        return 0.25 + 0.5 * batch.contact.float()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            MotionGenerator,
            "denoise_once",
            lambda self, *inputs: conditions.append(inputs[3].contact) or denoise_once(self, *inputs),
        )
        tested = refiner_objective(annotated, sample_contact)
    assert all(set(contact.unique().tolist()) == {0.25, 0.75} for contact in conditions)
    read = list[Tensor]()
    tested.network.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0].contact_map))
    batch = training_batch(list(HoiDataset(annotated, "train")))
    tested.losses(batch, seeded())
    torch.testing.assert_close(read[0], 0.25 + 0.5 * batch.contact_map)


def test_the_trained_refiner_was_given_the_contact_network(
    annotated: AnnotatedStore, paper_trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The objective that the stage trains has predicted maps, not only one that a test builds."""
    built, make = list[RefinerObjective](), refiner_training.RefinerObjective
    monkeypatch.setattr(refiner_training, "RefinerObjective", lambda *a, **k: built.append(make(*a, **k)) or built[0])
    plan = TrainingSpec.of(load_network("refiner"), PAPER["refiner"])
    trained = {name: load_checkpoint(paper_trained / name, load_network(name)) for name in ("contact", "diffusion")}
    corpus = Corpus.of(annotated, 0, "start")
    refiner_training.REFINER.objective(
        Setup(plan.network, plan.loss, seed=0, corpus=corpus, hands=Hands(HANDS), device=CPU, trained=trained)
    )
    maps = torch.stack([coarse.contact_map for motions in built[0].pool.values() for coarse in motions])
    assert is_fractional(maps)


# --- sentences, conditions, sampler


def test_training_draws_all_four_sentence_forms(annotated: AnnotatedStore, batch: ClipBatch) -> None:
    forms = torch.arange(1.0, 5.0)[:, None].expand(4, 512)  # 0: a dropped sentence, which the paper does not have
    clips = [replace(sample, text=forms.numpy()) for sample in HoiDataset(annotated, "train")]
    marked, forms_read = training_batch(clips), dict[str, Counter[float]]()

    def count(name: str, text: Tensor) -> None:
        forms_read.setdefault(name, Counter()).update(text[:, 0].tolist())

    corpus = Corpus.of(annotated, 0)
    contact = ContactObjective(ContactModel(SMALL), ContactLossConfig(64), corpus, CPU)
    contact.network.register_forward_pre_hook(lambda _, inputs: count("contact", inputs[2]))
    length = LengthObjective(LengthModel(LengthConfig(16)), corpus, CPU)
    length.network.layers.register_forward_pre_hook(lambda _, inputs: count("length", inputs[0][:, 64:]))
    diffusion = diffusion_objective(annotated)
    diffusion.network.register_forward_pre_hook(lambda _, inputs: count("diffusion", inputs[3].text))
    refiner = refiner_objective(annotated, lambda batch, text, random: batch.contact.float())
    refiner.generator.network.register_forward_pre_hook(lambda _, inputs: count("refiner", inputs[3].text))
    for number in range(20):
        for tested in (contact, length, diffusion):
            tested.losses(marked, seeded(number))
        refiner._coarse_motions(clips, seeded(number))
    assert set(forms_read) == {"contact", "length", "diffusion", "refiner"}
    for counts in forms_read.values():
        assert set(counts) == {1.0, 2.0, 3.0, 4.0}
        assert min(counts.values()) > 20 * len(clips) / 4 / 3


def test_the_presets_sampler_is_ddpm_with_1000_steps(
    paper_trained: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used, sample = list[SamplerConfig](), MotionGenerator.sample
    monkeypatch.setattr(
        MotionGenerator, "sample", lambda self, *inputs: used.append(inputs[1]) or sample(self, *inputs)
    )
    paper = Generator.load(paper_trained, HANDS, load_encoder("hash"))
    paper.generate("Lift a box with both hands.", user_box(), MotionOptions(frames=8))
    assert used == [SamplerConfig("ddpm", 1000)]
    assert paper.model.with_sampler(kind="ddim", steps=5).sampler == SamplerConfig("ddim", 5)
    assert Text2Hoi.load(trained, HANDS).sampler == SamplerConfig("ddim", 20)


@pytest.mark.parametrize("name", ["contact", "length", "diffusion", "refiner"])
@pytest.mark.parametrize("size", ["small", "full"])
def test_the_preset_has_no_settings_of_its_own_but_the_training(name: str, size: Any) -> None:
    """All inputs and losses are the library's defaults; sizes and budgets differ."""
    network = spec(name, size=size).network
    size_fields = {"transformer", "point_net", "decoder_widths", "latent", "width", "dropout"}
    defaults = type(network)()
    different = {field for field in vars(network) if getattr(network, field) != getattr(defaults, field)}
    assert different <= size_fields
    if hasattr(network, "point_net"):
        assert network.point_net.centred is False


@pytest.mark.parametrize(
    ("name", "steps", "rate"),
    [("contact", 28_000, 1e-3), ("length", 3_500, 1e-3), ("diffusion", 78_000, 1e-4), ("refiner", 10_500, 1e-4)],
)
def test_budgets_are_those_of_the_authors_code_for_arctic(name: str, steps: int, rate: float) -> None:
    """The paper states none."""
    training = spec(name).training
    assert (training.steps, training.batch, training.learning_rate) == (steps, 64, rate)
    assert (training.schedule, training.warmup, training.ema_decay, training.clip_norm) == ("constant", 0, 0, 0)


@pytest.mark.parametrize(("preset", "rates"), [("ours", (2e-3, 1e-3)), ("paper", (5e-4, 5e-4))])
def test_small_networks_of_the_paper_learn_more_slowly_than_ours(preset: Any, rates: tuple[float, float]) -> None:
    """At 0.002 the validation loss of `paper` jumps from 1.7 to 4.9 after 1,000 steps and stays there."""
    got = [spec(name, preset=preset, size="small").training for name in ("diffusion", "refiner")]
    assert tuple(training.learning_rate for training in got) == rates


def test_latents_are_normal_and_agents_have_the_positions_of_the_authors_code() -> None:
    latents = ContactModel(CONTACT).draw_latents(50, 50, seeded())
    assert spec("contact").network.latent == 64
    assert (float(latents.mean()), float(latents.std())) == pytest.approx((0, 1), abs=0.02)
    assert torch.equal(agent_codes(512, CPU), sinusoid(torch.tensor([1, 1666, 3333]), 512))


# --- hand type


def test_hands_are_chosen_by_similarity_for_the_paper_and_by_rules_otherwise(
    paper_trained: Path, trained: Path
) -> None:
    encoder, text = load_encoder("hash"), "Grab a box, left hand idle."
    features = encoder.encode([text, *TEMPLATES.values()])
    features = features / np.linalg.norm(features, axis=1, keepdims=True)
    most_similar = list(TEMPLATES)[int(np.argmax(features[1:] @ features[0]))]
    paper, ours = (Text2Hoi.load(folder, HANDS) for folder in (paper_trained, trained))
    assert paper.choose_hand(text, encoder).hand == most_similar
    assert paper.choose_hand(text, encoder).source == "embedding"
    assert ours.choose_hand("Lift a box with the right hand.", encoder).source == "rule"
    assert paper.choose_hand("Lift a box with the right hand.", encoder, "rules").source == "rule"


def test_evaluation_can_use_the_estimated_hand_type_and_length(
    annotated_root: Path, annotated: AnnotatedStore, paper_trained: Path, tmp_path: Path
) -> None:
    settings = {"text2hoi": {"sampler": {"steps": 2}}}
    sources = Sources(annotated, paper_trained, HANDS, CPU, settings)
    family, test = load_family("text2hoi-estimated"), list(HoiDataset(annotated, "test", crop="start"))
    model = family.load(sources)
    correct = []
    for sample in test:
        request = requests_for(sample, PredictionConfig(samples=1))[0]
        hand = model.model.choose_hand(sample.sentences[0], model.encoder).hand
        wrong = replace(request, active_hands=~request.active_hands, n_frames=149)
        (clip,) = model.sample([wrong])
        assert [clip.hands[side].valid.any() for side in ("left", "right")] == [
            hand in (side, "both") for side in ("left", "right")
        ]
        assert clip.n_frames == model.model.sample_length(request)
        correct.append(hand == sample.hand_type)
    assert family.diagnose(sources) == {
        "hand_type": {"clips": len(test), "accuracy": pytest.approx(np.mean(correct), abs=1e-6)}
    }
    sample_family(family, annotated_root, paper_trained, tmp_path / "out", {"samples": 2}, HANDS, settings=settings)
    evaluation = evaluate_store(tmp_path / "out/clips", annotated_root, HANDS)
    assert evaluation["length"] == "own"
    assert "length_error_frames" in evaluation["figures"]
    # A hand that is not generated cannot be compared, and is reported.
    missing = [sample for sample, right in zip(test, correct, strict=True) if not right]
    assert len({item["clip_id"].rpartition("~")[0] for item in evaluation["left_out"]}) <= len(missing)


def test_another_encoder_than_clip_is_named() -> None:
    assert not_clip_note("clip:weights.safetensors") == not_clip_note("clip-ViT-B-32") == ""
    assert "'use', not by CLIP" in not_clip_note("use")


# --- generate needs what it uses


def without(folder: Path, name: str, out: Path) -> Path:
    return Path(shutil.copytree(folder, out, ignore=shutil.ignore_patterns(name)))


def test_generation_reads_only_the_networks_it_uses(trained: Path, paper_trained: Path, tmp_path: Path) -> None:
    config = SamplingConfig(SamplerConfig(steps=1), refine="contact")
    partial = without(trained, "refiner", tmp_path / "no-refiner")
    generator = Generator.load(partial, HANDS, load_encoder("hash"), sampling=config)
    motion = generator.generate("Lift a box.", user_box(), MotionOptions(frames=8))[0]
    assert set(motion.evidence["checkpoints"]) == {"contact", "diffusion"}
    with pytest.raises(BadInput, match="refiner"):
        Generator.load(without(paper_trained, "refiner", tmp_path / "paper"), HANDS, load_encoder("hash"))
    short = Generator.load(without(trained, "length", tmp_path / "no-length"), HANDS, load_encoder("hash"))
    with pytest.raises(BadInput, match="--length"):
        short.generate("Lift a box.", user_box())


# --- contact follows size


def brute_force(sample: ClipSample, factor: float) -> np.ndarray:
    """Per hand and touching joint, the points within 2 cm of the joint, which is as far above its surface point."""
    contact, entries = np.zeros((2, 1024), bool), sample.distances
    closest: dict[tuple[int, int], float] = {}
    joints: dict[tuple[int, int, int], tuple[float, int]] = {}
    columns = entries.side, entries.frame, entries.joint, entries.point, entries.distance_m
    for side, frame, joint, point, distance in zip(*(column.tolist() for column in columns), strict=True):
        key = (side, frame, joint)
        joints[key] = min(joints.get(key, (np.inf, -1)), (distance, point))
    for (side, *_), (distance, point) in joints.items():
        closest[side, point] = min(closest.get((side, point), np.inf), distance)
    cloud = sample.points
    for (side, point), distance in closest.items():
        joint = factor * cloud.points_m[point] + distance * cloud.normals[point]
        near = np.linalg.norm(factor * cloud.points_m - joint, axis=1) < sample.contact_threshold_m
        contact[side] |= near & (cloud.part == cloud.part[point])
    return contact


def test_a_scaled_objects_map_is_recomputed_in_metres(samples: list[ClipSample]) -> None:
    chosen = np.arange(1024)[::3]
    for sample in samples:
        shares = []
        for factor in (0.5, 1.0, 2.0):
            contact = scaled_contact(sample, factor, chosen)
            np.testing.assert_array_equal(contact, brute_force(sample, factor)[:, chosen])
            shares.append(contact[sample.active_hands].mean())
        assert shares[0] > shares[1] > shares[2] > 0
        recorded = sample.contact[:, chosen]
        unscaled = scaled_contact(sample, 1.0, chosen)
        assert (recorded & unscaled).sum() > 0.75 * (recorded | unscaled).sum()
    empty = replace(samples[0], distances=DistanceEntries(*(np.zeros(0, np.int64) for _ in range(5))))
    assert not scaled_contact(empty, 0.5, chosen).any()


def test_half_of_the_clips_of_a_step_have_a_scaled_object(
    annotated: AnnotatedStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert spec("contact").loss.max_scaling == 1
    loss = replace(spec("contact", "ours", "small").loss, points=1024)
    objective = ContactObjective(AnchoredContact(OURS), loss, Corpus.of(annotated, 0), CPU)
    batch, factors = collate(list(objective.corpus.train)), list[float]()
    inputs, losses = list[tuple[ClipBatch, Tensor]](), AnchoredContact.losses
    monkeypatch.setattr(
        AnchoredContact,
        "losses",
        lambda self, scaled, text, contact, random: (
            inputs.append((scaled, contact)) or losses(self, scaled, text, contact, random)
        ),
    )
    for number in range(20):
        objective.losses(batch, seeded(number))
        order = torch.randperm(1024, generator=seeded(number))
        (scaled, contact), ratio = inputs[-1], inputs[-1][0].scale_m / batch.scale_m
        torch.testing.assert_close(scaled.points_m, batch.points_m[:, order] * ratio[:, None, None])
        for sample, factor, contact_map in zip(batch.samples, ratio.tolist(), contact, strict=True):
            expected = sample.contact[:, order] if factor == 1 else scaled_contact(sample, factor, order.numpy())
            assert (contact_map.numpy() > 0).mean() == pytest.approx(expected.mean(), abs=2e-3)
        factors += ratio.tolist()
    changed = np.array([factor for factor in factors if factor != 1])
    assert 0.3 < len(changed) / len(factors) < 0.7
    assert 0.5 <= changed.min() < 0.7
    assert 1.4 < changed.max() <= 2


@pytest.mark.slow
def test_ours_learns_that_a_larger_object_is_touched_on_a_smaller_share(annotated: AnnotatedStore) -> None:
    """The same words and shape: only the size differs."""
    torch.manual_seed(0)
    corpus = Corpus.of(annotated, 0)
    loss = spec("contact", "ours", "small").loss
    assert loss.max_scaling == 2
    network = AnchoredContact(OURS)
    objective, batch = ContactObjective(network, loss, corpus, CPU), collate(list(corpus.train))
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    for step in range(200):
        optimiser.zero_grad()
        objective.losses(batch, seeded(step))["total"].backward()
        optimiser.step()
    network.eval()
    latents = network.draw_latents(8, len(batch), seeded(1))
    shares = []
    for factor in (0.5, 1.0, 2.0):
        scaled = replace(batch, points_m=batch.points_m * factor, scale_m=batch.scale_m * factor)
        maps = network.sample(scaled, batch.text[:, 0], latents).amax(2)
        shares.append((maps > 0.5).float().mean((1, 2)))
    touched = batch.contact_map.mean(1) > 0.05
    assert touched.sum() == 2
    assert bool((shares[0] > 1.2 * shares[1])[touched].all())
    assert bool((shares[1] > 1.2 * shares[2])[touched].all())
