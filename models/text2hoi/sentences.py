"""A user's sentence: is it one, and what of it has a model never seen in training?"""

import re
from collections.abc import Mapping

import numpy as np
from lemminflect import getAllLemmas

from hoidata.annotation.encoders import TextEncoder
from hoidata.annotation.prompts import read_prompt
from hoidata.clips.clip import HandType
from hoidata.errors import BadInput
from models.common.vocabulary import Vocabulary

LONGEST_WORDS = 60
KNOWN_SHARE = 0.6
NAMED = 3
# What the dictionary, which inflects, does not list.
_FUNCTION_WORDS = """the a an with of to from in on onto into at and or then while it its your my his her their this
that these those as if for until without using only one two three four five both each every no not"""
FUNCTION_WORDS = frozenset(re.findall(r"\w+", _FUNCTION_WORDS))


def unseen_words(
    known: Vocabulary, text: str, verb: str | None, thing: str | None, hand: HandType, encoder: TextEncoder
) -> list[str]:
    """What of a sentence was never in training, each with the nearest that was; in words for a person."""
    thing = thing or _known_object(known, text)
    notes = []
    if not verb or verb not in known.verbs:
        word = verb or _first_verb(text)
        notes.append(_stranger("verb", word, known.verbs, encoder))
    if not thing or thing not in known.objects:
        notes.append(_stranger("object", thing, known.objects, encoder))
    if notes:
        return notes
    if not any(key[:2] == (verb, thing) for key in known.counts):
        return [f"{verb!r} and {thing!r} were each in training, never together"]
    if (verb, thing, hand) not in known.counts:
        return [f"{verb!r} with {thing!r} was in training, never with hand type {hand!r}"]
    return []


def _known_object(known: Vocabulary, text: str) -> str | None:
    """The object of training whose words stand in ``text``, the longest; a sentence with a strange verb is not read."""
    found = [thing for thing in known.objects if thing and re.search(rf"\b{re.escape(thing)}\b", text.lower())]
    return max(found, key=len, default=None)


def _stranger(kind: str, word: str | None, known: Mapping[str, int], encoder: TextEncoder) -> str:
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


def further_verbs(text: str, verb: str, known: Vocabulary) -> list[str]:
    """Verbs of training that a sentence asks for beside its first, as "pour" in "Lift a mug and then pour"."""
    first_words = {other.split()[0] for other in known.verbs if other}
    following = re.findall(r"\b(?:and|then)\s+(?!then\b)(\w+)", text.lower())
    found = [lemma for word in following for lemma in getAllLemmas(word).get("VERB", ())]
    return [own for own in dict.fromkeys(found) if own in first_words and own != verb.split()[0]]


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
