"""The rival that has everything of `ours` but its networks: the training clip of the prompt, held as ours are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.hands import HandPair
from hoidata.refinement import HoldSettings, hold_hands
from hoidata.settings import build_config
from models.baselines.lookups import PROMPT_LOOKUP
from models.common.family import Family, LeftOut, Sampler, Sources
from models.text2hoi.sampler import SamplingConfig


@dataclass(frozen=True)
class HeldLookup:
    """lookup: whose motions are held. hold: the settings ours has."""

    lookup: Sampler
    pair: HandPair
    hold: HoldSettings

    @classmethod
    def load(cls, sources: Sources) -> "HeldLookup":
        config = build_config(SamplingConfig, sources.settings.get("text2hoi"), "params.yaml: sample.text2hoi")
        return cls(PROMPT_LOOKUP.load(sources), sources.hands, config.hold)

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return [
            replace(found, hands=hold_hands(self.pair, found, self.hold)) if isinstance(found, Clip) else found
            for found in self.lookup.sample(requests)
        ]


PROMPT_LOOKUP_HELD = Family("prompt-lookup-held", "training clip of the prompt, held", HeldLookup.load)
