"""Motions as one vector of 208 normalised features per frame, with the objective and sampler that use them.

Layout: left hand 99, right hand 99, object 10 (``hoidata.clips.features``), in the model frame. The baselines MDM, IMoS
and T2M generate such vectors from the sentence, as Text2HOI adapted them: they see neither object nor contact map.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch
from hoidata.batches.requests import Request, RequestBatch, bucket_by_length, collate_requests
from hoidata.clips.clip import Clip
from hoidata.clips.features import HAND_FEATURES, OBJECT_FEATURES
from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus
from models.common.family import ClipObjective, Losses, Network, Setup, motion_clip
from models.common.features import Normaliser, proper_hands, proper_object, recentred
from models.common.sampling import Motion

MOTION_FEATURES = 2 * HAND_FEATURES + OBJECT_FEATURES


def joined(hands: Tensor, objects: Tensor) -> Tensor:
    """Vectors (B, F, 208) of hands (B, 2, F, 99) and objects (B, F, 10)."""
    return torch.cat((hands[:, 0], hands[:, 1], objects), -1)


def separated(motion: Tensor) -> Motion:
    """The inverse of ``joined``."""
    left, right, objects = motion.split((HAND_FEATURES, HAND_FEATURES, OBJECT_FEATURES), -1)
    return torch.stack((left, right), 1), objects


def feature_mask(hand_frames: Tensor, frames: Tensor) -> Tensor:
    """(B, F, 208) bool: features of the hands in ``hand_frames`` (B, 2, F), and of the object in ``frames`` (B, F)."""
    hands = hand_frames[..., None].expand(-1, -1, -1, HAND_FEATURES)
    return joined(hands, frames[..., None].expand(-1, -1, OBJECT_FEATURES))


@dataclass(frozen=True)
class RecordedVectors:
    """Recorded clips of a batch as vectors."""

    motion: Tensor  # (B, F, 208) normalised; 0 where not visible
    visible: Tensor  # (B, F, 208) bool: active hands and object in the frames of the clip; networks see nothing else
    mask: Tensor  # (B, F, 208) bool: visible and tracked, so that losses may count it

    @classmethod
    def of(cls, batch: ClipBatch, normaliser: Normaliser) -> "RecordedVectors":
        visible = feature_mask(batch.hand_frames, batch.frames)
        motion = joined(*normaliser.encode(batch.hands, batch.object))
        return cls(motion * visible, visible, feature_mask(batch.present, batch.frames))


def vector_normaliser(corpus: Corpus) -> Normaliser:
    """Mean and deviation of the training clips' features; untracked frames and inactive hands are skipped."""
    clips = []
    for sample in corpus.train:
        present = torch.from_numpy(sample.valid & sample.active_hands[:, None])
        clips.append((torch.from_numpy(sample.hands), torch.from_numpy(sample.object), present))
    return Normaliser.of(clips)


class VectorObjective(ClipObjective):
    """Objective of a network of motion vectors; subclasses define ``terms``."""

    def __init__(self, network: nn.Module, setup: Setup, normaliser: Normaliser) -> None:
        super().__init__(network.to(setup.device), setup.corpus, setup.device)
        self.normaliser = normaliser.to(setup.device)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        return self.terms(self.network, batch, generator)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        return self.terms(network, self.held_out, torch.Generator().manual_seed(0))["total"]

    def terms(self, network: nn.Module, batch: ClipBatch, generator: torch.Generator) -> Losses:
        """Loss terms of a batch; "total" is minimised."""
        raise NotImplementedError


def vector_network(
    name: str, config: type, build: Callable[[Any], nn.Module], objective: type[VectorObjective]
) -> Network:
    """A network of motion vectors, trained by ``objective`` with the statistics of the training clips."""

    def start(setup: Setup) -> tuple[VectorObjective, Normaliser]:
        chosen = objective(build(setup.network), setup, vector_normaliser(setup.corpus))
        return chosen, chosen.normaliser

    return Network(name, config, build=build, objective=start)


@dataclass(frozen=True)
class VectorSampler:
    """Answers requests with the motions of a network of motion vectors; subclasses define ``generate``."""

    checkpoint: Checkpoint
    device: torch.device

    @torch.no_grad()
    def sample(self, requests: Sequence[Request]) -> list[Clip]:
        answers = dict[int, Clip]()
        for numbers in bucket_by_length(requests):
            chosen = [requests[number] for number in numbers]
            generators = [torch.Generator().manual_seed(request.seed) for request in chosen]
            hands, objects = separated(self.generate(chosen, collate_requests(chosen).to(self.device), generators))
            hands, objects = recentred(proper_hands(hands), proper_object(objects))
            for index, number in enumerate(numbers):
                motion = hands[index], objects[index]
                answers[number] = motion_clip(requests[number], *motion, self.checkpoint.facts["synthetic"])
        return [answers[number] for number in range(len(requests))]

    def generate(self, requests: Sequence[Request], batch: RequestBatch, generators: list[torch.Generator]) -> Tensor:
        """Motions (B, F, 208) in metres, in the model frame, with one generator per request."""
        raise NotImplementedError

    def decoded(self, motion: Tensor) -> Tensor:
        """Vectors (B, F, 208) without the normalisation."""
        assert self.checkpoint.normaliser is not None
        return joined(*self.checkpoint.normaliser.decode(*separated(motion)))
