"""Which hand a prompt asks for: rules first, similarity with a margin second, a counted prior or "unknown" last.

Text2HOI (Sec. 4.1) always takes the most similar of three templates. That invents a hand for every sentence that names
none, so it is kept apart as :func:`most_similar_hand`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hoidata.annotation.encoders import TextEncoder
from hoidata.annotation.hand_mentions import HAND_WORD, SIDE_WORD, Mentions, find_mentions
from hoidata.clips import SIDES, HandType

HAND_TYPES: tuple[HandType, ...] = ("left", "right", "both")
TEMPLATES: dict[HandType, str] = {
    "left": "A photo of left hand",
    "right": "A photo of right hand",
    "both": "A photo of both hands",
}
# Per encoder: the phrase it tells hands apart by best, and the cosine margin below which it is guessing.
PHRASES: dict[HandType, str] = {"left": "with the left hand", "right": "with the right hand", "both": "with both hands"}
MARGIN = 0.05
Source = Literal["rule", "embedding", "prior", "unknown"]
Method = Literal["rules", "similarity"]


@dataclass(frozen=True)
class HandChoice:
    """hand: None when the sentence does not determine one and no prior was given (source "unknown").

    source: what decided. confidence: 1 for a rule, the cosine margin for "embedding", the share for "prior", 0 for
    "unknown". evidence: the words or numbers it rests on.
    """

    hand: HandType | None
    source: Source
    confidence: float
    evidence: str


def select_hand(
    text: str, encoder: TextEncoder | None = None, prior: Mapping[HandType, float] | None = None
) -> HandChoice:
    """The hand an English prompt asks for.

    encoder: asked only when the rules are silent, yet words for a hand and for a side are left; its answer counts
    from a margin of 0.05.
    prior: share of each hand type, say from ``hand_prior``; used last, and named as the source.
    """
    mentions = find_mentions(text)
    evidence = "; ".join(mentions.evidence) or "no hand is named"
    hand = _by_rule(mentions)
    if hand:
        return HandChoice(hand, "rule", 1.0, evidence)
    if encoder is not None and _is_cue(mentions):
        hand, margin = most_similar_hand(text, encoder, PHRASES)
        if margin >= MARGIN:
            return HandChoice(hand, "embedding", margin, f"most like {PHRASES[hand]!r} by {margin:.3f}")
    if prior:
        hand, share = _most_likely(prior, mentions)
        return HandChoice(hand, "prior", share, f"{evidence}; {hand} in {share:.0%} of the training clips")
    return HandChoice(None, "unknown", 0.0, evidence)


def choose_hand(
    text: str, encoder: TextEncoder, prior: Mapping[HandType, float] | None = None, method: Method = "rules"
) -> HandChoice:
    """``select_hand``; or by "similarity" the paper's plain way: always the most similar of three templates."""
    if method == "rules":
        return select_hand(text, encoder, prior)
    hand, margin = most_similar_hand(text, encoder)
    return HandChoice(
        hand, "embedding", margin, f"most like {TEMPLATES[hand]!r} by {margin:.3f}; no margin is asked for"
    )


def most_similar_hand(
    text: str, encoder: TextEncoder, templates: Mapping[HandType, str] = TEMPLATES
) -> tuple[HandType, float]:
    """The template with the highest cosine similarity, as in the paper, and its lead over the second."""
    features = encoder.encode([text, *(templates[hand] for hand in HAND_TYPES)])
    features = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)
    cosines = features[1:] @ features[0]
    order = np.argsort(-cosines, kind="stable")
    return HAND_TYPES[order[0]], float(cosines[order[0]] - cosines[order[1]])


def _by_rule(mentions: Mentions) -> HandType | None:
    if mentions.both and mentions.one and "both" not in mentions.denied:
        return None
    if mentions.both or len(mentions.sides) == 2:
        return "both"
    if mentions.sides:
        return next(iter(mentions.sides))
    allowed: list[HandType] = [side for side in SIDES if side not in mentions.denied]
    return allowed[0] if mentions.one and len(allowed) == 1 else None


def _is_cue(mentions: Mentions) -> bool:
    """Similarity alone answers every sentence; it is asked only where the words for an answer are there."""
    undecided = mentions.denied or mentions.one or mentions.either or mentions.both
    return not undecided and bool(HAND_WORD.search(mentions.rest) and SIDE_WORD.search(mentions.rest))


def _most_likely(prior: Mapping[HandType, float], mentions: Mentions) -> tuple[HandType, float]:
    """The likeliest hand type the sentence does not rule out; ties go to left, then right."""
    ruled_out = set(mentions.denied) | ({"both"} if mentions.one or mentions.denied & set(SIDES) else set())
    allowed: list[HandType] = [hand for hand in HAND_TYPES if hand not in ruled_out] or list(HAND_TYPES)
    best = max(allowed, key=lambda hand: prior.get(hand, 0.0))
    total = sum(prior.get(hand, 0.0) for hand in allowed)
    return best, prior.get(best, 0.0) / total if total else 1 / len(allowed)
