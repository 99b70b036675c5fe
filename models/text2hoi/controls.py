"""Text2HOI with one thing taken from it, as families: what is then as good does not come from that."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from models.common.family import Family, LeftOut, Sampler, Sources
from models.text2hoi.family import NAMES, OtherPrompt, load_text2hoi, other_prompts
from models.text2hoi.sampler import Text2Hoi


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
