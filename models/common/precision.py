"""Mixed precision: Transformers and point networks in 16 bits, geometry and losses in float32."""

from typing import Any, Literal

import torch
from torch import Tensor, nn

from models.common.point_net import PointNet
from models.common.transformer import Encoder

Precision = Literal["float32", "bfloat16"]


def compute_in(network: nn.Module, precision: Precision) -> None:
    """Make these parts of ``network`` compute in ``precision`` (autocast). Weights and outputs stay float32."""
    if precision == "float32":
        return
    for module in network.modules():
        if isinstance(module, Encoder | PointNet):
            lowered = _lowered(module.forward, getattr(torch, precision))
            setattr(module, "forward", lowered)  # noqa: B010 (pyright knows forward as a method)


def _lowered(forward: Any, dtype: torch.dtype) -> Any:
    def lowered(x: Tensor, *arguments: Any) -> Any:
        with torch.autocast(x.device.type, dtype):
            outputs = forward(x, *arguments)
        return outputs.float() if isinstance(outputs, Tensor) else tuple(output.float() for output in outputs)

    return lowered
