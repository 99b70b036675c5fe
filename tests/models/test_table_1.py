"""The baselines of Text2HOI's Table 1: sizes, forward passes against NumPy, masks, and two clips learned by heart."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from scipy.special import erf
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset, collate
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.store.annotated import AnnotatedStore
from models.common.corpus import Corpus
from models.common.family import Sampler, Setup, Sources
from models.common.features import Hands
from models.common.motion_vectors import joined, separated
from models.common.predicting import PredictionConfig, requests_for
from models.common.repeatable import seeded_generator
from models.common.training import TrainingConfig, TrainingSpec, fit
from models.common.transformer import TransformerConfig
from models.imos.family import interpolated, key_frames
from models.imos.network import ImosConfig, ImosNetwork
from models.imos.network import divergence as imos_divergence
from models.mdm.family import MdmConfig, MdmNetwork
from models.registry import load_family, load_network
from models.t2m.generator import T2mConfig, T2mNetwork
from models.t2m.movement import MovementConfig, MovementModel
from pipelines.stages.base import load_settings
from pipelines.stages.train import TrainParams
from tests.models.conftest import two_clips
from tests.models.toy import BUDGET, train

HANDS = load_embedded_hands()
NETWORKS = ("mdm", "imos", "t2m-movement", "t2m", "t2m-length")
FAMILIES = ("mdm", "imos", "imos-true-start", "t2m", "t2m-given-length")
TINY: dict[str, Any] = {
    "mdm": {"transformer": {"width": 16, "layers": 1, "heads": 2, "feed_forward": 16, "frames_per_token": 5}},
    "imos": {"condition": 8, "latent": 4, "hidden": 8, "inner": 8},
    "t2m-movement": {"width": 8, "latent": 8},
    "t2m": {"word": 8, "text": 8, "attention": 8, "latent": 4, "hidden": 8},
    "t2m-length": {},
}


def count(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def small(name: str) -> nn.Module:
    """The network of a name with the sizes of params.yaml."""
    network = load_network(name)
    spec = TrainingSpec.of(network, load_settings(TrainParams, "train").of(name))
    if name == "t2m":
        return network.build(replace(spec.network, movement=small("t2m-movement").config))
    return network.build(spec.network)


# Sizes


def test_full_sizes_have_the_parameters_of_the_originals() -> None:
    """Counted by hand from the layers that the papers and their code describe, for vectors of 208 numbers."""
    width, feed_forward, features = 512, 1024, 208
    block = 4 * (width * width + width) + (width + 1) * feed_forward + (feed_forward + 1) * width + 4 * width
    linears = 2 * (width * width + width) + (512 * width + width)  # timestep, sentence
    assert count(MdmNetwork(MdmConfig())) == 8 * block + linears + (features + 1) * width + (width + 1) * features
    # IMoS as released: the arms' pose of 36 and the object's position, ten betas of the body.
    assert count(ImosNetwork(ImosConfig(), inputs=39, outputs=36, betas=10)) == 22_005_522
    assert count(ImosNetwork(ImosConfig())) == pytest.approx(29.1e6, rel=0.005)
    network = T2mNetwork(T2mConfig())
    # 36.1 million with the layer for 15 parts of speech, and without GloVe's word vectors.
    assert count(network) - count(network.words) + 15 * 300 + 300 == 36_095_840


def test_small_sizes_are_within_a_quarter_of_each_other_and_of_the_diffusion_network() -> None:
    sizes = {name: count(small(name)) for name in NETWORKS}
    families = [sizes["mdm"], sizes["imos"], sizes["t2m"] + sizes["t2m-length"], 1_830_000]
    assert max(families) <= 1.25 * min(families)


def test_all_budgets_have_as_many_steps_as_the_diffusion_network() -> None:
    settings = load_settings(TrainParams, "train")
    for size in ("small", "full"):
        steps = {
            name: TrainingSpec.of(load_network(name), replace(settings, size=size).of(name)).training.steps
            for name in ("diffusion", "mdm", "imos", "t2m-movement", "t2m")
        }
        assert steps["mdm"] == steps["imos"] == steps["t2m-movement"] + steps["t2m"] == steps["diffusion"]


# Forward passes against NumPy


def weights(network: nn.Module) -> dict[str, np.ndarray]:
    """Random weights, which are also set in the network, and the buffers of batch norm."""
    generator = torch.Generator().manual_seed(1)
    for name, tensor in network.state_dict().items():
        if tensor.is_floating_point():
            tensor.copy_(0.3 * torch.randn(tensor.shape, generator=generator))
            if name.endswith("running_var"):
                tensor.abs_().add_(0.5)
    return {name: tensor.double().numpy() for name, tensor in network.state_dict().items()}


def linear(w: dict[str, np.ndarray], name: str, x: np.ndarray) -> np.ndarray:
    return x @ w[f"{name}.weight"].T + w.get(f"{name}.bias", 0)


def layer_norm(w: dict[str, np.ndarray], name: str, x: np.ndarray) -> np.ndarray:
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return x * w[f"{name}.weight"] + w[f"{name}.bias"]


def batch_norm(w: dict[str, np.ndarray], name: str, x: np.ndarray) -> np.ndarray:
    x = (x - w[f"{name}.running_mean"]) / np.sqrt(w[f"{name}.running_var"] + 1e-5)
    return x * w[f"{name}.weight"] + w[f"{name}.bias"]


def leaky(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.2 * x)


def softmax(x: np.ndarray) -> np.ndarray:
    raised = np.exp(x - x.max(-1, keepdims=True))
    return raised / raised.sum(-1, keepdims=True)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def waves(position: np.ndarray, width: int) -> np.ndarray:
    angles = np.asarray(position, float)[..., None] * 10_000.0 ** (-np.arange(width // 2) / (width // 2))
    return np.concatenate((np.sin(angles), np.cos(angles)), -1)


def scaled(text: np.ndarray) -> np.ndarray:
    return text / np.linalg.norm(text, axis=-1, keepdims=True) * np.sqrt(text.shape[-1])


def gru(w: dict[str, np.ndarray], names: Sequence[str], x: np.ndarray, state: np.ndarray) -> np.ndarray:
    """One step of a gated recurrent unit (Cho et al. 2014); names of weights and biases of input and state."""
    of_input, of_state = x @ w[names[0]].T + w[names[1]], state @ w[names[2]].T + w[names[3]]
    (reset, update, new), (state_reset, state_update, state_new) = (np.split(y, 3, -1) for y in (of_input, of_state))
    update = sigmoid(update + state_update)
    return update * state + (1 - update) * np.tanh(new + sigmoid(reset + state_reset) * state_new)


def test_mdm_denoises_as_written_in_numpy() -> None:
    network = MdmNetwork(MdmConfig(TransformerConfig(**TINY["mdm"]["transformer"] | {"layers": 2}))).eval()
    w, random = weights(network), np.random.default_rng(0)
    motion, text = random.normal(size=(1, 12, 208)), random.normal(size=(1, 512))
    visible = np.ones((1, 12, 208), bool)
    visible[..., :99] = False
    tokens = np.pad((motion * visible)[0], ((0, 3), (0, 0))).reshape(3, 5 * 208)
    step = linear(w, "step_in.0", waves(np.array([70.0]), 16))
    condition = linear(w, "text_in", scaled(text)) + linear(w, "step_in.2", step * sigmoid(step))
    x = np.concatenate((condition, linear(w, "motion_in", tokens))) + waves(np.arange(4), 16)
    for layer in range(2):
        block = f"encoder.blocks.{layer}"
        projected = linear(w, f"{block}.in_proj", x).reshape(4, 3, 2, 8).transpose(1, 2, 0, 3)
        query, key, value = projected
        mixed = softmax(query @ key.transpose(0, 2, 1) / np.sqrt(8)) @ value
        attended = linear(w, f"{block}.out_proj", mixed.transpose(1, 0, 2).reshape(4, 16))
        x = layer_norm(w, f"{block}.norm_attention", x + attended)
        hidden = linear(w, f"{block}.feed_forward.0", x)
        hidden = hidden * 0.5 * (1 + erf(hidden / np.sqrt(2)))
        x = layer_norm(w, f"{block}.norm_feed_forward", x + linear(w, f"{block}.feed_forward.3", hidden))
    expected = linear(w, "motion_out", x[1:]).reshape(15, 208)[:12] * visible[0]
    arguments = (*map(torch.from_numpy, (motion.astype(np.float32), np.array([70]), text.astype(np.float32), visible)),)
    with torch.no_grad():
        np.testing.assert_allclose(network(*arguments)[0].numpy(), expected, rtol=2e-3, atol=2e-4)


def test_imos_predicts_a_key_frame_as_written_in_numpy() -> None:
    network = ImosNetwork(ImosConfig(**TINY["imos"])).eval()
    w, random = weights(network), np.random.default_rng(0)
    text, betas, past, noise = (random.normal(size=size) for size in ((3, 512), (3, 2, 10), (3, 4, 208), (3, 1, 4)))

    def block(name: str, x: np.ndarray) -> np.ndarray:
        hidden = leaky(batch_norm(w, f"{name}.layers.1", linear(w, f"{name}.layers.0", x)))
        hidden = batch_norm(w, f"{name}.layers.5", linear(w, f"{name}.layers.4", hidden))
        return leaky(hidden + leaky(linear(w, f"{name}.skip.0", x)))

    def dense(name: str, x: np.ndarray) -> np.ndarray:
        x = batch_norm(w, f"{name}.norm", x)
        return block(f"{name}.second", np.concatenate((x, block(f"{name}.first", x)), -1))

    both = np.concatenate((text, betas.reshape(3, 20)), -1)
    condition = block("condition.1", batch_norm(w, "condition.0", both))
    flat = past.reshape(3, 4 * 208)
    hidden = dense("past.body", np.concatenate((flat, condition), -1))
    z = linear(w, "past.mean", hidden) + linear(w, "past.deviation", hidden) * noise[:, 0]
    expected = past[:, 3] + dense("decoder", np.concatenate((condition, z, flat), -1))
    with torch.no_grad():
        text, betas, past, noise = (torch.from_numpy(x).float() for x in (text, betas, past, noise))
        frames = network.roll_out(past, network.conditions(text, betas), torch.ones(3, 208).bool(), noise)
    assert frames.shape == (3, 5, 208)
    np.testing.assert_allclose(frames[:, 4].numpy(), expected, rtol=2e-3, atol=2e-3)


def test_t2m_unrolls_two_snippets_as_written_in_numpy() -> None:
    config = T2mConfig(**TINY["t2m"], movement=MovementConfig(8, 8), words=("box", "lift"))
    network = T2mNetwork(config).eval()
    w, random = weights(network), np.random.default_rng(0)
    noise, true = random.normal(size=(1, 2, 4)), random.normal(size=(1, 2, 8))
    words = linear(w, "words_in", w["words.weight"][[3, 1, 2]])  # lift, unknown, box
    directions = []
    for suffix, order in (("", (0, 1, 2)), ("_reverse", (2, 1, 0))):
        names = tuple(f"text.{name}_l0{suffix}" for name in ("weight_ih", "bias_ih", "weight_hh", "bias_hh"))
        state, states = w["text_start"][len(directions), 0], {}
        for number in order:
            states[number] = state = gru(w, names, words[number], state)
        directions.append((np.stack([states[number] for number in range(3)]), state))
    outputs, sentence = (np.concatenate(parts, -1) for parts in zip(*directions, strict=True))

    def advance(name: str, inputs: Sequence[np.ndarray], left: int, state: np.ndarray) -> np.ndarray:
        embedded = leaky(layer_norm(w, f"{name}.embed.1", linear(w, f"{name}.embed.0", np.concatenate(inputs))))
        names = tuple(f"{name}.cell.{part}" for part in ("weight_ih", "bias_ih", "weight_hh", "bias_hh"))
        return gru(w, names, embedded + waves(np.array(left), 8), state)

    states = {name: linear(w, f"{name}.start", sentence) for name in ("prior", "posterior", "decoder")}
    with torch.no_grad():
        last, snippets, divergences = network.movement.encode(torch.zeros(1, 4, 208))[0, 0].double().numpy(), [], []
    for number in range(2):
        scores = linear(w, "key", outputs) @ linear(w, "query", states["decoder"]) / np.sqrt(8)
        attended = softmax(scores) @ linear(w, "value", outputs)
        left = 2 - number
        states["prior"] = advance("prior", (last, attended), left, states["prior"])
        states["posterior"] = advance("posterior", (last, true[0, number], attended), left, states["posterior"])
        prior_mean, prior_log = np.split(linear(w, "prior_z", states["prior"]), 2)
        mean, log = np.split(linear(w, "posterior_z", states["posterior"]), 2)
        of_prior, of_posterior = np.exp(prior_log), np.exp(log)
        divergences.append(0.5 * np.sum(prior_log - log + (of_posterior + (mean - prior_mean) ** 2) / of_prior - 1))
        z = mean + np.sqrt(of_posterior) * noise[0, number]
        states["decoder"] = advance("decoder", (last, attended, z), left, states["decoder"])
        hidden = leaky(layer_norm(w, "snippet_out.1", linear(w, "snippet_out.0", states["decoder"])))
        last = linear(w, "snippet_out.3", hidden)
        snippets.append(last)
    with torch.no_grad():
        tensors = (torch.from_numpy(x).float() for x in (noise, true))
        got = network(["Lift the box"], torch.tensor([2]), *tensors)
    for value, expected in zip(got, (np.stack(snippets), np.array(divergences)), strict=True):
        np.testing.assert_allclose(value[0].numpy(), expected, rtol=2e-3, atol=1e-4)


def test_t2m_encodes_and_decodes_snippets_as_written_in_numpy() -> None:
    network = MovementModel(MovementConfig(width=3, latent=2)).eval()
    w, motion = weights(network), np.random.default_rng(0).normal(size=(9, 208))
    x = np.pad(motion, ((0, 7), (0, 0)))  # three snippets, and one that is removed

    def convolved(name: str, x: np.ndarray) -> np.ndarray:
        x, kernel = np.pad(x, ((1, 1), (0, 0))), w[f"{name}.weight"]
        rows = [np.einsum("oik,ki->o", kernel, x[2 * step : 2 * step + 4]) for step in range(len(x) // 2 - 1)]
        return leaky(np.stack(rows) + w[f"{name}.bias"])

    snippets = linear(w, "latent", convolved("encoder.3", convolved("encoder.0", x)))[:3]

    def spread(name: str, x: np.ndarray) -> np.ndarray:
        kernel = w[f"{name}.weight"]
        out = np.zeros((2 * len(x) + 2, kernel.shape[1]))
        for step, values in enumerate(x):
            out[2 * step : 2 * step + 4] += np.einsum("iok,i->ko", kernel, values)
        return leaky(out[1:-1] + w[f"{name}.bias"])

    decoded = linear(w, "motion_out", spread("decoder.2", spread("decoder.0", np.pad(snippets, ((0, 1), (0, 0))))))[:9]
    with torch.no_grad():
        got = network.encode(torch.from_numpy(motion)[None].float())
        back = network.decode(got, torch.ones(1, 3).bool(), 9)
    assert got.shape == (1, 3, 2)
    np.testing.assert_allclose(got[0].numpy(), snippets, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(back[0].numpy(), decoded, rtol=1e-3, atol=1e-4)


def test_the_divergence_of_imos_is_that_of_a_normal_distribution() -> None:
    mean, deviation = torch.randn(2, 5, 3), torch.tensor([0.5, -2.0, 1.0]).expand(2, 5, 3)
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(normal(mean, deviation.abs()), normal(0.0, 1.0)).mean()
    torch.testing.assert_close(imos_divergence(mean, deviation), expected)


# Key frames of IMoS


def test_key_frames_are_even_and_interpolation_meets_them() -> None:
    assert key_frames(torch.tensor([15, 29])).tolist() == [list(range(15)), list(range(0, 29, 2))]
    motion = joined(torch.zeros(1, 2, 29, 99), torch.zeros(1, 29, 10))[0].double()
    angle = torch.linspace(0, 2.8, 29, dtype=torch.float64)  # of a rotation about z at constant speed
    rotation = torch.stack((angle.cos(), -angle.sin(), angle.sin(), angle.cos(), 0 * angle, 0 * angle), -1)
    for first in (*range(3, 99, 6), *range(102, 198, 6), 201):
        motion[:, first : first + 6] = rotation
    motion[:, 198] = angle
    torch.testing.assert_close(interpolated(motion[::2], 29), motion)
    assert interpolated(motion[::2], 8).shape == (8, 208)


# Training and sampling


@pytest.fixture(scope="module")
def tiny(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints of tiny networks, trained for two steps."""
    out = tmp_path_factory.mktemp("table-1")
    for name in NETWORKS:
        train(name, annotated_root, out, params={name: {"network": TINY[name], "training": BUDGET}})
    return out


@pytest.fixture(scope="module")
def tiny_sources(annotated: AnnotatedStore, tiny: Path) -> Sources:
    settings = {"mdm": {"sampler": {"steps": 2}}}
    return Sources(annotated, tiny, HANDS, torch.device("cpu"), settings)


def motions(sampler: Sampler, requests: Sequence[Request]) -> list[Clip]:
    answers = [answer for answer in sampler.sample(requests) if isinstance(answer, Clip)]
    assert len(answers) == len(requests)
    return answers


def joints_of(clip: Clip) -> np.ndarray:
    return np.concatenate([track_joints(clip.hands[side], HANDS[side])[clip.hands[side].valid] for side in SIDES])


@pytest.mark.parametrize("name", FAMILIES)
def test_a_motion_depends_on_its_seed_and_not_on_its_batch(name: str, tiny_sources: Sources) -> None:
    family = load_family(name).load(tiny_sources)
    short, long = HoiDataset(tiny_sources.annotated, "test", crop="start")
    requests = [*requests_for(short, PredictionConfig(samples=2)), *requests_for(long, PredictionConfig(samples=1))]
    # All with the same hand, so that they share a batch.
    requests = [replace(request, active_hands=short.active_hands) for request in requests]
    together, (alone,) = motions(family, requests), motions(family, requests[:1])
    np.testing.assert_allclose(joints_of(alone), joints_of(together[0]), atol=1e-5)
    if name != "t2m":
        assert [clip.n_frames for clip in together] == [request.n_frames for request in requests]
        assert abs(joints_of(together[0]) - joints_of(together[1])).max() > 1e-6
    for clip, request in zip(together, requests, strict=True):
        assert [bool(clip.hands[side].valid.all()) for side in SIDES] == request.active_hands.tolist()
        np.testing.assert_allclose(clip.object.translation_m[0], request.world_from_model[:3, 3], atol=1e-5)


def test_t2m_samples_whole_snippets(tiny_sources: Sources) -> None:
    (sample, _) = HoiDataset(tiny_sources.annotated, "test", crop="start")
    requests = requests_for(sample, PredictionConfig(samples=30))
    lengths = [clip.n_frames for clip in motions(load_family("t2m").load(tiny_sources), requests)]
    assert len(set(lengths)) > 1
    assert all(4 <= length <= 150 and (length % 4 == 0 or length == 150) for length in lengths)


def test_imos_starts_from_a_training_clip_or_from_the_recorded_one(tiny_sources: Sources) -> None:
    (sample, _) = HoiDataset(tiny_sources.annotated, "test", crop="start")
    (request,) = requests_for(sample, PredictionConfig(samples=1))
    retrieved, true = (load_family(name).load(tiny_sources) for name in ("imos", "imos-true-start"))
    start = retrieved.start(request)
    assert start.clip_id in tiny_sources.annotated.ids("train")
    assert (start.verb, start.hand_type) == (sample.verb, sample.hand_type)
    (motion,) = true.sample([request])
    frames = key_frames(torch.tensor([sample.length]))[0, 1]  # motion and recording share the second key frame
    recorded = tiny_sources.annotated.clip(sample.clip_id)
    side = SIDES[int(sample.active_hands.argmax())]
    moment = (sample.length - 1) / 14  # of the second key frame, which the motion passes between two frames
    assert abs(float(frames) - moment) <= 0.5
    first = motion.hands[side].wrist_m[0] - motion.object.translation_m[0]
    expected = recorded.hands[side].wrist_m[0] - recorded.object.translation_m[0]
    np.testing.assert_allclose(first, expected, atol=1e-5)


def overwritten(batch: ClipBatch) -> ClipBatch:
    """The batch with other numbers of hands that do not act, of untracked frames, and beyond the length."""
    hands = torch.where(batch.present[..., None], batch.hands, torch.full_like(batch.hands, 7.0))
    objects = torch.where(batch.frames[..., None], batch.object, torch.full_like(batch.object, 7.0))
    return replace(batch, hands=hands, object=objects)


@pytest.mark.parametrize("name", NETWORKS)
def test_losses_read_active_hands_within_the_length_only(name: str, annotated: AnnotatedStore) -> None:
    objective = objective_of(name, Corpus.of(annotated, 0), TINY)
    batch = collate(list(HoiDataset(annotated, "train", crop="start")))
    assert not batch.hand_frames.all()
    state = copy.deepcopy(objective.network.state_dict())  # with the statistics of batch norm

    def loss(one: ClipBatch) -> Tensor:
        objective.network.load_state_dict(state)
        return objective.losses(one, seeded_generator(0))["total"].detach()

    plain, other = loss(batch), loss(overwritten(batch))
    torch.testing.assert_close(plain, other, rtol=0, atol=0)
    if name != "t2m-length":
        moved = replace(batch, hands=batch.hands + 0.3)
        assert abs(float(loss(moved) - plain)) > 1e-4


def objective_of(name: str, corpus: Corpus, sizes: dict[str, Any], trained: dict[str, Any] | None = None) -> Any:
    torch.manual_seed(0)
    network, trained = load_network(name), dict(trained or {})
    for needed in network.needs:
        if needed not in trained:
            of_needed = objective_of(needed, corpus, sizes)
            trained[needed] = SimpleNamespace(network=of_needed.network, normaliser=of_needed.normaliser)
    config = TrainingSpec.of(network, {"network": sizes[name]}).network
    hands = Hands(corpus.annotated.store.hand_pair())
    setup = Setup(config, None, 0, corpus, hands, torch.device("cpu"), trained)
    objective, _ = network.objective(setup)
    return objective


def test_the_movement_decoder_learns_at_a_tenth_of_the_rate_and_the_encoder_not_at_all(annotated) -> None:
    corpus = Corpus.of(annotated, 0)
    objective = objective_of("t2m", corpus, TINY)
    before = {name: tensor.clone() for name, tensor in objective.network.state_dict().items()}
    config = TrainingConfig(steps=1, batch=4, learning_rate=1e-2, weight_decay=0.0, validate_every=1)
    after = fit(objective, corpus, config, 0, torch.device("cpu"))[0].state_dict()
    moved = {name: float((after[name] - before[name]).abs().max()) for name in before}
    # The first step of Adam moves every weight by the learning rate.
    assert moved["snippet_out.3.weight"] == pytest.approx(1e-2, rel=0.01)
    assert moved["movement.motion_out.weight"] == pytest.approx(1e-3, rel=0.01)
    assert {moved[name] for name in moved if name.startswith(("movement.encoder", "movement.latent"))} == {0.0}


# Two clips by heart


COPIES = {"mdm": 8, "imos": 8, "t2m": 1}  # of a clip in a batch: several timesteps, several key frames
MIDDLE: dict[str, Any] = {
    "mdm": {
        "transformer": {"width": 64, "layers": 2, "heads": 2, "feed_forward": 64, "frames_per_token": 5, "dropout": 0.0}
    },
    "imos": {"condition": 32, "latent": 8, "hidden": 32, "inner": 32, "dropout": 0.0},
    "t2m-movement": {"width": 64, "latent": 32, "dropout": 0.0},
    "t2m": {"word": 16, "text": 16, "attention": 16, "latent": 8, "hidden": 64},
    "t2m-length": {},
}
# Largest error of the object's path, whose length is 200 mm, and mean error of joints.
LARGEST_M = {"mdm": (0.05, 0.04), "imos": (0.10, 0.05), "t2m": (0.05, 0.02)}
# Steps and learning rate.
BUDGETS = {
    "mdm": (400, 1e-3), "imos": (600, 1e-2), "t2m-movement": (300, 3e-3), "t2m": (200, 3e-3), "t2m-length": (60, 3e-3),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("name", ["mdm", "imos", "t2m"])
def test_a_family_learns_two_clips_by_heart(name: str, tmp_path: Path) -> None:
    two, family, trained = two_clips(tmp_path), load_family(name), {}
    samples: list[ClipSample] = list(two.train)
    two.train.ids = two.train.ids * COPIES[name]
    for network in family.networks:
        objective = objective_of(network.name, two, MIDDLE, trained)
        steps, rate = BUDGETS[network.name]
        config = TrainingConfig(
            steps,
            batch=len(two.train),
            learning_rate=rate,
            weight_decay=0.0,
            ema_decay=0.98,
            schedule="cosine",
            warmup=30,
            validate_every=steps,
        )
        learned = fit(objective, two, config, 0, torch.device("cpu"))[0]
        facts = {"synthetic": True}
        trained[network.name] = SimpleNamespace(network=learned, normaliser=objective.normaliser, facts=facts)
    sources = Sources(
        annotated=two.annotated,
        checkpoints=Path(),
        device=torch.device("cpu"),
        settings={"mdm": {"guidance": 1.0}},  # more would overshoot the clip that the sentence names
        hands=HANDS,
    )
    module = family.load.__module__
    with patch(f"{module}.load_checkpoint", lambda folder, network, device: trained[network.name]):
        sampler = family.load(sources)
    requests = [request for one in samples for request in requests_for(one, PredictionConfig(samples=2))]
    for motion, sample in zip(motions(sampler, requests), [one for one in samples for _ in range(2)], strict=True):
        assert motion.n_frames == sample.length
        recorded = two.annotated.clip(sample.clip_id)
        path = abs(motion.object.translation_m - recorded.object.translation_m).max()
        error = np.linalg.norm(joints_of(motion) - joints_of(recorded).reshape(2, -1, 21, 3)[1], axis=-1)
        print(f"{name} {sample.verb}: path {1000 * path:.1f} mm, joints {1000 * error.mean():.1f} mm")
        assert path < LARGEST_M[name][0]
        assert error.mean() < LARGEST_M[name][1]


def test_vectors_are_hands_and_object_side_by_side() -> None:
    hands, objects = torch.randn(2, 2, 5, 99), torch.randn(2, 5, 10)
    vectors: Tensor = joined(hands, objects)
    assert vectors.shape == (2, 5, 208)
    for one, other in zip(separated(vectors), (hands, objects), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
