"""Four sentences for one interaction, in the forms of Text2HOI (Cha et al. 2024, supplement, section 6).

``four_sentences`` writes them as a person would say them; ``reference_sentences`` as the reference implementation does,
for comparing with models trained on those: no articles, "with" in the passive, everything but the first letter in lower
case, object names without their size. Its misspellings ("openning", "takes take") and its passives without an auxiliary
are not copied.
"""

import re

from hoidata.annotation.grammar import VerbForms, default_grammar, default_phrases
from hoidata.clips import HandType

FORMS = ("imperative", "passive", "subject", "gerund")
HAND_PHRASES: dict[HandType, str] = {"left": "the left hand", "right": "the right hand", "both": "both hands"}
UNLABELLED_VERB = "move"
REFERENCE_HANDS: dict[HandType, str] = {"left": "left hand", "right": "right hand", "both": "both hands"}
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

FourSentences = tuple[str, str, str, str]


def four_sentences(verb: str | None, object_words: str, hand: HandType) -> FourSentences:
    """Imperative, passive, subject and gerund form of one interaction.

    verb: base form with its particle (``take out``); None becomes ``move``. object_words: the noun without article.
    Example: "Place a book with both hands." / "A book is placed by both hands." / "Both hands place a book." /
    "Placing a book with both hands." Of an instrument: "Chop with a knife in the right hand." / "A knife is used by the
    right hand to chop." Raises BadInput when verb or object holds no word.
    """
    grammar, phrases = default_grammar(), default_phrases()
    forms = grammar.verb(UNLABELLED_VERB if verb is None else verb)
    noun = grammar.noun(object_words)
    phrase = phrases.verb(forms, noun.base)
    noun, said, hands = phrases.noun(noun, forms.base), phrase.said, HAND_PHRASES[hand]
    auxiliary = "are" if noun.number == "plural" else "is"
    passive = f"{noun.words} {auxiliary} {said.past_participle} by {hands}"
    subject = f"{hands} {said.base if hand == 'both' else said.third_singular} {noun.words}"
    if phrase.tool:
        passive = f"{noun.words} {auxiliary} {phrase.tool} by {hands} to {phrase.purpose}"
    if phrase.tool == "held":
        subject = f"{hands} {'hold' if hand == 'both' else 'holds'} {noun.words} to {phrase.purpose}"
    return (
        as_sentence(f"{said.base} {noun.words} {phrase.hand} {hands}"),
        as_sentence(passive),
        as_sentence(subject),
        as_sentence(f"{said.gerund} {noun.words} {phrase.hand} {hands}"),
    )


def reference_sentences(verb: str | None, object_words: str, hand: HandType) -> FourSentences:
    """Imperative, passive, subject and gerund form, in hoidata's order of forms.

    verb, object_words, errors: as in ``four_sentences``. Example: "Place book with both hands." / "Book is placed
    with both hands." / "Both hands place book." / "Placing book with both hands."
    """
    grammar = default_grammar()
    forms = grammar.verb(UNLABELLED_VERB if verb is None else verb)
    forms = ACTIONS.get(forms.base, forms)
    words = reference_words(grammar.noun(object_words).base)
    hands = REFERENCE_HANDS[hand]
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


def as_sentence(words: str) -> str:
    """The words with a capital and a full stop."""
    return words[0].upper() + words[1:] + "."
