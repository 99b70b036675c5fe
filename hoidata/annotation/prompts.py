"""Parses a prompt: hand, verb and object."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

from hoidata.annotation.encoders import TextEncoder
from hoidata.annotation.grammar import Grammar, default_grammar, default_phrases
from hoidata.annotation.hand_choice import HandChoice, select_hand
from hoidata.annotation.sentences import ACTIONS, JOINED

HAND_PHRASE = re.compile(
    r"\b(?:(?:with|by|in|using)\s+)?(?:(?:the|your|my|his|her|their)\s+)?(?:left|right)\s+hand\b|"
    r"\b(?:(?:with|by|in|using)\s+)?(?:both|two)\s+(?:of\s+)?(?:(?:the|your|my|his|her|their)\s+)?hands\b|"
    r"\b(?:with|by)\s+(?:(?:only|just)\s+)?(?:(?:the|your|my|his|her|their|a|one)\s+)?(?:single\s+)?hand\b|"
    r"\busing\s+(?:(?:only|just)\s+)?(?:the|your|my|his|her|their|a|one)\s+(?:single\s+)?hand\b"
)
_RUN = re.compile(r"[\w-]+")
# The words before the verb in "A knife is used by the right hand to chop".
_PURPOSE = re.compile(r"\b(?:hold|holds|held|holding|use|uses|used|using)\b.*\bto $")


@dataclass(frozen=True)
class PromptReading:
    """Hand, verb and object of a prompt."""

    hand: HandChoice
    verb: str | None  # base form in the grammar table; None without a known word
    object_words: str | None  # likewise


@dataclass(frozen=True)
class _Match:
    base: str
    start: int
    stop: int

    def overlaps(self, other: "_Match") -> bool:
        return self.start < other.stop and other.start < self.stop


@dataclass(frozen=True)
class _Form:
    """A word form and its base form."""

    number: int  # position in the lexicon; between equally good readings the first one wins
    words: str
    base: str


class Lexicon:
    """Surface forms of verbs and objects, and their base forms.

    Args:
        verbs, nouns: pairs of a lower-case form and its base form.

    Raises:
        ValueError: a form has two base forms, so that it is ambiguous.
    """

    def __init__(self, verbs: Iterable[tuple[str, str]], nouns: Iterable[tuple[str, str]]) -> None:
        self._verbs = _Forms(verbs)
        self._nouns = _Forms(nouns)

    def read(self, text: str) -> tuple[str | None, str | None]:
        """Find the verb and the object of a sentence, base forms.

        Hand phrases are skipped. A verb after "to" is the action: "A knife is used to chop". Among pairs of a verb and
        a noun that do not overlap, the pair that covers most characters wins; between equal pairs, the first verb.
        """
        rest = " ".join(HAND_PHRASE.sub(" ¤ ", text.lower()).split())
        verbs, nouns = self._verbs.matches(rest), self._nouns.matches(rest)
        verbs = [verb for verb in verbs if _PURPOSE.search(rest, 0, verb.start)] or verbs
        pairs = [(verb, noun) for verb in verbs for noun in nouns if not verb.overlaps(noun)]
        if pairs:
            verb, noun = max(pairs, key=_score)
            return verb.base, noun.base
        verb = max(verbs, key=_length, default=None)
        return (verb.base if verb else None), None


class _Forms:
    """Finds word forms in a text, indexed by their first word."""

    def __init__(self, forms: Iterable[tuple[str, str]]) -> None:
        bases: dict[str, str] = {}
        for form, base in forms:
            if bases.setdefault(form.lower(), base) != base:
                raise ValueError(f"{form!r} stands for both {bases[form.lower()]!r} and {base!r}")
        self._by_start: dict[str, list[_Form]] = {}
        for number, (words, base) in enumerate(bases.items()):
            start = _RUN.match(words)
            self._by_start.setdefault(start[0] if start else "", []).append(_Form(number, words, base))

    def matches(self, text: str) -> list[_Match]:
        """Find whole words. Matches of one form do not overlap; sorted by position in the lexicon, then in the text."""
        matches: list[tuple[int, _Match]] = []
        stops: dict[int, int] = {}
        for form, start in self._candidates(text):
            stop = start + len(form.words)
            whole = text.startswith(form.words, start) and not _RUN.match(text, stop)
            if whole and start >= stops.get(form.number, 0):
                stops[form.number] = stop
                matches.append((form.number, _Match(form.base, start, stop)))
        return [match for _, match in sorted(matches, key=lambda entry: entry[0])]

    def _candidates(self, text: str) -> Iterator[tuple[_Form, int]]:
        for run in _RUN.finditer(text):
            for form in self._by_start.get(run[0], ()):
                yield form, run.start()
        for form in self._by_start.get("", ()):  # begins with a bracket or quotation mark
            yield from ((form, start) for start in range(len(text)) if not _RUN.match(text, max(start - 1, 0), start))


def grammar_lexicon(grammar: Grammar) -> Lexicon:
    """Build the lexicon of a grammar: all verb forms, and objects without articles.

    It includes idioms ("look through" for see) and the words of the reference implementation.
    """
    verbs = [(form, verb.base) for verb in grammar.verbs.values() for form in sorted(set(verb.forms))]
    verbs += [(form, base) for base, verb in ACTIONS.items() if base in grammar.verbs for form in verb.forms]
    for (base, _), phrase in default_phrases().verbs.items():
        if base in grammar.verbs and phrase.said.base not in grammar.verbs:
            verbs += [(form, base) for form in phrase.said.forms]
        if base in grammar.verbs and phrase.purpose:
            verbs.append((phrase.purpose, base))
    nouns = [(noun.base, noun.base) for noun in grammar.nouns.values()]
    joined = [(words, base) for base, words in JOINED.items() if base in grammar.nouns and words not in grammar.nouns]
    return Lexicon(verbs, nouns + joined)


@lru_cache(maxsize=1)
def _default_lexicon() -> Lexicon:
    return grammar_lexicon(default_grammar())


def read_prompt(text: str, encoder: TextEncoder | None = None, grammar: Grammar | None = None) -> PromptReading:
    """Parse hand, verb and object of an English prompt with the words of a grammar (see ``Lexicon.read``)."""
    lexicon = _default_lexicon() if grammar is None else grammar_lexicon(grammar)
    verb, noun = lexicon.read(text)
    return PromptReading(select_hand(text, encoder), _labels().get((verb, noun), verb), noun)


@lru_cache(maxsize=1)
def _labels() -> dict[tuple[str | None, str | None], str]:
    """Map idioms that equal another verb of the table to the verb they replace: "put on" eyeglasses is "wear"."""
    verbs = default_phrases().verbs
    return {
        (phrase.said.base, noun): verb
        for (verb, noun), phrase in verbs.items()
        if phrase.said.base in default_grammar().verbs and phrase.said.base != verb
    }


def _length(match: _Match) -> int:
    return match.stop - match.start


def _score(pair: tuple[_Match, _Match]) -> tuple[int, int]:
    verb, noun = pair
    return _length(verb) + _length(noun), -verb.start
