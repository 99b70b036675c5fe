"""Runs training, sampling and refinement on a fake device without data; its test runs this in a separate process.

``python -m tests.models.fake_device ANNOTATED CHECKPOINTS`` prints one line of JSON per path: its name, and its error.
torch's FakeTensorMode tracks shape and device of every tensor but no values. An operation that reads a value on the
host (``float``, ``tolist``, ``nonzero``) or mixes two devices is an error; on a GPU it would be slow or wrong. Within a
training step, a blocking copy is an error as well (``hoidata.devices.send`` makes non-blocking ones).
"""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode, unset_fake_temporarily
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from hoidata.batches.dataset import collate
from hoidata.batches.frame_selection import FrameSelection
from hoidata.batches.requests import Request, collate_requests
from hoidata.hands import load_embedded_hands
from hoidata.settings import build_config
from hoidata.store.annotated import load_annotated
from hoidata.store.store import Store
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.common.corpus import Corpus
from models.common.family import Network, Setup
from models.common.features import Hands, Normaliser, recentred
from models.common.predicting import PredictionConfig, requests_for
from models.common.sampling import SamplerConfig
from models.text2hoi.motion_representation import MotionRepresentation, MotionRepresentationConfig
from models.text2hoi.sampler import NETWORKS, SamplingConfig, Text2Hoi
from pipelines.params import merge_settings, read_params
from tests.models.toy import PAPER, PARAMS

BACKEND = "nodata"
_setup_privateuseone_for_python_backend(BACKEND)
DEVICE = torch.device(f"{BACKEND}:0")
TO = torch.Tensor.to
IN_STEP = [False]
ROOT = Path(__file__).parents[2]


def on_host(function: Callable) -> Callable:
    """The function outside of FakeTensorMode: clips are read, and their joints computed, on the host."""

    def call(*arguments: Any) -> Any:
        with unset_fake_temporarily():
            return function(*arguments)

    return call


def moved(module: nn.Module, device: Any) -> nn.Module:
    """``nn.Module.to`` for parameters without data."""
    for part in module.modules():
        for table in (part._parameters, part._buffers):
            for name, old in table.items():
                if old is not None:
                    new = torch.empty(old.shape, dtype=old.dtype, device=device)
                    table[name] = nn.Parameter(new, old.requires_grad) if isinstance(old, nn.Parameter) else new
    return module


def sent(tensor: torch.Tensor, *arguments: Any, **options: Any) -> torch.Tensor:
    """``Tensor.to`` from the CPU to the device; torch would read the values of small tensors."""
    to_device = any(
        isinstance(argument, torch.device | torch.Tensor) and _device(argument) == DEVICE for argument in arguments
    )
    if not to_device or tensor.device.type != "cpu" or tensor.requires_grad:
        return TO(tensor, *arguments, **options)
    if IN_STEP[0] and not options.get("non_blocking"):
        raise RuntimeError("a blocking copy")
    dtype = next((argument.dtype for argument in arguments if isinstance(argument, torch.Tensor)), tensor.dtype)
    return torch.empty(tensor.shape, dtype=dtype, device=DEVICE)


def _device(target: torch.device | torch.Tensor) -> torch.device:
    return target.device if isinstance(target, torch.Tensor) else target


def paths(root: Path, checkpoints: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Name and function of every path."""
    annotated = load_annotated(root)
    corpus = Corpus.of(annotated, 0)
    stored = {network.name: load_checkpoint(checkpoints / network.name, network) for network in NETWORKS}
    for preset in ("paper", "ours"):
        for network in NETWORKS:
            yield f"train {network.name} {preset}", lambda n=network, p=preset: trained(n, p, corpus, stored)
    requests = [request for sample in corpus.train for request in requests_for(sample, PredictionConfig(1))]
    for kind in ("ddim", "ddpm", "dpm++"):
        config = SamplerConfig(kind, 3)
        yield f"sample and refine by {kind}", lambda c=config: sampled(stored, c, requests)
    yield "decode control points of ours", control_points_of_ours
    yield "sample lengths", lambda: lengths(stored, requests)


def on_device(stored: dict[str, Checkpoint]) -> dict[str, Checkpoint]:
    """Networks as ``load_checkpoint`` returns them; files cannot be read into tensors without data."""
    modules = {network.name: network.build(stored[network.name].network.config) for network in NETWORKS}
    return {
        name: Checkpoint(
            modules[name].to(DEVICE).eval().requires_grad_(False),
            checkpoint.normaliser and checkpoint.normaliser.to(DEVICE),
            checkpoint.info,
        )
        for name, checkpoint in stored.items()
    }


def trained(network: Network, preset: str, corpus: Corpus, stored: dict[str, Checkpoint]) -> None:
    """An objective, the losses of a batch, their gradients, a step of the optimiser, and the validation loss."""
    network_settings, loss_settings = PAPER[network.name]["network"], {}
    if preset == "ours":  # all its settings, at the toy's sizes
        ours = read_params(ROOT)["train"]["ours"][network.name]
        network_settings, loss_settings = (
            merge_settings(ours.get("network", {}), PARAMS[network.name]["network"]),
            ours.get("loss", {}),
        )
    # Objects are scaled on the host.
    loss_settings = {name: value for name, value in loss_settings.items() if name != "max_scaling"}
    config = build_config(network.config, network_settings, network.name)
    weights = build_config(network.loss, loss_settings, network.name) if network.loss else None
    hands = Hands(load_embedded_hands())
    setup = Setup(
        network=config,
        loss=weights,
        seed=0,
        corpus=corpus,
        hands=hands,
        device=DEVICE,
        trained=on_device(stored),
    )
    objective, _ = network.objective(setup)
    clips = list(corpus.train)
    sight = FrameSelection.drawn(
        [c.length for c in clips], objective.frames, objective.entries, np.random.default_rng(0)
    )
    optimiser = torch.optim.AdamW([weight for weight in objective.network.parameters() if weight.requires_grad])
    with step():
        batch = collate(clips, sight if objective.frames else None).to(DEVICE)
        terms = objective.losses(batch, torch.Generator().manual_seed(0))
        assert all(value.device == DEVICE for value in terms.values())
        terms["total"].backward()
        optimiser.step()
    assert objective.validation(objective.network.eval()).device == DEVICE


@contextmanager
def step() -> Iterator[None]:
    """Context in which a blocking copy is an error."""
    IN_STEP[0] = True
    try:
        yield
    finally:
        IN_STEP[0] = False


def copied() -> None:
    """A blocking copy in a step."""
    with step():
        torch.zeros(2).to(DEVICE)


def sampled(stored: dict[str, Checkpoint], sampler: SamplerConfig, requests: list[Request]) -> None:
    pair = load_embedded_hands()
    model = Text2Hoi(on_device(stored), Hands(pair), SamplingConfig(sampler), device=DEVICE, pair=pair)
    batch, generators = collate_requests(requests).to(DEVICE), [torch.Generator().manual_seed(0) for _ in requests]
    contact = model.sample_contact(batch, generators)
    hands, objects = model.denoise(batch, [None] * len(requests), contact, generators)
    surface = model.surface(requests)
    assert model.refine(batch, hands, objects, contact, surface, generators).shape == hands.shape


def control_points_of_ours() -> None:
    """Decode the sampler's output to features in the world, without a blocking copy."""
    motion = read_params(ROOT)["train"]["ours"]["diffusion"]["network"]["motion"]
    representation, counts = MotionRepresentation(build_config(MotionRepresentationConfig, motion, "motion")), [24, 40]
    hand_points, object_points = representation.sizes(max(counts))
    hands = torch.zeros(2, 2, hand_points, 99, device=DEVICE)
    objects = torch.zeros(2, object_points, representation.object_features, device=DEVICE)
    points_m, part = torch.zeros(2, 16, 3, device=DEVICE), torch.zeros(2, 16, dtype=torch.uint8, device=DEVICE)
    with step():
        hands, objects = representation.features_per_frame(hands, objects, counts)
        objects_at_origin = representation.at_origin(objects, points_m, part)
        hands, objects = recentred(representation.in_world(hands, objects), objects_at_origin)
    assert (hands.shape, objects.shape) == ((2, 2, 40, 99), (2, 40, 10))


def lengths(stored: dict[str, Checkpoint], requests: list[Request]) -> None:
    network = on_device(stored)["length"].network
    text = torch.stack([torch.from_numpy(request.text) for request in requests]).to(DEVICE)
    frames = network.sample(text, ["lift"] * len(text), torch.Generator().manual_seed(0))  # pyright: ignore[reportCallIssue]
    assert frames.device == DEVICE


def main() -> None:
    setattr(nn.Module, "to", moved)  # noqa: B010 (pyright: a method)
    setattr(torch.Tensor, "to", sent)  # noqa: B010
    setattr(Store, "joints", on_host(Store.joints))  # noqa: B010
    # The normaliser reads values on the host, once before the first step.
    setattr(Normaliser, "of", lambda clips: Normaliser.identity(clips[0][1].shape[-1]))  # noqa: B010
    all_paths = [("a value read on the host", lambda: float(torch.zeros((), device=DEVICE))),
             ("a blocking copy", copied),
             ("tensors of two devices", lambda: torch.zeros(2, device=DEVICE) + torch.zeros(2))]  # fmt: skip
    all_paths += paths(*map(Path, sys.argv[1:]))
    for name, work in all_paths:
        message = ""
        try:
            with FakeTensorMode(allow_non_fake_inputs=True):
                work()
        except Exception as error:
            message = f"{type(error).__name__}: {str(error)[:200]} at {last_line(error)}"
        print(json.dumps([name, message]), flush=True)


def last_line(error: BaseException) -> str:
    """The last line of product code in the traceback."""
    trace, line = error.__traceback__, ""
    while trace:
        file = trace.tb_frame.f_code.co_filename
        if "/models/" in file or "/hoidata/" in file:
            line = f"{Path(file).name}:{trace.tb_lineno}"
        trace = trace.tb_next
    return line


if __name__ == "__main__":
    main()
