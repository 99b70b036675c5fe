"""Sentences as the reference implementation of Text2HOI writes them, for comparing with models trained on those.

No articles, "with" in the passive, everything but the first letter in lower case, object names without their size. Its
misspellings ("openning", "takes take") and its passives without an auxiliary are not copied.
"""

import re

from hoidata.annotation.grammar import VerbForms, default_grammar
from hoidata.annotation.sentences import UNLABELLED_VERB, FourSentences, as_sentence
from hoidata.clips import HandType

HAND_WORDS: dict[HandType, str] = {"left": "left hand", "right": "right hand", "both": "both hands"}
# What the reference calls an object, where its name differs from ours.
JOINED = {
    "wine glass": "wineglass",
    "capsule machine": "capsulemachine",
    "espresso machine": "espressomachine",
    "waffle iron": "waffleiron",
    "coffee mug": "coffeemug",
    "rubber duck": "rubberduck",
}
# What the reference calls an action, where its words differ from the grammar's: GRAB's takepicture.
ACTIONS = {"take a picture with": VerbForms("take picture", "taking picture", "pictured", "takes picture")}
SIZED = re.compile(r"(?:large|medium|small) (cube|cylinder|pyramid|sphere|torus)")


def reference_sentences(verb: str | None, object_words: str, hand: HandType) -> FourSentences:
    """Imperative, passive, subject and gerund form, in hoidata's order of forms.

    verb, object_words, errors: as in ``four_sentences``. Example: "Place book with both hands." / "Book is placed
    with both hands." / "Both hands place book." / "Placing book with both hands."
    """
    grammar = default_grammar()
    forms = grammar.verb(UNLABELLED_VERB if verb is None else verb)
    forms = ACTIONS.get(forms.base, forms)
    words = reference_words(grammar.noun(object_words).base)
    hands = HAND_WORDS[hand]
    present = forms.base if hand == "both" else forms.third_singular
    said = (
        f"{forms.base} {words} with {hands}",
        f"{words} is {forms.past_participle} with {hands}",
        f"{hands} {present} {words}",
        f"{forms.gerund} {words} with {hands}",
    )
    imperative, passive, subject, gerund = (as_sentence(words.lower()) for words in said)
    return imperative, passive, subject, gerund


def reference_words(object_words: str) -> str:
    """The reference's name of an object: "large cube" is "cube", "wine glass" is "wineglass"."""
    sized = SIZED.fullmatch(object_words.lower())
    return sized[1] if sized else JOINED.get(object_words.lower(), object_words.lower())
