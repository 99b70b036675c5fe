"""Finds the hand that a prompt requests: by rules, then by text similarity with a margin, then by a prior.

Text2HOI (Sec. 4.1) always takes the most similar of three templates, which also gives a hand to sentences without one.
:func:`most_similar_hand` does the same.

"Left" and "right" count only as hands ("with your left", "LH", "left-handed", "the right holds it"), not as positions
("cup on the left", "right-hand drawer"), verbs ("he left it") or adverbs ("right away"). The order matters: phrases
that only look like hands are blanked first, then negated hands, then mentions are collected.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hoidata.annotation.encoders import TextEncoder, cosine_similarities
from hoidata.annotation.grammar import default_grammar
from hoidata.clips import SIDES, HandType, Side

HAND_TYPES: tuple[HandType, ...] = ("left", "right", "both")
_NAMES: dict[HandType, str] = {"left": "left hand", "right": "right hand", "both": "both hands"}
TEMPLATES: dict[HandType, str] = {hand: f"A photo of {name}" for hand, name in _NAMES.items()}
# The phrases by which the encoders distinguish hands best, and the cosine margin below which the result is random.
PHRASES: dict[HandType, str] = {"left": "with the left hand", "right": "with the right hand", "both": "with both hands"}
MARGIN = 0.05
Source = Literal["rule", "embedding", "prior", "unknown"]
Method = Literal["rules", "similarity"]


@dataclass(frozen=True)
class HandChoice:
    """The hand that a prompt requests."""

    hand: HandType | None  # None if neither the prompt nor a prior determines it
    source: Source  # what decided
    confidence: float  # 1 for "rule", cosine margin for "embedding", fraction for "prior", 0 for "unknown"
    evidence: str  # the words or numbers behind the decision


def select_hand(
    text: str, encoder: TextEncoder | None = None, prior: Mapping[HandType, float] | None = None
) -> HandChoice:
    """Find the hand that an English prompt requests.

    encoder: used if no rule applies but the prompt has words for a hand and a side; needs a margin of 0.05.
    prior: fraction of each hand type in the training clips; used last.
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
        hand, fraction = _most_likely(prior, mentions)
        return HandChoice(hand, "prior", fraction, f"{evidence}; {hand} in {fraction:.0%} of the training clips")
    return HandChoice(None, "unknown", 0.0, evidence)


def choose_hand(
    text: str, encoder: TextEncoder, prior: Mapping[HandType, float] | None = None, method: Method = "rules"
) -> HandChoice:
    """Call ``select_hand``, or with "similarity" take the most similar of three templates, as the paper does."""
    if method == "rules":
        return select_hand(text, encoder, prior)
    hand, margin = most_similar_hand(text, encoder)
    return HandChoice(hand, "embedding", margin, f"most like {TEMPLATES[hand]!r} by {margin:.3f}; any margin counts")


def most_similar_hand(
    text: str, encoder: TextEncoder, templates: Mapping[HandType, str] = TEMPLATES
) -> tuple[HandType, float]:
    """Return the template with the highest cosine similarity, as in the paper, and its margin over the second."""
    cosines = cosine_similarities(encoder, text, [templates[hand] for hand in HAND_TYPES])
    order = np.argsort(-cosines, kind="stable")
    return HAND_TYPES[order[0]], float(cosines[order[0]] - cosines[order[1]])


def _by_rule(mentions: "Mentions") -> HandType | None:
    if mentions.both and mentions.one and "both" not in mentions.denied:
        return None
    if mentions.both or len(mentions.sides) == 2:
        return "both"
    if mentions.sides:
        return next(iter(mentions.sides))
    allowed: list[HandType] = [side for side in SIDES if side not in mentions.denied]
    return allowed[0] if mentions.one and len(allowed) == 1 else None


def _is_cue(mentions: "Mentions") -> bool:
    """Whether the rest of the sentence mentions hand and side. Without them, similarity gives a random answer."""
    undecided = mentions.denied or mentions.one or mentions.either or mentions.both
    return not undecided and bool(HAND_WORD.search(mentions.rest) and SIDE_WORD.search(mentions.rest))


def _most_likely(prior: Mapping[HandType, float], mentions: "Mentions") -> tuple[HandType, float]:
    """Return the most likely hand type that the sentence does not exclude; ties go to left, then right."""
    excluded = set(mentions.denied) | ({"both"} if mentions.one or mentions.denied & set(SIDES) else set())
    allowed: list[HandType] = [hand for hand in HAND_TYPES if hand not in excluded] or list(HAND_TYPES)
    best = max(allowed, key=lambda hand: prior.get(hand, 0.0))
    total = sum(prior.get(hand, 0.0) for hand in allowed)
    return best, prior.get(best, 0.0) / total if total else 1 / len(allowed)


BLANK = " ¤ "
_DET = r"(?:(?:the|your|my|his|her|their|its|our|one's|a|an)\s+)"
_POSSESSIVE = r"(?:(?:your|my|his|her|their|its|our|one's)\s+)"
_SIDE = r"(?P<side>left|right)"
_ADJECTIVE = r"(?:(?:gloved|bare|free|dominant|own|open|closed|other|stronger|weaker|outstretched)\s+)?"
_PART = r"(?:hands?|palms?|fists?|arms?|fingers?|fingertips?|thumbs?|(?:index|middle|ring|little)\s+fingers?)"
# None of these words after a bare "left" or "right" is a noun, so the side means a hand.
_CLAUSE_END = (
    r"(?=\s*(?:$|[.,;:!?¤)]|(?:and|to|then|only|alone|while|but|not|now|please|again|for|as|with|when|instead|because|"
    r"before|after|from|until|first|rather|if|or|on|this\s+time|\w+ly)\b))"
)
_LOCATION_NOUN = (
    r"(?:side|drawer|door|corner|edge|shelf|column|lane|part|half|end|one|panel|pocket|margin|page|knob|handle|"
    r"button|cup|mug|box|bottle|shoe|glove|lens|wall|cupboard|compartment|wheel|key|speaker|seat|window)\b"
)
_HANDED_TOOL = (
    r"(?:scissors|mouse|mug|knife|guitar|tools?|screws?|threads?|version|model|desk|gloves?|bat|club|opener)\b"
)
_MENTION = rf"{_SIDE}(?:\s+|-)?{_ADJECTIVE}{_PART}\b"
_BOTH = (
    rf"(?:both\s+(?:of\s+)?{_DET}?(?:\w+\s+)?(?:hands?|palms|arms|fists)|both\s+(?:the\s+)?left\s+and\s+(?:the\s+)?right|"
    rf"(?:left\s+(?:and|&|\+|plus)\s+{_DET}?right|right\s+(?:and|&|\+|plus)\s+{_DET}?left)\s+{_PART}|"
    r"(?:two|2)(?:\s+|-)(?:\w+\s+)?(?:hands?|palms|arms)|(?:two|2|double)(?:\s+|-)?handed(?:ly)?|bimanual(?:ly)?|"
    r"pair\s+of\s+hands|(?:each|every)\s+hand|hands\s+together)\b"
)
_ONE = (
    r"(?:one|1|a\s+single|single)(?:\s+|-)hand(?:ed(?:ly)?)?\b|only\s+a\s+hand\b|one\s+of\s+(?:your|my|his|her|their|the)\s+"
    r"hands\b"
)
_NO_SIDE = r"(?<!left )(?<!right )(?<!both )(?<!two )"

LOOKALIKES = tuple(
    re.compile(pattern)
    for pattern in (
        r"\bon\s+the\s+(?:other|one)\s+hand\s*,",
        r"\b(?:model|toy|robot|robotic|prosthetic|mannequin|plastic|wooden|rubber)\s+hands?\b",
        rf"\b(?:left|right)(?:\s+|-)?hand\s+{_LOCATION_NOUN}",
        r"\b(?:left|right)-hand\s+(?!grip|grasp|hold|only|alone|thumb|finger|palm|and\b|to\b|then\b|while\b|but\b)\w+",
        rf"\b(?:left|right|one|two)(?:\s+|-)?handed\s+{_HANDED_TOOL}",
        r"\b(?:left\s+(?:to|and|or|-)\s*right|right\s+(?:to|and|or|-)\s*left)\b(?!\s+(?:hand|palm|arm|fist))",
        r"\b(?:left|right)(?:most|over|overs|ward|wards|ful|fully|ly)\b",
        r"\bright\s+(?:away|now|after|before|next|there|here|angles?|then|back)\b",
        r"\ball\s+right\b",
        rf"{_NO_SIDE}\bhand(?:\s+|-)(?:towels?|soap|cream|grip|brake)\b|\bhands(?:\s+|-)(?:free|off|down)\b",
        rf"{_NO_SIDE}\bhand(?:s|ed|ing)?\s+(?:over|it|me|him|her|them|us|out|back|down)\b",
        r"\b(?:second|first|before|off|by|at|close\s+at)(?:\s+|-)?hand\b",
        r"\bhands\s+of\s+(?:the|a)\b",
    )
)
EITHER = re.compile(
    rf"\b(?:either\s+(?:hand|one|the\s+left|your\s+left)|any\s+hand|whichever\s+hand|left\s+(?:{_PART}\s+)?or\s+{_DET}?right"
    rf"(?:\s+{_PART})?|right\s+(?:{_PART}\s+)?or\s+{_DET}?left(?:\s+{_PART})?)\b"
)
_NOT = r"\b(?:do\s+not|don't|dont|does\s+not|doesn't|did\s+not|never|not(?!\s+(?:only|just))|cannot|can't|avoid|no)\b"
_NOT_NEAR = (
    r"\b(?:without|instead\s+of|rather\s+than|except(?:\s+for)?|other\s+than|(?:anything|all)\s+but|nor|neither)\b"
)
_LOOSE = r"(?:\s+(?!but\b|only\b|just\b|instead\b|because\b|and\b)[\w']+){0,6}?\s+"
_TIGHT = r"(?:\s+(?:using|use|with|in|by|the|your|my|his|her|their|a|any|help|of)){0,4}\s+"
_DENIED = (
    rf"(?:(?:{_MENTION})|(?P<both>{_BOTH}|both{_CLAUSE_END})|(?P<hand>[lr])(?:h\b|(?:\s+|-)hand\b)|"
    rf"(?P<bare>left|right){_CLAUSE_END})"
)
NEGATED = (re.compile(rf"{_NOT}{_LOOSE}{_DENIED}"), re.compile(rf"{_NOT_NEAR}{_TIGHT}{_DENIED}"))
# A hand that is kept away or rests is not the active hand.
_ASIDE = r"(?:away|still|free|idle|on|off)\b"
AT_REST = (
    re.compile(rf"\b(?:keep|keeps|keeping|leave|leaves|leaving)\s+{_DET}?{_MENTION}\s+{_ASIDE}"),
    re.compile(
        rf"\b{_MENTION}\s+(?:(?:(?:is|are|stays?|remains?)\s+)?(?:rest(?:s|ing)?\b|free\b|idle\b)|"
        rf"(?:does|do|doing)\s+nothing\b|(?:(?:is|are)\s+)?(?:kept|left)\s+{_ASIDE}|(?:stays?|remains?)\s+{_ASIDE})"
    ),
)
# A hand that receives an object, or is a location, is not the active hand.
PLACED = re.compile(
    rf"\b(?:on|onto|near|beside|behind|under|above|towards?|(?:left|right|top|front|side|next|close)\s+(?:of|to))\s+"
    rf"{_DET}?{_MENTION}"
)
HANDED = re.compile(
    rf"\bfrom\s+{_DET}?(?:left|right)(?:\s+{_PART}\s+(?:in)?to\s+{_DET}?(?:left|right)(?:\s+{_PART})?|"
    rf"\s+(?:in)?to\s+{_DET}?(?:left|right)\s+{_PART})\b"
)
RECEIVING = re.compile(rf"\b(?:in)?to\s+{_DET}?{_MENTION}")
OTHER_HAND = re.compile(r"\b(?:one|a)\s+(?:hand|palm)\b.*\b(?:the|your|his|her|their|my)\s+other\b")
HANDS = (
    re.compile(rf"\b(?:with|using|use|by|in|between)\s+(?:{_DET}|all\s+|bare\s+)?(?:own\s+|bare\s+)?hands\b"),
    re.compile(rf"\bin\s+{_POSSESSIVE}(?:arms|palms)\b|\bhand\s+to\s+hand\b"),
    re.compile(rf"^\s*{_DET}?hands\s+(?!over\b|on\b|off\b)\w+"),
    re.compile(rf"\b(?:with|use|using)\s+both{_CLAUSE_END}"),
    re.compile(_BOTH),
)
ONE = re.compile(rf"\b(?:{_ONE})")
SIDE_PATTERNS = (
    re.compile(rf"\b{_MENTION}"),
    re.compile(rf"\b{_SIDE}(?:\s+|-)?handed(?:ly)?\b"),
    re.compile(r"\b(?P<letter>[lr])(?:h\b|\.h\b\.?|(?:\s+|-|\.\s*)hand(?:ed)?\b)"),
    re.compile(r"\b(?P<letter>l)eft(?:y|ies)\b|\b(?P<letter2>r)ight(?:y|ies)\b|\bsouthpaws?\b"),
    re.compile(rf"\b(?:with|using|use|just|only|but|via)\s+(?:(?:just|only)\s+)?{_DET}?{_SIDE}{_CLAUSE_END}"),
    re.compile(rf"\bin\s+{_POSSESSIVE}{_SIDE}{_CLAUSE_END}"),
    re.compile(rf"\b{_SIDE}\s+only\b"),
)
HAND_WORD = re.compile(r"\b(?:hand|hands|handed|hander|palms?|fists?)\b")
SIDE_WORD = re.compile(r"\b(?:left|right|both|two)\b")
INDEFINITE_HAND = re.compile(r"\ban?\s+hand\b")


@dataclass
class Mentions:
    """The mentions of hands in a sentence."""

    sides: set[Side] = field(default_factory=set)  # active sides
    both: bool = False
    denied: set[str] = field(default_factory=set)  # negated hands
    one: bool = False  # a single hand without a side
    either: bool = False
    evidence: list[str] = field(default_factory=list)  # the words
    rest: str = ""  # the sentence without them


def find_mentions(text: str) -> Mentions:
    """Find the mentions of hands in an English sentence."""
    mentions = Mentions()
    rest = _normalised(text)
    for pattern in LOOKALIKES:
        rest = pattern.sub(BLANK, rest)
    if EITHER.search(rest):
        mentions.either = True
        rest = EITHER.sub(BLANK, rest)
    for pattern in NEGATED:
        rest = _take(pattern, rest, lambda match: mentions.denied.add(_denied(match)), mentions)
    for pattern in AT_REST:
        rest = _take(pattern, rest, lambda match: mentions.denied.add(_side(match)), mentions)
    for pattern in (HANDED, OTHER_HAND, *HANDS):
        rest = _take(pattern, rest, lambda match: setattr(mentions, "both", True), mentions)
    rest = RECEIVING.sub(BLANK, PLACED.sub(BLANK, rest))
    for pattern in (*SIDE_PATTERNS, _subject_pattern()):
        rest = _take(pattern, rest, lambda match: mentions.sides.add(_side(match)), mentions)
    rest = _take(ONE, rest, lambda match: setattr(mentions, "one", True), mentions)
    if mentions.one and not mentions.sides:
        rest = _take(_AFTER_ONE, rest, lambda match: mentions.sides.add(_side(match)), mentions)
    mentions.rest = INDEFINITE_HAND.sub(BLANK, rest)
    return mentions


_AFTER_ONE = re.compile(rf"¤\s*[,:(]\s*(?:namely\s+)?{_DET}?{_SIDE}\s*(?:$|[.,;!?)])")


def _subject_pattern() -> re.Pattern[str]:
    """Match a side as the subject of a known verb at the start of a clause: "The right grabs ..."."""
    verbs = "|".join(sorted({re.escape(forms.third_singular.split()[0]) for forms in default_grammar().verbs.values()}))
    return re.compile(rf"(?:^|[,;.¤]|\b(?:while|and|then|as|but))\s*{_DET}{_SIDE}\s+(?:{verbs})\b")


def _take(pattern: re.Pattern[str], text: str, record, mentions: Mentions) -> str:
    """Record and blank each match, so that no later pattern matches the same words."""

    def replace(match: re.Match[str]) -> str:
        record(match)
        mentions.evidence.append(" ".join(match.group().replace("¤", "").split()))
        return BLANK

    return pattern.sub(replace, text)


def _side(match: re.Match[str]) -> Side:
    groups = match.groupdict()
    word = groups.get("side") or groups.get("letter") or groups.get("letter2") or "l"
    return "left" if word.startswith("l") else "right"


def _denied(match: re.Match[str]) -> str:
    if match["both"]:
        return "both"
    return "left" if (match["side"] or match["hand"] or match["bare"]).startswith("l") else "right"


def _normalised(text: str) -> str:
    """Normalise case, quotes, dashes and spaces, and correct typing errors in words for hands and sides."""
    text = re.sub(r"\s*[—–]\s*", ", ", text.lower().replace("’", "'"))
    text = re.sub(r"\b([lr])\.\s?h\.", r"\1h", text)
    return " ".join(re.sub(r"[a-z]+", lambda match: _TYPOS.get(match.group(), match.group()), text).split())


def _typos(word: str) -> set[str]:
    """Return typing errors of ``word``: two letters swapped or one doubled. None is an English word."""
    swapped = {word[:i] + word[i + 1] + word[i] + word[i + 2 :] for i in range(len(word) - 1)}
    doubled = {word[: i + 1] + word[i:] for i in range(len(word))}
    return (swapped | doubled) - {word}


# Dropped letters are listed, because most ("had", "let", "and") give other words.
_TYPOS = {typo: word for word in ("left", "right", "both", "hand", "hands") for typo in _typos(word)} | {
    "rigt": "right", "rght": "right", "riht": "right", "bth": "both", "hnd": "hand", "hnds": "hands",
}  # fmt: skip
