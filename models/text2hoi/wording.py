"""What a user's sentence means to the networks: misspelt words are corrected, a synonym becomes a verb of training.

A word that is in no dictionary is replaced where one word of training is a single slip away, which the user is told.
Everything else that would have to be guessed is refused, with the nearest words.
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
from hoidata.annotation.prompts import HAND_PHRASE
from hoidata.errors import BadInput
from models.common.vocabulary import Vocabulary
from models.text2hoi.sentences import (
    FUNCTION_WORDS,
    LEFT_OF_NOUNS,
    first_verb,
    is_english,
    nearest_words,
    read_sentence,
)

FORCE = "or add --force to generate from the sentence as it is typed"
# Letters that a slip of the pen is surely one in: in shorter words only two letters that changed places.
LEAST_LETTERS = 5
SUGGESTED = 3
LETTERS = "abcdefghijklmnopqrstuvwxyz"
_WORD = re.compile(r"[^\W\d_]+(?:['’][^\W\d_]+)*")
# What people say for a verb of the datasets, beside the synonyms of the word table.
PARAPHRASES = {"pick up": "lift", "set down": "place"}
PARTICLES = frozenset({"down", "up", "out", "off", "in", "on", "over", "away", "back"})
NO_OBJECTS = frozenset({"hand", "hands", "left hand", "right hand", "person", "man", "woman"})
_IS = re.compile(r"\b(?:is|are|was|were|be|been|being)\s+$", re.IGNORECASE)
_PARTICLE_WITHIN = 5  # words after a verb: "put the heavy mug down"
_OBJECT = re.compile(rf"\b(?:{'|'.join(LEFT_OF_NOUNS)})\s+(?=((?:[a-z-]+\s*)+))")


@dataclass(frozen=True)
class Wording:
    """A sentence as it is understood.

    text: the sentence with its slips corrected, and a synonym replaced.
    verb, thing: base forms, None where none was found. The verb is one of training unless the sentence was forced.
    notes: what was changed, for the user.
    """

    text: str
    verb: str | None
    thing: str | None
    notes: tuple[str, ...] = ()


def understood_words(
    text: str, known: Vocabulary, encoder: Callable[[], TextEncoder], names: Iterable[str] = (), force: bool = False
) -> Wording:
    """The sentence with its verb and object.

    known: what the models were trained on. encoder: makes what finds words of like meaning, asked only for an error.
    names: words that are right beside those of the dictionary, as a mesh file's name. force: take the sentence as it
    is, whatever it holds.
    Raises BadInput for words that no dictionary has, and for a verb that was never in training, with the nearest.
    """
    notes = list[str]()
    if not force:
        text, notes = _corrected(text, known, names)
    verb, thing = read_sentence(text)
    verbs = sorted(filter(None, known.verbs))
    if verb not in verbs:
        verb = _with_particle(text, [*verbs, *PARAPHRASES, *filter(None, map(synonym_of, verbs))]) or verb
    if thing in (None, "hand"):
        thing = _phrase_after_article(text, verb)
    trained = next((own for own in verbs if verb and own in (synonym_of(verb), PARAPHRASES.get(verb))), None)
    if verb not in verbs and trained:
        notes.append(f"{verb!r} is read as {trained!r}")
        text, verb = _replaced(text, str(verb), trained), trained
    if verbs and verb not in verbs and not force:
        raise _untrained(verb or first_verb(text), text, verbs, encoder)
    return Wording(text, verb, thing, tuple(notes))


def _untrained(word: str | None, text: str, verbs: Sequence[str], encoder: Callable[[], TextEncoder]) -> BadInput:
    """The error for a verb that no model was trained on; ``word`` is None where the sentence has no verb."""
    expected = f"a verb that the models were trained on ({', '.join(verbs)})"
    first = word or _plain(_WORD.findall(text)[0])
    spelt = [verb for _, verb in _near(first, verbs, 2)]
    begins = [verb for verb in verbs if verb.split()[0] == word]
    alike = nearest_words(word, list(verbs), encoder()) if word else []
    near = list(dict.fromkeys([*begins, *spelt, *alike]))[:SUGGESTED]
    meant = f"did you mean {_either(near)}? Take" if near else "name what the hands do with"
    return BadInput("the sentence", expected, repr(word) if word else "none", f"{meant} one of them, {FORCE}")


def _corrected(text: str, known: Vocabulary, names: Iterable[str]) -> tuple[str, list[str]]:
    """The text with every word that is in no dictionary replaced by the one word of training that it can be."""
    named = {word for name in names for word in re.findall(r"[a-z]+", name.lower())}
    wanted, notes = _trained_words(known), list[str]()

    def right(found: re.Match[str]) -> str:
        word, _, rest = found[0].replace("’", "'").partition("'")
        plain = _plain(word)
        is_name = len(word) == 1 or (found.start() > 0 and word != word.lower())
        is_word = plain in named | wanted | _table_words() or is_english(plain)
        if is_name or is_word or (rest and rest != "s"):
            return found[0]
        near = _near(plain, wanted, 2)
        sure = [own for distance, own in near if distance == 1 and _is_slip(plain, own)]
        if len(sure) != 1 or sum(distance == 1 for distance, _ in near) != 1:
            if not sure and _is_compound(plain):
                return found[0]
            raise _unknown(word, [own for _, own in near] + _english_near(plain))
        notes.append(f"{word!r} is read as {sure[0]!r}")
        own = sure[0].capitalize() if word[0].isupper() else sure[0]
        return found[0].replace(word, own, 1)

    return _WORD.sub(right, text), notes


def _unknown(word: str, near: Sequence[str]) -> BadInput:
    near = list(dict.fromkeys(near))[:SUGGESTED]
    meant = f"did you mean {_either(near)}? Correct it" if near else "write it otherwise"
    return BadInput("the sentence", "English words", repr(word), f"{meant}, {FORCE}")


def _plain(word: str) -> str:
    """Lower case and without accents, as the dictionary has its words: "Café" is "cafe"."""
    decomposed = unicodedata.normalize("NFKD", word.lower())
    return "".join(letter for letter in decomposed if not unicodedata.combining(letter))


def _trained_words(known: Vocabulary) -> frozenset[str]:
    """Single words of what training had: every form of its verbs and their synonyms, its objects, words for hands."""
    verbs = [verb for verb in known.verbs if verb]
    forms = [form for verb in [*verbs, *filter(None, map(synonym_of, verbs))] for form in forms_of(verb)]
    words = " ".join([*forms, *known.objects, *PHRASES.values(), *LEFT_OF_NOUNS, "hands from two using"])
    return frozenset(re.findall(r"[a-z]+", words.lower()))


@cache
def _table_words() -> frozenset[str]:
    """Single words of the table of English verbs and objects."""
    grammar = default_grammar()
    return frozenset(re.findall(r"[a-z]+", " ".join([*grammar.verbs, *grammar.nouns]).lower()))


@cache
def synonym_of(verb: str) -> str | None:
    """The other verb of a pair of synonyms in the word table, either way: lift and raise."""
    pairs = default_phrases().synonyms
    return pairs.get(verb) or next((base for base, other in pairs.items() if other == verb), None)


def forms_of(verb: str) -> tuple[str, str, str, str]:
    """Base, gerund, past participle and third person."""
    return default_grammar().verb(verb).forms


def _near(word: str, known: Iterable[str], most: int) -> list[tuple[int, str]]:
    """Known words at most so many edits away, the nearest first."""
    found = [(edits(word, own, most), own) for own in known]
    return sorted(item for item in found if item[0] <= min(most, max(1, len(word) // 3)))


def _is_compound(word: str) -> bool:
    """Whether a word is made of two English ones, as "smartphone"."""
    return any(is_english(word[:place]) and "NOUN" in getAllLemmas(word[place:]) for place in range(3, len(word) - 2))


def _is_slip(word: str, own: str) -> bool:
    """Whether one edit between two words is surely a slip: of a long word, or two letters that changed places."""
    return len(word) >= LEAST_LETTERS or sorted(word) == sorted(own)


def _english_near(word: str) -> list[str]:
    """English nouns and verbs one edit away, in order of the alphabet."""
    cuts = [(word[:place], word[place:]) for place in range(len(word) + 1)]
    made = {head + tail[1:] for head, tail in cuts if tail}
    made |= {head + tail[1] + tail[0] + tail[2:] for head, tail in cuts if len(tail) > 1}
    made |= {head + letter + tail[1:] for head, tail in cuts if tail for letter in LETTERS}
    made |= {head + letter + tail for head, tail in cuts for letter in LETTERS}
    return sorted(own for own in made if {"NOUN", "VERB"} & set(getAllLemmas(own)))


def edits(one: str, other: str, most: int) -> int:
    """Letters to insert, delete, replace or exchange with a neighbour (Damerau 1964, optimal string alignment).

    ``most`` + 1 for words that are farther apart than ``most``.
    """
    if abs(len(one) - len(other)) > most:
        return most + 1
    before, row = list[int](), list(range(len(other) + 1))
    for i, letter in enumerate(one, 1):
        above, before, row = before, row, [i]
        for j, own in enumerate(other, 1):
            cost = min(before[j] + 1, row[j - 1] + 1, before[j - 1] + (letter != own))
            if i > 1 and j > 1 and letter == other[j - 2] and one[i - 2] == own:
                cost = min(cost, above[j - 2] + 1)
            row.append(cost)
    return min(row[-1], most + 1)


def _with_particle(text: str, verbs: Iterable[str]) -> str | None:
    """The verb of several words that stand apart in the text, as "put down" in "Put the mug down"."""
    words = re.findall(r"[a-z-]+", HAND_PHRASE.sub(" ", text.lower()))
    for verb in sorted(filter(lambda own: " " in own, verbs), key=len, reverse=True):
        head, *rest = verb.split()
        for start, word in enumerate(words):
            is_noun = start > 0 and words[start - 1] in LEFT_OF_NOUNS
            after = words[start + 1 : start + 1 + _PARTICLE_WITHIN]
            if not is_noun and head in getAllLemmas(word).get("VERB", ()) and all(own in after for own in rest):
                return verb
    return None


def _replaced(text: str, verb: str, trained: str) -> str:
    """The text with a trained verb in the place of its synonym, in the same form; unchanged where words stand apart."""
    new_forms = forms_of(trained)
    for form, own in zip(forms_of(verb), new_forms, strict=True):
        found = re.search(rf"\b{re.escape(form)}\b", text, re.IGNORECASE)
        if found:
            # "put down" is base form and participle.
            own = new_forms[2] if form == forms_of(verb)[2] and _IS.search(text[: found.start()]) else own
            new = own.capitalize() if found[0][0].isupper() else own
            return text[: found.start()] + new + text[found.end() :]
    return text


def _phrase_after_article(text: str, verb: str | None) -> str | None:
    """What an object of no word table is called: the words between an article and what cannot be part of a name."""
    rest, forms = HAND_PHRASE.sub(" . ", text.lower()), forms_of(verb) if verb else ()
    for found in _OBJECT.finditer(rest):
        words = found[1].split()
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
