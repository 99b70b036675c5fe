"""Prepares a user's sentence for the networks: spelling is corrected, synonyms become verbs of the training clips.

A word that is in no dictionary is replaced if exactly one training word is a single edit away; the user is informed.
Anything else that would need guessing is refused, with suggestions.
"""

import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

from lemminflect import getAllLemmas

from hoidata.annotation.encoders import TextEncoder
from hoidata.annotation.grammar import default_grammar, default_phrases
from hoidata.annotation.hand_choice import PHRASES
from hoidata.annotation.prompts import (
    FUNCTION_WORDS,
    HAND_PHRASE,
    LEFT_OF_NOUNS,
    first_verb,
    is_english,
    nearest_words,
    read_prompt,
    read_sentence,
)
from hoidata.annotation.vocabulary import Vocabulary
from hoidata.errors import BadInput

FORCE = "or add --force to generate from the sentence as it is typed"
# Words from this length on may have any single edit; shorter ones only two exchanged letters.
MIN_LETTERS = 5
MAX_SUGGESTIONS = 3
LETTERS = "abcdefghijklmnopqrstuvwxyz"
_WORD = re.compile(r"[^\W\d_]+(?:['’][^\W\d_]+)*")
# Paraphrases of training verbs, in addition to the synonyms of the word table; the first one that was trained is used.
PARAPHRASES = {
    "pick up": ("lift",), "set down": ("place",), "hold": ("grasp", "grab"), "grab": ("grasp",), "grasp": ("grab",),
    "give": ("hand over", "pass"),
}  # fmt: skip
PARTICLES = frozenset({"down", "up", "out", "off", "in", "on", "over", "away", "back"})
NO_OBJECTS = frozenset({"hand", "hands", "left hand", "right hand", "person", "man", "woman"})
_IS = re.compile(r"\b(?:is|are|was|were|be|been|being)\s+$", re.IGNORECASE)
_PARTICLE_WITHIN = 5  # words after a verb: "put the heavy mug down"
_OBJECT = re.compile(rf"\b(?:{'|'.join(LEFT_OF_NOUNS)})\s+(?=((?:[a-z-]+\s*)+))")


@dataclass(frozen=True)
class Wording:
    """A prepared sentence."""

    text: str  # with corrected spelling and replaced synonym
    verb: str | None  # base form; a verb of the training clips unless forced; None if not found
    noun: str | None  # the object, base form; None if not found
    notes: tuple[str, ...] = ()  # what was changed, for the user


def understood_words(
    text: str,
    vocabulary: Vocabulary,
    encoder: Callable[[], TextEncoder],
    names: Iterable[str] = (),
    force: bool = False,
) -> Wording:
    """Prepare a sentence: correct it, and find its verb and object.

    encoder: returns a text encoder for suggestions; called only for an error. names: further words that are spelt
    correctly, such as the name of a mesh file. force: accept the sentence unchanged, whatever it contains. Raises
    BadInput, with suggestions, if a word is in no dictionary, or the verb was not in training.
    """
    notes = list[str]()
    if not force:
        text, notes = _corrected(text, vocabulary, names)
    _, noun = read_sentence(text)
    verbs = vocabulary.verb_names
    verb = parsed_verb(text, verbs)
    if noun in (None, "hand"):
        noun = _phrase_after_article(text, verb)
    trained = trained_verb(text, verbs)
    if verb and trained and verb != trained:
        notes.append(f"{verb!r} is read as {trained!r}")
        text, verb = _replaced(text, verb, trained), trained
    if verbs and verb not in verbs and not force:
        first = first_verb(text)
        raise _untrained(verb or (None if first in vocabulary.objects else first), text, verbs, encoder)
    longer_names = [name for name in vocabulary.objects if name and name.endswith(f" {noun}")]
    if noun not in vocabulary.objects and len(longer_names) == 1:
        notes += [] if force else [f"{noun!r} is taken for {longer_names[0]!r}"]
        noun = longer_names[0]
    return Wording(text, verb, noun, tuple(notes))


def trained_verb(text: str, verbs: Sequence[str]) -> str | None:
    """The verb of a sentence, or its first synonym in ``verbs`` if the verb is not there."""
    verb = parsed_verb(text, verbs)
    synonyms = (synonym_of(verb), *PARAPHRASES.get(verb, ())) if verb else ()
    return verb if verb in verbs else next((synonym for synonym in synonyms if synonym in verbs), verb)


def parsed_verb(text: str, verbs: Sequence[str]) -> str | None:
    """The verb of a sentence by the grammar, base form; separated verbs ("put it down") if similar to ``verbs``."""
    verb = read_prompt(text).verb
    if verb in verbs:
        return verb
    return _with_particle(text, [*verbs, *PARAPHRASES, *filter(None, map(synonym_of, verbs))]) or verb


def _untrained(word: str | None, text: str, verbs: Sequence[str], encoder: Callable[[], TextEncoder]) -> BadInput:
    """The error for a verb that no model was trained on; ``word`` is None if the sentence has no verb."""
    expected = f"a verb that the models were trained on ({', '.join(verbs)})"
    first = word or _plain(_WORD.findall(text)[0])
    spelt = [verb for _, verb in _near(first, verbs, 2)]
    same_beginning = [verb for verb in verbs if verb.split()[0] == word]
    # Features of the encoder "hash" do not depend on the meaning of a word.
    has_meanings = word is not None and (model := encoder()).identity["name"] != "hash"
    similar = nearest_words(word, list(verbs), model) if word and has_meanings else []
    suggestions = list(dict.fromkeys([*same_beginning, *spelt, *similar]))[:MAX_SUGGESTIONS]
    suggestion = f"did you mean {_either(suggestions)}? Take" if suggestions else "name what the hands do with"
    return BadInput("the sentence", expected, repr(word) if word else "none", f"{suggestion} one of them, {FORCE}")


def _corrected(text: str, vocabulary: Vocabulary, names: Iterable[str]) -> tuple[str, list[str]]:
    """The text with misspelt words replaced by training words, and a note for each."""
    in_names = {word for name in names for word in re.findall(r"[a-z]+", name.lower())}
    trained, notes = _trained_words(vocabulary), list[str]()

    def corrected_word(match: re.Match[str]) -> str:
        word, _, rest = match[0].replace("’", "'").partition("'")
        lower_case = _plain(word)
        may_be_name = len(word) == 1 or (match.start() > 0 and word != word.lower())
        is_word = lower_case in in_names | trained | _table_words() or is_english(lower_case)
        if may_be_name or is_word or (rest and rest != "s"):
            return match[0]
        candidates = _near(lower_case, trained, 2)
        one_edit_away = [candidate for distance, candidate in candidates if distance == 1]
        corrections = [candidate for candidate in one_edit_away if _is_slip(lower_case, candidate)]
        if len(corrections) != 1 or len(one_edit_away) != 1:
            if not corrections and _is_compound(lower_case):
                return match[0]
            raise _unknown(word, [candidate for _, candidate in candidates] + _english_near(lower_case))
        notes.append(f"{word!r} is read as {corrections[0]!r}")
        correction = corrections[0].capitalize() if word[0].isupper() else corrections[0]
        return match[0].replace(word, correction, 1)

    return _WORD.sub(corrected_word, text), notes


def _unknown(word: str, candidates: Sequence[str]) -> BadInput:
    candidates = list(dict.fromkeys(candidates))[:MAX_SUGGESTIONS]
    suggestion = f"did you mean {_either(candidates)}? Correct it" if candidates else "write it otherwise"
    return BadInput("the sentence", "English words", repr(word), f"{suggestion}, {FORCE}")


def _plain(word: str) -> str:
    """Lower case without accents, as in the dictionary: "Café" becomes "cafe"."""
    decomposed = unicodedata.normalize("NFKD", word.lower())
    return "".join(letter for letter in decomposed if not unicodedata.combining(letter))


def _trained_words(vocabulary: Vocabulary) -> frozenset[str]:
    """All single words of training sentences: forms of verbs and their synonyms, objects, words for hands."""
    verbs = [verb for verb in vocabulary.verbs if verb]
    forms = [form for verb in [*verbs, *filter(None, map(synonym_of, verbs))] for form in forms_of(verb)]
    words = " ".join([*forms, *vocabulary.objects, *PHRASES.values(), *LEFT_OF_NOUNS, "hands from two using"])
    return frozenset(re.findall(r"[a-z]+", words.lower()))


@cache
def _table_words() -> frozenset[str]:
    """Single words of the table of English verbs and objects."""
    grammar = default_grammar()
    return frozenset(re.findall(r"[a-z]+", " ".join([*grammar.verbs, *grammar.nouns]).lower()))


@cache
def synonym_of(verb: str) -> str | None:
    """The synonym of a verb in the word table, in either direction: lift and raise."""
    pairs = default_phrases().synonyms
    return pairs.get(verb) or next((base for base, other in pairs.items() if other == verb), None)


def forms_of(verb: str) -> tuple[str, str, str, str]:
    """Base, gerund, past participle and third person."""
    return default_grammar().verb(verb).forms


def _near(word: str, candidates: Iterable[str], max_edits: int) -> list[tuple[int, str]]:
    """Candidates at most ``max_edits`` edits away, with their distance; the nearest first."""
    near = [(edit_distance(word, candidate, max_edits), candidate) for candidate in candidates]
    return sorted(item for item in near if item[0] <= min(max_edits, max(1, len(word) // 3)))


def _is_compound(word: str) -> bool:
    """Whether a word is a compound of two English words, such as "smartphone"."""
    splits = [(word[:position], word[position:]) for position in range(3, len(word) - 2)]
    return any(is_english(head) and "NOUN" in getAllLemmas(tail) for head, tail in splits)


def _is_slip(word: str, candidate: str) -> bool:
    """Whether one edit between two words is a typing error: the word is long, or two letters are exchanged."""
    return len(word) >= MIN_LETTERS or sorted(word) == sorted(candidate)


def _english_near(word: str) -> list[str]:
    """English nouns and verbs one edit away, in alphabetical order."""
    cuts = [(word[:position], word[position:]) for position in range(len(word) + 1)]
    variants = {head + tail[1:] for head, tail in cuts if tail}
    variants |= {head + tail[1] + tail[0] + tail[2:] for head, tail in cuts if len(tail) > 1}
    variants |= {head + letter + tail[1:] for head, tail in cuts if tail for letter in LETTERS}
    variants |= {head + letter + tail for head, tail in cuts for letter in LETTERS}
    return sorted(variant for variant in variants if {"NOUN", "VERB"} & set(getAllLemmas(variant)))


def edit_distance(one: str, other: str, limit: int) -> int:
    """Damerau-Levenshtein distance (optimal string alignment), at most ``limit`` + 1."""
    if abs(len(one) - len(other)) > limit:
        return limit + 1
    before, row = list[int](), list(range(len(other) + 1))
    for i, letter in enumerate(one, 1):
        above, before, row = before, row, [i]
        for j, other_letter in enumerate(other, 1):
            cost = min(before[j] + 1, row[j - 1] + 1, before[j - 1] + (letter != other_letter))
            if i > 1 and j > 1 and letter == other[j - 2] and one[i - 2] == other_letter:
                cost = min(cost, above[j - 2] + 1)
            row.append(cost)
    return min(row[-1], limit + 1)


def _with_particle(text: str, verbs: Iterable[str]) -> str | None:
    """The verb whose words are separated in the text, such as "put down" in "Put the mug down"."""
    words = re.findall(r"[a-z-]+", HAND_PHRASE.sub(" ", text.lower()))
    for verb in sorted(filter(lambda particle: " " in particle, verbs), key=len, reverse=True):
        head, *rest = verb.split()
        for start, word in enumerate(words):
            is_noun = start > 0 and words[start - 1] in LEFT_OF_NOUNS
            is_verb = not is_noun and head in getAllLemmas(word).get("VERB", ())
            if is_verb and set(rest) <= set(words[start + 1 : start + 1 + _PARTICLE_WITHIN]):
                return verb
    return None


def _replaced(text: str, verb: str, trained: str) -> str:
    """The text with a synonym replaced by a training verb in the same form; unchanged if its words are separated."""
    new_forms = forms_of(trained)
    for form, new_form in zip(forms_of(verb), new_forms, strict=True):
        match = re.search(rf"\b{re.escape(form)}\b", text, re.IGNORECASE)
        if match:
            # "put down" is base form and participle.
            new_form = new_forms[2] if form == forms_of(verb)[2] and _IS.search(text[: match.start()]) else new_form
            replacement = new_form.capitalize() if match[0][0].isupper() else new_form
            return text[: match.start()] + replacement + text[match.end() :]
    return text


def _phrase_after_article(text: str, verb: str | None) -> str | None:
    """The name of an object that is in no word table: the words from an article to the end of the noun phrase."""
    rest, forms = HAND_PHRASE.sub(" . ", text.lower()), forms_of(verb) if verb else ()
    for match in _OBJECT.finditer(rest):
        words = match[1].split()
        stop = next((number for number, word in enumerate(words) if _ends_a_name(word) or word in forms), len(words))
        phrase = " ".join(words[:stop])
        if phrase and phrase not in NO_OBJECTS:
            return phrase
    return None


def _ends_a_name(word: str) -> bool:
    kinds = set(getAllLemmas(word))
    return word in FUNCTION_WORDS | PARTICLES or (bool(kinds) and not {"NOUN", "ADJ"} & kinds)


def _either(words: Sequence[str]) -> str:
    return " or ".join(repr(word) for word in words)
