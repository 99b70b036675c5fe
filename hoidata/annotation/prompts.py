"""Parses a prompt (hand, verb and object), and checks it: is it English, and which words were not in training?"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from lemminflect import getAllLemmas

from hoidata.annotation.encoders import TextEncoder, cosine_similarities
from hoidata.annotation.grammar import default_grammar, default_phrases
from hoidata.annotation.hand_choice import HandChoice, select_hand
from hoidata.annotation.sentences import ACTIONS, JOINED
from hoidata.annotation.vocabulary import Vocabulary
from hoidata.clips.clip import HandType
from hoidata.errors import BadInput

HAND_PHRASE = re.compile(
    r"\b(?:(?:with|by|in|using)\s+)?(?:(?:only|just)\s+)?(?:(?:the|your|my|his|her|their)\s+)?(?:left|right)\s+hand\b|"
    r"\b(?:(?:with|by|in|using)\s+)?(?:(?:only|just)\s+)?(?:both|two)\s+"
    r"(?:of\s+)?(?:(?:the|your|my|his|her|their)\s+)?hands\b|"
    r"\b(?:with|by)\s+(?:(?:only|just)\s+)?(?:(?:the|your|my|his|her|their|a|one)\s+)?(?:single\s+)?hand\b|"
    r"\busing\s+(?:(?:only|just)\s+)?(?:the|your|my|his|her|their|a|one)\s+(?:single\s+)?hand\b|"
    r"\b(?:(?:left|right|one|two|single)(?:-|\s+)handedly|bimanually)\b"
)
# A clause that negates an action, and not a hand: "but do not close it", "without closing it".
_NEGATED = re.compile(
    r"\b(?:(?:(?:do|does|did|is|are|must|should)\s+)?not(?!\s+(?:only|just)\b)|(?:do|does|did)n['’]?t|never|without|"
    r"instead\s+of|rather\s+than)\b(?!(?:\s+(?:use|using|with|in|by|the|your|my|his|her|their))*\s+"
    r"(?:¤|(?:left|right|both|one|two|hands?)\b)).*?(?=[,;:.!?&]|\b(?:and|then|but)\b|$)"
)
# The words before a noun, such as a place: "from the table".
_ARTICLE = r"\s+(?:(?:a|an|the|this|that|your|my|his|her|their|its|our)\s+)?$"
_FROM = re.compile(rf"\bfrom{_ARTICLE}")
_PLACE = re.compile(rf"\b(?:from|off|on|onto|into|in|inside|next\s+to|near|beside|beneath|under){_ARTICLE}")
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

    @property
    def length(self) -> int:
        return self.stop - self.start

    def overlaps(self, other: "_Match") -> bool:
        return self.start < other.stop and other.start < self.stop


class Lexicon:
    """Surface forms of verbs and objects, as pairs of a lower-case form and its base form.

    Raises ValueError if a form has two base forms, so that it is ambiguous.
    """

    def __init__(self, verbs: Iterable[tuple[str, str]], nouns: Iterable[tuple[str, str]]) -> None:
        self._verbs = _Forms(verbs)
        self._nouns = _Forms(nouns)

    def read(self, text: str) -> tuple[str | None, str | None]:
        """Find the verb and the object of a sentence, base forms.

        Hand phrases and negated clauses are skipped. A verb after "to" is the action: "A knife is used to chop". Among
        pairs of a verb and a noun that do not overlap, the verb of the pair that covers most characters wins; between
        equal pairs, the first verb.
        """
        rest = " ".join(_affirmed(HAND_PHRASE.sub(" ¤ ", text.lower())).split())
        verbs, nouns = self._verbs.matches(rest), self._nouns.matches(rest)
        verbs = [verb for verb in verbs if _PURPOSE.search(rest, 0, verb.start)] or verbs
        pairs = [(verb, noun) for verb in verbs for noun in nouns if not verb.overlaps(noun)]
        if pairs:
            verb, _ = max(pairs, key=lambda pair: (pair[0].length + pair[1].length, -pair[0].start))
            return verb.base, _object_of(verb, nouns, rest).base
        verb = max(verbs, key=lambda match: match.length, default=None)
        return (verb.base if verb else None), None


def _object_of(verb: _Match, nouns: list[_Match], text: str) -> _Match:
    """The noun that a verb acts on: the first after it, else in the text; a place only if there is nothing else."""
    free = [noun for noun in nouns if not noun.overlaps(verb)]
    whole = [noun for noun in free if noun.length == max(other.length for other in free if noun.overlaps(other))]
    # The "on" of the verb "put on" names no place.
    searched_from = {noun: verb.stop if noun.start > verb.start else 0 for noun in whole}
    no_places = [noun for noun in whole if not _PLACE.search(text, searched_from[noun], noun.start)]
    sources = [noun for noun in whole if _is_source(verb, noun, text)]
    return min(sources or no_places or whole, key=lambda noun: (noun.start < verb.start, noun.start))


def _is_source(verb: _Match, noun: _Match, text: str) -> bool:
    """Whether a verb acts on the noun after its "from": "Pour water from a teapot"."""
    phrase = default_phrases().verbs.get((verb.base, noun.base))
    return bool(phrase) and phrase.said.base.endswith(" from") and bool(_FROM.search(text, 0, noun.start))


def _affirmed(text: str) -> str:
    """A lower-case text without its negated clauses; unchanged if no verb is left."""
    affirmed = _NEGATED.sub(" ", text)
    return affirmed if first_verb(re.sub(r"\buse\s+¤", "", affirmed)) else text


class _Forms:
    """Finds word forms in a text."""

    def __init__(self, forms: Iterable[tuple[str, str]]) -> None:
        bases: dict[str, str] = {}
        for form, base in forms:
            if bases.setdefault(form.lower(), base) != base:
                raise ValueError(f"{form!r} stands for both {bases[form.lower()]!r} and {base!r}")
        whole = r"(?<![\w-]){}(?![\w-])"
        self._forms = [(form, re.compile(whole.format(re.escape(form))), base) for form, base in bases.items()]

    def matches(self, text: str) -> list[_Match]:
        """Find whole words. Matches of one form do not overlap; sorted by position in the lexicon, then in the text."""
        present = [(pattern, base) for form, pattern, base in self._forms if form in text]
        return [_Match(base, *match.span()) for pattern, base in present for match in pattern.finditer(text)]


@lru_cache(maxsize=1)
def _default_lexicon() -> Lexicon:
    """Build the lexicon of the grammar: all verb forms, and objects without articles.

    It includes idioms ("look through" for see) and the words of the reference implementation.
    """
    grammar = default_grammar()
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


def read_prompt(text: str) -> PromptReading:
    """Parse hand, verb and object of an English prompt with the words of the grammar (see ``Lexicon.read``)."""
    verb, noun = _default_lexicon().read(text)
    return PromptReading(select_hand(text), _labels().get((verb, noun), verb), noun)


@lru_cache(maxsize=1)
def _labels() -> dict[tuple[str | None, str | None], str]:
    """Map idioms that equal another verb of the table to the verb they replace: "put on" eyeglasses is "wear"."""
    said = {(phrase.said.base, noun): verb for (verb, noun), phrase in default_phrases().verbs.items()}
    return {key: verb for key, verb in said.items() if key[0] in default_grammar().verbs and key[0] != verb}


LONGEST_WORDS = 60
KNOWN_SHARE = 0.6
NAMED = 3
# Words that the dictionary does not list.
_FUNCTION_WORDS = """the a an with of to from in on onto into at and or then while it its your my his her their this
that these those as if for until without using only one two three four five both each every no not towards toward
beside against but because than nor per upon beneath during ok
handedly bimanually six seven eight nine ten twenty thirty forty fifty sixty ninety"""
_BETWEEN_CLAUSES = re.compile(r"[,;.&]|\band/or\b|\b(?:and|then)\b")
_ADVERBS = frozenset({"also", "again", "now", "next", "please", "first"})
# A noun follows these words: "drink" in "a drink" is not a verb.
LEFT_OF_NOUNS = ("a", "an", "the", "this", "that", "these", "those", "my", "your", "his", "her", "their", "its", "our")
FUNCTION_WORDS = frozenset(re.findall(r"\w+", _FUNCTION_WORDS))


def unseen_words(
    vocabulary: Vocabulary, text: str, verb: str | None, noun: str | None, hand: HandType, encoder: TextEncoder
) -> list[str]:
    """What of a sentence was not in training, with the most similar training words; in words for the user."""
    noun = noun or _known_object(vocabulary, text)
    notes = []
    if not verb or verb not in vocabulary.verbs:
        word = verb or first_verb(text)
        notes.append(_stranger("verb", word, vocabulary.verbs, encoder))
    if not noun or noun not in vocabulary.objects:
        notes.append(_stranger("object", noun, vocabulary.objects, encoder))
    if notes:
        return notes
    if not any(key[:2] == (verb, noun) for key in vocabulary.counts):
        return [f"{verb!r} and {noun!r} were each in training, never together"]
    if (verb, noun, hand) not in vocabulary.counts:
        return [f"{verb!r} with {noun!r} was in training, never with hand type {hand!r}"]
    return []


def _known_object(vocabulary: Vocabulary, text: str) -> str | None:
    """The longest name of a training object in ``text``; also found in a sentence with an unknown verb."""
    matches = [noun for noun in vocabulary.objects if noun and re.search(rf"\b{re.escape(noun)}\b", text.lower())]
    return max(matches, key=len, default=None)


def _stranger(kind: str, word: str | None, known: Mapping[str, int], encoder: TextEncoder) -> str:
    if not word:
        return f"no {kind} is in the sentence that training had; it had: {', '.join(sorted(filter(None, known)))}"
    near = nearest_words(word, sorted(filter(None, known)), encoder)
    return f"the {kind} {word!r} was never in training; nearest that were: {', '.join(near)}"


def read_sentence(text: str) -> tuple[str | None, str | None]:
    """Verb and object of a user's sentence, in base form; None if not in the word tables.

    Raises BadInput for an empty text, more than 60 words, and text that is not English.
    """
    words = ["".join(filter(str.isalpha, word)) for word in re.split(r"[\s-]+", text)]
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


def further_verbs(text: str, generated: str | None, vocabulary: Vocabulary) -> list[str]:
    """Training verbs in a sentence in addition to the generated one, such as "pour" in "Lift a mug and pour"."""
    clauses = [re.findall(r"[a-z-]+", clause) for clause in _BETWEEN_CLAUSES.split(_affirmed(text.lower()))]
    clauses = [rest for words in clauses if (rest := words[_count_adverbs(words) :])]
    verbs = sorted(filter(None, vocabulary.verbs))
    first = clauses[0][0] if clauses else ""
    ordered = first in getAllLemmas(first).get("VERB", ())  # "Lift ..." and not "A hand lifts ..."
    matches = []
    for number, words in enumerate(clauses):
        starts = range(1) if ordered or number else _of_no_article(words)
        begun = (verb for start in starts for verb in verbs if _begins_with(words[start:], verb, vocabulary, ordered))
        matches += [verb for verb in (next(begun, None),) if verb and verb != generated]
    return list(dict.fromkeys(matches))


def _count_adverbs(words: list[str]) -> int:
    """Number of adverbs before a clause's verb."""
    return next((n for n, word in enumerate(words) if not (word.endswith("ly") or word in _ADVERBS)), len(words))


def _begins_with(words: list[str], verb: str, vocabulary: Vocabulary, ordered: bool) -> bool:
    """Whether words begin with a known verb, and not with an object's name; in base form if ``ordered``."""
    first, *others = verb.split()
    fits = words[0] == first if ordered else first in getAllLemmas(words[0]).get("VERB", ())
    if not fits or words[0] in vocabulary.objects:
        return False
    of_hand = first in ("hand", "use") and {"hand", "hands"} & set(words[1:4])  # "and use both hands"
    return not of_hand and all(other in words[1:6] for other in others)


def _of_no_article(words: list[str]) -> list[int]:
    """Positions of a verb in a clause with a subject: not first, and not after an article."""
    return [start for start in range(1, len(words)) if words[start - 1] not in ("a", "an", "the")]


def is_english(word: str) -> bool:
    """Whether a lower-case word is in lemminflect's dictionary or a function word; ASCII only."""
    return word.isascii() and (word in FUNCTION_WORDS or bool(getAllLemmas(word)))


def nearest_words(word: str, known: list[str], encoder: TextEncoder) -> list[str]:
    """The known words whose text features are most similar to those of ``word``, best first."""
    order = np.argsort(-cosine_similarities(encoder, word, known), kind="stable")[:NAMED]
    return [known[row] for row in order]


def first_verb(text: str) -> str | None:
    """The first word that can be a verb and follows no article, in base form."""
    before = ""
    for word in text.lower().split():
        word = "".join(filter(str.isalpha, word))
        lemmas = getAllLemmas(word).get("VERB")
        if lemmas and word not in FUNCTION_WORDS and before not in LEFT_OF_NOUNS and word not in ("left", "right"):
            return lemmas[0]
        before = word if word not in ("left", "right") else before  # "the right hand"
    return None
