"""Text2HOI's answer to requests: a contact map, a motion of hands and object, and its refinement (Sec. 3).

Everything a motion is drawn from comes from its request's seed, so it is the same in any company.
Of several motions drawn for one request the best is the answer: whose hands carry, that does as its verb says, and as
is usual.
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
from hoidata.refinement import HoldSettings, carried_share, hold_clip
from hoidata.settings import at_least
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
from models.text2hoi.verb_check import VerbCheck, asked_verb

NETWORKS = (CONTACT, LENGTH, DIFFUSION, REFINER)


ENOUGH = 0.5  # of the frames looked at: holds carry in all of them or in none


@dataclass(frozen=True)
class Drawn:
    """A motion's clip. carried: share of some frames in the air in which its hands can carry the object, 1 where no
    hold asked for it. moved_as: the verb whose training clips move the object most alike, None where that is not known
    (``VerbCheck``); other_verb: whether it is not what was asked. unusual: numbers of object and hands, in words, that
    lie outside the bounds of the verb's training clips; beyond: by how much the worst of them does, in widths of its
    bounds, 0 where none does. draws: how many motions were drawn for it.
    """

    clip: Clip
    carried: float = 1.0
    moved_as: str | None = None
    other_verb: bool = False
    unusual: tuple[str, ...] = ()
    beyond: float = 0.0
    draws: int = 1

    @property
    def goodness(self) -> tuple[int, float, float]:
        """How many of two things are so, that hands carry and that the verb is the one asked for; then how little is
        unusual, at most 0 (a motion of another verb nearly always is, and is not counted twice); then the share.
        """
        count = int(self.carried >= ENOUGH) + (not self.other_verb)
        return count, 0.0 if self.other_verb else -self.beyond, self.carried

    @property
    def needs_another(self) -> bool:
        """Whether it is to be drawn again."""
        return self.goodness[:2] != (2, 0.0)


AnyDrawn = TypeVar("AnyDrawn", bound=Drawn)


def checked(check: VerbCheck, clip: Clip, points: ObjectPoints, asked: str | None) -> dict[str, Any]:
    """What ``Drawn`` says of a motion and the verb asked for; points: of the object."""
    numbers = check.numbers(clip, points)
    moved_as = check.moved_as(numbers)
    return {
        "moved_as": moved_as,
        "other_verb": check.fails(asked, moved_as),
        "unusual": check.unusual(asked, numbers),
        "beyond": check.beyond(asked, numbers),
    }


def best_drawn(count: int, draws: int, draw: Callable[[Sequence[int], int], Sequence[AnyDrawn]]) -> list[AnyDrawn]:
    """The best of at most ``draws`` motions for each of ``count`` requests; the first of equals.

    draw: from the numbers of requests and which draw it is, from 1, to one motion for each of them.
    """
    best = list(draw(range(count), 1))
    for which in range(2, draws + 1):
        weak = [number for number, own in enumerate(best) if own.needs_another]
        if not weak:
            break
        for number, own in zip(weak, draw(weak, which), strict=True):
            kept = own if own.goodness > best[number].goodness else best[number]
            best[number] = replace(kept, draws=which)
    return best


AT_ONCE = 64  # requests of the same hands and of like length: what is cut off for all is not computed


@dataclass(frozen=True)
class SamplingConfig:
    """sampler: of the diffusion network. refined_by: what corrects its hands, the refiner network or a hold
    (``hoidata.refinement.holding``), which also sees to it that the object lies where it lay; "preset": a hold where
    the diffusion network gives hands in the object's frame, as `ours` does. field_resolution: of the distance grids the
    refiner sees. precision: of the diffusion network's Transformer; float16 is for GPUs (a CPU is slower with it).
    draws: how often at most a motion is drawn whose hands, held, cannot carry its object in half of the frames looked
    at, whose object moves as in training clips of another verb, or whose object or hands move outside the bounds of its
    own verb's (``VerbCheck``); of those that carry and do as asked the least unusual is the answer. contact_draws: how
    many contact maps are drawn for a motion by a network that draws anchors; the one most like the others is asked for.
    Draws of a latent hardly differ: one.
    """

    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    field_resolution: int = 48
    refined_by: Literal["preset", "network", "hold"] = "preset"
    hold: HoldSettings = field(default_factory=HoldSettings)
    draws: int = 5
    precision: SamplingPrecision = "float32"
    contact_draws: int = 12

    def __post_init__(self) -> None:
        for name in ("draws", "contact_draws"):
            at_least("sample.text2hoi", self, name, 1)


@dataclass(frozen=True)
class Text2HoiMotion:
    """Features in the model frame: hands (2, F, 99) before and after the refiner, object (F, 10); contact_map (N,).

    What a hold changes stands in the clips alone.
    """

    coarse: Tensor
    refined: Tensor
    object: Tensor
    contact_map: Tensor


@dataclass(frozen=True, kw_only=True)
class Answer(Drawn):
    """A motion and its clip."""

    motion: Text2HoiMotion


@dataclass(frozen=True)
class Text2Hoi:
    """The four trained networks of one dataset, ready to answer."""

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
        """From ``checkpoints/<network>``. Raises BadInput for one that is not there."""
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
    def refined_by(self) -> Literal["network", "hold"]:
        """What corrects the hands of the diffusion network."""
        if self.config.refined_by != "preset":
            return self.config.refined_by
        code = motion_generator(self.trained["diffusion"]).network.code.config
        return "hold" if code.hand_frame == "object" else "network"

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the networks that make refined motions of a given length."""
        return "contact", "diffusion", *(("refiner",) if self.refined_by == "network" else ())

    def sample(self, requests: Sequence[Request]) -> list[Clip]:
        """Refined motions."""
        return self.sample_asked(requests)[0]

    def sample_asked(
        self, requests: Sequence[Request], refined: bool = True, contact_maps: Sequence[Tensor] | None = None
    ) -> tuple[list[Clip], list[np.ndarray]]:
        """Motions, and the contact map (N,) bool each of them was drawn for; arguments as in ``motions``."""
        answers = self.answers(requests, refined, contact_maps)
        return [own.clip for own in answers], [own.motion.contact_map.numpy() > 0 for own in answers]

    def answers(
        self,
        requests: Sequence[Request],
        refined: bool = True,
        contact_maps: Sequence[Tensor] | None = None,
    ) -> list[Answer]:
        """Motions and their clips, drawn again where held hands cannot carry, or what is done is not usual of the verb.

        Other arguments as in ``motions``.
        """

        def draw(numbers: Sequence[int], which: int) -> list[Answer]:
            own = [requests[number] for number in numbers]
            again = own if which == 1 else [replace(one, seed=_next_seed(one.seed, which)) for one in own]
            given = None if contact_maps is None else [contact_maps[number] for number in numbers]
            return self._drawn(again, refined, given)

        return best_drawn(len(requests), self.config.draws, draw)

    def _drawn(
        self,
        requests: Sequence[Request],
        refined: bool,
        contact_maps: Sequence[Tensor] | None,
    ) -> list[Answer]:
        """Every request answered once; what only holds can tell is 1 elsewhere."""
        motions = self.motions(requests, refined, contact_maps)
        clips = self.clips(requests, motions, refined)
        if not self._held(refined):
            return [Answer(clip=clip, motion=motion) for motion, clip in zip(motions, clips, strict=True)]
        check, found = VerbCheck.of(self.trained["diffusion"], self.pair), []
        for request, motion, clip in zip(requests, motions, clips, strict=True):
            asked = asked_verb(self.trained["diffusion"], request)
            known = {} if check is None else checked(check, clip, request.points, asked)
            carried = carried_share(self.pair, clip, self.config.hold)
            found.append(Answer(clip=clip, motion=motion, carried=carried, **known))
        return found

    def clips(self, requests: Sequence[Request], motions: Sequence[Text2HoiMotion], refined: bool) -> list[Clip]:
        """Motions as clips, after refinement or before it."""
        found = [
            motion_clip(request, motion.refined if refined else motion.coarse, motion.object, self.facts["synthetic"])
            for request, motion in zip(requests, motions, strict=True)
        ]
        return [hold_clip(self.pair, clip, self.config.hold) for clip in found] if self._held(refined) else found

    def _held(self, refined: bool) -> bool:
        """Whether a hold corrects motions, where they are refined."""
        return refined and self.refined_by == "hold"

    @torch.no_grad()
    def motions(
        self, requests: Sequence[Request], refined: bool = True, contact_maps: Sequence[Tensor] | None = None
    ) -> list[Text2HoiMotion]:
        """Every network's part in one motion per request; where the refiner has none ``refined`` is ``coarse``.

        contact_maps: (2, N) by hand, or (N,) for either, 0 or 1, per request: in the place of what would be drawn.
        """
        models = {request.object.name: request.object for request in requests}.values()
        seen = refined and self.refined_by == "network"
        surface = Surface.of(self.hands, models, self.config.field_resolution, self.device) if seen else None
        made: dict[int, Text2HoiMotion] = {}
        for numbers in alike(requests):
            given = None if contact_maps is None else [contact_maps[number] for number in numbers]
            found = self._batch_motions([requests[number] for number in numbers], surface, given)
            made.update(zip(numbers, found, strict=True))
        return [made[number] for number in range(len(requests))]

    @torch.no_grad()
    def contact_maps(self, requests: Sequence[Request]) -> list[Tensor]:
        """(2, N) by hand the contact map, 0 or 1, that the first motion drawn for each request would be made for."""
        batch = collate_requests(requests).to(self.device)
        generators = [torch.Generator().manual_seed(request.seed) for request in requests]
        return list(self._contact(batch, generators).cpu())

    def sample_lengths(self, text: Tensor, active_hands: Tensor, generator: torch.Generator) -> list[int]:
        """Numbers of frames, 8 to 150, for sentences (B, 512) and hand flags (B, 2)."""
        network = self.trained["length"].network
        assert isinstance(network, LengthModel)
        return network.sample(text.to(self.device), active_hands.to(self.device), generator).tolist()

    def _batch_motions(
        self, requests: Sequence[Request], surface: Surface | None, given: Sequence[Tensor] | None
    ) -> list[Text2HoiMotion]:
        batch = collate_requests(requests).to(self.device)
        generators = [torch.Generator().manual_seed(request.seed) for request in requests]
        # Drawn even where they are given: the noise of a motion comes after it from the same generator.
        contact = self._contact(batch, generators)
        if given is not None:
            contact = torch.stack([own.expand(2, -1) for own in given]).to(contact) * batch.active_hands[..., None]
        generator = motion_generator(self.trained["diffusion"])
        condition = Condition.of(batch, generator.network.object_feature(batch.points_m), batch.text, contact)
        code = generator.network.code
        noise = draw_each(code.largest, code.sizes(batch.frames.shape[1]), generators, code.object_features)
        coarse, objects = generator.sample(condition, self.config.sampler, noise, generators)
        contact_maps = contact.amax(1)
        refined = coarse
        if surface is not None:
            network = self.trained["refiner"].network
            assert isinstance(network, RefinerModel)
            seen = surface.coarse(batch, coarse, objects, contact_maps, batch.hand_frames)
            refined = refine(network, seen)
        parts = zip(coarse, refined, objects, contact_maps, strict=True)
        return [
            Text2HoiMotion(before[:, :n].cpu(), after[:, :n].cpu(), thing[:n].cpu(), contact_map.cpu())
            for (before, after, thing, contact_map), n in zip(parts, batch.counts, strict=True)
        ]

    def _contact(self, batch: RequestBatch, generators: Sequence[torch.Generator]) -> Tensor:
        """(B, 2, N) one map for each hand, 0 or 1: the most typical of those that are drawn."""
        network = self.trained["contact"].network
        assert isinstance(network, ContactNetwork)
        count = self.config.contact_draws if isinstance(network, AnchoredContact) else 1
        latents = torch.cat([network.draw_latents(count, 1, generator) for generator in generators], 1)
        return most_typical(touched_maps(self.trained["contact"], batch, batch.text, latents))


def alike(requests: Sequence[Request]) -> list[list[int]]:
    """Numbers of the requests in batches: of the same hands, and of like length."""
    keys = [(tuple(request.active_hands.tolist()), request.n_frames) for request in requests]
    ordered = sorted(range(len(requests)), key=keys.__getitem__)
    same = [list(numbers) for _, numbers in groupby(ordered, key=lambda number: keys[number][0])]
    return [own[start : start + AT_ONCE] for own in same for start in range(0, len(own), AT_ONCE)]


def _next_seed(seed: int, draw: int) -> int:
    """Of the ``draw``-th motion for one request."""
    return int.from_bytes(sha256(f"{seed} draw {draw}".encode()).digest()[:7])
