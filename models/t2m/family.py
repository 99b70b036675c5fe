"""T2M (Guo et al., Generating Diverse and Natural 3D Human Motions from Text, 2022) for two hands and an object."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import Request, RequestBatch
from hoidata.clips.clip import Clip
from hoidata.devices import send
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.common.family import Family, Sources
from models.common.motion_vectors import VectorSampler
from models.t2m.generator import GENERATOR, T2mNetwork
from models.t2m.movement import LENGTH, MAX_SNIPPETS, MOVEMENT, SNIPPET_FRAMES, snippet_counts, snippet_mask


@dataclass(frozen=True)
class T2m(VectorSampler):
    """T2M as a sampler."""

    length: Checkpoint | None = None  # None: motions have the length of the recorded clip

    def sample(self, requests: Sequence[Request]) -> list[Clip]:
        return super().sample([self.with_length(one, self.length) if self.length else one for one in requests])

    @torch.no_grad()
    def with_length(self, request: Request, length: Checkpoint) -> Request:
        """The request with a length sampled by the length network, in whole snippets."""
        logits = length.network(torch.from_numpy(request.text)[None].to(self.device)).cpu()
        generator = torch.Generator().manual_seed(request.seed)
        snippets = int(torch.multinomial(logits[0].softmax(-1), 1, generator=generator)) + 1
        return replace(request, n_frames=min(snippets * SNIPPET_FRAMES, MAX_FRAMES))

    def generate(self, requests: Sequence[Request], batch: RequestBatch, generators: list[torch.Generator]) -> Tensor:
        network, counts = self.checkpoint.network, snippet_counts(batch.lengths)
        assert isinstance(network, T2mNetwork)
        noise = [torch.randn(MAX_SNIPPETS, network.config.latent, generator=generator) for generator in generators]
        noise = send(torch.stack(noise)[:, : -(-max(batch.counts) // SNIPPET_FRAMES)], self.device)
        sentences = [request.sentence.words if request.sentence else "" for request in requests]
        snippets, mask = network(sentences, counts, noise)[0], snippet_mask(counts, noise.shape[1])
        return self.decoded(network.movement.decode(snippets, mask, batch.frames.shape[1]))


def _load(sources: Sources, estimates_length: bool) -> T2m:
    networks = (GENERATOR, LENGTH) if estimates_length else (GENERATOR,)
    generator, *length = (load_checkpoint(sources.checkpoints / one.name, one, sources.device) for one in networks)
    return T2m(generator, sources.device, *length)


FAMILY = Family(
    "t2m",
    "T2M, estimated length",
    lambda sources: _load(sources, estimates_length=True),
    networks=(MOVEMENT, GENERATOR, LENGTH),
    uses=(GENERATOR.name, LENGTH.name),
    estimates_length=True,
)
GIVEN_LENGTH = Family("t2m-given-length", "T2M", lambda sources: _load(sources, False), uses=(GENERATOR.name,))
