"""Text2HOI's answer to requests: a contact map, a motion of hands and object, and its refinement (Sec. 3).

All random numbers of a motion come from its request's seed, so it does not depend on the other requests of a batch.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from hoidata.annotation.encoders import TextEncoder
from hoidata.annotation.hand_choice import HandChoice, Method, choose_hand
from hoidata.annotation.vocabulary import Vocabulary
from hoidata.annotation.wording import trained_verb
from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import Request, RequestBatch, bucket_by_length, collate_requests
from hoidata.clips.clip import Clip
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.metrics.verb_ranges import ACCEPTED
from hoidata.refinement import refine_grasps
from hoidata.settings import require_at_least
from models.common.checkpoints import FILE_NAME, Checkpoint, load_checkpoint
from models.common.family import Network, ReportsContact, motion_clip
from models.common.features import Hands
from models.common.repeatable import seed_of
from models.common.sampling import TRAIN_STEPS, Motion, SamplerConfig, draw_each
from models.text2hoi.contact_training import CONTACT, contact_sampler, touched
from models.text2hoi.diffusion import Condition, MotionGenerator, is_paper
from models.text2hoi.diffusion_training import DIFFUSION, motion_generator, verb_ranges
from models.text2hoi.length import LENGTH, LengthModel
from models.text2hoi.refiner import RefinerModel, Surface, refine
from models.text2hoi.refiner_training import REFINER

NETWORKS = (CONTACT, LENGTH, DIFFUSION, REFINER)
PAPER_SAMPLER = SamplerConfig("ddpm", TRAIN_STEPS)
CONTACT_MAP_SAMPLES = 12  # of a contact network with anchors; the medoid is the condition


@dataclass(frozen=True)
class SamplingConfig:
    """How motions are sampled, refined and rejected."""

    # Sampler of the diffusion network. None: the paper's for networks of preset `paper`, DDIM with 20 steps for others.
    sampler: SamplerConfig | None = None
    # What corrects the hands: the refiner network, contact refinement by optimisation (``hoidata.refinement``), or
    # nothing.
    refine: Literal["network", "contact", "none"] = "network"
    # Candidates per motion, at most (rejection sampling, ``VerbRanges.rank``).
    attempts: int = 1

    def __post_init__(self) -> None:
        require_at_least("sample.text2hoi", self, "attempts", 1)


@dataclass(frozen=True)
class Answer:
    """A generated motion. Features are in the model frame."""

    clip: Clip  # refined
    coarse: Tensor  # (2, F, 99) hands of the diffusion network
    object: Tensor  # (F, 10)
    touched: Tensor  # (N,) bool, touched points of the contact map that was the condition
    attempts: int = 1  # candidates sampled until this one was accepted
    rank: tuple[int, float, float] = (*ACCEPTED, 1.0)  # ``VerbRanges.rank``, with rejection sampling


@dataclass(frozen=True)
class Text2Hoi(ReportsContact):
    """The trained networks of one dataset, as a sampler."""

    trained: Mapping[str, Checkpoint]  # without those that are not used
    hands: Hands
    config: SamplingConfig
    device: torch.device
    pair: HandPair

    @classmethod
    def load(
        cls,
        checkpoints: str | Path,
        hands: HandPair,
        config: SamplingConfig | None = None,
        device: torch.device | str = "cpu",
    ) -> "Text2Hoi":
        """Load ``checkpoints/<network>``: contact and diffusion, the refiner if it is used, the length if it is there.

        Raises BadInput for a missing network.
        """
        device, folder, config = torch.device(device), Path(checkpoints), config or SamplingConfig()
        networks: list[Network] = [CONTACT, DIFFUSION, *([REFINER] if config.refine == "network" else [])]
        if (folder / LENGTH.name / FILE_NAME).is_file():
            networks.append(LENGTH)
        trained = {network.name: load_checkpoint(folder / network.name, network, device) for network in networks}
        return cls(trained, Hands(hands).to(device), config, device, hands)

    def with_sampler(self, **changes: Any) -> "Text2Hoi":
        """The model with other fields of its :class:`SamplerConfig`."""
        return replace(self, config=replace(self.config, sampler=replace(self.sampler, **changes)))

    @property
    def generator(self) -> MotionGenerator:
        return motion_generator(self.trained["diffusion"])

    @property
    def is_paper(self) -> bool:
        """Whether the networks are those of preset `paper`, of any size."""
        return is_paper(self.generator.network.config)

    @property
    def sampler(self) -> SamplerConfig:
        """The sampler of the diffusion network."""
        return self.config.sampler or (PAPER_SAMPLER if self.is_paper else SamplerConfig())

    @property
    def facts(self) -> dict[str, Any]:
        """What the diffusion network was trained on."""
        return self.trained["diffusion"].facts

    def verb_of(self, request: Request) -> str | None:
        """The verb of a request's sentence, as it was trained, base form; None if the grammar finds none."""
        verbs = Vocabulary.read(self.facts).verb_names
        return trained_verb(request.sentence.words, verbs) if request.sentence else None

    def choose_hand(self, text: str, encoder: TextEncoder, method: Method | None = None) -> HandChoice:
        """The hand of a sentence; without a ``method`` by similarity for preset `paper`, by rules for others."""
        counts = self.trained["contact"].facts["hand_types"]
        prior = {hand: count / max(sum(counts.values()), 1) for hand, count in counts.items()}
        return choose_hand(text, encoder, prior, method or ("similarity" if self.is_paper else "rules"))

    def sample_length(self, request: Request) -> int:
        """Number of frames, 8 to 150, for a request's sentence and seed. Raises BadInput without a length network."""
        if LENGTH.name not in self.trained:
            raise BadInput("length network", "a trained one", "none", "train it, or give a length (--length)")
        network, generator = self.trained[LENGTH.name].network, torch.Generator().manual_seed(request.seed)
        assert isinstance(network, LengthModel)
        text = torch.from_numpy(request.text)[None].to(self.device)
        return int(network.sample(text, [self.verb_of(request)], generator))

    def sample_with_targets(
        self, requests: Sequence[Request], contact_maps: Sequence[Tensor] | None = None
    ) -> tuple[list[Clip], list[np.ndarray]]:
        """Motions, and the touched points (N,) bool of each one's condition; contact_maps: as in ``candidates``."""
        answers = self.answers(requests, contact_maps)
        return [answer.clip for answer in answers], [answer.touched.numpy() for answer in answers]

    def answers(self, requests: Sequence[Request], contact_maps: Sequence[Tensor] | None = None) -> list[Answer]:
        """The best of at most ``config.attempts`` candidates for each request; contact_maps: as in ``candidates``."""
        best = self.candidates(requests, contact_maps)
        for attempt in range(2, self.config.attempts + 1):
            rejected = [number for number, answer in enumerate(best) if answer.rank[:2] != ACCEPTED]
            again = [replace(requests[n], seed=seed_of(f"{requests[n].seed} draw {attempt}")) for n in rejected]
            maps = None if contact_maps is None else [contact_maps[number] for number in rejected]
            for number, answer in zip(rejected, self.candidates(again, maps), strict=True):
                better = max(best[number], answer, key=lambda candidate: candidate.rank)
                best[number] = replace(better, attempts=attempt)
        return best

    @torch.no_grad()
    def candidates(self, requests: Sequence[Request], contact_maps: Sequence[Tensor] | None = None) -> list[Answer]:
        """One motion per request.

        contact_maps: one per request, (2, N) by hand or (N,) for both, from 0 to 1, instead of sampled ones.
        """
        surface, answers = self.surface(requests), dict[int, Answer]()
        for numbers in bucket_by_length(requests):
            chosen = [requests[number] for number in numbers]
            batch = collate_requests(chosen).to(self.device)
            generators = [torch.Generator().manual_seed(request.seed) for request in chosen]
            # Sampled even if maps are given, because the noise of a motion follows from the same generator.
            contact = self.sample_contact(batch, generators)
            if contact_maps is not None:
                given = torch.stack([contact_maps[number].expand(2, -1) for number in numbers]).to(contact)
                contact = given * batch.active_hands[..., None]
            coarse, objects = self.denoise(batch, [self.verb_of(request) for request in chosen], contact, generators)
            hands = coarse if surface is None else self.refine(batch, coarse, objects, contact, surface, generators)
            for row, number in enumerate(numbers):
                clip = self.refined_clip(requests[number], hands[row], objects[row])
                points = touched(self.trained["contact"], contact[row].amax(0)) & (contact[row].amax(0) > 0)
                frames = slice(requests[number].n_frames)
                features = coarse[row, :, frames].cpu(), objects[row, frames].cpu()
                answers[number] = self._ranked(Answer(clip, *features, points.cpu()), requests[number])
        return [answers[number] for number in range(len(requests))]

    @torch.no_grad()
    def contact_maps(self, requests: Sequence[Request]) -> list[Tensor]:
        """The contact map (2, N), from 0 to 1, by hand, of each request's first candidate."""
        generators = [torch.Generator().manual_seed(request.seed) for request in requests]
        return list(self.sample_contact(collate_requests(requests).to(self.device), generators).cpu())

    def sample_contact(self, batch: RequestBatch, generators: Sequence[torch.Generator]) -> Tensor:
        """Contact maps (B, 2, N) by hand: probabilities, or 0 or 1 for a network with contact tokens."""
        is_binary = self.generator.network.config.contact_input == "tokens"
        return contact_sampler(self.trained["contact"], is_binary, CONTACT_MAP_SAMPLES)(batch, batch.text, generators)

    def denoise(
        self, batch: RequestBatch, verbs: Sequence[str | None], contact: Tensor, generators: list[torch.Generator]
    ) -> Motion:
        """Hands (B, 2, F, 99) and object (B, F, 10) in the model frame."""
        representation = self.generator.network.representation
        sizes = representation.sizes(batch.frames.shape[1])
        longest, features = representation.sizes(MAX_FRAMES), representation.object_features
        draw = partial(draw_each, longest, sizes, generators, features)
        return self.generator.sample(Condition(batch, batch.text, verbs, contact), self.sampler, draw)

    def refine(
        self,
        batch: RequestBatch,
        hands: Tensor,
        objects: Tensor,
        contact: Tensor,
        surface: Surface,
        generators: Sequence[torch.Generator],
    ) -> Tensor:
        """Hands (B, 2, F, 99) of the refiner network; generators: one per motion, which a diffusion model uses."""
        network = self.trained["refiner"].network
        assert isinstance(network, RefinerModel)
        coarse = surface.coarse(batch, hands, objects, contact.amax(1), batch.hand_frames)
        return refine(network, coarse, lambda: draw_each((MAX_FRAMES, 0), (hands.shape[2], 0), generators)[0])

    def refined_clip(self, request: Request, hands: Tensor, objects: Tensor) -> Clip:
        """The clip of features (2, F, 99) and (F, 10), after contact refinement if it is chosen."""
        clip = motion_clip(request, hands, objects, self.facts["synthetic"])
        return refine_grasps(self.pair, clip) if self.config.refine == "contact" else clip

    def surface(self, requests: Sequence[Request]) -> Surface | None:
        """Distances to the requests' objects, if the refiner network needs them."""
        models = {request.object.name: request.object for request in requests}.values()
        return Surface.of(self.hands, models, self.device) if self.config.refine == "network" and models else None

    def _ranked(self, answer: Answer, request: Request) -> Answer:
        """The answer with its rank, which only rejection sampling needs."""
        ranges = verb_ranges(self.trained["diffusion"], self.pair) if self.config.attempts > 1 else None
        if ranges is None:
            return answer
        return replace(answer, rank=ranges.rank(self.verb_of(request), answer.clip, request.points))
