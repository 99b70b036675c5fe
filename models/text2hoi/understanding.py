"""Which sentence the networks are told, so that they take it for the verb it has.

Networks of `ours` read the verb of a sentence from its features, learnt on sentences that name a hand and objects of
training. A sentence without a hand, or of a strange object, may be read as another verb though its own was learnt.
Such a sentence is told with the hand in words, or with an object that its verb was learnt with.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from hoidata.annotation.encoders import TextEncoder
from hoidata.annotation.hand_choice import PHRASES, select_hand
from hoidata.clips.clip import HandType
from models.common.vocabulary import Vocabulary

MOST_OBJECTS = 12

Reading = tuple[str, float]


@dataclass(frozen=True)
class Understood:
    """sentence: what the networks are told. text: its features (512,). read_as: the verb they take it for, and how
    likely, None where they are told features. plainly: the verb they take the user's own sentence for.
    """

    sentence: str
    text: np.ndarray
    read_as: Reading | None
    plainly: Reading | None


def understand(
    sentence: str,
    verb: str | None,
    thing: str | None,
    hand: HandType,
    known: Vocabulary,
    encoder: TextEncoder,
    read: Callable[[np.ndarray], Reading | None],
) -> Understood:
    """The user's sentence, or the likeliest of those like it where the networks miss its verb.

    verb, thing: of the sentence, base forms. hand: that acts. read: the reading of features (512,).
    """
    text = encoder.encode([sentence])[0]
    plainly = read(text)
    own = Understood(sentence, text, plainly, plainly)
    if plainly is None or not verb or plainly[0] == verb or verb not in known.verbs:
        return own
    for sentences in _like(sentence, verb, thing, hand, known):
        found = [(told, text, read(text)) for told, text in zip(sentences, encoder.encode(sentences), strict=True)]
        right = [(reading[1], told, text) for told, text, reading in found if reading and reading[0] == verb]
        if right:
            likely, told, text = max(right, key=lambda item: item[:2])
            return Understood(told, text, (verb, likely), plainly)
    return own


def _like(sentence: str, verb: str, thing: str | None, hand: HandType, known: Vocabulary) -> Sequence[list[str]]:
    """The sentence with the hand in words; then that with objects of training in the place of its own."""
    named = sentence if select_hand(sentence).hand else f"{sentence.rstrip(' .!')} {PHRASES[hand]}."
    place = re.compile(rf"\b(an?\s+)?{re.escape(thing)}\b", re.IGNORECASE) if thing else None
    if place is None or not place.search(named):
        return [[named]]
    others = {other for own_verb, other, _ in known.counts if own_verb == verb and other not in ("", thing)}
    swapped = [place.sub(partial(_in_its_place, other), named) for other in sorted(others)[:MOST_OBJECTS]]
    return [[named], swapped] if swapped else [[named]]


def _in_its_place(other: str, found: re.Match[str]) -> str:
    """Another object's words, with the article they take where there was one."""
    article = "an " if other[0] in "aeiou" else "a "
    return (article if found.group(1) else "") + other
