"""What a model has been told about in training, and what of a user's sentence it has never seen."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from lemminflect import getAllLemmas

from hoidata.annotation.encoders import TextEncoder
from hoidata.annotation.prompts import read_prompt
from hoidata.batches.dataset import ClipSample
from hoidata.clips.clip import HandType
from hoidata.errors import BadInput

LONGEST_WORDS = 60
KNOWN_SHARE = 0.6
NAMED = 3
# What the dictionary, which inflects, does not list.
_FUNCTION_WORDS = """the a an with of to from in on onto into at and or then while it its your my his her their this
that these those as if for until without using only one two three four five both each every no not"""
FUNCTION_WORDS = frozenset(re.findall(r"\w+", _FUNCTION_WORDS))


@dataclass(frozen=True)
class Vocabulary:
    """What training clips were about. counts: clips by (verb, object words, hand type)."""

    counts: Mapping[tuple[str, str, str], int]

    @classmethod
    def of(cls, samples: Iterable[ClipSample]) -> "Vocabulary":
        return cls(Counter((sample.verb or "", sample.object_words, sample.hand_type) for sample in samples))

    @classmethod
    def read(cls, facts: Mapping[str, Any]) -> "Vocabulary":
        """From what a checkpoint records."""
        return cls({(verb, thing, hand): count for verb, thing, hand, count in facts.get("vocabulary", [])})

    @property
    def rows(self) -> list[list[str | int]]:
        """What a checkpoint records: verb, object, hand type, clips."""
        return [[*key, count] for key, count in sorted(self.counts.items())]

    @property
    def verbs(self) -> Counter[str]:
        return self._clips_by(0)

    @property
    def objects(self) -> Counter[str]:
        return self._clips_by(1)

    def _clips_by(self, column: int) -> Counter[str]:
        found: Counter[str] = Counter()
        for key, count in self.counts.items():
            found[key[column]] += count
        return found

    def knows(self, verb: str | None, object_words: str | None) -> int:
        """How many training clips are about this verb and object; a verb alone counts a little, an object less."""
        both = sum(count for key, count in self.counts.items() if key[:2] == (verb, object_words))
        return 4 * bool(both) + 2 * (verb in self.verbs) + (object_words in self.objects)

    def unseen(self, text: str, verb: str | None, thing: str | None, hand: HandType, encoder: TextEncoder) -> list[str]:
        """What of a sentence was never in training, each with the nearest that was; in words for a person."""
        notes = []
        if not verb or verb not in self.verbs:
            word = verb or _first_verb(text)
            notes.append(self._stranger("verb", word, self.verbs, encoder))
        if not thing or thing not in self.objects:
            notes.append(self._stranger("object", thing, self.objects, encoder))
        if notes:
            return notes
        if not any(key[:2] == (verb, thing) for key in self.counts):
            return [f"{verb!r} and {thing!r} were each in training, never together"]
        if (verb, thing, hand) not in self.counts:
            return [f"{verb!r} with {thing!r} was in training, never with hand type {hand!r}"]
        return []

    def _stranger(self, kind: str, word: str | None, known: Mapping[str, int], encoder: TextEncoder) -> str:
        if not word:
            return f"no {kind} is in the sentence that training had; it had: {', '.join(sorted(filter(None, known)))}"
        near = nearest_words(word, sorted(filter(None, known)), encoder)
        return f"the {kind} {word!r} was never in training; nearest that were: {', '.join(near)}"


def read_sentence(text: str) -> tuple[str | None, str | None]:
    """Verb and object of a user's sentence, base forms; None for what no word table knows.

    Raises BadInput for no text, more than 60 words, and what is hardly English.
    """
    words = ["".join(filter(str.isalpha, word)) for word in text.split()]
    words = [word.lower() for word in words if word]
    remedy = "write an English sentence, like: Lift a mug with the right hand."
    if not words:
        raise BadInput("the sentence", "words", repr(text[:40]), remedy)
    if len(words) > LONGEST_WORDS:
        raise BadInput("the sentence", f"at most {LONGEST_WORDS} words", f"{len(words)} words", "ask for one action")
    reading = read_prompt(text)
    strange = [word for word in words if not is_english(word)]
    if len(strange) > (1 - KNOWN_SHARE) * len(words) and not (reading.verb and reading.object_words):
        raise BadInput("the sentence", "English", f"unknown words: {', '.join(strange[:8])}", remedy)
    return reading.verb, reading.object_words


def is_english(word: str) -> bool:
    """Whether a lower-case word is in lemminflect's dictionary or a function word. ASCII only: no other script is."""
    return word.isascii() and (word in FUNCTION_WORDS or bool(getAllLemmas(word)))


def nearest_words(word: str, known: list[str], encoder: TextEncoder) -> list[str]:
    """The known words most like ``word`` in the text encoder's features, best first."""
    features = encoder.encode([word, *known])
    features = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)
    order = np.argsort(-(features[1:] @ features[0]), kind="stable")[:NAMED]
    return [known[row] for row in order]


def _first_verb(text: str) -> str | None:
    """The first word that the dictionary knows as a verb, in its base form."""
    for word in text.lower().split():
        lemmas = getAllLemmas("".join(filter(str.isalpha, word))).get("VERB")
        if lemmas and word not in FUNCTION_WORDS:
            return lemmas[0]
    return None
