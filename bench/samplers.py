"""CPU time of one Text2HOI motion: strided samplers, and tokens without padding.

``python -m bench samplers``. The baseline is ``nn.TransformerEncoder`` of the same size over all 451 tokens with a
mask. Its 1,000 calls are extrapolated from a few. Weights are random.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor, nn

from bench.harness import medians, show
from hoidata.batches.requests import ObjectPoints, Request, collate_requests
from hoidata.objects.model import ObjectModel
from hoidata.settings import build_config
from models.common.sampling import Motion, SamplerConfig, sample_motion
from models.common.transformer import TransformerConfig
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel
from pipelines.params import load_yaml

FRAMES, STOCK_STEPS, RUNS = 150, 1000, 3


def main() -> None:
    torch.manual_seed(0)
    size = TransformerConfig()
    model, stock = DiffusionModel(DiffusionConfig(size)).eval(), stock_encoder(size)
    calls: dict[str, Callable[[], object]] = {
        "both hands, 150 frames": one_call(model, (True, True), FRAMES),
        "one hand, 60 frames": one_call(model, (False, True), 60),
        "stock encoder, 451 tokens masked": stock_call(stock, size, 60),
    }
    with torch.no_grad():
        times = medians(calls, RUNS)
        full_s = times["both hands, 150 frames"].processor
        rows = [
            [name, f"{timing.processor * 1e3:.0f}", f"{timing.processor / full_s:.2f}"]
            for name, timing in times.items()
        ]
        show("One call of the denoiser, one motion", ["call", "processor ms", "relative to the first"], rows)
        stock_s = times["stock encoder, 451 tokens masked"].processor * STOCK_STEPS
        rows = [["stock encoder, 1,000 masked steps (scaled)", f"{stock_s:.1f}", "1"]]
        ours = DiffusionModel(ours_config()).eval()
        for name, network, kind, steps in (
            ("paper, ddim", model, "ddim", 50),
            ("paper, dpm++", model, "dpm++", 20),
            ("ours, ddim", ours, "ddim", 20),
        ):
            seconds = motion_s(network, SamplerConfig(kind, steps))
            rows.append([f"{name}, {steps} steps", f"{seconds:.2f}", f"{stock_s / seconds:.0f}"])
        show("One motion of 150 frames and both hands", ["preset and sampler", "processor s", "speed-up"], rows)


def ours_config() -> DiffusionConfig:
    """The settings of the preset `ours` in params.yaml."""
    changes = load_yaml(Path("params.yaml").read_bytes())["train"]["ours"]["diffusion"]["network"]
    return build_config(DiffusionConfig, changes, "params.yaml: train.ours.diffusion.network")


def stock_encoder(size: TransformerConfig) -> nn.TransformerEncoder:
    layer = nn.TransformerEncoderLayer(
        d_model=size.width,
        nhead=size.heads,
        dim_feedforward=size.feed_forward,
        dropout=0.0,
        activation="gelu",
        batch_first=True,
    )
    return nn.TransformerEncoder(layer, size.layers, enable_nested_tensor=False).eval()


def stock_call(stock: nn.TransformerEncoder, size: TransformerConfig, n_frames: int) -> Callable[[], object]:
    """All tokens of 150 frames and three agents; those that a motion of one hand does not use are masked."""
    tokens, mask = torch.randn(1, 1 + 3 * FRAMES, size.width), torch.zeros(1, 1 + 3 * FRAMES, dtype=torch.bool)
    mask[:, 1 + 3 * n_frames :] = True
    return lambda: stock(tokens, src_key_padding_mask=mask)


def condition(active: tuple[bool, bool], frames: int) -> Condition:
    mesh, random = trimesh.creation.box((0.1, 0.1, 0.1)), np.random.default_rng(0)
    model = ObjectModel("box", np.asarray(mesh.vertices), np.asarray(mesh.faces), np.zeros(8, np.uint8))
    points_m, normals = random.normal(0, 0.05, (2, 1024, 3)).astype(np.float32)
    points = ObjectPoints(points_m, normals, np.zeros(1024, np.uint8))
    text = random.normal(size=512).astype(np.float32)
    batch = collate_requests([Request("box", model, points, text, np.array(active), frames)])
    return Condition(batch, batch.text, [None], torch.zeros(1, 2, 1024))


def one_call(model: DiffusionModel, active: tuple[bool, bool], frames: int) -> Callable[[], tuple[Tensor, Tensor]]:
    encoded = model.encode_condition(condition(active, frames))
    hands, objects, steps = torch.randn(1, 2, frames, 99), torch.randn(1, frames, 10), torch.full((1,), 500)
    return lambda: model.denoise(hands, objects, steps, encoded)


def motion_s(model: DiffusionModel, config: SamplerConfig) -> float:
    """Processor seconds of the denoising of one motion from fixed noise."""
    generator, (hand_points, object_points) = torch.Generator().manual_seed(0), model.representation.sizes(FRAMES)
    shapes = (1, 2, hand_points, 99), (1, object_points, model.representation.object_features)

    def draw() -> Motion:
        return torch.randn(shapes[0], generator=generator), torch.randn(shapes[1], generator=generator)

    start = time.process_time()
    encoded = model.encode_condition(condition((True, True), FRAMES))
    sample_motion(lambda *inputs: model.denoise(*inputs, encoded), draw, config)
    return time.process_time() - start
