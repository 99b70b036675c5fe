"""Negative controls for Text2HOI.

A negative control is Text2HOI with one input replaced: a metric that does not change does not depend on that input.

A refined control is a perturbed recording after the refiner network (Text2HOI, Fig. S6).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request, collate_requests
from hoidata.clips.clip import SIDES, Clip
from hoidata.clips.features import hand_features, object_features
from models.baselines.controls import NOISE, PRESSED, PerturbedRecording
from models.common.family import Family, ReportsContact, Sampler, Skipped, Sources
from models.text2hoi.family import NAMES, OtherPrompt, load_text2hoi, other_prompts
from models.text2hoi.refiner import Surface
from models.text2hoi.sampler import Text2Hoi


@dataclass(frozen=True)
class OtherContact(ReportsContact):
    """Text2HOI conditioned on the recorded contact map of another clip with the same object.

    It reports the contact map of its sentence as the requested one, so it must lose in adherence.
    """

    model: Text2Hoi
    others: dict[str, Tensor]  # contact maps by clip id; a clip without another one of its object is absent

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[Sequence[Clip | Skipped], list[np.ndarray]]:
        predicted = self.model.contact_maps(requests)
        conditions = [self.others.get(request.clip_id, mine) for request, mine in zip(requests, predicted, strict=True)]
        clips, _ = self.model.sample_with_targets(requests, contact_maps=conditions)
        reason = "no other test clip of its object has another contact map"
        answers = [
            clip if request.clip_id in self.others else Skipped(request.motion_id, reason)
            for request, clip in zip(requests, clips, strict=True)
        ]
        return answers, [contact_map.amax(0).numpy() > 0 for contact_map in predicted]


@dataclass(frozen=True)
class OwnContact(ReportsContact):
    """Text2HOI conditioned on another clip's sentence, with the contact map of the original sentence."""

    other_prompt: OtherPrompt

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[list[Clip | Skipped], list[np.ndarray | None]]:
        return self.other_prompt.sample_with_targets(requests, self.other_prompt.model.contact_maps(requests))


def other_contact_maps(sources: Sources) -> dict[str, Tensor]:
    """For every test clip, the least similar recorded contact map of another test clip with the same object."""
    test, found = sources.clips("test"), {}
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


_family = partial(Family, uses=NAMES)
ONE_CALL = _family(
    "one-call", "Text2HOI, one call of the denoiser", lambda sources: load_text2hoi(sources).with_sampler(steps=1)
)
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
class RefinedControl:
    """A perturbed recording with the hands of the refiner network, which is given the recorded contact map."""

    control: PerturbedRecording
    model: Text2Hoi

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        clips, contact_maps = self.control.sample_with_targets(requests)
        surface = self.model.surface(requests)
        assert surface is not None
        return [
            self._refined(request, clip, contact_map, surface) if isinstance(clip, Clip) else clip
            for request, clip, contact_map in zip(requests, clips, contact_maps, strict=True)
        ]

    def _refined(self, request: Request, clip: Clip, contact_map: np.ndarray, surface: Surface) -> Clip:
        """The clip with refined active hands; the object and the tracked frames are unchanged."""
        frame = request.world_from_model[:3, :3].T, request.world_from_model[:3, 3]
        hands = np.stack([hand_features(clip.hands[side].with_last_valid_pose(), *frame) for side in SIDES])
        features = hands, object_features(clip.object, *frame), contact_map[None].astype(np.float32)
        coarse, objects, contact = (torch.from_numpy(array)[None].to(self.model.device) for array in features)
        batch = collate_requests([request]).to(self.model.device)
        generators = [torch.Generator().manual_seed(request.seed)]
        moved = self.model.refine(batch, coarse, objects, contact, surface, generators)[0]
        refined = self.model.refined_clip(request, moved, objects[0]).hands.items()
        tracks = {side: replace(track, valid=clip.hands[side].valid) for side, track in refined if track.valid.any()}
        return replace(clip, hands={**clip.hands, **tracks})


def _refined_control(control: Family) -> Family:
    def load(sources: Sources) -> Sampler:
        perturbed = control.load(sources)
        assert isinstance(perturbed, PerturbedRecording)
        return RefinedControl(perturbed, load_text2hoi(sources, refine="network"))

    return _family(f"{control.name}-refined", f"{control.title}, refined", load)


NOISE_REFINED, PRESSED_REFINED = _refined_control(NOISE), _refined_control(PRESSED)
