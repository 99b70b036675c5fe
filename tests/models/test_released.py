"""Files of Text2HOI's published layout, with random weights made here: read as our networks they give its answers.

Layout and forward pass are typed from the authors' layer names and the facts sheet, apart from the converter's tables.
"""

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import ClipBatch
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from models.common.checkpoints import load_checkpoint
from models.text2hoi.contact_training import CONTACT
from models.text2hoi.diffusion import Condition
from models.text2hoi.diffusion_training import DIFFUSION
from models.text2hoi.motion_code import MotionCode, MotionCodeConfig
from models.text2hoi.released import import_released, read_weights
from pipelines.lineage.tree import lineage_tree

D, HEADS, LAYERS = 512, 4, 8
Named = dict[str, np.ndarray]


def drawn(random: np.random.Generator, shapes: dict[str, tuple[int, ...]]) -> Named:
    """Weights of these shapes, and biases, by layer."""
    found: Named = {}
    for name, shape in shapes.items():
        found[f"{name}.weight"] = random.normal(0, 1 / np.sqrt(np.prod(shape[1:])), shape)
        found[f"{name}.bias"] = random.normal(0, 0.1, shape[0])
    return found


def norms(random: np.random.Generator, sizes: dict[str, int]) -> Named:
    found: Named = {}
    for name, size in sizes.items():
        found[f"{name}.weight"], found[f"{name}.bias"] = random.uniform(0.5, 1.5, size), random.normal(0, 0.1, size)
        found[f"{name}.running_mean"], found[f"{name}.running_var"] = (
            random.normal(0, 0.1, size),
            random.uniform(0.5, 2, size),
        )
        found[f"{name}.num_batches_tracked"] = np.array(7)
    return found


def point_net(random: np.random.Generator, channels: int, at: str = "") -> Named:
    convolutions = {"conv1": (64, channels, 1), "conv2": (128, 64, 1), "conv3": (1024, 128, 1)}
    dense = {"stn.fc1": (512, 1024), "stn.fc2": (256, 512), "stn.fc3": (channels**2, 256)}
    layers = {**convolutions, **{f"stn.{name}": shape for name, shape in convolutions.items()}, **dense}
    sizes = {"bn1": 64, "bn2": 128, "bn3": 1024}
    batch = {**sizes, **{f"stn.{name}": size for name, size in sizes.items()}, "stn.bn4": 512, "stn.bn5": 256}
    made = drawn(random, layers) | norms(random, batch)
    return {at + name: value for name, value in made.items()}


def contact_file(random: np.random.Generator) -> Named:
    found = point_net(random, 4, "encoder.feat.")
    found |= drawn(random, {"encoder.fc1": (512, 1024), "encoder.fc2": (256, 512), "encoder.fc3": (128, 256)})
    found |= norms(random, {"encoder.bn1": 512, "encoder.bn2": 256})
    sizes = [1665, 512, 256, 128, 1]
    return found | drawn(random, {f"decoder.MLP.{n}.0": (sizes[n + 1], sizes[n]) for n in range(4)})


def codes() -> np.ndarray:
    """(5000, 512): sines at even channels, cosines at odd ones."""
    angles = np.arange(5000)[:, None] * np.exp(np.arange(0, D, 2) * (-np.log(10_000.0) / D))
    table = np.zeros((5000, D))
    table[:, 0::2], table[:, 1::2] = np.sin(angles), np.cos(angles)
    return table


def generator_file(random: np.random.Generator, numbers: int) -> Named:
    layers: dict[str, tuple[int, ...]] = {
        "init_fc_lhand.fc": (D, 99), "init_fc_rhand.fc": (D, 99), "init_fc_obj.fc": (D, numbers),
        "embed_timestep.time_embed.0": (D, D), "embed_timestep.time_embed.2": (D, D), "embed_text": (D, 512),
        "embed_obj": (D, 2052), "out_fc_lhand.fc": (99, 2 * D), "out_fc_rhand.fc": (99, 2 * D),
        "out_fc_obj.fc": (numbers, D),
    }  # fmt: skip
    found = drawn(random, layers)
    for number in range(LAYERS):
        at = f"seqTransEncoder.layers.{number}."
        block = drawn(random, {"linear1": (1024, D), "linear2": (D, 1024), "self_attn.out_proj": (D, D)})
        attention = drawn(random, {"x": (3 * D, D)})
        block |= {f"self_attn.in_proj_{kind}": attention[f"x.{kind}"] for kind in ("weight", "bias")}
        for name in ("norm1", "norm2"):
            block |= {f"{name}.weight": random.uniform(0.5, 1.5, D), f"{name}.bias": random.normal(0, 0.1, D)}
        found |= {at + name: value for name, value in block.items()}
    for name in ("sequence_pos_encoder", "sequence_hand_encoder", "embed_timestep.sequence_pos_encoder"):
        found[f"{name}.pe"] = codes()[:, None]
    return found


def save(path: Path, weights: Named) -> Path:
    tensors = {
        name: torch.from_numpy(np.asarray(value, np.int64 if value.ndim == 0 else np.float32))
        for name, value in weights.items()
    }
    torch.save({"model": tensors, "epoch": 12, "loss": 0.5}, path)
    return path


@pytest.fixture(scope="module", params=[9, 10], ids=["nine numbers", "ten numbers"])
def published(request: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Named, Named, Named]:
    random, folder = np.random.default_rng(request.param), tmp_path_factory.mktemp("published")
    made = point_net(random, 3), contact_file(random), generator_file(random, request.param)
    names = ("pointfeat.pth.tar", "contact.pth.tar", "texthom.pth.tar")
    return [save(folder / name, weights) for name, weights in zip(names, made, strict=True)], *made


# --- the forward pass of the published networks in NumPy


def dense(weights: Named, name: str, x: np.ndarray) -> np.ndarray:
    matrix = weights[f"{name}.weight"]
    return x @ matrix.reshape(len(matrix), -1).T + weights[f"{name}.bias"]


def batch_norm(weights: Named, name: str, x: np.ndarray) -> np.ndarray:
    spread = np.sqrt(weights[f"{name}.running_var"] + 1e-5)
    return (x - weights[f"{name}.running_mean"]) / spread * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def point_features(weights: Named, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Global (1024,) and local (N, 64) features of points (N, 3)."""
    y = x
    for number in (1, 2, 3):
        y = np.maximum(batch_norm(weights, f"stn.bn{number}", dense(weights, f"stn.conv{number}", y)), 0)
    y = y.max(0)
    for number in (1, 2):
        y = np.maximum(batch_norm(weights, f"stn.bn{number + 3}", dense(weights, f"stn.fc{number}", y)), 0)
    turn = dense(weights, "stn.fc3", y).reshape(3, 3) + np.eye(3)
    local = np.maximum(batch_norm(weights, "bn1", dense(weights, "conv1", x @ turn)), 0)
    y = np.maximum(batch_norm(weights, "bn2", dense(weights, "conv2", local)), 0)
    return batch_norm(weights, "bn3", dense(weights, "conv3", y)).max(0), local


def normal(points: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    centre = points.mean(0)
    scale = np.linalg.norm(points - centre, axis=-1).max()
    return (points - centre) / scale, scale, centre


def contact_logits(point: Named, weights: Named, points: np.ndarray, text: np.ndarray, z: np.ndarray) -> np.ndarray:
    cloud, scale, _ = normal(points)
    overall, local = point_features(point, cloud)
    count = len(points)
    every = [np.tile(part, (count, 1)) for part in (z, np.array([scale]), overall)]
    y = np.concatenate((*every, local, np.tile(text, (count, 1))), -1)
    for number in range(3):
        y = dense(weights, f"decoder.MLP.{number}.0", y)
        y = np.where(y > 0, y, 0.2 * y)
    return dense(weights, "decoder.MLP.3.0", y)[:, 0]


def layer_norm(weights: Named, name: str, x: np.ndarray) -> np.ndarray:
    centred = x - x.mean(-1, keepdims=True)
    return (
        centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5) * weights[f"{name}.weight"]
        + weights[f"{name}.bias"]
    )


def gelu(x: np.ndarray) -> np.ndarray:
    from scipy.special import erf

    return 0.5 * x * (1 + erf(x / np.sqrt(2)))


def block(weights: Named, at: str, x: np.ndarray, there: np.ndarray) -> np.ndarray:
    mixed = x @ weights[f"{at}self_attn.in_proj_weight"].T + weights[f"{at}self_attn.in_proj_bias"]
    query, key, value = (part.reshape(len(x), HEADS, -1).swapaxes(0, 1) for part in np.split(mixed, 3, -1))
    scores = query @ key.swapaxes(-1, -2) / np.sqrt(D // HEADS)
    scores[..., ~there] = -np.inf
    share = np.exp(scores - scores.max(-1, keepdims=True))
    attended = (share / share.sum(-1, keepdims=True) @ value).swapaxes(0, 1).reshape(len(x), D)
    x = layer_norm(weights, f"{at}norm1", x + dense(weights, f"{at}self_attn.out_proj", attended))
    return layer_norm(
        weights, f"{at}norm2", x + dense(weights, f"{at}linear2", gelu(dense(weights, f"{at}linear1", x)))
    )


def clean_motion(
    point: Named, weights: Named, step: int, motion: tuple[np.ndarray, ...], told: dict[str, np.ndarray]
) -> list[np.ndarray]:
    """x0 of left, right and object (F, .) from what is noised; told: points, contact, text, active, all of one clip."""
    table, n_frames = codes(), len(motion[2])
    hidden = dense(weights, "embed_timestep.time_embed.0", table[step])
    condition = dense(weights, "embed_timestep.time_embed.2", hidden / (1 + np.exp(-hidden)))
    cloud, scale, centre = normal(told["points"])
    body = np.concatenate((point_features(point, cloud)[0], told["contact"], [scale], centre))
    condition = condition + dense(weights, "embed_text", told["text"]) + dense(weights, "embed_obj", body) + table[0]
    rows = [
        dense(weights, f"init_fc_{name}.fc", own) + table[1 : n_frames + 1] + table[agent]
        for name, own, agent in zip(("lhand", "rhand", "obj"), motion, (1, 1666, 3333), strict=True)
    ]
    x = np.concatenate((condition[None], np.stack(rows, 1).reshape(-1, D)))
    there = np.concatenate(([True], np.tile([*told["active"], True], n_frames)))
    for number in range(LAYERS):
        x = block(weights, f"seqTransEncoder.layers.{number}.", x, there)
    left, right, thing = x[1::3], x[2::3], x[3::3]
    hands = [
        dense(weights, f"out_fc_{name}.fc", np.concatenate((own, thing), -1))
        for name, own in (("lhand", left), ("rhand", right))
    ]
    return [*hands, dense(weights, "out_fc_obj.fc", thing)]


@pytest.mark.slow
def test_imported_networks_answer_as_the_published_ones_would(
    published: tuple[list[Path], Named, Named, Named], batch: ClipBatch, tmp_path: Path
) -> None:
    """Three lengths (24, 32 and 28 frames) and three hand types (left, right, both) in one padded batch."""
    files, point, contact, generator = published
    import_released(files[::-1], tmp_path, "h2o", load_embedded_hands())
    random = np.random.default_rng(5)
    read, denoiser = (load_checkpoint(tmp_path / network.name, network) for network in (CONTACT, DIFFUSION))
    text, z = random.normal(size=(3, 512)), random.normal(size=(3, 64))
    given = [torch.from_numpy(part).float() for part in (text, z)]
    numbers = generator["init_fc_obj.fc.weight"].shape[1]
    noised = random.normal(size=batch.hands.shape), random.normal(size=batch.object.shape)
    noised[1][..., numbers:] = 0
    steps = torch.tensor([0, 400, 999])
    with torch.no_grad():
        logits = read.network.decode(batch.points_m, *given)  # pyright: ignore[reportCallIssue]
        feature = denoiser.network.object_feature(batch.points_m)  # pyright: ignore[reportCallIssue]
        condition = Condition.of(batch, feature, given[0], batch.contact)
        hands, objects = denoiser.network(*[torch.from_numpy(part).float() for part in noised], steps, condition)
    for row, count in enumerate(batch.counts):
        points = batch.points_m[row].double().numpy()
        expected = contact_logits(point, contact, points, text[row], z[row])
        np.testing.assert_allclose(logits[row].numpy(), expected, atol=1e-4)
        told = {"points": points, "contact": batch.contact_map[row].numpy(), "text": text[row],
                "active": batch.active_hands[row].numpy()}  # fmt: skip
        motion = noised[0][row, 0, :count], noised[0][row, 1, :count], noised[1][row, :count, :numbers]
        left, right, thing = clean_motion(point, generator, int(steps[row]), motion, told)
        for side, own in enumerate((left, right)):
            if batch.active_hands[row, side]:
                np.testing.assert_allclose(hands[row, side, :count].numpy(), own, atol=1e-4)
        np.testing.assert_allclose(objects[row, :count, :numbers].numpy(), thing, atol=1e-4)
    assert read.facts["clips_seen"] == "unknown"
    tree, provenance = lineage_tree(tmp_path, tmp_path / "diffusion" / "model.safetensors")
    assert provenance["clips"] == "unknown"
    assert "clips: unknown" in tree.detail
    assert [child.name for child in tree.children] == [
        "published contact",
        "published generator",
        "published point_net",
    ]


def test_numbers_of_each_dataset_come_back_from_the_authors_convention(batch: ClipBatch) -> None:
    random, sample = np.random.default_rng(0), batch.samples[2]
    mean = tuple(random.normal(0, 0.3, 90).tolist())
    for dataset in ("h2o", "grab", "arctic"):
        code = MotionCode(MotionCodeConfig(convention=dataset, finger_mean_rad=mean))
        coded = code.encode(sample)
        hands, objects = code.curves(coded.hands[None], coded.object[None], [sample.length])
        np.testing.assert_allclose(hands[0].numpy(), sample.hands, atol=1e-5)
        np.testing.assert_allclose(objects[0].numpy(), sample.object, atol=1e-5)
    # GRAB's first rotation, 6D rows of R^T: the second number is R10 where ours is R01.
    turned = MotionCode(MotionCodeConfig(convention="grab")).encode(sample).object[-1, 3:9]
    ours = sample.object[-1, 3:9]
    np.testing.assert_allclose(turned[:3].numpy(), [ours[0], ours[2], ours[1]], atol=1e-6)


class Bomb:
    def __reduce__(self) -> tuple:
        return (exec, ("raise SystemExit('it ran')",))


def rewritten(source: Path, target: Path, change: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", kind) as new:
        for name in old.namelist():
            new.writestr(name, change.get(name.rpartition("/")[2], old.read(name)))
    return target


def test_files_that_are_cut_foreign_or_malicious_are_refused_and_say_why(tmp_path: Path) -> None:
    random, hands = np.random.default_rng(0), load_embedded_hands()
    good = save(tmp_path / "good.pth", point_net(random, 3))
    cut, text, legacy, plain = (tmp_path / name for name in ("cut.pth", "text.pth", "legacy.pth", "plain.pth"))
    cut.write_bytes(good.read_bytes()[:-2000])
    text.write_bytes(b"not a checkpoint")
    torch.save({"model": {}}, legacy, _use_new_zipfile_serialization=False)
    torch.save([torch.ones(3)], plain)
    torch.save({"model": {"layer.weight": torch.ones(3)}, "epoch": 1, "loss": 0.0}, tmp_path / "foreign.pth")
    bomb = io.BytesIO()
    pickle.Pickler(bomb, protocol=2).dump({"model": Bomb()})
    torch.save({"model": {"stn.fc3.weight": torch.ones(9, 256)}}, tmp_path / "bare.pth")
    cases = {
        cut: "a zip file of torch tensors",
        text: "a zip file of torch tensors",
        legacy: "a zip file of torch tensors",
        plain: "weights by name under 'model'",
        tmp_path / "foreign.pth": "the weights of point_net, contact, generator",
        rewritten(good, tmp_path / "bomb.pth", {"data.pkl": bomb.getvalue()}): "it names",
        rewritten(good, tmp_path / "zipped.pth", {}, zipfile.ZIP_DEFLATED): "compressed",
        tmp_path / "none.pth": "no file",
    }
    for path, said in cases.items():
        with pytest.raises(BadInput, match=said):
            import_released([path], tmp_path / "out", "grab", hands)
    with pytest.raises(BadInput, match="none of contact, generator"):
        import_released([good], tmp_path / "out", "grab", hands)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("prefix", ["", "module."])
def test_weights_trained_in_parallel_have_the_names_of_those_that_were_not(prefix: str, tmp_path: Path) -> None:
    weights = {f"{prefix}stn.fc3.weight": torch.ones(2, dtype=torch.float64), f"{prefix}bn1.steps": torch.tensor(7)}
    torch.save({"model": weights}, tmp_path / "network.pth")
    read = read_weights(tmp_path / "network.pth")
    assert {name: value.dtype for name, value in read.items()} == {
        "stn.fc3.weight": torch.float32,
        "bn1.steps": torch.int64,
    }
