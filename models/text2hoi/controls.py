"""Negative controls and retrieval baselines for Text2HOI.

A negative control is Text2HOI with one input replaced: a metric that does not change does not depend on that input.

A retrieval baseline has no network: it retrieves a training clip of the same prompt or verb, and post-processes it like
Text2HOI's samples. It applies contact refinement, then rejection sampling: if the hands cannot carry the object or the
motion is unusual for its verb, the next clip of the ranking is a candidate. So selection gives networks no advantage.
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
from hoidata.refinement import carried_fraction, refine_grasps
from hoidata.settings import build_config
from models.baselines.retrieval import PROMPT_LOOKUP, VERB_LOOKUP
from models.common.family import Family, Sampler, Skipped, Sources
from models.text2hoi.family import NAMES, OtherPrompt, load_text2hoi, other_prompts
from models.text2hoi.sampler import Candidate, SamplingConfig, Text2Hoi, best_candidates, verb_check_results
from models.text2hoi.verb_check import VerbCheck, usual_motion


@dataclass(frozen=True)
class OtherContact:
    """Text2HOI conditioned on the recorded contact map of another clip with the same object.

    It reports the contact map of its sentence as the requested one, so it must lose in adherence.
    """

    model: Text2Hoi
    others: dict[str, Tensor]  # contact maps by clip id; a clip without another one of its object is absent

    def sample(self, requests: Sequence[Request]) -> Sequence[Clip | Skipped]:
        return self.sample_with_targets(requests)[0]

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[Sequence[Clip | Skipped], list[np.ndarray]]:
        own = self.model.contact_maps(requests)
        given = [self.others.get(request.clip_id, mine) for request, mine in zip(requests, own, strict=True)]
        made, _ = self.model.sample_with_targets(requests, contact_maps=given)
        reason = "no other test clip of its object has another contact map"
        answers = [
            clip if request.clip_id in self.others else Skipped(request.motion_id, reason)
            for request, clip in zip(requests, made, strict=True)
        ]
        return answers, [contact_map.amax(0).numpy() > 0 for contact_map in own]


@dataclass(frozen=True)
class OwnContact:
    """Text2HOI conditioned on another clip's sentence, with the contact map of the original sentence."""

    other_prompt: OtherPrompt

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        return self.sample_with_targets(requests)[0]

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[list[Clip | Skipped], list[np.ndarray | None]]:
        return self.other_prompt.sample_with_targets(requests, self.other_prompt.model.contact_maps(requests))


def other_contact_maps(sources: Sources) -> dict[str, Tensor]:
    """For every test clip, the least similar recorded contact map of another test clip with the same object."""
    test, found = list(HoiDataset(sources.annotated, "test", crop="start")), {}
    for sample in test:
        others = [other for other in test if other.object_key == sample.object_key]
        least = min(others, key=lambda other: _shared(sample, other))
        if _shared(sample, least) < 1:
            found[sample.clip_id] = torch.from_numpy(least.contact_map).float()
    return found


def _shared(one: ClipSample, other: ClipSample) -> float:
    """Intersection over union of two clips' touched points."""
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
class RefinedRetrieval:
    """A retrieval baseline with contact refinement and rejection sampling."""

    lookup: Sampler  # retrieves training clips
    pair: HandPair
    config: SamplingConfig  # as of Text2HOI
    check: VerbCheck  # of the training clips

    @classmethod
    def load(cls, lookup: Family, sources: Sources) -> "RefinedRetrieval":
        config = build_config(SamplingConfig, sources.settings.get("text2hoi"), "params.yaml: sample.text2hoi")
        store = sources.annotated
        check = VerbCheck.read(usual_motion(store), store.contact_threshold_m, sources.hands)
        return cls(lookup.load(sources), sources.hands, config, check)

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        found = list(self.lookup.sample(requests))
        there = [row for row, one in enumerate(found) if isinstance(one, Clip)]

        def draw(numbers: Sequence[int], which: int) -> list[Candidate]:
            own = [requests[there[number]] for number in numbers]
            again = [replace(one, number=one.number + which - 1) for one in own]
            clips = [found[there[number]] for number in numbers] if which == 1 else self.lookup.sample(again)
            return [self._held(one, clip) for one, clip in zip(own, clips, strict=True)]

        for row, drawn in zip(there, best_candidates(len(there), self.config.max_attempts, draw), strict=True):
            found[row] = drawn.clip
        return found

    def _held(self, request: Request, found: Clip | Skipped) -> Candidate:
        assert isinstance(found, Clip)
        clip = refine_grasps(self.pair, found, self.config.contact_refinement)
        asked = request.sentence.verb if request.sentence else None
        known = verb_check_results(self.check, clip, request.points, asked)
        return Candidate(clip, carried_fraction(self.pair, clip, self.config.contact_refinement), **known)


def _held(lookup: Family) -> Family:
    return Family(f"{lookup.name}-refined", f"{lookup.title}, refined", partial(RefinedRetrieval.load, lookup))


PROMPT_LOOKUP_HELD, VERB_LOOKUP_HELD = _held(PROMPT_LOOKUP), _held(VERB_LOOKUP)
