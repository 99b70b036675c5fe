"""Sentences for one interaction, in the forms of Text2HOI (Cha et al. 2024, supplement, section 6).

``english_sentences`` writes idiomatic English. ``reference_sentences`` writes like the reference implementation, for
comparisons with models trained on its sentences: no articles, "with" in the passive, lower case after the first letter,
object names without their size. Its misspellings ("openning", "takes take") and its passives without an auxiliary are
corrected.

To add a sentence form, add its template to ``FORMS``.
"""

import re
from dataclasses import dataclass

from hoidata.annotation.grammar import VerbForms, default_grammar, default_phrases
from hoidata.clips import HandType

# The sentence forms and their templates, with the fields of ``Clause``. The first form is the default prompt.
FORMS = {
    "imperative": "{base} {object} {preposition} {hands}",
    "passive": "{object} {passive}",
    "subject": "{hands} {active}",
    "gerund": "{gerund} {object} {preposition} {hands}",
}
HAND_PHRASES: dict[HandType, str] = {"left": "the left hand", "right": "the right hand", "both": "both hands"}
UNLABELLED_VERB = "move"
REFERENCE_HANDS: dict[HandType, str] = {"left": "left hand", "right": "right hand", "both": "both hands"}
# Object names of the reference implementation that differ from ours.
_JOINED = ("wine glass", "capsule machine", "espresso machine", "waffle iron", "coffee mug", "rubber duck")
JOINED = {words: words.replace(" ", "") for words in _JOINED}
# Verbs of the reference implementation that differ from the grammar's: GRAB's takepicture.
ACTIONS = {"take a picture with": VerbForms("take picture", "taking picture", "pictured", "takes picture")}
SIZED = re.compile(r"(?:large|medium|small) (cube|cylinder|pyramid|sphere|torus)")


@dataclass(frozen=True)
class Clause:
    """The inflected words of one interaction, which the templates of ``FORMS`` combine."""

    base: str  # verb: "place"
    gerund: str  # "placing"
    active: str  # verb in agreement with the hands, and the object: "places a book"
    passive: str  # predicate of the object: "is placed by both hands"
    object: str  # "a book"
    hands: str  # "both hands"
    preposition: str = "with"  # before the hands: "with", or "in" if the object is an instrument

    def sentences(self) -> tuple[str, ...]:
        """Return the sentence of each form in ``FORMS``."""
        return tuple(as_sentence(template.format(**vars(self))) for template in FORMS.values())


def english_sentences(verb: str | None, object_words: str, hand: HandType) -> tuple[str, ...]:
    """Write one sentence of each form, in idiomatic English.

    Examples: "Place a book with both hands.", "A book is placed by both hands.", "Both hands place a book.", "Placing a
    book with both hands." Of an instrument: "Chop with a knife in the right hand.", "A knife is used by the right hand
    to chop."

    verb: base form with its particle (``take out``); None becomes ``move``. object_words: noun without article. Raises
    BadInput if the verb or the object has no word.
    """
    grammar, phrases = default_grammar(), default_phrases()
    forms = grammar.verb(UNLABELLED_VERB if verb is None else verb)
    noun = grammar.noun(object_words)
    phrase = phrases.verb(forms, noun.base)
    noun, verb_forms, hands = phrases.noun(noun, forms.base), phrase.said, HAND_PHRASES[hand]
    auxiliary = "are" if noun.number == "plural" else "is"
    active = f"{_agreeing(verb_forms, hand)} {noun.words}"
    passive = f"{auxiliary} {verb_forms.past_participle} by {hands}"
    if phrase.tool:
        passive = f"{auxiliary} {phrase.tool} by {hands} to {phrase.purpose}"
    if phrase.tool == "held":
        active = f"{'hold' if hand == 'both' else 'holds'} {noun.words} to {phrase.purpose}"
    return Clause(
        base=verb_forms.base,
        gerund=verb_forms.gerund,
        active=active,
        passive=passive,
        object=noun.words,
        hands=hands,
        preposition=phrase.hand,
    ).sentences()


def reference_sentences(verb: str | None, object_words: str, hand: HandType) -> tuple[str, ...]:
    """Write one sentence of each form, as the reference implementation of Text2HOI does.

    Examples: "Place book with both hands.", "Book is placed with both hands.", "Both hands place book.", "Placing book
    with both hands." Arguments and errors are those of ``english_sentences``.
    """
    grammar = default_grammar()
    forms = grammar.verb(UNLABELLED_VERB if verb is None else verb)
    forms = ACTIONS.get(forms.base, forms)
    words = reference_words(grammar.noun(object_words).base)
    hands = REFERENCE_HANDS[hand]
    clause = Clause(
        base=forms.base,
        gerund=forms.gerund,
        active=f"{_agreeing(forms, hand)} {words}",
        passive=f"is {forms.past_participle} with {hands}",
        object=words,
        hands=hands,
    )
    return Clause(**{name: text.lower() for name, text in vars(clause).items()}).sentences()


def _agreeing(forms: VerbForms, hand: HandType) -> str:
    return forms.base if hand == "both" else forms.third_singular


def reference_words(object_words: str) -> str:
    """Return the reference's name of an object: "cube" for "large cube", "wineglass" for "wine glass"."""
    sized = SIZED.fullmatch(object_words.lower())
    return sized[1] if sized else JOINED.get(object_words.lower(), object_words.lower())


def as_sentence(words: str) -> str:
    """Add a capital letter and a full stop."""
    return words[0].upper() + words[1:] + "."
