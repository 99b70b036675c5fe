"""Reading a user's prompt: which hand, which verb, which object."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

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


class Lexicon:
    """Surface forms of verbs and objects and the base form each stands for.

    verbs, nouns: lower-case form -> base form. A form that stands for two bases is refused (ValueError): a sentence
    with it could not be read back.
    """

    def __init__(self, verbs: Iterable[tuple[str, str]], nouns: Iterable[tuple[str, str]]) -> None:
        self._verbs = _patterns(verbs)
        self._nouns = _patterns(nouns)

    def read(self, text: str) -> tuple[str | None, str | None]:
        """Verb and object of a sentence, base forms.

        Hand phrases are passed over. Of all pairs of a known verb form and a known noun that do not overlap, the pair
        that covers most of the sentence wins; among equals the one whose verb stands first.
        """
        rest = " ".join(_HAND_PHRASE.sub(" ¤ ", text.lower()).split())
        verbs, nouns = list(_matches(rest, self._verbs)), list(_matches(rest, self._nouns))
        pairs = [(verb, noun) for verb in verbs for noun in nouns if not verb.overlaps(noun)]
        if pairs:
            verb, noun = max(pairs, key=_score)
            return verb.base, noun.base
        verb = max(verbs, key=_length, default=None)
        return (verb.base if verb else None), None


def grammar_lexicon(grammar: Grammar) -> Lexicon:
    """Every form of the verbs of a grammar, and its objects without their articles."""
    verbs = [(form, verb.base) for verb in grammar.verbs.values() for form in sorted(set(_forms(verb)))]
    return Lexicon(verbs, [(noun.base, noun.base) for noun in grammar.nouns.values()])


@lru_cache(maxsize=1)
def _default_lexicon() -> Lexicon:
    return grammar_lexicon(default_grammar())


def read_prompt(text: str, encoder: TextEncoder | None = None, grammar: Grammar | None = None) -> PromptReading:
    """Hand type, verb and object of an English prompt, by the words of a grammar (see ``Lexicon.read``)."""
    lexicon = _default_lexicon() if grammar is None else grammar_lexicon(grammar)
    verb, noun = lexicon.read(text)
    return PromptReading(select_hand(text, encoder), verb, noun)


def _patterns(forms: Iterable[tuple[str, str]]) -> list[tuple[str, re.Pattern[str]]]:
    bases: dict[str, str] = {}
    for form, base in forms:
        if bases.setdefault(form.lower(), base) != base:
            raise ValueError(f"{form!r} stands for both {bases[form.lower()]!r} and {base!r}")
    return [(base, re.compile(rf"(?<![\w-]){re.escape(form)}(?![\w-])")) for form, base in bases.items()]


def _forms(verb) -> tuple[str, ...]:
    return verb.base, verb.gerund, verb.past_participle, verb.third_singular


def _matches(text: str, patterns: list[tuple[str, re.Pattern[str]]]) -> Iterator[_Match]:
    for base, pattern in patterns:
        for match in pattern.finditer(text):
            yield _Match(base, match.start(), match.end())


def _length(match: _Match) -> int:
    return match.stop - match.start


def _score(pair: tuple[_Match, _Match]) -> tuple[int, int]:
    verb, noun = pair
    return _length(verb) + _length(noun), -verb.start
