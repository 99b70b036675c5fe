"""Reading a user's prompt: which hand, which verb, which object."""

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
# What stands before the verb in "A knife is used by the right hand to chop".
_PURPOSE = re.compile(r"\b(?:hold|holds|held|holding|use|uses|used|using)\b.*\bto $")


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


@dataclass(frozen=True)
class _Form:
    """number: place in the lexicon; of two equally good readings the one that stands first there is taken."""

    number: int
    words: str
    base: str


class Lexicon:
    """Surface forms of verbs and objects and the base form each stands for.

    verbs, nouns: lower-case form -> base form. A form that stands for two bases is refused (ValueError): a sentence
    with it could not be read back.
    """

    def __init__(self, verbs: Iterable[tuple[str, str]], nouns: Iterable[tuple[str, str]]) -> None:
        self._verbs = _Forms(verbs)
        self._nouns = _Forms(nouns)

    def read(self, text: str) -> tuple[str | None, str | None]:
        """Verb and object of a sentence, base forms.

        Hand phrases are passed over. A verb after "to" is the action: "A knife is used to chop". Of all pairs of a
        known verb form and a known noun that do not overlap, the pair that covers most of the sentence wins; among
        equals the one whose verb stands first.
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
    """Word forms found by the run of letters, digits and hyphens they begin with: a look-up per word of the text."""

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
        """Whole words; places of one form do not overlap. In the order of the lexicon, then of the text."""
        found: list[tuple[int, _Match]] = []
        stops: dict[int, int] = {}
        for form, start in self._candidates(text):
            stop = start + len(form.words)
            whole = text.startswith(form.words, start) and not _RUN.match(text, stop)
            if whole and start >= stops.get(form.number, 0):
                stops[form.number] = stop
                found.append((form.number, _Match(form.base, start, stop)))
        return [match for _, match in sorted(found, key=lambda entry: entry[0])]

    def _candidates(self, text: str) -> Iterator[tuple[_Form, int]]:
        for run in _RUN.finditer(text):
            for form in self._by_start.get(run[0], ()):
                yield form, run.start()
        for form in self._by_start.get("", ()):  # begins with a bracket or quotation mark
            yield from ((form, start) for start in range(len(text)) if not _RUN.match(text, max(start - 1, 0), start))


def grammar_lexicon(grammar: Grammar) -> Lexicon:
    """Every form of the verbs of a grammar, and its objects without their articles.

    Phrases ("look through" for see) and the reference's words stand for the same verbs and objects.
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
    """Hand type, verb and object of an English prompt, by the words of a grammar (see ``Lexicon.read``)."""
    lexicon = _default_lexicon() if grammar is None else grammar_lexicon(grammar)
    verb, noun = lexicon.read(text)
    return PromptReading(select_hand(text, encoder), _labels().get((verb, noun), verb), noun)


@lru_cache(maxsize=1)
def _labels() -> dict[tuple[str | None, str | None], str]:
    """The verb of a dataset that is said with another verb of the table: "put on" eyeglasses is "wear"."""
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
