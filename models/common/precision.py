"""Half the bits where the time is: Transformers and point networks in bfloat16, geometry and losses in float32."""

from typing import Any, Literal

import torch
from torch import Tensor, nn

from models.common.point_net import PointNet
from models.common.transformer import Encoder

Precision = Literal["float32", "bfloat16"]


def compute_in_bfloat16(network: nn.Module) -> None:
    """From now on these parts of ``network`` compute in bfloat16 (autocast: weights stay float32) and give float32."""
    for module in network.modules():
        if isinstance(module, Encoder | PointNet):
            setattr(module, "forward", _lowered(module.forward))  # noqa: B010 (pyright knows forward as a method)


def _lowered(forward: Any) -> Any:
    def lowered(x: Tensor, *given: Any) -> Any:
        with torch.autocast(x.device.type, torch.bfloat16):
            found = forward(x, *given)
        return found.float() if isinstance(found, Tensor) else tuple(own.float() for own in found)

    return lowered
