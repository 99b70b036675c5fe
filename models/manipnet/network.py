"""ManipNet's network (Zhang et al. 2021, Sec. 6.2): the next pose and distances from pose, trajectories and sensors.

    a = relu([E0 pose; E1 trajectory; E2 sensors])
    twice:  h = W a + b + a;  r = relu(h);  g = V r + c + r + a;  a = relu(g) before the next block
    output = D g + d

Inputs and outputs are not normalised by the caller: normalisation is part of the network and of its checkpoint.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from models.manipnet.features import FeatureSettings


@dataclass(frozen=True)
class NetworkConfig:
    """Architecture; the defaults are the paper's, with sizes for the 17-joint hand and our features."""

    pose: int = 192  # numbers of each input and of the output
    trajectory: int = 336
    sensors: int = 1822
    output: int = 214
    joints: int = 17  # of the hand
    features: FeatureSettings = field(default_factory=FeatureSettings)
    encoder: int = 512  # width of each of the three encoders
    blocks: int = 2
    keep_probability: float = 0.7  # of dropout, at the input of each linear layer

    @property
    def inputs(self) -> tuple[int, int, int]:
        return self.pose, self.trajectory, self.sensors


class DenseBlock(nn.Module):
    """One residual dense block on activations (..., width): Sec. 6.2, the two equations."""

    def __init__(self, width: int, keep_probability: float) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)
        self.dropout = nn.Dropout(1 - keep_probability)

    def forward(self, a: Tensor) -> Tensor:
        r = torch.relu(self.first(self.dropout(a)) + a)
        return self.second(self.dropout(r)) + r + a


class ManipNet(nn.Module):
    """Inputs (..., pose + trajectory + sensors) to outputs (..., output), without normalisation on both sides."""

    input_mean: Tensor
    input_scale: Tensor
    output_mean: Tensor
    output_scale: Tensor
    low_rad: Tensor  # (joint - 1, 3) joint limits from the training poses, see ``inverse_kinematics.Limits``
    high_rad: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        width = 3 * config.encoder
        self.encoders = nn.ModuleList([nn.Linear(size, config.encoder) for size in config.inputs])
        self.blocks = nn.ModuleList([DenseBlock(width, config.keep_probability) for _ in range(config.blocks)])
        self.decoder = nn.Linear(width, config.output)
        self.dropout = nn.Dropout(1 - config.keep_probability)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
        for name, size in (("input", sum(config.inputs)), ("output", config.output)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        for name, value in (("low_rad", -torch.pi), ("high_rad", torch.pi)):
            self.register_buffer(name, torch.full((config.joints - 1, 3), value))

    def forward(self, inputs: Tensor) -> Tensor:
        return self.normalised(inputs) * self.output_scale + self.output_mean

    def normalised(self, inputs: Tensor) -> Tensor:
        """Normalised outputs, which the loss compares."""
        z = self.dropout((inputs - self.input_mean) / self.input_scale)
        parts = z.split(self.config.inputs, -1)
        a = torch.cat([encoder(part) for encoder, part in zip(self.encoders, parts, strict=True)], -1)
        for block in self.blocks:
            a = block(torch.relu(a))
        return self.decoder(self.dropout(a))

    def learn_normalisation(self, inputs: Tensor, outputs: Tensor, floors: tuple[Tensor, Tensor]) -> None:
        """Set the normalisation from training inputs and outputs; floors: least standard deviation of each number.

        Without a floor, a number that hardly varies in training has very large normalised values at test time.
        """
        for name, values, floor in zip(("input", "output"), (inputs, outputs), floors, strict=True):
            getattr(self, f"{name}_mean").copy_(values.mean(0))
            getattr(self, f"{name}_scale").copy_(torch.maximum(values.std(0, correction=0), floor))
