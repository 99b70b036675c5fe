"""Retrieval baselines with contact refinement: the baselines of ``text2hoi-contact``."""

from collections.abc import Sequence
from dataclasses import dataclass

from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.hands import HandPair
from hoidata.refinement import refine_grasps
from models.baselines.retrieval import PROMPT_LOOKUP, VERB_LOOKUP
from models.common.family import Family, Sampler, Skipped, Sources


@dataclass(frozen=True)
class RefinedRetrieval:
    """A retrieval baseline with contact refinement."""

    retrieval: Sampler
    pair: HandPair

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        clips = self.retrieval.sample(requests)
        return [refine_grasps(self.pair, clip) if isinstance(clip, Clip) else clip for clip in clips]


def _refined(retrieval: Family) -> Family:
    def load(sources: Sources) -> Sampler:
        return RefinedRetrieval(retrieval.load(sources), sources.hands)

    return Family(f"{retrieval.name}-refined", f"{retrieval.title}, contact refinement", load)


PROMPT_RETRIEVAL_REFINED, VERB_RETRIEVAL_REFINED = _refined(PROMPT_LOOKUP), _refined(VERB_LOOKUP)
