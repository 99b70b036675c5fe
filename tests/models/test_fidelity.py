"""The preset ``paper`` is Text2HOI as published: numbers typed from its tables, equations worked out apart in NumPy."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, HoiDataset, collate
from hoidata.batches.sight import Sight
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common import losses
from models.common.corpus import Corpus
from models.common.features import Hands, Normaliser, place_points
from models.common.sampling import add_noise, alphas_cumprod
from models.common.training import Plan
from models.common.transformer import TransformerConfig
from models.registry import load_network
from models.text2hoi.contact import ContactModel, contact_loss
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.diffusion_training import DiffusionLossConfig, DiffusionObjective, feature_shares
from models.text2hoi.length import LengthModel, length_error
from models.text2hoi.refiner import CoarseMotion, RefinerConfig, RefinerModel, Surface, attention_map
from models.text2hoi.refiner_training import RefinerObjective
from pipelines.stages.base import load_settings
from pipelines.stages.train import TrainParams

CPU = torch.device("cpu")


def plan(name: str, preset: Any = "paper", size: Any = "full") -> Plan:
    settings = replace(load_settings(TrainParams, "train"), preset=preset, size=size)
    return Plan.of(load_network(name), settings.of(name))


def module(name: str) -> nn.Module:
    return load_network(name).build(plan(name).network)


def learnt(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


# (inputs, outputs) of every layer, typed from the supplement's tables.
TABLES = {
    "S4": [(3, 64), (64, 128), (128, 1024), (1024, 512), (512, 256), (256, 9), (3, 64), (64, 128), (128, 1024)],
    "S5": [(4, 64), (64, 128), (128, 1024), (1024, 512), (512, 256), (256, 16), (4, 64), (64, 128), (128, 1024),
           (1024, 512), (512, 256), (256, 128)],
    "S6": [(1665, 512), (512, 256), (256, 128), (128, 1)],
    "S7": [(99, 512), (99, 512), (10, 512), (512, 512), (512, 512), (512, 512), (2049, 512)],
    "S8": [(512, 3 * 512), (512, 512), (512, 1024), (1024, 512)] * 8,
    "S9": [(512, 99), (512, 99), (512, 10)],
    "S10": [(2273, 512), (2273, 512), (512, 99), (512, 99)],
}  # fmt: skip


def linear(module: nn.Module) -> list[tuple[int, int]]:
    return [(layer.in_features, layer.out_features) for layer in module.modules() if isinstance(layer, nn.Linear)]


def counted(table: str, norms: int = 0) -> int:
    """Weights and biases of a table's linear layers, and two numbers for each of ``norms`` normalised features."""
    return sum((inputs + 1) * outputs for inputs, outputs in TABLES[table]) + 2 * norms


def test_the_contact_network_is_that_of_tables_s4_to_s6() -> None:
    network = module("contact")
    assert isinstance(network, ContactModel)
    stn = 64 + 128 + 1024 + 512 + 256
    assert (counted("S4", stn + 64 + 128 + 1024), counted("S5", stn + 64 + 128 + 1024 + 512 + 256), counted("S6")) == (
        946_185, 1_638_672, 1_017_345,
    )  # fmt: skip
    assert learnt(network.object_net) == 946_185
    assert learnt(network.contact_net) + learnt(network.to_latent) == 1_638_672
    assert learnt(network) == 3_602_202
    assert sorted(linear(network.object_net)) == sorted(TABLES["S4"])
    assert sorted(linear(network.contact_net) + linear(network.to_latent)) == sorted(TABLES["S5"])
    first = network.from_point.in_features + network.from_clip.in_features
    assert [(first, 512), *linear(network.rest)] == TABLES["S6"]


def test_the_denoiser_is_that_of_tables_s7_to_s9() -> None:
    network = module("diffusion")
    assert isinstance(network, DiffusionModel)
    encoder = counted("S8", norms=8 * 2 * 512)
    assert encoder == learnt(network.encoder) == 16_822_272
    assert counted("S7") + encoder + counted("S9") == learnt(network) == 18_874_576
    assert linear(network.encoder) == TABLES["S8"]
    heads = [*linear(network.hands_out), *linear(network.object_out)]
    assert heads == TABLES["S9"]
    seen = [network.hands_in, network.object_in, network.step_in, network.text_in, network.object_condition_in]
    assert [size for part in seen for size in linear(part)] == TABLES["S7"]
    assert network.extent_in is network.to_go_in is network.points_in is None


def test_the_refiner_is_that_of_table_s10() -> None:
    network = module("refiner")
    assert isinstance(network, RefinerModel)
    assert 99 + 3 * 21 + 1024 + 1024 + 3 * 21 == 2273
    assert counted("S10") + counted("S8", norms=8 * 2 * 512) == learnt(network) == 19_252_422
    assert linear(network.encoder) == TABLES["S8"]
    assert [*linear(network.hands_in), *linear(network.hands_out)] == TABLES["S10"]


def test_the_length_network_sees_text_and_64_numbers_of_noise() -> None:
    network = module("length")
    assert isinstance(network, LengthModel)
    assert linear(network) == [(512 + 64, 512), (512, 1)]


# --- equations


@pytest.fixture(scope="module")
def seen(annotated: AnnotatedStore) -> ClipBatch:
    clips = list(HoiDataset(annotated, "train"))
    return collate(clips, Sight.drawn([clip.length for clip in clips], 5, 2000, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def drawn(seen: ClipBatch) -> tuple[np.ndarray, np.ndarray]:
    """Predicted hands (B, 2, F, 99) and objects (B, F, 10) near the true ones."""
    random = np.random.default_rng(1)
    hands, objects = (part.double().numpy() for part in (seen.hands, seen.object))
    return hands + random.normal(0, 0.1, hands.shape), objects + random.normal(0, 0.1, objects.shape)


def test_noise_follows_equation_1() -> None:
    share, random = alphas_cumprod().double().numpy(), np.random.default_rng(0)
    clean, noise = random.normal(size=(4, 3, 2)), random.normal(size=(4, 3, 2))
    steps = np.array([0, 10, 500, 999])
    expected = np.sqrt(share[steps])[:, None, None] * clean + np.sqrt(1 - share[steps])[:, None, None] * noise
    found = add_noise(*map(torch.from_numpy, (clean, noise, steps)), alphas_cumprod().double())
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)


def objective(annotated: AnnotatedStore, **weights: Any) -> DiffusionObjective:
    """Eq. 4-7 with the paper's weights around a small network."""
    config, loss = DiffusionConfig(transformer=TransformerConfig(32, 1)), DiffusionLossConfig(**weights)
    given = Corpus.of(annotated, 0), Hands(load_embedded_hands()), Normaliser.nothing(), CPU
    return DiffusionObjective(DiffusionModel(config), loss, *given)


def test_simple_distance_and_orientation_losses_follow_equations_5_to_7(
    annotated: AnnotatedStore, seen: ClipBatch, drawn: tuple[np.ndarray, np.ndarray]
) -> None:
    made = objective(annotated)
    target = made.targets.of(seen)
    predicted = tuple(torch.from_numpy(part).float() for part in drawn)
    simple = float(made._simple(predicted, target))  # pyright: ignore[reportArgumentType]
    geometry = made._geometry(predicted, seen, target)  # pyright: ignore[reportArgumentType]
    present, frames = seen.present.numpy(), seen.frames.numpy()
    both = zip(drawn, (seen.hands, seen.object), strict=True)
    squares = [((own - true.double().numpy()) ** 2).sum(-1) for own, true in both]
    assert simple == pytest.approx(squares[0][present].mean() + squares[1][frames].mean(), rel=1e-5)
    assert float(geometry["distance_map"]) == pytest.approx(equation_6(seen, *drawn), rel=1e-5)
    assert float(geometry["relative_orientation"]) == pytest.approx(equation_7(seen, *drawn), rel=1e-5)


def rotations(numbers: np.ndarray) -> np.ndarray:
    """Rows [R00 R01 R10 R11 R20 R21] to matrices by Gram and Schmidt (Zhou et al. 2019)."""
    columns = numbers.reshape(*numbers.shape[:-1], 3, 2)
    first = columns[..., 0] / np.linalg.norm(columns[..., 0], axis=-1, keepdims=True).clip(1e-9)
    second = columns[..., 1] - (first * columns[..., 1]).sum(-1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=-1, keepdims=True).clip(1e-9)
    return np.stack((first, second, np.cross(first, second)), -1)


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' rotation about a unit axis."""
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def equation_6(batch: ClipBatch, hands: np.ndarray, objects: np.ndarray) -> float:
    """Mean over the listed pairs below 2 cm of (estimated distance - true distance)^2, metres."""
    kinematics = Hands(load_embedded_hands()).double()
    joints = kinematics.joints(torch.from_numpy(hands), batch.betas.double()).numpy()
    errors = []
    for (clip, side, place, joint, point), true in zip(batch.entries.tolist(), batch.entry_distance_m, strict=True):
        frame, spot = int(batch.chosen[clip, place]), batch.points_m[clip, point].double().numpy()
        if batch.articulated[clip] and batch.part[clip, point] == 1:
            axis, origin = (part[clip].double().numpy() for part in (batch.hinge_axis, batch.hinge_origin_m))
            spot = about(axis, objects[clip, frame, 9]) @ (spot - origin) + origin
        world = rotations(objects[clip, frame, 3:9]) @ spot + objects[clip, frame, :3]
        errors.append(np.linalg.norm(joints[clip, side, frame, joint] - world) - float(true))
    return float(np.mean(np.square(errors)))


def equation_7(batch: ClipBatch, hands: np.ndarray, objects: np.ndarray) -> float:
    """Mean over frames with a hand of the squared distance of R_object^T R_hand from the true one."""

    def relative(hand: np.ndarray, thing: np.ndarray) -> np.ndarray:
        return rotations(thing[..., 3:9])[:, None].swapaxes(-1, -2) @ rotations(hand[..., 3:9])

    apart = relative(hands, objects) - relative(batch.hands.double().numpy(), batch.object.double().numpy())
    rows, chosen = np.arange(len(hands))[:, None], batch.chosen.numpy()
    at = (rows, slice(None), chosen)
    return float((apart**2).sum((-1, -2))[at][batch.present.numpy()[at]].mean())


def test_the_condition_follows_equations_2_and_3(seen: ClipBatch) -> None:
    """t_emb + f_text(CLIP) + f_obj({F_obj, contact map, scale}), with Table S7's layers."""
    torch.manual_seed(0)
    network = DiffusionModel(DiffusionConfig(transformer=TransformerConfig(layers=1))).eval()
    feature = torch.randn(len(seen), 1024)
    condition = Condition.of(seen, feature, seen.text[:, 0], seen.contact)
    steps = torch.tensor([3, 500, 999])
    with torch.no_grad():
        found = network._condition(network._time(steps), network.prepare(condition), None)[0][:, 0].numpy()
    weights = {name: value.detach().numpy() for name, value in network.named_parameters()}

    def layer(name: str, x: np.ndarray) -> np.ndarray:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    angles = steps.numpy()[:, None] * 10_000.0 ** (-np.arange(256) / 256)
    hidden = layer("step_in.0", np.concatenate((np.sin(angles), np.cos(angles)), -1))
    time = layer("step_in.2", hidden / (1 + np.exp(-hidden)))
    points = seen.points_m.double().numpy()
    scale = np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1).max(1, keepdims=True)
    body = np.concatenate((feature.numpy(), seen.contact_map.numpy(), scale), -1)
    expected = time + layer("text_in", seen.text[:, 0].double().numpy()) + layer("object_condition_in", body)
    np.testing.assert_allclose(found, expected, atol=1e-5, rtol=1e-5)


def test_penetration_contact_and_attention_follow_section_3_3() -> None:
    random = np.random.default_rng(0)
    skin, joints = random.normal(0, 0.02, (2, 2, 3, 7)), random.normal(0, 0.03, (2, 2, 3, 21))
    mask = random.random((2, 2, 3)) < 0.7
    inside = np.where(skin < 0, skin, 0.0)
    given = [torch.from_numpy(part) for part in (skin, joints, mask)]
    # Eq. 10: squared distance of the vertices inside; eq. 11: of the joints closer than 2 cm, to the surface.
    deep = float(losses.penetration_loss(given[0], given[2], 1.0))
    assert deep == pytest.approx((inside**2).sum(-1)[mask].mean(), rel=1e-5)
    near = (np.abs(joints) < 0.02) & mask[..., None]
    assert float(losses.surface_loss(given[1], given[2], 0.02)) == pytest.approx((joints[near] ** 2).mean(), rel=1e-5)
    np.testing.assert_allclose(attention_map(given[1]).numpy(), np.exp(-50 * np.abs(joints)), atol=1e-5)


def test_the_denoisers_total_is_equation_4(annotated: AnnotatedStore, seen: ClipBatch) -> None:
    made = objective(annotated, **asdict(plan("diffusion").loss))
    found = made.losses(seen, torch.Generator().manual_seed(0))
    found = {name: float(value.detach()) for name, value in found.items()}
    parts = found["simple"] + found["distance_map"] + found["relative_orientation"]
    assert set(found) == {"total", "simple", "distance_map", "relative_orientation"}
    assert found["total"] == pytest.approx(parts, rel=1e-6)


class Exact(MotionGenerator):
    """A generator that gives recorded motions back."""

    def denoise_once(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        del timesteps, generator
        return self._features((hands, objects), condition)


class Off(RefinerModel):
    """A refiner that adds 0.001 to every number."""

    def forward(self, coarse: CoarseMotion) -> Tensor:
        return coarse.hands + 0.001


def refiner_objective(network: RefinerModel, annotated: AnnotatedStore) -> RefinerObjective:
    """On coarse motions that are the recorded ones."""
    corpus, hands = Corpus.of(annotated, 0), Hands(load_embedded_hands())
    generator = Exact(
        DiffusionModel(DiffusionConfig(transformer=TransformerConfig(16, 1, 2, 16))), Normaliser.nothing()
    )
    surface = Surface.of(hands, [clip.object_model for clip in (*corpus.train, *corpus.held_out)], 24, CPU)
    weights = replace(plan("refiner").loss, samples=1)
    return RefinerObjective(network, weights, corpus, generator, surface, CPU, 0)


def test_the_refiners_losses_follow_equations_8_and_9(annotated: AnnotatedStore) -> None:
    """Eq. 9 in the hands' 99 numbers, summed; eq. 8 with lambda_1 = 5."""
    network = Off(replace(plan("refiner").network, transformer=TransformerConfig(16, 1, 2, 16)))
    made = refiner_objective(network, annotated)
    found = made._losses(network, made.held_out)
    assert float(found["simple"]) == pytest.approx(99 * 0.001**2, rel=1e-3)
    assert float(found["contact"]) > 0
    parts = found["simple"] + found["penetration"] + 5 * found["contact"]
    assert float(found["total"]) == pytest.approx(float(parts), rel=1e-6)


def test_the_refiner_reads_the_2273_numbers_of_section_12(seen: ClipBatch) -> None:
    surface = Surface.of(Hands(load_embedded_hands()), seen.objects, 24, CPU)
    coarse = surface.coarse(seen, seen.hands, seen.object, seen.contact_map, seen.present)
    config = RefinerConfig(transformer=TransformerConfig(16, 1, 2, 16))
    found = RefinerModel(config)._inputs(coarse, coarse.hands).double().numpy()
    turn = rotations(seen.object.double().numpy()[..., 3:9])
    displacement = np.einsum("bfij,bsfkj->bsfki", turn, coarse.offset_m.double().numpy())
    norms = np.linalg.norm(place_points(seen, seen.object).double().numpy(), axis=-1)
    shape = (*found.shape[:-1], -1)
    expected = np.concatenate((
        seen.hands.numpy(), seen.joints_m.numpy().reshape(shape), np.exp(-50 * np.abs(displacement)).reshape(shape),
        np.broadcast_to(norms[:, None], (*found.shape[:-1], 1024)),
        np.broadcast_to(seen.contact_map.numpy()[:, None, None], (*found.shape[:-1], 1024)),
    ), -1)  # fmt: skip
    there = seen.present.numpy()
    assert found.shape[-1] == 2273
    np.testing.assert_allclose(found[there], expected[there], atol=1e-5)


def test_contact_and_length_losses_are_sums_of_their_parts() -> None:
    random = np.random.default_rng(0)
    logits, mean, spread = (random.normal(size=size) for size in ((3, 50), (3, 64), (3, 64)))
    touched = (random.random((3, 50)) < 0.3).astype(float)
    p = 1 / (1 + np.exp(-logits))
    cross = -(touched * np.log(p) + (1 - touched) * np.log(1 - p)).sum(1).mean()
    dice = (1 - (2 * (p * touched).sum(1) + 1) / (p.sum(1) + touched.sum(1) + 1)).mean()
    divergence = (0.5 * (mean**2 + np.exp(spread) - 1 - spread)).sum(1).mean()
    found = contact_loss(*map(torch.from_numpy, (logits, touched, mean, spread)))
    assert float(found["total"]) == pytest.approx(cross + dice + divergence, rel=1e-5)
    assert float(length_error(torch.tensor([0.5, 0.2]), torch.tensor([90, 30]))["total"]) == pytest.approx(0.005)


@pytest.mark.slow
def test_at_first_equations_6_and_7_pull_no_harder_than_5(annotated: AnnotatedStore, seen: ClipBatch) -> None:
    """They did 97 times, where eq. 5 was a mean over 99 numbers and eq. 6 counted in thresholds of 2 cm."""
    torch.manual_seed(0)
    made = DiffusionObjective(
        DiffusionModel(plan("diffusion").network), plan("diffusion").loss, Corpus.of(annotated, 0),
        Hands(load_embedded_hands()), Normaliser.nothing(), CPU,
    )  # fmt: skip
    found = made.losses(seen, torch.Generator().manual_seed(0))
    weights = [weight for weight in made.network.parameters() if weight.requires_grad]
    pulls = {}
    for name in ("simple", "distance_map", "relative_orientation"):
        own = torch.autograd.grad(found[name], weights, retain_graph=True, allow_unused=True)
        pulls[name] = float(sum((part.square().sum() for part in own if part is not None), torch.zeros(())).sqrt())
    assert max(pulls["distance_map"], pulls["relative_orientation"]) <= pulls["simple"]


def test_shares_of_the_switches_that_weigh_numbers_sum_to_one() -> None:
    for weighting, total in (("sum", (99, 10)), ("grouped", (1, 1))):
        found = [float(share.sum()) for share in feature_shares(weighting, CPU)]
        assert found == pytest.approx(total)
