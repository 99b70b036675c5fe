"""Text2HOI's answer to requests: a contact map, a motion of hands and object, and its refinement (Sec. 3).

All random numbers of a motion come from its request's seed, so it does not depend on the other requests of a batch.
Motions are sampled by rejection: of several candidates the best one is the answer. Criteria: hands carry the object,
the motion matches its verb, and it is within the range of the training clips.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.requests import ObjectPoints, Request, RequestBatch, collate_requests
from hoidata.clips.clip import Clip
from hoidata.hands import HandPair
from hoidata.refinement import GraspSettings, carried_fraction, refine_grasps
from hoidata.settings import require_at_least
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.common.family import motion_clip
from models.common.features import Hands
from models.common.precision import SamplingPrecision, compute_in
from models.common.sampling import SamplerConfig, draw_each
from models.text2hoi.contact import AnchoredContact
from models.text2hoi.contact_training import CONTACT, ContactNetwork, most_typical, touched_maps
from models.text2hoi.diffusion import Condition
from models.text2hoi.diffusion_training import DIFFUSION, motion_generator
from models.text2hoi.length import LENGTH, LengthModel
from models.text2hoi.refiner import RefinerModel, Surface, refine
from models.text2hoi.refiner_training import REFINER
from models.text2hoi.verb_check import VerbCheck, requested_verb

NETWORKS = (CONTACT, LENGTH, DIFFUSION, REFINER)


MIN_LIFT_FRACTION = 0.5  # of the checked frames; a refined grasp carries the object in all or in none


@dataclass(frozen=True)
class Candidate:
    """A generated motion and the measures that accept or reject it."""

    clip: Clip
    # Fraction of checked frames in the air in which the hands can carry the object; 1 without contact refinement.
    carried: float = 1.0
    # The verb whose training clips have the most similar object motion; None if not known (``VerbCheck``).
    moved_as: str | None = None
    # Whether ``moved_as`` is another verb than the requested one.
    other_verb: bool = False
    # Measures of object and hands outside the range of the verb's training clips, in words.
    unusual: tuple[str, ...] = ()
    # The largest violation of such a range, in widths of the range; 0 if there is none.
    constraint_violation: float = 0.0
    # Number of motions sampled for the request so far.
    attempts: int = 1

    @property
    def rank_key(self) -> tuple[int, float, float]:
        """Larger is better: criteria met (carried, verb), then least violation, then the fraction carried.

        The violation of a motion with another verb does not count: nearly every such motion has one.
        """
        count = int(self.carried >= MIN_LIFT_FRACTION) + (not self.other_verb)
        return count, 0.0 if self.other_verb else -self.constraint_violation, self.carried

    @property
    def is_rejected(self) -> bool:
        """Whether to sample another candidate."""
        return self.rank_key[:2] != (2, 0.0)


AnyCandidate = TypeVar("AnyCandidate", bound=Candidate)


def verb_check_results(check: VerbCheck, clip: Clip, points: ObjectPoints, verb: str | None) -> dict[str, Any]:
    """Fields of ``Candidate`` for a motion and the requested verb; points: sampled on the object."""
    numbers = check.numbers(clip, points)
    moved_as = check.moved_as(numbers)
    return {
        "moved_as": moved_as,
        "other_verb": check.fails(verb, moved_as),
        "unusual": check.unusual(verb, numbers),
        "constraint_violation": check.beyond(verb, numbers),
    }


def best_candidates(
    count: int, max_attempts: int, draw: Callable[[Sequence[int], int], Sequence[AnyCandidate]]
) -> list[AnyCandidate]:
    """Rejection sampling: the best of at most ``max_attempts`` candidates for each request; the first of equals.

    draw: from the indices of requests and the attempt, from 1, to one candidate for each.
    """
    best = list(draw(range(count), 1))
    for attempt in range(2, max_attempts + 1):
        rejected = [number for number, candidate in enumerate(best) if candidate.is_rejected]
        if not rejected:
            break
        for number, candidate in zip(rejected, draw(rejected, attempt), strict=True):
            better = candidate if candidate.rank_key > best[number].rank_key else best[number]
            best[number] = replace(better, attempts=attempt)
    return best


MAX_BATCH_SIZE = 64  # requests with the same hand type and similar length, so that there is little padding


@dataclass(frozen=True)
class SamplingConfig:
    """How motions are sampled, refined and rejected."""

    # Sampler of the diffusion network.
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    # Grid points along each axis of the distance grids that the refiner network reads.
    field_resolution: int = 48
    # What corrects the hands: the refiner network, or contact refinement by optimisation, which also keeps a resting
    # object at rest. "preset": contact refinement if the diffusion network gives hands in the object's frame (`ours`).
    refined_by: Literal["preset", "network", "contact_refinement"] = "preset"
    contact_refinement: GraspSettings = field(default_factory=GraspSettings)
    # Candidates per motion, at most: another one is sampled if the hands cannot carry the object, if the object
    # moves as for another verb, or if object or hands move outside the range of the verb's training clips.
    max_attempts: int = 5
    # Arithmetic of the diffusion network's Transformer; float16 is for GPUs, a CPU is slower with it.
    precision: SamplingPrecision = "float32"
    # Contact maps sampled for a motion by a contact network with anchors; the medoid is the condition. Maps of the VAE
    # hardly differ, so one is sampled.
    contact_map_samples: int = 12

    def __post_init__(self) -> None:
        for name in ("max_attempts", "contact_map_samples"):
            require_at_least("sample.text2hoi", self, name, 1)


@dataclass(frozen=True)
class Text2HoiMotion:
    """Features of one motion in the model frame; contact refinement changes only the clip."""

    coarse: Tensor  # (2, F, 99) hands of the diffusion network
    refined: Tensor  # (2, F, 99) hands of the refiner network
    object: Tensor  # (F, 10)
    contact_map: Tensor  # (N,) 0 or 1


@dataclass(frozen=True, kw_only=True)
class Answer(Candidate):
    """A candidate with its features."""

    motion: Text2HoiMotion


@dataclass(frozen=True)
class Text2Hoi:
    """The four trained networks of one dataset, as a sampler."""

    trained: Mapping[str, Checkpoint]
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
        """Load ``checkpoints/<network>``. Raises BadInput for a missing one."""
        device = torch.device(device)
        trained = {
            network.name: load_checkpoint(Path(checkpoints) / network.name, network, device) for network in NETWORKS
        }
        config = config or SamplingConfig()
        compute_in(trained["diffusion"].network, config.precision)
        return cls(trained, Hands(hands).to(device), config, device, hands)

    @property
    def facts(self) -> dict[str, Any]:
        """What the diffusion network was trained on."""
        return self.trained["diffusion"].facts

    @property
    def refined_by(self) -> Literal["network", "contact_refinement"]:
        """What corrects the hands of the diffusion network."""
        if self.config.refined_by != "preset":
            return self.config.refined_by
        motion = motion_generator(self.trained["diffusion"]).network.representation.config
        return "contact_refinement" if motion.hand_frame == "object" else "network"

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the networks that generate refined motions of a given length."""
        return "contact", "diffusion", *(("refiner",) if self.refined_by == "network" else ())

    def sample(self, requests: Sequence[Request]) -> list[Clip]:
        """Refined motions."""
        return self.sample_with_targets(requests)[0]

    def sample_with_targets(
        self, requests: Sequence[Request], refined: bool = True, contact_maps: Sequence[Tensor] | None = None
    ) -> tuple[list[Clip], list[np.ndarray]]:
        """Motions, and the contact map (N,) bool that was the condition of each; arguments as in ``motions``."""
        answers = self.answers(requests, refined, contact_maps)
        return [answer.clip for answer in answers], [answer.motion.contact_map.numpy() > 0 for answer in answers]

    def answers(
        self,
        requests: Sequence[Request],
        refined: bool = True,
        contact_maps: Sequence[Tensor] | None = None,
    ) -> list[Answer]:
        """Motions and their clips, sampled by rejection; other arguments as in ``motions``."""

        def draw(numbers: Sequence[int], attempt: int) -> list[Answer]:
            chosen = [requests[number] for number in numbers]
            if attempt > 1:
                chosen = [replace(request, seed=_next_seed(request.seed, attempt)) for request in chosen]
            maps = None if contact_maps is None else [contact_maps[number] for number in numbers]
            return self._candidates(chosen, refined, maps)

        return best_candidates(len(requests), self.config.max_attempts, draw)

    def _candidates(
        self,
        requests: Sequence[Request],
        refined: bool,
        contact_maps: Sequence[Tensor] | None,
    ) -> list[Answer]:
        """One candidate per request."""
        motions = self.motions(requests, refined, contact_maps)
        clips = self.clips(requests, motions, refined)
        if not self._held(refined):
            return [Answer(clip=clip, motion=motion) for motion, clip in zip(motions, clips, strict=True)]
        check, answers = VerbCheck.of(self.trained["diffusion"], self.pair), []
        for request, motion, clip in zip(requests, motions, clips, strict=True):
            verb = requested_verb(self.trained["diffusion"], request)
            results = {} if check is None else verb_check_results(check, clip, request.points, verb)
            carried = carried_fraction(self.pair, clip, self.config.contact_refinement)
            answers.append(Answer(clip=clip, motion=motion, carried=carried, **results))
        return answers

    def clips(self, requests: Sequence[Request], motions: Sequence[Text2HoiMotion], refined: bool) -> list[Clip]:
        """Motions as clips, after refinement or before it."""
        clips = [
            motion_clip(request, motion.refined if refined else motion.coarse, motion.object, self.facts["synthetic"])
            for request, motion in zip(requests, motions, strict=True)
        ]
        if not self._held(refined):
            return clips
        return [refine_grasps(self.pair, clip, self.config.contact_refinement) for clip in clips]

    def _held(self, refined: bool) -> bool:
        """Whether contact refinement corrects the hands."""
        return refined and self.refined_by == "contact_refinement"

    @torch.no_grad()
    def motions(
        self, requests: Sequence[Request], refined: bool = True, contact_maps: Sequence[Tensor] | None = None
    ) -> list[Text2HoiMotion]:
        """One motion per request; ``refined`` equals ``coarse`` unless the refiner network is used.

        contact_maps: one per request, (2, N) by hand or (N,) for both, 0 or 1, instead of sampled ones.
        """
        models = {request.object.name: request.object for request in requests}.values()
        uses_network = refined and self.refined_by == "network"
        surface = Surface.of(self.hands, models, self.config.field_resolution, self.device) if uses_network else None
        motions: dict[int, Text2HoiMotion] = {}
        for numbers in bucket_by_length(requests):
            maps = None if contact_maps is None else [contact_maps[number] for number in numbers]
            generated = self._batch_motions([requests[number] for number in numbers], surface, maps)
            motions.update(zip(numbers, generated, strict=True))
        return [motions[number] for number in range(len(requests))]

    @torch.no_grad()
    def contact_maps(self, requests: Sequence[Request]) -> list[Tensor]:
        """The contact map (2, N), 0 or 1, by hand, of each request's first candidate."""
        batch = collate_requests(requests).to(self.device)
        generators = [torch.Generator().manual_seed(request.seed) for request in requests]
        return list(self._contact(batch, generators).cpu())

    def sample_lengths(self, text: Tensor, active_hands: Tensor, generator: torch.Generator) -> list[int]:
        """Numbers of frames, 8 to 150, for sentences (B, 512) and hand flags (B, 2)."""
        network = self.trained["length"].network
        assert isinstance(network, LengthModel)
        return network.sample(text.to(self.device), active_hands.to(self.device), generator).tolist()

    def _batch_motions(
        self, requests: Sequence[Request], surface: Surface | None, contact_maps: Sequence[Tensor] | None
    ) -> list[Text2HoiMotion]:
        batch = collate_requests(requests).to(self.device)
        generators = [torch.Generator().manual_seed(request.seed) for request in requests]
        # Sampled even if maps are given, because the noise of a motion follows from the same generator.
        contact = self._contact(batch, generators)
        if contact_maps is not None:
            by_hand = torch.stack([contact_map.expand(2, -1) for contact_map in contact_maps])
            contact = by_hand.to(contact) * batch.active_hands[..., None]
        generator = motion_generator(self.trained["diffusion"])
        condition = Condition.of(batch, generator.network.object_feature(batch.points_m), batch.text, contact)
        representation = generator.network.representation
        sizes = representation.sizes(batch.frames.shape[1])
        noise = draw_each(representation.max_sizes, sizes, generators, representation.object_features)
        coarse, objects = generator.sample(condition, self.config.sampler, noise, generators)
        either_hand = contact.amax(1)
        refined = coarse
        if surface is not None:
            network = self.trained["refiner"].network
            assert isinstance(network, RefinerModel)
            inputs = surface.coarse(batch, coarse, objects, either_hand, batch.hand_frames)
            refined = refine(network, inputs)
        parts = zip(coarse, refined, objects, either_hand, strict=True)
        return [
            Text2HoiMotion(before[:, :n].cpu(), after[:, :n].cpu(), object_features[:n].cpu(), either.cpu())
            for (before, after, object_features, either), n in zip(parts, batch.counts, strict=True)
        ]

    def _contact(self, batch: RequestBatch, generators: Sequence[torch.Generator]) -> Tensor:
        """Contact maps (B, 2, N), 0 or 1, by hand: the medoid of the sampled maps."""
        network = self.trained["contact"].network
        assert isinstance(network, ContactNetwork)
        count = self.config.contact_map_samples if isinstance(network, AnchoredContact) else 1
        latents = torch.cat([network.draw_latents(count, 1, generator) for generator in generators], 1)
        return most_typical(touched_maps(self.trained["contact"], batch, batch.text, latents))


def bucket_by_length(requests: Sequence[Request]) -> list[list[int]]:
    """Indices of the requests in batches of the same hand type and similar length."""
    keys = [(tuple(request.active_hands.tolist()), request.n_frames) for request in requests]
    ordered = sorted(range(len(requests)), key=keys.__getitem__)
    groups = [list(numbers) for _, numbers in groupby(ordered, key=lambda number: keys[number][0])]
    return [group[start : start + MAX_BATCH_SIZE] for group in groups for start in range(0, len(group), MAX_BATCH_SIZE)]


def _next_seed(seed: int, draw: int) -> int:
    """Seed of the ``draw``-th candidate of a request."""
    return int.from_bytes(sha256(f"{seed} draw {draw}".encode()).digest()[:7])
