"""Reading a user's prompt: which hand, which verb, which object."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

from hoidata.annotation.encoders import TextEncoder
from hoidata.annotation.grammar import Grammar, default_grammar
from hoidata.annotation.hand_choice import HandChoice, select_hand

_HAND_PHRASE = re.compile(
    r"\b(?:(?:with|by|using)\s+)?(?:(?:the|your|my|his|her|their)\s+)?(?:left|right)\s+hand\b|"
    r"\b(?:(?:with|by|using)\s+)?(?:both|two)\s+(?:of\s+)?(?:(?:the|your|my|his|her|their)\s+)?hands\b"
)


@dataclass(frozen=True)
class PromptReading:
    """verb, object_words: base forms of the word table, None when no word of it is there."""

    hand: HandChoice
    verb: str | None
    object_words: str | None


@dataclass(frozen=True)
class _Match:
    base: str
    start: int
    stop: int

    def overlaps(self, other: "_Match") -> bool:
        return self.start < other.stop and other.start < self.stop


def read_prompt(text: str, encoder: TextEncoder | None = None, grammar: Grammar | None = None) -> PromptReading:
    """Hand type, verb and object of an English prompt.

    Of all pairs of a known verb form and a known noun that do not overlap, the pair that covers most of the sentence
    wins; among equals the one whose verb stands first.
    """
    grammar = grammar or default_grammar()
    rest = " ".join(_HAND_PHRASE.sub(" ¤ ", text.lower()).split())
    verbs = list(_matches(rest, {form.lower(): verb.base for verb in grammar.verbs.values() for form in _forms(verb)}))
    nouns = list(_matches(rest, {noun.base.lower(): noun.base for noun in grammar.nouns.values()}))
    pairs = [(verb, noun) for verb in verbs for noun in nouns if not verb.overlaps(noun)]
    best = max(pairs, key=_score, default=None)
    verb = best[0] if best else max(verbs, key=_length, default=None)
    noun = best[1] if best else max(nouns, key=_length, default=None)
    return PromptReading(select_hand(text, encoder), verb.base if verb else None, noun.base if noun and best else None)


def _forms(verb) -> tuple[str, ...]:
    return verb.base, verb.gerund, verb.past_participle, verb.third_singular


def _matches(text: str, bases: dict[str, str]) -> Iterator[_Match]:
    for form, base in bases.items():
        for match in re.finditer(rf"(?<![\w-]){re.escape(form)}(?![\w-])", text):
            yield _Match(base, match.start(), match.end())


def _length(match: _Match) -> int:
    return match.stop - match.start


def _score(pair: tuple[_Match, _Match]) -> tuple[int, int]:
    verb, noun = pair
    return _length(verb) + _length(noun), -verb.start
