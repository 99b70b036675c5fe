"""Word forms of verbs and objects, from tables and, for other words, from rules.

``words.json`` lists the verbs and objects of the datasets that follow the rules, and mass nouns of everyday English.
``grammar.csv`` has one row per irregular word: kind (verb or object), base; gerund, past_participle and third_singular
of verbs; noun_phrase and number (singular, plural or mass) of objects. For other words: lemminflect inflects the first
word of a verb; the first sound decides the article; the head noun decides the number.

``phrases.csv`` has idioms of a verb with an object, with lists divided by semicolons. Kinds of rows:

- noun: ``said`` for each of ``objects``, {} is the object: "a pair of scissors".
- contents: verbs that act on the contents; with them the object keeps its bare name: "pour milk".
- verb: ``said`` before each of ``objects`` (* is any), {} is the verb: "chop with", "look through". hand: preposition
  of the hand, "with" or "in". tool: "used" or "held", as in "A knife is used by the right hand to chop". purpose: the
  words after that "to".
- synonym: another verb of the same meaning.
"""

import csv
import json
import logging
import re
from collections.abc import Iterable
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
# Words that start with a vowel letter but a consonant sound, and vice versa.
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
    """An object in a sentence: ``a book``, ``scissors``, ``milk``. The verb agrees with ``number``."""

    base: str
    words: str
    number: Number


@dataclass(frozen=True)
class Grammar:
    """Known verbs and objects by base form; unknown ones are inflected by rule."""

    verbs: dict[str, VerbForms]
    nouns: dict[str, NounPhrase]

    def verb(self, base: str) -> VerbForms:
        """Return the forms of ``base`` (``hand over``). Raises BadInput if it has no word."""
        base = _words(base, "verb")
        listed = self.verbs.get(base) or self.verbs.get(base.lower())
        if listed is None:
            logger.warning("verb %r is not in the grammar table; its forms follow a rule", base)
        return listed or inflect_verb(base)

    def noun(self, base: str) -> NounPhrase:
        """Return the phrase of ``base`` (``large cube``) with its article. Raises BadInput if it has no word."""
        base = _words(base, "object")
        listed = self.nouns.get(base) or self.nouns.get(base.lower())
        if listed:
            return listed
        number = self._number_by_rule(base)
        bare = number != "singular" or base.split()[0].lower() in DETERMINERS
        return NounPhrase(base, base if bare else f"{article(base)} {base}", number)

    def _number_by_rule(self, base: str) -> Number:
        """Return the number of the head noun: the last word, or the last word before "of"."""
        head = re.split(r"\s+of\s+", base)[0].split()[-1]
        listed = self.nouns.get(head) or self.nouns.get(head.lower())
        if listed:
            return listed.number
        if head.lower() in mass_nouns():
            return "mass"
        plural = head.lower().endswith("s") and len(head) > 3 and not SINGULAR_IN_S.search(head)
        return "plural" if plural else "singular"


@lru_cache(maxsize=4096)
def inflect_verb(base: str) -> VerbForms:
    """Inflect the first word of a verb that is not in the table (``zip up``), of each verb joined by "and".

    lemminflect's dictionary has some 20,000 verbs, including irregular ones; others are treated as regular.
    """
    from lemminflect import getInflection

    if " and " in base:
        first, second = (inflect_verb(verb).forms for verb in base.split(" and ", 1))
        return VerbForms(*map(" and ".join, zip(first, second, strict=True)))
    head, _, rest = base.partition(" ")
    regular = regular_forms(head)
    tagged = zip(("VBG", "VBN", "VBZ"), regular, strict=True)
    forms = [(getInflection(head, tag=tag, inflect_oov=False) or [form])[0] for tag, form in tagged]
    # The dictionary has clippings such as "gon" for "going to", which have no gerund.
    gerund = forms[0] if forms[0].endswith("ing") else regular[0]
    return _phrase((head, gerund, *forms[1:]), rest)


def _phrase(forms: Iterable[str], rest: str) -> VerbForms:
    """Add further words to the forms of a verb: "put" and "down"."""
    return VerbForms(*(f"{form} {rest}".rstrip() for form in forms))


def regular_forms(verb: str) -> tuple[str, str, str]:
    """Return gerund, past participle and third person of a regular verb: ``clipping``, ``clipped``, ``clips``."""
    third = verb + ("es" if SIBILANT.search(verb) else "s")
    if CONSONANT_Y.search(verb):
        return verb + "ing", verb[:-1] + "ied", verb[:-1] + "ies"
    if verb.endswith("e"):
        stem = verb[:-2] + "y" if verb.endswith("ie") else verb[:-1] if SILENT_E.search(verb) else verb
        return stem + "ing", verb + "d", third
    stem = verb + verb[-1] if DOUBLED.fullmatch(verb) else verb + "k" if verb.endswith("ic") else verb
    return stem + "ing", stem + "ed", third


def article(noun: str) -> Literal["a", "an"]:
    """Return "a" or "an" by the first sound of ``noun``: an hour, a unicycle, an SD card, an 8-sided die."""
    first = re.split(r"[\s-]", noun.strip())[0]
    letters = re.sub(r"[^A-Za-z]", "", first)
    if letters and letters.isupper() and (len(letters) == 1 or len(letters) <= 4):
        return "an" if letters[0] in "AEFHILMNORSX" else "a"
    if VOWEL_NUMBER.match(noun) or SILENT_H.match(noun):
        return "an"
    return "an" if noun[0].lower() in "aeiou" and not CONSONANT_SOUND.match(noun) else "a"


@dataclass(frozen=True)
class Phrase:
    """The idiom of a verb with one object (``phrases.csv``)."""

    said: VerbForms  # the words before the object: "look through"
    hand: str = "with"  # preposition of the hand
    tool: str = ""  # "used" or "held" if the object is an instrument
    purpose: str = ""  # "chop", as in "is used by the right hand to chop"


@dataclass(frozen=True)
class Phrases:
    """The idioms of ``phrases.csv``."""

    verbs: dict[tuple[str, str], Phrase]  # by verb and object, "*" for any object
    nouns: dict[str, str]  # pattern by object
    contents: frozenset[str]  # verbs that act on the contents of a container
    synonyms: dict[str, str]

    def verb(self, forms: VerbForms, base: str) -> Phrase:
        """Return the idiom of a verb with an object. The object of "cut with" and the like is an instrument."""
        listed = self.verbs.get((forms.base, base)) or self.verbs.get((forms.base, "*"))
        if not listed and forms.base.endswith(" with"):
            return Phrase(forms, "in", "used", forms.base.removesuffix(" with"))
        return listed or Phrase(forms)

    def noun(self, noun: NounPhrase, verb: str) -> NounPhrase:
        """Return the noun phrase of an object with a verb: "lift a carton of milk", but "pour milk"."""
        if noun.base not in self.nouns or verb in self.contents:
            return noun
        return NounPhrase(noun.base, self.nouns[noun.base].format(noun.base), "singular")


@lru_cache(maxsize=1)
def default_phrases() -> Phrases:
    """Read the phrases shipped with the package."""
    rows: dict[str, list[dict[str, str]]] = {"noun": [], "contents": [], "verb": [], "synonym": []}
    for entry in _rows("phrases.csv"):
        rows[entry["kind"]].append(entry)
    verbs = {}
    for entry in rows["verb"]:
        for verb, name in product(entry["verb"].split(";"), entry["objects"].split(";")):
            verb_forms, purpose = _inflected(entry["said"].format(verb)), entry["purpose"].format(verb)
            verbs[verb, name] = Phrase(verb_forms, hand=entry["hand"], tool=entry["tool"], purpose=purpose)
    nouns = {name: entry["said"] for entry in rows["noun"] for name in entry["objects"].split(";")}
    contents = frozenset(verb for entry in rows["contents"] for verb in entry["verb"].split(";"))
    return Phrases(verbs, nouns, contents, synonyms={entry["verb"]: entry["said"] for entry in rows["synonym"]})


def _inflected(words: str) -> VerbForms:
    """Inflect the first word of a phrase: "looking through"."""
    verbs, (head, _, rest) = default_grammar().verbs, words.partition(" ")
    if words in verbs:
        return verbs[words]
    return _phrase((verbs.get(head) or inflect_verb(head)).forms, rest)


@lru_cache(maxsize=1)
def default_grammar() -> Grammar:
    """Read the words shipped with the package: verbs and objects of H2O, GRAB and ARCTIC, and common others."""
    listed, rules = _listed_words(), Grammar({}, {})
    nouns, verbs = {base: rules.noun(base) for base in listed["regular_objects"]}, dict[str, VerbForms]()
    for base in listed["regular_verbs"]:
        head, _, rest = base.partition(" ")
        verbs[base] = _phrase((head, *regular_forms(head)), rest)
    for entry in _rows("grammar.csv"):
        base = entry["base"]
        if entry["kind"] == "verb":
            verbs[base] = VerbForms(base, entry["gerund"], entry["past_participle"], entry["third_singular"])
        else:
            nouns[base] = NounPhrase(base, entry["noun_phrase"], cast(Number, entry["number"]))
    return Grammar(dict(sorted(verbs.items())), dict(sorted(nouns.items())))


@lru_cache(maxsize=1)
def _listed_words() -> dict[str, list[str]]:
    return json.loads(_text("words.json"))


@lru_cache(maxsize=1)
def mass_nouns() -> frozenset[str]:
    """Return the nouns without article and with a singular verb: water, bread, luggage."""
    return frozenset(_listed_words()["mass_nouns"])


def _rows(table: str) -> list[dict[str, str]]:
    """Read a table of this package."""
    return list(csv.DictReader(_text(table).splitlines()))


def _text(name: str) -> str:
    return files("hoidata.annotation").joinpath(name).read_text(encoding="utf-8")


def _words(text: str, kind: str) -> str:
    words = " ".join(text.split())
    if not re.search(r"\w", words):
        raise BadInput(f"{kind} of a sentence", "at least one word", repr(text), "give the clip a name for it")
    return words
