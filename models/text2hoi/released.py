"""Text2HOI's published checkpoint files, as its authors' code writes them, turned into checkpoints of our networks.

A file is ``{"model": weights by name, "epoch", "loss"}``. Layers are told by their names and shapes; what differs from
ours is order alone: convolutions with a kernel of 1 are linear layers, codes interleave sines and cosines where ours
follow each other, so every channel of the denoiser's width is moved, and an object has 9 numbers, whose tenth becomes
zero. Nothing is known of the clips they have seen: the authors' code trains on every subject unless told otherwise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.clips.clip import SIDES
from hoidata.clips.features import WRIST
from hoidata.errors import BadInput
from hoidata.files import sha256_file
from hoidata.files.torch_zip import load_torch_zip
from hoidata.hands import HandPair
from models.common.checkpoints import save_checkpoint
from models.common.features import Normaliser
from models.text2hoi.contact import ContactModel
from models.text2hoi.contact_config import ContactConfig
from models.text2hoi.diffusion import DiffusionConfig, DiffusionModel
from models.text2hoi.motion_code import MotionCodeConfig

Dataset = Literal["h2o", "grab", "arctic"]
Weights = dict[str, Tensor]
THRESHOLD = 0.5
WIDTH, LAYERS = 512, 8
# One layer of each kind of file, and the last one it must have; by these a file is told.
KINDS = {"point_net": "stn.fc3.weight", "contact": "decoder.MLP.3.0.weight", "generator": "out_fc_obj.fc.weight"}
UNKNOWN = "unknown"
PARALLEL = "module."


@dataclass(frozen=True)
class Released:
    """The three networks of one dataset's files that are read. digests: SHA-256 of the files, by kind."""

    contact: ContactModel
    diffusion: DiffusionModel
    normaliser: Normaliser
    digests: dict[str, str]


def import_released(files: Sequence[Path], out: Path, dataset: Dataset, hands: HandPair) -> list[Path]:
    """Write ``out/contact`` and ``out/diffusion`` from PointNet's, the contact network's and the generator's file.

    dataset: they were trained on, which decides what their numbers mean. hands: MANO's, of mean shape.
    Raises BadInput for files that are cut, of another layout, not all three, or that would run code.
    """
    read = read_released(files, dataset, hands)
    facts: dict[str, Any] = {
        "clips": UNKNOWN,
        "clips_seen": UNKNOWN,
        "datasets": {dataset: UNKNOWN},
        "synthetic": False,
        "hand": hands.name,
        "hand_digest": hands.digest,
        "encoder": {"name": "clip", "normalised": False},
        "contact_threshold_m": 0.02,
        "imported": read.digests,
    }
    written = []
    for name, network, normaliser in (
        ("contact", read.contact, None),
        ("diffusion", read.diffusion, read.normaliser),
    ):
        own = {**facts, "model": name}
        info = {"facts": own, "results": {"contact_threshold": THRESHOLD} if name == "contact" else {}}
        lineage = {"schema": "hoidata.provenance/1", "stage": "import-checkpoint", "stages": {}, **own}
        written.append(save_checkpoint(out / name, name, network, normaliser, {**info, "provenance": lineage}))
    return written


def read_released(files: Sequence[Path], dataset: Dataset, hands: HandPair) -> Released:
    """The networks of three files, in whatever order they are given; errors as in :func:`import_released`."""
    weights, digests = dict[str, Weights](), dict[str, str]()
    for path in files:
        own = read_weights(path)
        kind = next((kind for kind, name in KINDS.items() if name in own), None)
        if kind is None:
            names = ", ".join(sorted(own)[:3])
            raise BadInput(path, f"the weights of {', '.join(KINDS)}", f"layers {names}", "pass Text2HOI's files")
        weights[kind], digests[kind] = own, sha256_file(path)
    if missing := sorted(KINDS.keys() - weights.keys()):
        raise BadInput(
            "the files", f"one each of {', '.join(KINDS)}", f"none of {', '.join(missing)}", "pass all three"
        )
    contact = ContactModel(ContactConfig(encoder_dropout=0.3))
    code = MotionCodeConfig(convention=dataset, finger_mean_rad=_finger_means(dataset, hands))
    diffusion = DiffusionModel(DiffusionConfig(motion=code, hand_head="hand and object", centroid=True, first_code=1))
    found = {"point_net": _point_net(weights["point_net"], ""), "contact": _contact_weights(weights["contact"])}
    _load(contact, found["contact"] | _below(found["point_net"], "object_net."), "the contact network")
    _load(diffusion, _generator(weights["generator"]) | _below(found["point_net"], "object_net."), "the generator")
    return Released(contact.eval(), diffusion.eval(), wrist_normaliser(hands), digests)


def read_weights(path: Path) -> Weights:
    """The weights by name of one file, float32. Raises BadInput for any other structure."""
    if not path.is_file():
        raise BadInput(path, "a checkpoint file of Text2HOI", "no file", "check the path")
    stored = load_torch_zip(path)
    model = stored.get("model") if isinstance(stored, Mapping) else None
    if not isinstance(model, Mapping) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in model.items()
    ):
        raise BadInput(path, "weights by name under 'model'", str(type(stored).__name__), "pass Text2HOI's files")
    # DataParallel, under which some people train, puts a prefix before every name.
    prefix = PARALLEL if all(name.startswith(PARALLEL) for name in model) else ""
    return {
        name.removeprefix(prefix): value.float() if value.is_floating_point() else value
        for name, value in model.items()
    }


def wrist_normaliser(hands: HandPair) -> Normaliser:
    """Numbers as they are, but for wrists: MANO's translation leaves out where the wrist of mean shape lies."""
    nothing = Normaliser.nothing()
    mean = nothing.hand_mean.clone()
    for row, side in enumerate(SIDES):
        mean[row, WRIST] = torch.from_numpy(hands[side].wrist_offset_m(np.zeros((1, 10)))[0]).float()
    return replace(nothing, hand_mean=mean)


def _finger_means(dataset: Dataset, hands: HandPair) -> tuple[float, ...]:
    """ARCTIC's finger poses are offsets from MANO's mean pose: 45 numbers of the left hand, 45 of the right."""
    if dataset != "arctic":
        return ()
    return tuple(float(value) for side in SIDES for value in np.asarray(hands[side].mean_pose).reshape(-1))


def _load(module: nn.Module, weights: Weights, what: str) -> None:
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        said = "; ".join(line.strip() for line in str(error).splitlines()[1:3])[:300]
        raise BadInput(what, "layers of the published sizes", said, "pass Text2HOI's own files") from None


def _below(weights: Weights, prefix: str) -> Weights:
    return {prefix + name: value for name, value in weights.items()}


def _renamed(weights: Weights, old: str, new: str, change: Callable[[Tensor], Tensor] = lambda value: value) -> Weights:
    """The tensors of one layer under another name; none of them may be missing."""
    own = {name: value for name, value in weights.items() if name.rpartition(".")[0] == old}
    if not own:
        raise BadInput("the weights", f"a layer {old}", "none", "pass Text2HOI's own files")
    return {f"{new}.{name.rpartition('.')[2]}": change(value) for name, value in own.items()}


def _dense(weights: Weights, old: str, norm: str, new: str) -> Weights:
    """A convolution with a kernel of 1, or a linear layer, and its batch norm, as a ``PointLayer``."""
    layer = _renamed(weights, old, f"{new}.linear", lambda value: value.squeeze(-1) if value.ndim == 3 else value)
    return layer | _renamed(weights, norm, f"{new}.norm")


def _point_net(weights: Weights, at: str) -> Weights:
    """PointNet with its spatial transformer, of layers whose names begin with ``at``."""
    found: Weights = {}
    for number in range(3):
        found |= _dense(weights, f"{at}stn.conv{number + 1}", f"{at}stn.bn{number + 1}", f"align.points.{number}")
    for number in range(2):
        found |= _dense(weights, f"{at}stn.fc{number + 1}", f"{at}stn.bn{number + 4}", f"align.hidden.{number}")
    found |= _renamed(weights, f"{at}stn.fc3", "align.matrix")
    for number, name in enumerate(("first", "second", "third"), 1):
        found |= _dense(weights, f"{at}conv{number}", f"{at}bn{number}", name)
    return found


def _contact_weights(weights: Weights) -> Weights:
    """Encoder and decoder; the decoder's first layer reads z, scale, global and local features, sentence."""
    found = _below(_point_net(weights, "encoder.feat."), "contact_net.")
    for number in range(2):
        found |= _dense(weights, f"encoder.fc{number + 1}", f"encoder.bn{number + 1}", f"to_latent.{number}")
    found |= _renamed(weights, "encoder.fc3", "to_latent.3")
    first = _renamed(weights, "decoder.MLP.0.0", "first")
    if first["first.weight"].shape[1] != 1665:
        raise BadInput("the contact network", "1665 inputs", str(first["first.weight"].shape[1]), "pass Text2HOI's own")
    z, scale, overall, local, text = first["first.weight"].split([64, 1, 1024, 64, 512], 1)
    found |= {"from_point.weight": local, "from_point.bias": first["first.bias"]}
    found["from_clip.weight"] = torch.cat((overall, scale, text, z), 1)
    for number in range(1, 4):
        found |= _renamed(weights, f"decoder.MLP.{number}.0", f"rest.{2 * number}")
    return found


def _generator(weights: Weights) -> Weights:
    """The denoiser, its channels in our order: first all sines, then all cosines."""
    order = torch.cat((torch.arange(0, WIDTH, 2), torch.arange(1, WIDTH, 2)))
    rows: Callable[[Tensor], Tensor] = lambda value: value[order]  # noqa: E731
    columns: Callable[[Tensor], Tensor] = lambda value: value[:, order] if value.ndim == 2 else value  # noqa: E731
    found: Weights = {}
    for number, side in enumerate(("lhand", "rhand")):
        found |= _renamed(weights, f"init_fc_{side}.fc", f"hands_in.{number}", rows)
        found |= _renamed(weights, f"out_fc_{side}.fc", f"hands_out.{number}", lambda v: _both_halves(v, order))
    found |= _renamed(weights, "init_fc_obj.fc", "object_in", lambda value: _widened(rows(value), 1))
    found |= _renamed(weights, "out_fc_obj.fc", "object_out", lambda value: _widened(columns(value), 0))
    found |= _renamed(weights, "embed_timestep.time_embed.0", "step_in.0", columns)
    found |= _renamed(weights, "embed_timestep.time_embed.2", "step_in.2", rows)
    # The first code, sines of zero and cosines of zero, is added to the condition's token.
    found["step_in.2.bias"] = found["step_in.2.bias"] + torch.cat((torch.zeros(WIDTH // 2), torch.ones(WIDTH // 2)))
    found |= _renamed(weights, "embed_text", "text_in", rows) | _renamed(
        weights, "embed_obj", "object_condition_in", rows
    )
    for number in range(LAYERS):
        found |= _block(weights, f"seqTransEncoder.layers.{number}", f"encoder.blocks.{number}", rows, columns)
    return found


def _block(
    weights: Weights, old: str, new: str, rows: Callable[[Tensor], Tensor], columns: Callable[[Tensor], Tensor]
) -> Weights:
    names = f"{old}.self_attn.in_proj_weight", f"{old}.self_attn.in_proj_bias"
    if not all(name in weights for name in names):
        raise BadInput("the generator", f"a layer {old}", "none", "pass Text2HOI's own files")
    found = {f"{new}.in_proj.weight": columns(weights[names[0]]), f"{new}.in_proj.bias": weights[names[1]]}
    found |= _renamed(weights, f"{old}.self_attn.out_proj", f"{new}.out_proj", rows)
    found |= _renamed(weights, f"{old}.linear1", f"{new}.feed_forward.0", columns)
    found |= _renamed(weights, f"{old}.linear2", f"{new}.feed_forward.3", rows)
    found |= _renamed(weights, f"{old}.norm1", f"{new}.norm_attention", rows)
    return found | _renamed(weights, f"{old}.norm2", f"{new}.norm_feed_forward", rows)


def _both_halves(value: Tensor, order: Tensor) -> Tensor:
    """The columns of a head that reads a hand's and the object's token."""
    return value[:, torch.cat((order, order + WIDTH))] if value.ndim == 2 and value.shape[1] == 2 * WIDTH else value


def _widened(value: Tensor, axis: int) -> Tensor:
    """Nine numbers of an object as ten; a bias has one axis, which only the output has to widen."""
    if value.ndim == 1 and axis == 1:
        return value
    shape = list(value.shape)
    shape[axis] = max(0, 10 - shape[axis])
    return torch.cat((value, value.new_zeros(shape)), axis)
