"""Word forms of verbs and objects: an explicit table first, rules for every other word.

``grammar.csv`` holds one row per word: kind (verb or object), base, gerund, past_participle, third_singular for verbs,
noun_phrase and number (singular, plural or mass) for objects. Rules: lemminflect on the head word of an unknown verb;
the first spoken sound for the article; the head noun's number, mass where ``mass_nouns.json`` lists it: substances and
collections of everyday English, which no rule of spelling gives away.

``phrases.csv`` holds what English says for a verb with an object, one kind per row; lists are divided by semicolons.
noun: ``said`` for each of ``objects`` ("a pair of scissors"), {} being the object.
contents: verbs of what a container holds; with them the object keeps its bare name ("pour milk").
verb: ``said`` before each of ``objects`` (* is any), {} being the verb: "chop with", "look through". hand: "with" or
"in" the hand. tool: "used" or "held", where the passive is "A knife is used by the right hand to chop". purpose: what
follows that "to".
synonym: another verb of the same meaning.
"""

import csv
import json
import logging
import re
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from itertools import product
from typing import Literal, cast

from hoidata.errors import BadInput

Number = Literal["singular", "plural", "mass"]
DETERMINERS = frozenset(
    ("a", "an", "the", "this", "that", "these", "those", "my", "your", "his", "her", "its", "our", "their", "some")
)
# Words that start with a vowel letter but a consonant sound, and the other way round.
CONSONANT_SOUND = re.compile(r"(?:eu|ew|uni(?!n|m)|one(?:\b|-)|once|ouija|u[bcfhjkqrst][aeiou])", re.IGNORECASE)
SILENT_H = re.compile(r"(?:hour|honest|honou?r|heir|herb)", re.IGNORECASE)
VOWEL_NUMBER = re.compile(r"(?:8|11(?!\d)|18(?!\d))")
SINGULAR_IN_S = re.compile(r"(?:ss|us|is|as|ics|lens|[aeiou]ss|yes)$", re.IGNORECASE)
# A final consonant is doubled after one short stressed vowel: stop, unclip; not lift, open, play, fix.
DOUBLED = re.compile(
    r"(?:un|re|de|over|out|up|under|mis|dis|inter|fore|sub)?(?:[^aeiou]*|[^aeiou]*qu)[aeiou][bdfgklmnprtvz]",
    re.IGNORECASE,
)
SILENT_E = re.compile(r"[^eoy]e$", re.IGNORECASE)
CONSONANT_Y = re.compile(r"[^aeiou]y$", re.IGNORECASE)
SIBILANT = re.compile(r"(?:s|x|z|ch|sh|[^aeiou]o)$", re.IGNORECASE)
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class VerbForms:
    """One verb: ``take out``, ``taking out``, ``taken out``, ``takes out``."""

    base: str
    gerund: str
    past_participle: str
    third_singular: str

    @property
    def forms(self) -> tuple[str, str, str, str]:
        return self.base, self.gerund, self.past_participle, self.third_singular


@dataclass(frozen=True)
class NounPhrase:
    """One object as it stands in a sentence: ``a book``, ``scissors``, ``milk``; number rules the verb's form."""

    base: str
    words: str
    number: Number


@dataclass(frozen=True)
class Grammar:
    """Known verbs and objects by base form; unknown ones are inflected by rule."""

    verbs: dict[str, VerbForms]
    nouns: dict[str, NounPhrase]

    def verb(self, base: str) -> VerbForms:
        """Forms of ``base`` (``hand over``). Raises BadInput when it holds no word."""
        base = _words(base, "verb")
        known = self.verbs.get(base) or self.verbs.get(base.lower())
        if known is None:
            logger.warning("verb %r is not in the grammar table; its forms are made by rule", base)
        return known or inflect_verb(base)

    def noun(self, base: str) -> NounPhrase:
        """Phrase of ``base`` (``large cube``), with its article. Raises BadInput when it holds no word."""
        base = _words(base, "object")
        known = self.nouns.get(base) or self.nouns.get(base.lower())
        if known:
            return known
        number = self._number_by_rule(base)
        bare = number != "singular" or base.split()[0].lower() in DETERMINERS
        return NounPhrase(base, base if bare else f"{article(base)} {base}", number)

    def _number_by_rule(self, base: str) -> Number:
        """The number of the head noun: the last word, or the last one before "of"."""
        head = re.split(r"\s+of\s+", base)[0].split()[-1]
        known = self.nouns.get(head) or self.nouns.get(head.lower())
        if known:
            return known.number
        if head.lower() in mass_nouns():
            return "mass"
        plural = head.lower().endswith("s") and len(head) > 3 and not SINGULAR_IN_S.search(head)
        return "plural" if plural else "singular"


@lru_cache(maxsize=4096)
def inflect_verb(base: str) -> VerbForms:
    """Forms of a verb outside the table: its first word inflected, the rest kept (``zip up``).

    lemminflect's dictionary knows some 20,000 verbs, irregular ones among them; any other is taken for regular.
    """
    from lemminflect import getInflection

    head, _, rest = base.partition(" ")
    listed = [getInflection(head, tag=tag, inflect_oov=False) for tag in ("VBG", "VBN", "VBZ")]
    forms = [found[0] if found else regular for found, regular in zip(listed, regular_forms(head), strict=True)]
    return VerbForms(base, *(f"{form} {rest}".rstrip() for form in forms))


def regular_forms(verb: str) -> tuple[str, str, str]:
    """Gerund, past participle and third person of a regular verb: ``clipping``, ``clipped``, ``clips``."""
    third = verb + ("es" if SIBILANT.search(verb) else "s")
    if CONSONANT_Y.search(verb):
        return verb + "ing", verb[:-1] + "ied", verb[:-1] + "ies"
    if verb.endswith("e"):
        stem = verb[:-2] + "y" if verb.endswith("ie") else verb[:-1] if SILENT_E.search(verb) else verb
        return stem + "ing", verb + "d", third
    stem = verb + verb[-1] if DOUBLED.fullmatch(verb) else verb + "k" if verb.endswith("ic") else verb
    return stem + "ing", stem + "ed", third


def article(noun: str) -> Literal["a", "an"]:
    """ "a" or "an" by the first sound of ``noun``: an hour, a unicycle, an SD card, a USB stick, an 8-sided die."""
    first = re.split(r"[\s-]", noun.strip())[0]
    letters = re.sub(r"[^A-Za-z]", "", first)
    if letters and letters.isupper() and (len(letters) == 1 or len(letters) <= 4):
        return "an" if letters[0] in "AEFHILMNORSX" else "a"
    if VOWEL_NUMBER.match(noun) or SILENT_H.match(noun):
        return "an"
    return "an" if noun[0].lower() in "aeiou" and not CONSONANT_SOUND.match(noun) else "a"


@dataclass(frozen=True)
class Phrase:
    """What English says for a verb with one object; see the module's text. said: the verb up to the object."""

    said: VerbForms
    hand: str = "with"
    tool: str = ""
    purpose: str = ""


@dataclass(frozen=True)
class Phrases:
    """``phrases.csv``. verbs: by verb and object, "*" for any object. nouns: pattern by object."""

    verbs: dict[tuple[str, str], Phrase]
    nouns: dict[str, str]
    contents: frozenset[str]
    synonyms: dict[str, str]

    def verb(self, forms: VerbForms, base: str) -> Phrase:
        """The phrase of a verb with an object; "cut with" and the like name the instrument they are done with."""
        found = self.verbs.get((forms.base, base)) or self.verbs.get((forms.base, "*"))
        if not found and forms.base.endswith(" with"):
            return Phrase(forms, "in", "used", forms.base.removesuffix(" with"))
        return found or Phrase(forms)

    def noun(self, noun: NounPhrase, verb: str) -> NounPhrase:
        """The object as it is called when a hand handles it: "a carton of milk", but "pour milk"."""
        if noun.base not in self.nouns or verb in self.contents:
            return noun
        return NounPhrase(noun.base, self.nouns[noun.base].format(noun.base), "singular")


@lru_cache(maxsize=1)
def default_phrases() -> Phrases:
    """The phrases shipped with the package."""
    rows: dict[str, list[dict[str, str]]] = {"noun": [], "contents": [], "verb": [], "synonym": []}
    for row in _rows("phrases.csv"):
        rows[row["kind"]].append(row)
    verbs = {
        (verb, name): Phrase(_said(row["said"].format(verb)), row["hand"], row["tool"], row["purpose"].format(verb))
        for row in rows["verb"]
        for verb, name in product(row["verb"].split(";"), row["objects"].split(";"))
    }
    nouns = {name: row["said"] for row in rows["noun"] for name in row["objects"].split(";")}
    contents = frozenset(verb for row in rows["contents"] for verb in row["verb"].split(";"))
    return Phrases(verbs, nouns, contents, {row["verb"]: row["said"] for row in rows["synonym"]})


def _said(words: str) -> VerbForms:
    """Forms of a phrase by those of its first word: "looking through"."""
    verbs, (head, _, rest) = default_grammar().verbs, words.partition(" ")
    if words in verbs:
        return verbs[words]
    forms = verbs.get(head) or inflect_verb(head)
    return VerbForms(*(f"{form} {rest}".rstrip() for form in forms.forms))


@lru_cache(maxsize=1)
def default_grammar() -> Grammar:
    """The table shipped with the package: every verb and object of H2O, GRAB and ARCTIC, and common others."""
    rows = _rows("grammar.csv")
    forms = ("base", "gerund", "past_participle", "third_singular")
    verbs = {row["base"]: VerbForms(*(row[name] for name in forms)) for row in rows if row["kind"] == "verb"}
    nouns = {
        row["base"]: NounPhrase(row["base"], row["noun_phrase"], cast(Number, row["number"]))
        for row in rows
        if row["kind"] == "object"
    }
    return Grammar(verbs, nouns)


@lru_cache(maxsize=1)
def mass_nouns() -> frozenset[str]:
    """Nouns that take no article and a singular verb: water, bread, luggage."""
    return frozenset(json.loads(_text("mass_nouns.json")))


def _rows(table: str) -> list[dict[str, str]]:
    """The rows of one of this package's tables."""
    return list(csv.DictReader(_text(table).splitlines()))


def _text(name: str) -> str:
    return files("hoidata.annotation").joinpath(name).read_text(encoding="utf-8")


def _words(text: str, kind: str) -> str:
    words = " ".join(text.split())
    if not re.search(r"\w", words):
        raise BadInput(f"{kind} of a sentence", "at least one word", repr(text), "give the clip a name for it")
    return words
