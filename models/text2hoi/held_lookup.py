"""Rivals that have no networks: training clips of the prompt or the verb, held and looked up again as ours are.

Where hands cannot carry, or the motion is not as usual of the verb, the next clip of the ranking is taken, as often as
`ours` draws again and by the same rules, so that what choosing does is no merit of a network. (Presets whose hands no
hold corrects draw once; these rows choose beside them, too.) A ranking may have fewer clips than there are draws.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.hands import HandPair
from hoidata.refinement import carried_share, hold_clip
from hoidata.settings import build_config
from models.baselines.lookups import PROMPT_LOOKUP, VERB_LOOKUP
from models.common.family import Family, LeftOut, Sampler, Sources
from models.text2hoi.sampler import Drawn, SamplingConfig, best_drawn, checked
from models.text2hoi.verb_check import VerbCheck, usual_motion


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
