"""Text2HOI with one thing taken from it, as families: what is then as good does not come from that. And rivals that
have no networks: training clips of the prompt or the verb, held and looked up again as ours are.

Where hands of such a rival cannot carry, or the motion is not as usual of the verb, the next clip of the ranking is
taken, as often as `ours` draws again and by the same rules, so that what choosing does is no merit of a network.
(Presets whose hands no hold corrects draw once; these rows choose beside them, too.) A ranking may have fewer clips.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.hands import HandPair
from hoidata.refinement import carried_share, hold_clip
from hoidata.settings import build_config
from models.baselines.lookups import PROMPT_LOOKUP, VERB_LOOKUP
from models.common.family import Family, LeftOut, Sampler, Sources
from models.text2hoi.family import NAMES, OtherPrompt, load_text2hoi, other_prompts
from models.text2hoi.sampler import Drawn, SamplingConfig, Text2Hoi, best_drawn, checked
from models.text2hoi.verb_check import VerbCheck, usual_motion


@dataclass(frozen=True)
class OtherContact:
    """Text2HOI told its own sentence and the contact map another clip of the object was recorded with.

    It still counts as asked for the map its own sentence gives: adherence to that is what the row must lose.
    others: those maps by clip; a clip without another of its object has none.
    """

    model: Text2Hoi
    others: dict[str, Tensor]

    def sample(self, requests: Sequence[Request]) -> Sequence[Clip | LeftOut]:
        return self.sample_asked(requests)[0]

    def sample_asked(self, requests: Sequence[Request]) -> tuple[Sequence[Clip | LeftOut], list[np.ndarray]]:
        own = self.model.contact_maps(requests)
        given = [self.others.get(request.clip_id, mine) for request, mine in zip(requests, own, strict=True)]
        made, _ = self.model.sample_asked(requests, contact_maps=given)
        reason = "no other test clip of its object has another contact map"
        answers = [
            clip if request.clip_id in self.others else LeftOut(request.motion_id, reason)
            for request, clip in zip(requests, made, strict=True)
        ]
        return answers, [contact_map.amax(0).numpy() > 0 for contact_map in own]


@dataclass(frozen=True)
class OwnContact:
    """Text2HOI told another clip's sentence and the contact map that its own sentence gives."""

    told_otherwise: OtherPrompt

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return self.sample_asked(requests)[0]

    def sample_asked(self, requests: Sequence[Request]) -> tuple[list[Clip | LeftOut], list[np.ndarray | None]]:
        return self.told_otherwise.sample_asked(requests, self.told_otherwise.model.contact_maps(requests))


def other_contact_maps(sources: Sources) -> dict[str, Tensor]:
    """For every test clip the recorded map, of the other clips of its object, that shares least with its own."""
    test, found = list(HoiDataset(sources.annotated, "test", crop="start")), {}
    for sample in test:
        others = [other for other in test if other.object_key == sample.object_key]
        least = min(others, key=lambda other: _shared(sample, other))
        if _shared(sample, least) < 1:
            found[sample.clip_id] = torch.from_numpy(least.contact_map).float()
    return found


def _shared(one: ClipSample, other: ClipSample) -> float:
    """Points that both touch, as a share of those that either does."""
    either = (one.contact_map | other.contact_map).sum()
    return float((one.contact_map & other.contact_map).sum() / either) if either else 1.0


def _one_call(sources: Sources) -> Sampler:
    model = load_text2hoi(sources)
    return replace(model, config=replace(model.config, sampler=replace(model.config.sampler, steps=1)))


def _family(name: str, title: str, load: Any) -> Family:
    return Family(name, title, load, uses=NAMES)


ONE_CALL = _family("one-call", "Text2HOI, one call of the denoiser", _one_call)
OTHER_CONTACT = _family(
    "other-contact",
    "Text2HOI, another clip's contact map",
    lambda sources: OtherContact(load_text2hoi(sources), other_contact_maps(sources)),
)
OTHER_PROMPT_OWN_CONTACT = _family(
    "other-prompt-own-contact",
    "Text2HOI, another clip's prompt, own contact map",
    lambda sources: OwnContact(OtherPrompt(load_text2hoi(sources), other_prompts(sources))),
)


@dataclass(frozen=True)
class HeldLookup:
    """lookup: whose motions are held. config: ours has. check: of the training clips."""

    lookup: Sampler
    pair: HandPair
    config: SamplingConfig
    check: VerbCheck

    @classmethod
    def load(cls, lookup: Family, sources: Sources) -> "HeldLookup":
        config = build_config(SamplingConfig, sources.settings.get("text2hoi"), "params.yaml: sample.text2hoi")
        store = sources.annotated
        check = VerbCheck.read(usual_motion(store), store.contact_threshold_m, sources.hands)
        return cls(lookup.load(sources), sources.hands, config, check)

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        found = list(self.lookup.sample(requests))
        there = [row for row, one in enumerate(found) if isinstance(one, Clip)]

        def draw(numbers: Sequence[int], which: int) -> list[Drawn]:
            own = [requests[there[number]] for number in numbers]
            again = [replace(one, number=one.number + which - 1) for one in own]
            clips = [found[there[number]] for number in numbers] if which == 1 else self.lookup.sample(again)
            return [self._held(one, clip) for one, clip in zip(own, clips, strict=True)]

        for row, drawn in zip(there, best_drawn(len(there), self.config.draws, draw), strict=True):
            found[row] = drawn.clip
        return found

    def _held(self, request: Request, found: Clip | LeftOut) -> Drawn:
        assert isinstance(found, Clip)
        clip = hold_clip(self.pair, found, self.config.hold)
        asked = request.sentence.verb if request.sentence else None
        known = checked(self.check, clip, request.points, asked)
        return Drawn(clip, carried_share(self.pair, clip, self.config.hold), **known)


def _held(lookup: Family) -> Family:
    return Family(f"{lookup.name}-held", f"{lookup.title}, held", partial(HeldLookup.load, lookup))


PROMPT_LOOKUP_HELD, VERB_LOOKUP_HELD = _held(PROMPT_LOOKUP), _held(VERB_LOOKUP)
