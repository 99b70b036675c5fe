"""More ways to say the same interaction than the paper's four, each read back before it is kept.

Frames, determiners, hand phrases, synonyms and, where the speed was measured, adverbs. A sentence is kept only when
reading it gives back its hand by rule, its verb and its object among the words of the dataset; the others are counted.
"""

import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from itertools import product
from typing import Literal

from hoidata.annotation.grammar import NounPhrase, VerbForms, default_grammar
from hoidata.annotation.hand_choice import select_hand
from hoidata.annotation.prompts import Lexicon
from hoidata.annotation.sentences import as_sentence
from hoidata.clips import HandType

Manner = Literal["slowly", "quickly"]
Loss = Literal["hand", "verb", "object"]
HAND_PHRASES: dict[HandType, tuple[str, ...]] = {
    "left": ("the left hand", "your left hand", "only the left hand"),
    "right": ("the right hand", "your right hand", "only the right hand"),
    "both": ("both hands", "two hands", "both of your hands"),
}
INSTRUMENT = "with"


@dataclass(frozen=True)
class WordTable:
    """``frames.csv``: prepositions a verb takes ("drink from"), natural phrases of objects, synonyms of verbs."""

    prepositions: dict[str, str]
    phrases: dict[str, str]
    synonyms: dict[str, str]


@dataclass(frozen=True)
class _Object:
    """An object in a sentence: words with determiner and preposition, and whether it is plural."""

    words: str
    preposition: str
    plural: bool

    @property
    def after_verb(self) -> str:
        return f"{self.preposition} {self.words}".strip()


class SentenceMaker:
    """Sentences over the words of one dataset.

    verbs, objects: base forms. A synonym that is itself a verb of the dataset, or stands for two of them, is not used.
    """

    def __init__(self, verbs: Iterable[str], objects: Iterable[str]) -> None:
        self._grammar = default_grammar()
        self._table = word_table()
        self._verbs = sorted(set(verbs))
        self._objects = sorted(set(objects))
        self._lexicon = self._make_lexicon()

    def unguarded(self, verb: str, object_words: str, hand: HandType, manner: Manner | None = None) -> tuple[str, ...]:
        """Every distinct sentence the frames make, before the guard; the paper's four are among them.

        manner: adds the adverb in two positions; only for a clip whose speed was measured.
        """
        return tuple(dict.fromkeys(self._sentences(verb, object_words, hand, manner)))

    def lost(self, sentence: str, verb: str, object_words: str, hand: HandType) -> Loss | None:
        """What reading the sentence does not give back, the first of hand, verb and object; None when all are there."""
        choice = select_hand(sentence)
        if choice.source != "rule" or choice.hand != hand:
            return "hand"
        read_verb, read_object = self._lexicon.read(sentence)
        if read_verb != verb:
            return "verb"
        return None if read_object == object_words else "object"

    def synonyms(self, verb: str) -> tuple[VerbForms, ...]:
        """The verb itself and its synonym, where that is no other word of the dataset."""
        names = [verb, self._table.synonyms.get(verb)]
        return tuple(self._grammar.verb(name) for name in names if name and (name == verb or name not in self._verbs))

    def _make_lexicon(self) -> Lexicon:
        verbs = {}
        for verb in self._verbs:
            for forms in self.synonyms(verb):
                for form in (forms.base, forms.gerund, forms.past_participle, forms.third_singular):
                    verbs.setdefault(form.lower(), verb)
        nouns = [(words, noun) for noun in self._objects for words in (noun, self._phrase(noun))]
        return Lexicon(verbs.items(), {words.lower(): noun for words, noun in nouns}.items())

    def _phrase(self, noun: str) -> str:
        """The natural phrase of an object without its article, or the object itself."""
        words = self._table.phrases.get(noun, noun)
        return words.partition(" ")[2] if words.startswith(("a ", "an ")) else words

    def _sentences(self, verb: str, noun: str, hand: HandType, manner: Manner | None) -> Iterator[str]:
        things = list(self._determined(verb, noun))
        for forms, thing, hands in product(self.synonyms(verb), things, HAND_PHRASES[hand]):
            for sentence in _frames(forms, thing, hands, hand == "both"):
                yield as_sentence(sentence)
                if manner:
                    yield as_sentence(f"{manner}, {sentence}")
                    yield as_sentence(f"{sentence} {manner}")

    def _determined(self, verb: str, noun: str) -> Iterator[_Object]:
        """The object plain and in its natural phrase, with "a", "the" and "this"; with and without its preposition."""
        plain = self._grammar.noun(noun)
        phrases = [plain]
        if noun in self._table.phrases:
            words = self._table.phrases[noun]
            phrases.append(NounPhrase(noun, words, "singular"))
        prepositions = dict.fromkeys(("", self._table.prepositions.get(verb, "")))
        for phrase, preposition in product(phrases, prepositions):
            bare = phrase.words.removeprefix("a ").removeprefix("an ")
            plural = phrase.number == "plural"
            for words in (phrase.words, f"the {bare}", f"{'these' if plural else 'this'} {bare}"):
                yield _Object(words, preposition, plural)


def _frames(forms: VerbForms, thing: _Object, hands: str, plural_hands: bool) -> Iterator[str]:
    what = thing.after_verb
    held = f"{'in' if thing.preposition == INSTRUMENT else 'with'} {hands}"
    yield f"{forms.base} {what} {held}"
    yield from _passives(forms, thing, hands)
    yield f"{hands} {forms.base if plural_hands else forms.third_singular} {what}"
    yield f"{hands} {'are' if plural_hands else 'is'} {forms.gerund} {what}"
    yield f"{forms.gerund} {what} {held}"
    yield f"with {hands}, {forms.base} {what}"
    if "your" not in hands:
        yield f"a person {forms.third_singular} {what} {held}"
        yield f"someone is {forms.gerund} {what} {held}"


def _passives(forms: VerbForms, thing: _Object, hands: str) -> Iterator[str]:
    auxiliary = "are" if thing.plural else "is"
    if thing.preposition == INSTRUMENT:
        yield f"{thing.words} {auxiliary} used to {forms.base} by {hands}"
        return
    done = f"{forms.past_participle} {thing.preposition}".strip()
    yield f"{thing.words} {auxiliary} {done} by {hands}"
    yield f"{thing.words} {auxiliary} being {done} by {hands}"


@lru_cache(maxsize=1)
def word_table() -> WordTable:
    """The table shipped with the package."""
    text = files("hoidata.annotation").joinpath("frames.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    kinds = {
        kind: {row["base"]: row["words"] for row in rows if row["kind"] == kind} for kind in {r["kind"] for r in rows}
    }
    return WordTable(kinds["preposition"], kinds["phrase"], kinds["synonym"])


def manner_of(speed: float, quantiles: tuple[float, float]) -> Manner | None:
    """The adverb a measured speed deserves: below the lower or above the upper of two quantiles of its dataset."""
    slow, quick = quantiles
    return "slowly" if speed < slow else "quickly" if speed > quick else None
