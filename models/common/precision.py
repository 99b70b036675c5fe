"""Half the bits where the time is: Transformers and point networks in 16 bits, geometry and losses in float32."""

from typing import Any, Literal

import torch
from torch import Tensor, nn

from models.common.point_net import PointNet
from models.common.transformer import Encoder

Precision = Literal["float32", "bfloat16"]
# float16 rounds to an eighth of what bfloat16 does; gradients would need scaling there, so it is for sampling alone.
SamplingPrecision = Literal["float32", "bfloat16", "float16"]


def compute_in(network: nn.Module, precision: SamplingPrecision) -> None:
    """From now on these parts of ``network`` compute in ``precision`` (autocast) and give float32, as weights stay."""
    if precision == "float32":
        return
    for module in network.modules():
        if isinstance(module, Encoder | PointNet):
            lowered = _lowered(module.forward, getattr(torch, precision))
            setattr(module, "forward", lowered)  # noqa: B010 (pyright knows forward as a method)


def _lowered(forward: Any, dtype: torch.dtype) -> Any:
    def lowered(x: Tensor, *given: Any) -> Any:
        with torch.autocast(x.device.type, dtype):
            found = forward(x, *given)
        return found.float() if isinstance(found, Tensor) else tuple(own.float() for own in found)

    return lowered
