"""Rivals that have no networks: training clips of the prompt or the verb, held as the motions of `ours` are.

They are not drawn again where they cannot carry, as those are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.hands import HandPair
from hoidata.refinement import HoldSettings, hold_clip
from hoidata.settings import build_config
from models.baselines.lookups import PROMPT_LOOKUP, VERB_LOOKUP
from models.common.family import Family, LeftOut, Sampler, Sources
from models.text2hoi.sampler import SamplingConfig


@dataclass(frozen=True)
class HeldLookup:
    """lookup: whose motions are held. hold: the settings ours has."""

    lookup: Sampler
    pair: HandPair
    hold: HoldSettings

    @classmethod
    def load(cls, lookup: Family, sources: Sources) -> "HeldLookup":
        config = build_config(SamplingConfig, sources.settings.get("text2hoi"), "params.yaml: sample.text2hoi")
        return cls(lookup.load(sources), sources.hands, config.hold)

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return [
            hold_clip(self.pair, found, self.hold) if isinstance(found, Clip) else found
            for found in self.lookup.sample(requests)
        ]


def _held(lookup: Family) -> Family:
    return Family(f"{lookup.name}-held", f"{lookup.title}, held", partial(HeldLookup.load, lookup))


PROMPT_LOOKUP_HELD, VERB_LOOKUP_HELD = _held(PROMPT_LOOKUP), _held(VERB_LOOKUP)
