"""Which sentence the networks are told, so that they take it for the verb it has.

Networks of `ours` read the verb of a sentence from its features, learnt on sentences that name a hand and objects of
training. A sentence without a hand, or of a strange object, may be read as another verb though its own was learnt.
Such a sentence is told with the hand in words, with an object that its verb was learnt with, or in a training clip's
words: its verb decides what is made, whatever else it says. A recorded clip's sentence is told as a person's is, so
that figures are of what a person gets.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product

import numpy as np
import torch

from hoidata.annotation.encoders import TextEncoder, refuse_other_encoder
from hoidata.annotation.hand_choice import PHRASES, select_hand
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, HandType
from models.common.checkpoints import Checkpoint
from models.common.vocabulary import Vocabulary
from models.text2hoi.verb_check import read_verb

MOST_OBJECTS = 12

Reading = tuple[str, float]
Encode = Callable[[Sequence[str]], np.ndarray]


def reading_of(diffusion: Checkpoint) -> Callable[[np.ndarray], Reading | None]:
    """From features (512,) of a sentence to the verb that a diffusion network takes it for."""
    return lambda text: read_verb(diffusion, torch.from_numpy(text))


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
    text: np.ndarray,
    verb: str | None,
    thing: str | None,
    hand: HandType,
    known: Vocabulary,
    encode: Encode,
    read: Callable[[np.ndarray], Reading | None],
) -> Understood:
    """The user's sentence, or the likeliest of those like it where the networks miss its verb.

    text: (512,) its features. verb, thing: of it, base forms. hand: that acts. encode: sentences to features, asked
    only where the verb is missed. read: the reading of features (512,).
    """
    plainly = read(text)
    own = Understood(sentence, text, plainly, plainly)
    if plainly is None or not verb or plainly[0] == verb or verb not in known.verbs:
        return own
    for sentences in _like(sentence, verb, thing, hand, known):
        found = [(told, text, read(text)) for told, text in zip(sentences, encode(sentences), strict=True)]
        right = [(reading[1], told, text) for told, text, reading in found if reading and reading[0] == verb]
        if right:
            likely, told, text = max(right, key=lambda item: item[:2])
            return Understood(told, text, (verb, likely), plainly)
    return own


@dataclass(frozen=True)
class Teller:
    """Tells networks the sentences of recorded clips as a person's are told (:func:`understand`).

    known: what the networks were trained on. encoder: asked for only where a sentence is misread. read: as there.
    """

    known: Vocabulary
    encoder: Callable[[], TextEncoder]
    read: Callable[[np.ndarray], Reading | None]

    @classmethod
    def of(cls, trained: Mapping[str, Checkpoint], encoder: Callable[[], TextEncoder]) -> "Teller":
        """For the networks of one dataset. The encoder is made once; it raises BadInput where it is not theirs."""
        diffusion = trained["diffusion"]

        @cache
        def own() -> TextEncoder:
            found = encoder()
            refuse_other_encoder("params.yaml: annotate.encoder", diffusion.facts["encoder"], found.identity)
            return found

        return cls(Vocabulary.read(trained["contact"].facts), own, reading_of(diffusion))

    def told(self, request: Request) -> Request:
        """The request with the features its sentence is told with; unchanged where its sentence is not known."""
        asked = request.sentence
        if asked is None:
            return request
        left, right = request.active_hands
        hand: HandType = "both" if left and right else SIDES[int(right)]

        def encode(sentences: Sequence[str]) -> np.ndarray:
            return self.encoder().encode(sentences)

        found = understand(asked.words, request.text, asked.verb, asked.thing, hand, self.known, encode, self.read)
        return replace(request, sentence=replace(asked, words=found.sentence), text=found.text)


def _like(sentence: str, verb: str, thing: str | None, hand: HandType, known: Vocabulary) -> Sequence[list[str]]:
    """The sentence with the hand in words; then with objects of training in place of its own; then training's own."""
    named = sentence if select_hand(sentence).hand else f"{sentence.rstrip(' .!?')} {PHRASES[hand]}."
    place = re.compile(rf"\b(an?\s+)?{re.escape(thing)}\b", re.IGNORECASE) if thing else None
    others = sorted({other for own_verb, other, _ in known.counts if own_verb == verb and other})
    # Training's own words with any hand: which hands act is told apart from the sentence.
    learnt = [
        f"{verb.capitalize()} {_with_article(other)} {phrase}."
        for other, phrase in product(others[:MOST_OBJECTS], dict.fromkeys([PHRASES[hand], *PHRASES.values()]))
    ]
    others = [other for other in others if other != thing][:MOST_OBJECTS]
    swapped = [place.sub(partial(_in_its_place, other), named) for other in others if place and place.search(named)]
    return [sentences for sentences in ([named], swapped, learnt) if sentences]


def _in_its_place(other: str, found: re.Match[str]) -> str:
    """Another object's words, with the article they take where there was one."""
    return _with_article(other) if found.group(1) else other


def _with_article(other: str) -> str:
    return f"{'an' if other[0] in 'aeiou' else 'a'} {other}"
