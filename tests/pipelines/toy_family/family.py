"""The smallest family that learns: it predicts the mean pose of the training clips, one value per feature."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, collate
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.clips.features import HAND_FEATURES, OBJECT_FEATURES
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.common.family import Family, Network, Setup, motion_clip
from models.common.features import proper_hands, proper_object
from models.common.losses import masked_mean


@dataclass(frozen=True)
class ToyConfig:
    """Settings of the network."""

    start: float = 0.1


class ToyNetwork(nn.Module):
    """Parameters for hands (2, 99) and object (10,), the same in all frames of all motions."""

    def __init__(self, config: ToyConfig) -> None:
        super().__init__()
        self.config = config
        self.hands = nn.Parameter(torch.full((2, HAND_FEATURES), config.start))
        self.object = nn.Parameter(torch.full((OBJECT_FEATURES,), config.start))


class ToyObjective:
    """Squared error to the recorded features."""

    frames = entries = 0

    def __init__(self, setup: Setup) -> None:
        self.network, self.setup = ToyNetwork(setup.network).to(setup.device), setup

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> dict[str, Tensor]:
        return {"total": self._error(self.network, batch)}

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        return self._error(network, collate(self.setup.corpus.held_out).to(self.setup.device))

    def _error(self, network: nn.Module, batch: ClipBatch) -> Tensor:
        assert isinstance(network, ToyNetwork)
        hands = masked_mean((batch.hands - network.hands[:, None]).square(), batch.present[..., None])
        return hands + masked_mean((batch.object - network.object).square(), batch.frames[..., None])


@dataclass(frozen=True)
class Toy:
    """A family that answers all requests with the learned pose."""

    checkpoint: Checkpoint

    def sample(self, requests: Sequence[Request]) -> list[Clip]:
        return [self._motion(request) for request in requests]

    def _motion(self, request: Request) -> Clip:
        network = self.checkpoint.network
        assert isinstance(network, ToyNetwork)
        hands = proper_hands(network.hands.detach()[:, None].expand(-1, request.n_frames, -1))
        object_parameters = proper_object(network.object.detach().expand(request.n_frames, -1))
        return motion_clip(request, hands, object_parameters, self.checkpoint.facts["synthetic"])


NETWORK = Network("toy", ToyConfig, ToyNetwork, lambda setup: (ToyObjective(setup), None))
TOY = Family(
    "toy",
    "learnt mean pose",
    lambda sources: Toy(load_checkpoint(sources.checkpoints / "toy", NETWORK, sources.device)),
    networks=(NETWORK,),
    uses=("toy",),
)
