"""Evaluator networks: one class whose configuration selects the trunk and its input.

``planar`` is the classifier of IMoS (Ghosh et al. 2023) that Text2HOI uses: a two-layer LSTM for each of two planar
views of the joints. ``recurrent`` reads the object as well. With ``text`` the outputs are a feature space shared with
sentences.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence

from hoidata.metrics.paths import JOINTS
from models.common.features import scaled_text
from models.evaluator.inputs import CORRECTED_SIZE, FAR_M, OBJECT

PLANES = ((0, 1), (0, 2))  # of x, y, z
PLANAR_SCALE = 0.1


@dataclass(frozen=True)
class EncoderConfig:
    """Sizes of an evaluator network."""

    trunk: Literal["planar", "recurrent"]  # input and layers
    outputs: int  # number of labels, or size of the space shared with text
    features: int  # size of the feature of a motion
    width: int = 64  # of hidden layers
    text: int = 0  # size of sentence features, 0 for a classifier


class PlanarTrunk(nn.Module):
    """Maps (B, 15, 126) joints to the (B, 128) sum of both views, and to its tanh times 0.1 as the feature."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        views = [nn.LSTM(2 * JOINTS, config.features, num_layers=2, batch_first=True) for _ in PLANES]
        self.views = nn.ModuleList(views)
        self.mixers = nn.ModuleList([nn.Conv1d(1, 1, 3, padding=1) for _ in PLANES])

    def forward(self, motion: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        del lengths  # always 15
        joints = motion.unflatten(-1, (JOINTS, 3))
        total = torch.zeros(())
        for plane, view, mixer in zip(PLANES, self.views, self.mixers, strict=True):
            last = view(joints[..., plane].flatten(-2))[0][:, -1]
            total = total + mixer(last[:, None])[:, 0]
        return total, PLANAR_SCALE * total.tanh()


class RecurrentTrunk(nn.Module):
    """Bidirectional GRU over (B, T, 179) steps with (B,) lengths to (B, F) features; padding is ignored."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.scale: Tensor
        self.register_buffer("scale", _scale(), persistent=False)
        self.first = nn.Linear(CORRECTED_SIZE, config.width)
        self.steps = nn.GRU(config.width, config.width, batch_first=True, bidirectional=True)
        self.last = nn.Linear(2 * config.width, config.features)

    def forward(self, motion: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        steps = self.first(motion * self.scale)
        packed = pack_padded_sequence(steps, lengths.cpu(), batch_first=True, enforce_sorted=False)
        _, ends = self.steps(packed)
        feature = self.last(ends.transpose(0, 1).flatten(1)).tanh()
        return feature, feature


TRUNKS = {"planar": PlanarTrunk, "recurrent": RecurrentTrunk}


class MotionEncoder(nn.Module):
    """Encodes motions (B, T, size) of (B,) steps to features and logits, and sentences to the space of the logits."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.trunk = TRUNKS[config.trunk](config)
        self.head = nn.Linear(config.features, config.outputs)
        self.text = nn.Linear(config.text, config.outputs) if config.text else None
        self.log_scale = nn.Parameter(torch.tensor(1 / 0.07).log()) if config.text else None

    def forward(self, motion: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        inner, feature = self.trunk(motion, lengths)
        return feature, self.head(inner)

    def of_text(self, text: Tensor) -> Tensor:
        """Unit vectors (B, outputs) of sentence features (B, text)."""
        assert self.text is not None
        return nn.functional.normalize(self.text(scaled_text(text)), dim=-1)


def rotated(motion: Tensor, angle: Tensor) -> Tensor:
    """Rotate motions (B, T, 179) about the vertical by (B,) radians; hinge, heading and distances do not change."""
    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    rows = (torch.stack(entries, -1) for entries in ((cos, -sin, zero), (sin, cos, zero), (zero, zero, zero + 1)))
    rotation = torch.stack(list(rows), -2)[:, None]
    spatial, unchanged = motion[..., : OBJECT.start + 3], motion[..., OBJECT.start + 9 :]
    columns = motion[..., OBJECT.start + 3 : OBJECT.start + 9].unflatten(-1, (3, 2))
    points = spatial.unflatten(-1, (-1, 3)) @ rotation.transpose(-1, -2)
    return torch.cat((points.flatten(-2), (rotation @ columns).flatten(-2), unchanged), -1)


def _scale() -> Tensor:
    """(179,) input scale that brings positions and distances to the order of one."""
    scale = np.ones(CORRECTED_SIZE, np.float32)
    scale[: OBJECT.start + 3] = 1 / FAR_M
    scale[OBJECT.stop :] = 1 / FAR_M
    return torch.from_numpy(scale)
