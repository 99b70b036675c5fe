"""Every path of training, sampling and refining on a device that holds no data; its test runs it in a process apart.

``python -m tests.models.fake_device ANNOTATED CHECKPOINTS`` prints a line of JSON per path: its name, what it raised.
torch's FakeTensorMode knows shape and device of every tensor but no value: a host that waits for one (``float``,
``tolist``, ``nonzero``) and tensors of two devices in one operation are errors there, as they are slow or wrong on a
GPU. So is, within a step of training, a copy for which the host waits (``hoidata.devices.send`` gives others).
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
from hoidata.batches.requests import Request
from hoidata.batches.sight import Sight
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
from models.text2hoi.motion_code import MotionCode, MotionCodeConfig
from models.text2hoi.sampler import NETWORKS, SamplingConfig, Text2Hoi
from pipelines.params import laid_over, read_params
from tests.models.toy import PARAMS, POINT_NET, TRANSFORMER

BACKEND = "nodata"
_setup_privateuseone_for_python_backend(BACKEND)
DEVICE = torch.device(f"{BACKEND}:0")
TO = torch.Tensor.to
IN_STEP = [False]
ROOT = Path(__file__).parents[2]
# The paper's way of everything, at the toy's sizes.
PAPER: dict[str, dict[str, Any]] = {
    "contact": {"point_net": POINT_NET, "decoder_widths": [32, 16, 8]},
    "length": {"width": 16},
    "diffusion": {"transformer": TRANSFORMER},
    "refiner": {"transformer": TRANSFORMER},
}


def on_host(function: Callable) -> Callable:
    """The function with tensors that hold data: clips are read on the host, and their joints are computed there."""

    def call(*arguments: Any) -> Any:
        with unset_fake_temporarily():
            return function(*arguments)

    return call


def moved(module: nn.Module, device: Any) -> nn.Module:
    """``nn.Module.to``, which cannot exchange parameters that hold no data."""
    for part in module.modules():
        for table in (part._parameters, part._buffers):
            for name, old in table.items():
                if old is not None:
                    new = torch.empty(old.shape, dtype=old.dtype, device=device)
                    table[name] = nn.Parameter(new, old.requires_grad) if isinstance(old, nn.Parameter) else new
    return module


def sent(tensor: torch.Tensor, *given: Any, **named: Any) -> torch.Tensor:
    """``Tensor.to`` from the CPU to the device, for which torch would look at small tensors' values."""
    there = any(isinstance(own, torch.device | torch.Tensor) and _device(own) == DEVICE for own in given)
    if not there or tensor.device.type != "cpu" or tensor.requires_grad:
        return TO(tensor, *given, **named)
    if IN_STEP[0] and not named.get("non_blocking"):
        raise RuntimeError("a copy that is waited for")
    dtype = next((own.dtype for own in given if isinstance(own, torch.Tensor)), tensor.dtype)
    return torch.empty(tensor.shape, dtype=dtype, device=DEVICE)


def _device(own: torch.device | torch.Tensor) -> torch.device:
    return own.device if isinstance(own, torch.Tensor) else own


def paths(root: Path, checkpoints: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Name and work of every path."""
    annotated = load_annotated(root)
    corpus = Corpus.of(annotated, 0)
    stored = {network.name: load_checkpoint(checkpoints / network.name, network) for network in NETWORKS}
    for preset in ("paper", "ours"):
        for network in NETWORKS:
            yield f"train {network.name} {preset}", lambda n=network, p=preset: trained(n, p, corpus, stored)
    requests = [own for sample in corpus.train for own in requests_for(sample, PredictionConfig(1))]
    for kind in ("ddim", "ddpm", "dpm++"):
        for guidance in (1.0, 2.0):
            name = f"sample and refine by {kind}, guidance {guidance:g}"
            config = SamplerConfig(kind, 3, guidance)
            yield name, lambda c=config: sampled(stored, c, requests)
    yield "generate rows of ours", rows_of_ours
    yield "sample lengths", lambda: lengths(stored, requests)


def on_device(stored: dict[str, Checkpoint]) -> dict[str, Checkpoint]:
    """Networks as ``load_checkpoint`` gives them there; files cannot be read where tensors hold no data."""
    made = {network.name: network.build(stored[network.name].network.config) for network in NETWORKS}
    return {
        name: Checkpoint(
            made[name].to(DEVICE).eval().requires_grad_(False), own.normaliser and own.normaliser.to(DEVICE), own.info
        )
        for name, own in stored.items()
    }


def trained(network: Network, preset: str, corpus: Corpus, stored: dict[str, Checkpoint]) -> None:
    """An objective, the losses of a batch, their gradients, a step of the optimiser, and the validation loss."""
    given, loss = PAPER[network.name], {}
    if preset == "ours":  # all of its switches, at the toy's sizes
        ours = read_params(ROOT)["train"]["ours"][network.name]
        given, loss = laid_over(ours.get("network", {}), PARAMS[network.name]["network"]), ours.get("loss", {})
    config = build_config(network.config, given, network.name)
    if network.name == "refiner":
        # A clip whose contact is exchanged is chosen by a value, on the host, once before the first step.
        loss = {**loss, "samples": 2, "sampler_steps": 2, "field_resolution": 16, "exchanged": False}
    weights = build_config(network.loss, loss, network.name) if network.loss else None
    hands = Hands(load_embedded_hands())
    objective, _ = network.objective(Setup(config, weights, 0, corpus, hands, DEVICE, on_device(stored)))
    clips = list(corpus.train)
    sight = Sight.drawn([c.length for c in clips], objective.frames, objective.entries, np.random.default_rng(0))
    optimiser = torch.optim.AdamW([weight for weight in objective.network.parameters() if weight.requires_grad])
    with step():
        batch = collate(clips, sight if objective.frames else None).to(DEVICE)
        found = objective.losses(batch, torch.Generator().manual_seed(0))
        assert all(value.device == DEVICE for value in found.values())
        found["total"].backward()
        optimiser.step()
    assert objective.validation(objective.network.eval()).device == DEVICE


@contextmanager
def step() -> Iterator[None]:
    """Inside, a copy that is waited for is an error."""
    IN_STEP[0] = True
    try:
        yield
    finally:
        IN_STEP[0] = False


def copied() -> None:
    """A copy that is waited for, in a step."""
    with step():
        torch.zeros(2).to(DEVICE)


def sampled(stored: dict[str, Checkpoint], sampler: SamplerConfig, requests: list[Request]) -> None:
    pair = load_embedded_hands()
    config = SamplingConfig(sampler, 16, "network")
    made = Text2Hoi(on_device(stored), Hands(pair), config, DEVICE, pair).motions(requests)
    assert len(made) == len(requests)
    assert made[0].refined.shape == (2, requests[0].n_frames, 99)


def rows_of_ours() -> None:
    """What comes out of the sampler, at rest and as features in the world; no copy in it is waited for."""
    motion = read_params(ROOT)["train"]["ours"]["diffusion"]["network"]["motion"]
    code, counts = MotionCode(build_config(MotionCodeConfig, motion, "motion")), [24, 40]
    of_hand, of_object = code.sizes(max(counts))
    hands = torch.zeros(2, 2, of_hand, 99, device=DEVICE)
    objects = torch.zeros(2, of_object, code.object_features, device=DEVICE)
    points_m, part = torch.zeros(2, 16, 3, device=DEVICE), torch.zeros(2, 16, dtype=torch.uint8, device=DEVICE)
    with step():
        hands, objects = code.curves(*code.settled(hands, objects, counts), counts)
        objects_at_origin = code.at_origin(objects, points_m, part)
        hands, objects = recentred(code.in_world(hands, objects), objects_at_origin)
    assert (hands.shape, objects.shape) == ((2, 2, 40, 99), (2, 40, 10))


def lengths(stored: dict[str, Checkpoint], requests: list[Request]) -> None:
    network = on_device(stored)["length"].network
    text = torch.stack([torch.from_numpy(own.text) for own in requests]).to(DEVICE)
    hands = torch.stack([torch.from_numpy(own.active_hands) for own in requests]).to(DEVICE)
    found = network.sample(text, hands, torch.Generator().manual_seed(0))  # pyright: ignore[reportCallIssue]
    assert found.device == DEVICE


def main() -> None:
    setattr(nn.Module, "to", moved)  # noqa: B010 (pyright knows it as a method)
    setattr(torch.Tensor, "to", sent)  # noqa: B010
    setattr(Store, "joints", on_host(Store.joints))  # noqa: B010
    # Read from the clips' values, on the host, once before the first step.
    setattr(Normaliser, "of", lambda clips: Normaliser.nothing(clips[0][1].shape[-1]))  # noqa: B010
    every = [("a value that is waited for", lambda: float(torch.zeros((), device=DEVICE))),
             ("a copy that is waited for", copied),
             ("tensors of two devices", lambda: torch.zeros(2, device=DEVICE) + torch.zeros(2))]  # fmt: skip
    every += paths(*map(Path, sys.argv[1:]))
    for name, work in every:
        said = ""
        try:
            with FakeTensorMode(allow_non_fake_inputs=True):
                work()
        except Exception as error:
            said = f"{type(error).__name__}: {str(error)[:200]} at {where(error)}"
        print(json.dumps([name, said]), flush=True)


def where(error: BaseException) -> str:
    """The last line of the product that was run."""
    trace, found = error.__traceback__, ""
    while trace:
        file = trace.tb_frame.f_code.co_filename
        if "/models/" in file or "/hoidata/" in file:
            found = f"{Path(file).name}:{trace.tb_lineno}"
        trace = trace.tb_next
    return found


if __name__ == "__main__":
    main()
