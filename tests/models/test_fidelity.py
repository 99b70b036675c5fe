"""The preset ``paper`` has Text2HOI's tables and equations; the equations are computed independently in NumPy."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, HoiDataset, collate
from hoidata.batches.frame_selection import FrameSelection
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common import losses
from models.common.corpus import Corpus
from models.common.features import Hands, Normaliser, place_points
from models.common.sampling import add_noise, alphas_cumprod
from models.common.training import TrainingSpec
from models.common.transformer import TransformerConfig, sinusoid
from models.registry import load_network
from models.text2hoi.contact import ContactModel, contact_loss
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.diffusion_training import DiffusionLossConfig, DiffusionObjective
from models.text2hoi.length import LengthModel, length_error
from models.text2hoi.refiner import CoarseMotion, NoisedHands, RefinerConfig, RefinerModel, Surface, attention_map
from models.text2hoi.refiner_training import RefinerObjective
from pipelines.stages.base import load_settings
from pipelines.stages.train import TrainParams

CPU = torch.device("cpu")


def spec(name: str, preset: Any = "paper", size: Any = "full") -> TrainingSpec:
    settings = replace(load_settings(TrainParams, "train"), preset=preset, size=size)
    return TrainingSpec.of(load_network(name), settings.of(name))


def module(name: str) -> nn.Module:
    return load_network(name).build(spec(name).network)


def n_trainable(module: nn.Module) -> int:
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


def n_parameters(table: str, norms: int = 0) -> int:
    """Weights and biases of a table's linear layers, and two numbers for each of ``norms`` normalised features."""
    return sum((inputs + 1) * outputs for inputs, outputs in TABLES[table]) + 2 * norms


def test_the_contact_network_is_that_of_tables_s4_to_s6() -> None:
    network = module("contact")
    assert isinstance(network, ContactModel)
    stn = 64 + 128 + 1024 + 512 + 256
    assert n_parameters("S4", stn + 64 + 128 + 1024) == 946_185
    assert n_parameters("S5", stn + 64 + 128 + 1024 + 512 + 256) == 1_638_672
    assert n_parameters("S6") == 1_017_345
    assert n_trainable(network.object_net) == 946_185
    assert n_trainable(network.contact_net) + n_trainable(network.to_latent) == 1_638_672
    assert n_trainable(network) == 3_602_202
    assert sorted(linear(network.object_net)) == sorted(TABLES["S4"])
    assert sorted(linear(network.contact_net) + linear(network.to_latent)) == sorted(TABLES["S5"])
    first = network.from_point.in_features + network.from_clip.in_features
    assert [(first, 512), *linear(network.rest)] == TABLES["S6"]


def test_the_denoiser_is_that_of_tables_s7_to_s9() -> None:
    network = module("diffusion")
    assert isinstance(network, DiffusionModel)
    encoder = n_parameters("S8", norms=8 * 2 * 512)
    assert encoder == n_trainable(network.encoder) == 16_822_272
    assert n_parameters("S7") + encoder + n_parameters("S9") == n_trainable(network) == 18_874_576
    assert linear(network.encoder) == TABLES["S8"]
    heads = [*linear(network.hands_out), *linear(network.object_out)]
    assert heads == TABLES["S9"]
    inputs = [network.hands_in, network.object_in, network.step_in, network.text_in, network.object_condition_in]
    assert [size for part in inputs for size in linear(part)] == TABLES["S7"]
    assert network.verb_in is network.to_go_in is network.points_in is None


def test_the_refiner_is_that_of_table_s10() -> None:
    network = module("refiner")
    assert isinstance(network, RefinerModel)
    assert 99 + 3 * 21 + 1024 + 1024 + 3 * 21 == 2273
    assert n_parameters("S10") + n_parameters("S8", norms=8 * 2 * 512) == n_trainable(network) == 19_252_422
    assert linear(network.encoder) == TABLES["S8"]
    assert [*linear(network.hands_in), *linear(network.hands_out)] == TABLES["S10"]


def test_the_length_network_reads_text_and_64_numbers_of_noise() -> None:
    network = module("length")
    assert isinstance(network, LengthModel)
    assert linear(network) == [(512 + 64, 512), (512, 1)]


# --- equations


@pytest.fixture(scope="module")
def batch(annotated: AnnotatedStore) -> ClipBatch:
    clips = list(HoiDataset(annotated, "train"))
    return collate(clips, FrameSelection.drawn([clip.length for clip in clips], 5, 2000, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def prediction(batch: ClipBatch) -> tuple[np.ndarray, np.ndarray]:
    """Predicted hands (B, 2, F, 99) and objects (B, F, 10): the recorded ones with noise."""
    random = np.random.default_rng(1)
    hands, objects = (part.double().numpy() for part in (batch.hands, batch.object))
    return hands + random.normal(0, 0.1, hands.shape), objects + random.normal(0, 0.1, objects.shape)


def test_noise_follows_equation_1() -> None:
    alpha_bar, random = alphas_cumprod().double().numpy(), np.random.default_rng(0)
    clean, noise = random.normal(size=(4, 3, 2)), random.normal(size=(4, 3, 2))
    steps = np.array([0, 10, 500, 999])
    expected = np.sqrt(alpha_bar[steps])[:, None, None] * clean + np.sqrt(1 - alpha_bar[steps])[:, None, None] * noise
    noised = add_noise(*map(torch.from_numpy, (clean, noise, steps)), alphas_cumprod().double())
    np.testing.assert_allclose(noised.numpy(), expected, atol=1e-5)


def objective(annotated: AnnotatedStore, **weights: Any) -> DiffusionObjective:
    """The objective of Eq. 4-7 with the paper's weights and a small network."""
    config, loss = DiffusionConfig(transformer=TransformerConfig(32, 1)), DiffusionLossConfig(**weights)
    arguments = Corpus.of(annotated, 0), Hands(load_embedded_hands()), Normaliser.identity(), CPU
    return DiffusionObjective(DiffusionModel(config), loss, *arguments)


def test_simple_distance_and_orientation_losses_follow_equations_5_to_7(
    annotated: AnnotatedStore, batch: ClipBatch, prediction: tuple[np.ndarray, np.ndarray]
) -> None:
    tested = objective(annotated)
    target = tested.targets.of(batch)
    predicted = tuple(torch.from_numpy(part).float() for part in prediction)
    simple = float(tested._simple(predicted, target))  # pyright: ignore[reportArgumentType]
    geometry = tested._geometry(predicted, batch, target)  # pyright: ignore[reportArgumentType]
    present, frames = batch.present.numpy(), batch.frames.numpy()
    pairs = zip(prediction, (batch.hands, batch.object), strict=True)
    squares = [((predicted_part - true.double().numpy()) ** 2).sum(-1) for predicted_part, true in pairs]
    assert simple == pytest.approx(squares[0][present].mean() + squares[1][frames].mean(), rel=1e-5)
    assert float(geometry["distance_map"]) == pytest.approx(equation_6(batch, *prediction), rel=1e-5)
    assert float(geometry["relative_orientation"]) == pytest.approx(equation_7(batch, *prediction), rel=1e-5)


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
    """Mean over the pairs within 2 cm of (predicted distance - recorded distance)^2, metres."""
    kinematics = Hands(load_embedded_hands()).double()
    joints = kinematics.joints(torch.from_numpy(hands), batch.betas.double()).numpy()
    errors = []
    for (clip, side, chosen, joint, point), true in zip(batch.entries.tolist(), batch.entry_distance_m, strict=True):
        frame, point_m = int(batch.chosen[clip, chosen]), batch.points_m[clip, point].double().numpy()
        if batch.articulated[clip] and batch.part[clip, point] == 1:
            axis, origin = (part[clip].double().numpy() for part in (batch.hinge_axis, batch.hinge_origin_m))
            point_m = about(axis, objects[clip, frame, 9]) @ (point_m - origin) + origin
        world = rotations(objects[clip, frame, 3:9]) @ point_m + objects[clip, frame, :3]
        errors.append(np.linalg.norm(joints[clip, side, frame, joint] - world) - float(true))
    return float(np.mean(np.square(errors)))


def equation_7(batch: ClipBatch, hands: np.ndarray, objects: np.ndarray) -> float:
    """Mean over frames with a hand of the squared error of R_object^T R_hand."""

    def relative(hand: np.ndarray, objects: np.ndarray) -> np.ndarray:
        return rotations(objects[..., 3:9])[:, None].swapaxes(-1, -2) @ rotations(hand[..., 3:9])

    difference = relative(hands, objects) - relative(batch.hands.double().numpy(), batch.object.double().numpy())
    clip, chosen = np.arange(len(hands))[:, None], batch.chosen.numpy()
    selected = (clip, slice(None), chosen)
    return float((difference**2).sum((-1, -2))[selected][batch.present.numpy()[selected]].mean())


def scales_m(batch: ClipBatch) -> np.ndarray:
    """(B,) s_obj of Sec. 3.1: from the mean of all vertices of the mesh, the distance of the farthest one."""
    vertices = [model.vertices_m for model in batch.objects]
    return np.array([max(np.linalg.norm(one - np.mean(v, 0)) for one in v) for v in vertices])


def test_point_clouds_are_divided_by_the_scale_of_the_mesh_and_not_moved(batch: ClipBatch) -> None:
    batch = replace(batch, points_m=batch.points_m + 0.05)  # of a mesh whose origin is not its centre
    points, scale = spec("contact").network.point_net.normalised(batch.points_m, batch.scale_m)
    expected = batch.points_m.numpy() / scales_m(batch)[:, None, None]
    np.testing.assert_allclose(points.numpy(), expected, rtol=1e-5)
    np.testing.assert_allclose(scale[:, 0].numpy(), scales_m(batch), rtol=1e-5)
    both, read = module("contact").eval(), list[Tensor]()
    for net in (both.object_net, both.contact_net):
        net.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0][..., :3]))
    both(batch.points_m, batch.scale_m, batch.text[:, 0], batch.contact_map, torch.zeros(len(batch), 64))
    denoiser = module("diffusion")
    denoiser.object_net.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0]))
    denoiser.encode_condition(Condition(batch, batch.text[:, 0], [None] * len(batch), batch.contact))
    assert len(read) == 3
    assert all(torch.equal(cloud, points) for cloud in read)


def test_the_condition_follows_equations_2_and_3(batch: ClipBatch) -> None:
    """t_emb + f_text(CLIP) + f_obj({F_obj, contact map, scale}), with Table S7's layers."""
    torch.manual_seed(0)
    network = DiffusionModel(DiffusionConfig(transformer=TransformerConfig(layers=1))).eval()
    contact = torch.rand(batch.contact.shape) * batch.active_hands[..., None]
    condition = Condition(batch, batch.text[:, 0], [None] * len(batch), contact)
    clouds = batch.points_m / torch.from_numpy(scales_m(batch)).float()[:, None, None]
    steps = torch.tensor([3, 500, 999])
    with torch.no_grad():
        feature = network.object_net(clouds)[0]
        time = network.step_in(sinusoid(steps, 512))
        token = (network.encode_condition(condition).token[:, 0] + time).numpy()
    weights = {name: value.detach().numpy() for name, value in network.named_parameters()}

    def layer(name: str, x: np.ndarray) -> np.ndarray:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    angles = steps.numpy()[:, None] * 10_000.0 ** (-np.arange(256) / 256)
    hidden = layer("step_in.0", np.concatenate((np.sin(angles), np.cos(angles)), -1))
    time = layer("step_in.2", hidden / (1 + np.exp(-hidden)))
    body = np.concatenate((feature.numpy(), contact.amax(1).numpy(), scales_m(batch)[:, None]), -1)
    expected = time + layer("text_in", batch.text[:, 0].double().numpy()) + layer("object_condition_in", body)
    np.testing.assert_allclose(token, expected, atol=1e-5, rtol=1e-5)


def test_penetration_contact_and_attention_follow_section_3_3() -> None:
    random = np.random.default_rng(0)
    skin, joints = random.normal(0, 0.02, (2, 2, 3, 7)), random.normal(0, 0.03, (2, 2, 3, 21))
    mask = random.random((2, 2, 3)) < 0.7
    inside = np.where(skin < 0, skin, 0.0)
    skin_m, joint_m, valid = (torch.from_numpy(part) for part in (skin, joints, mask))
    # Eq. 10: squared distance of the vertices inside; eq. 11: of the joints closer than 2 cm, to the surface.
    for unit_m in (1.0, 0.01):
        loss = float(losses.penetration_loss(skin_m, valid, unit_m))
        assert loss == pytest.approx(((inside / unit_m) ** 2).sum(-1)[mask].mean(), rel=1e-5)
    near = (np.abs(joints) < 0.02) & mask[..., None]
    assert float(losses.surface_loss(joint_m, valid, 0.02)) == pytest.approx((joints[near] ** 2).mean(), rel=1e-5)
    np.testing.assert_allclose(attention_map(joint_m).numpy(), np.exp(-50 * np.abs(joints)), atol=1e-5)


def test_the_denoisers_total_is_equation_4(annotated: AnnotatedStore, batch: ClipBatch) -> None:
    tested = objective(annotated, **asdict(spec("diffusion").loss))
    terms = tested.losses(batch, torch.Generator().manual_seed(0))
    terms = {name: float(value.detach()) for name, value in terms.items()}
    total = terms["simple"] + terms["distance_map"] + terms["relative_orientation"]
    assert set(terms) == {"total", "simple", "distance_map", "relative_orientation"}
    assert terms["total"] == pytest.approx(total, rel=1e-6)


class Exact(MotionGenerator):
    """A generator that returns recorded motions."""

    def denoise_once(
        self, hands: Tensor, objects: Tensor, timesteps: Tensor, condition: Condition, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        del timesteps, generator
        return self._features((hands, objects), condition)


class Off(RefinerModel):
    """A refiner that adds 0.001 to every number, and keeps what it is given to denoise."""

    noised: list[NoisedHands | None]

    def forward(self, coarse: CoarseMotion, noised: NoisedHands | None = None) -> Tensor:
        self.noised = [*getattr(self, "noised", []), noised]
        return coarse.hands + 0.001


def refiner_objective(network: RefinerModel, annotated: AnnotatedStore) -> RefinerObjective:
    """An objective whose coarse motions are the recorded ones."""
    corpus, hands = Corpus.of(annotated, 0), Hands(load_embedded_hands())
    generator = Exact(
        DiffusionModel(DiffusionConfig(transformer=TransformerConfig(16, 1, 2, 16))), Normaliser.identity()
    )
    surface = Surface.of(hands, [clip.object_model for clip in (*corpus.train, *corpus.held_out)], CPU)
    return RefinerObjective(
        network,
        weights=spec("refiner").loss,
        corpus=corpus,
        generator=generator,
        surface=surface,
        device=CPU,
        seed=0,
        sample_contact=lambda batch, text, random: batch.contact.float(),
    )


def test_the_refiners_losses_follow_equations_8_and_9(annotated: AnnotatedStore) -> None:
    """Eq. 9 in the hands' 99 numbers, summed; eq. 8 with lambda_1 = 5."""
    network = Off(replace(spec("refiner").network, transformer=TransformerConfig(16, 1, 2, 16)))
    tested = refiner_objective(network, annotated)
    terms = tested._losses(network, tested.held_out, torch.Generator())
    assert network.noised == [None]
    assert float(terms["simple"]) == pytest.approx(99 * 0.001**2, rel=1e-3)
    assert float(terms["contact"]) > 0
    total = terms["simple"] + terms["penetration"] + 5 * terms["contact"]
    assert float(terms["total"]) == pytest.approx(float(total), rel=1e-6)


def test_a_diffusion_refiner_learns_from_recorded_hands_noised_as_in_equation_1(annotated: AnnotatedStore) -> None:
    network = Off(RefinerConfig(transformer=TransformerConfig(16, 1, 2, 16), output="diffusion"))
    tested = refiner_objective(network, annotated)
    coarse = replace(tested.held_out.coarse, hands=tested.held_out.target + 0.3)
    comparison = replace(tested.held_out, coarse=coarse)
    for seed in range(40):
        terms = tested._losses(network, comparison, torch.Generator().manual_seed(seed))
    assert float(terms["simple"]) == pytest.approx(99 * 0.301**2, rel=1e-3)
    steps = torch.stack([noised.steps for noised in network.noised])
    assert 0 <= int(steps.min()) < 50
    assert 450 < int(steps.max()) < 500
    assert len(set(steps[0].tolist())) > 1
    angle = ((steps.double().numpy() + 1) / 1000 + 0.008) / 1.008 * np.pi / 2  # cosine schedule
    alpha_bar = (np.cos(angle) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2)[..., None, None, None]
    hands = torch.stack([noised.hands for noised in network.noised]).double().numpy()
    noise = (hands - np.sqrt(alpha_bar) * tested.held_out.target.double().numpy()) / np.sqrt(1 - alpha_bar)
    assert noise.mean() == pytest.approx(0, abs=0.02)
    assert noise.std() == pytest.approx(1, abs=0.02)
    assert tested.validation(network) == tested.validation(network)
    assert torch.equal(network.noised[-1].hands, network.noised[-2].hands)
    train = list(Corpus.of(annotated, 0).train)
    batch = collate(train, FrameSelection.drawn([clip.length for clip in train], 8, 0, np.random.default_rng(0)))
    for seed in (0, 1):
        tested.losses(batch, torch.Generator().manual_seed(seed))
    assert not torch.equal(network.noised[-1].steps, network.noised[-2].steps)


def test_the_refiner_reads_the_2273_numbers_of_section_12(batch: ClipBatch) -> None:
    surface = Surface.of(Hands(load_embedded_hands()), batch.objects, CPU)
    coarse = surface.coarse(batch, batch.hands, batch.object, batch.contact_map, batch.present)
    config = RefinerConfig(transformer=TransformerConfig(16, 1, 2, 16))
    inputs = RefinerModel(config)._inputs(coarse, coarse.hands).double().numpy()
    rotation = rotations(batch.object.double().numpy()[..., 3:9])
    displacement = np.einsum("bfij,bsfkj->bsfki", rotation, coarse.offset_m.double().numpy())
    norms = np.linalg.norm(place_points(batch, batch.object).double().numpy(), axis=-1)
    shape = (*inputs.shape[:-1], -1)
    expected = np.concatenate((
        batch.hands.numpy(), batch.joints_m.numpy().reshape(shape), np.exp(-50 * np.abs(displacement)).reshape(shape),
        np.broadcast_to(norms[:, None], (*inputs.shape[:-1], 1024)),
        np.broadcast_to(batch.contact_map.numpy()[:, None, None], (*inputs.shape[:-1], 1024)),
    ), -1)  # fmt: skip
    present = batch.present.numpy()
    assert inputs.shape[-1] == 2273
    np.testing.assert_allclose(inputs[present], expected[present], atol=1e-5)


def test_contact_and_length_losses_are_sums_of_their_parts() -> None:
    random = np.random.default_rng(0)
    logits, mean, log_variance = (random.normal(size=size) for size in ((3, 50), (3, 64), (3, 64)))
    touched = (random.random((3, 50)) < 0.3).astype(float)
    p = 1 / (1 + np.exp(-logits))
    cross = -(touched * np.log(p) + (1 - touched) * np.log(1 - p)).sum(1).mean()
    dice = (1 - (2 * (p * touched).sum(1) + 1) / (p.sum(1) + touched.sum(1) + 1)).mean()
    divergence = (0.5 * (mean**2 + np.exp(log_variance) - 1 - log_variance)).sum(1).mean()
    terms = contact_loss(*map(torch.from_numpy, (logits, touched, mean, log_variance)))
    assert float(terms["total"]) == pytest.approx(cross + dice + divergence, rel=1e-5)
    assert float(length_error(torch.tensor([0.5, 0.2]), torch.tensor([90, 30]))["total"]) == pytest.approx(0.005)


@pytest.mark.slow
def test_initial_gradients_of_equations_6_and_7_are_no_larger_than_of_5(
    annotated: AnnotatedStore, batch: ClipBatch
) -> None:
    """With a mean in Eq. 5 and units of 2 cm in Eq. 6, their gradients would be 97 times as large."""
    torch.manual_seed(0)
    tested = DiffusionObjective(
        DiffusionModel(spec("diffusion").network),
        spec("diffusion").loss,
        corpus=Corpus.of(annotated, 0),
        hands=Hands(load_embedded_hands()),
        normaliser=Normaliser.identity(),
        device=CPU,
    )
    terms = tested.losses(batch, torch.Generator().manual_seed(0))
    weights = [weight for weight in tested.network.parameters() if weight.requires_grad]
    norms = {}
    for name in ("simple", "distance_map", "relative_orientation"):
        gradients = torch.autograd.grad(terms[name], weights, retain_graph=True, allow_unused=True)
        squares = [gradient.square().sum() for gradient in gradients if gradient is not None]
        norms[name] = float(sum(squares, torch.zeros(())).sqrt())
    assert max(norms["distance_map"], norms["relative_orientation"]) <= norms["simple"]


def test_weights_of_feature_groups_sum_to_one() -> None:
    for by_group, total in ((False, (99, 10)), (True, (1, 1))):
        sums = [float(weights.sum()) for weights in losses.feature_weights(by_group, CPU)]
        assert sums == pytest.approx(total)
