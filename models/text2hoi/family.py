"""Text2HOI as a family, the same before its refiner, and the same asked with another clip's sentence."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from torch import Tensor

from hoidata.annotation.encoders import TextEncoder, load_encoder
from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.settings import build_config
from models.common.family import Family, LeftOut, Sources
from models.common.predicting import first_sentence
from models.text2hoi.diagnostics import diagnose
from models.text2hoi.networks import NETWORKS
from models.text2hoi.sampler import SamplingConfig, Text2Hoi

NAMES = tuple(network.name for network in NETWORKS)
WITHOUT_FILES = ("use", "hash")
NO_OTHER_SENTENCE = "all test clips have its sentence"


def load_text2hoi(sources: Sources) -> Text2Hoi:
    """The four networks with the settings of ``sample.text2hoi``."""
    config = build_config(SamplingConfig, sources.settings.get("text2hoi"), "params.yaml: sample.text2hoi")
    return Text2Hoi.load(sources.checkpoints, sources.hands, config, sources.device, encoder_of(sources))


def encoder_of(sources: Sources) -> Callable[[], TextEncoder] | None:
    """What makes the encoder of the dataset's sentences; None where it needs a file that nobody has named."""
    name = sources.encoder or sources.annotated.encoder_identity["name"]
    return partial(load_encoder, name) if sources.encoder or name in WITHOUT_FILES else None


@dataclass(frozen=True)
class BeforeRefiner:
    """The motions of Text2HOI as the diffusion network leaves them."""

    model: Text2Hoi

    def sample(self, requests: Sequence[Request]) -> list[Clip]:
        return self.sample_asked(requests)[0]

    def sample_asked(self, requests: Sequence[Request]) -> tuple[list[Clip], list[np.ndarray]]:
        return self.model.sample_asked(requests, refined=False)


@dataclass(frozen=True)
class OtherPrompt:
    """Text2HOI told another clip's sentence: what is then as good does not come from the words.

    other: the clip whose sentence to use instead, by clip; a clip without another sentence has no answer.
    """

    model: Text2Hoi
    other: dict[str, ClipSample]

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return self.sample_asked(requests)[0]

    def sample_asked(
        self, requests: Sequence[Request], contact_maps: Sequence[Tensor] | None = None
    ) -> tuple[list[Clip | LeftOut], list[np.ndarray | None]]:
        """contact_maps: as in ``Text2Hoi.motions``."""
        answers: list[Clip | LeftOut] = [LeftOut(request.motion_id, NO_OTHER_SENTENCE) for request in requests]
        maps: list[np.ndarray | None] = [None] * len(requests)
        rows = [row for row, request in enumerate(requests) if request.clip_id in self.other]
        given = None if contact_maps is None else [contact_maps[row] for row in rows]
        if rows:
            made = self.model.sample_asked(self.told([requests[row] for row in rows]), contact_maps=given)
            for row, clip, contact_map in zip(rows, *made, strict=True):
                answers[row], maps[row] = clip, contact_map
        return answers, maps

    def told(self, requests: Sequence[Request]) -> list[Request]:
        """The requests with the other sentences."""
        others = [self.other[request.clip_id] for request in requests]
        return [
            replace(request, sentence=first_sentence(other), text=other.text[0])
            for request, other in zip(requests, others, strict=True)
        ]


def other_prompts(sources: Sources) -> dict[str, ClipSample]:
    """For every test clip another whose first sentence it is told: other verb and object if there is one such.

    A clip is absent where all test clips have its sentence.
    """
    test = list(HoiDataset(sources.annotated, "test", crop="start"))
    draws, chosen = np.random.default_rng(0), {}
    for sample in test:
        other = [s for s in test if s.verb != sample.verb and s.object_key != sample.object_key]
        other = other or [s for s in test if s.sentences[0] != sample.sentences[0]]
        if not other:
            continue
        same_hand = [s for s in other if s.hand_type == sample.hand_type] or other
        chosen[sample.clip_id] = same_hand[int(draws.integers(len(same_hand)))]
    return chosen


TEXT2HOI = Family("text2hoi", "Text2HOI", load_text2hoi, networks=NETWORKS, uses=NAMES, diagnose=diagnose)
COARSE = Family(
    "text2hoi-coarse", "Text2HOI before its refiner", lambda sources: BeforeRefiner(load_text2hoi(sources)), uses=NAMES
)
OTHER_PROMPT = Family(
    "other-prompt",
    "Text2HOI, another clip's prompt",
    lambda sources: OtherPrompt(load_text2hoi(sources), other_prompts(sources)),
    uses=NAMES,
)
