"""Four sentences for one interaction, in the forms of Text2HOI (Cha et al. 2024, supplement, section 6)."""

from hoidata.annotation.grammar import default_grammar
from hoidata.clips import HandType

FORMS = ("imperative", "passive", "subject", "gerund")
HAND_PHRASES: dict[HandType, str] = {"left": "the left hand", "right": "the right hand", "both": "both hands"}
UNLABELLED_VERB = "move"

FourSentences = tuple[str, str, str, str]


def four_sentences(verb: str | None, object_words: str, hand: HandType) -> FourSentences:
    """Imperative, passive, subject and gerund form of one interaction.

    verb: base form with its particle (``take out``); None becomes ``move``. object_words: the noun without article.
    Example: "Place a book with both hands." / "A book is placed by both hands." / "Both hands place a book." /
    "Placing a book with both hands." Raises BadInput when verb or object holds no word.
    """
    grammar = default_grammar()
    forms = grammar.verb(UNLABELLED_VERB if verb is None else verb)
    noun = grammar.noun(object_words)
    hand_phrase = HAND_PHRASES[hand]
    auxiliary = "are" if noun.number == "plural" else "is"
    present = forms.base if hand == "both" else forms.third_singular
    return (
        as_sentence(f"{forms.base} {noun.words} with {hand_phrase}"),
        as_sentence(f"{noun.words} {auxiliary} {forms.past_participle} by {hand_phrase}"),
        as_sentence(f"{hand_phrase} {present} {noun.words}"),
        as_sentence(f"{forms.gerund} {noun.words} with {hand_phrase}"),
    )


def as_sentence(words: str) -> str:
    """The words with a capital and a full stop."""
    return words[0].upper() + words[1:] + "."
