"""Every prompt of the three datasets reads back: hand, object and verb, in the paper's forms and the reference's."""

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
import pytest

from hoidata.annotation.hand_choice import HAND_TYPES
from hoidata.annotation.prompts import Lexicon, read_prompt
from hoidata.annotation.sentences import english_sentences, reference_sentences, reference_words
from hoidata.datasets.arctic import adapter as arctic
from hoidata.datasets.grab import adapter as grab
from hoidata.datasets.h2o import files as h2o

# Every verb with every object: 36 of H2O's pairs, 202 of GRAB's and 55 of ARCTIC's are real actions.
PAIRS = [
    *product(sorted({verb for verb, _ in h2o.PAIRS}), sorted({noun for _, noun in h2o.PAIRS})),
    *product(grab.INTENTS.values(), grab.OBJECTS.values()),
    *product(arctic.VERBS, map(arctic.object_words, arctic.OBJECTS)),
]


def prompts(forms: Callable) -> Iterator[tuple[str, tuple[str, str, str]]]:
    for (verb, noun), hand in product(PAIRS, HAND_TYPES):
        for sentence in forms(verb, noun, hand):
            yield sentence, (hand, noun, verb)


def shares(forms: Callable, named: Callable[[str], str] = str) -> np.ndarray:
    """Return the fractions of hands, objects and verbs that read back. named: part of an object's name to compare."""
    right = []
    for sentence, (hand, noun, verb) in prompts(forms):
        reading = read_prompt(sentence)
        by_rule = reading.hand.source == "rule" and reading.hand.hand == hand
        right.append((by_rule, named(reading.object_words or "") == named(noun), reading.verb == verb))
    rate = np.mean(right, axis=0)
    print(f"{forms.__name__}: {len(right):,} prompts; hand {rate[0]:.2%}, object {rate[1]:.2%}, verb {rate[2]:.2%}")
    return rate


@pytest.mark.parametrize(("dataset", "count"), [(grab, 202), (h2o, 36), (arctic, 91)], ids=["grab", "h2o", "arctic"])
def test_every_sentence_of_a_recorded_pair_reads_back(dataset, count: int) -> None:
    assert len(set(dataset.PAIRS)) == len(dataset.PAIRS) == count
    for verb, noun in dataset.PAIRS:
        for hand in HAND_TYPES:
            for sentence in english_sentences(verb, noun, hand):
                reading = read_prompt(sentence)
                assert (reading.verb, reading.object_words, reading.hand.hand) == (verb, noun, hand), sentence


@pytest.mark.long
def test_all_prompts_over_all_verbs_objects_and_hands_read_back() -> None:
    assert len(PAIRS) == 8 * 11 + 29 * 51 + 11 * 11
    hand, noun_accuracy, verb = shares(english_sentences)
    assert hand == 1
    assert noun_accuracy >= 0.999
    assert verb >= 0.99


@pytest.mark.long
def test_the_references_forms_read_back_but_for_the_sizes_they_leave_out() -> None:
    """ "cube" may be any of three; every other object, hand and verb is read."""
    sized = {
        noun
        for noun in grab.OBJECTS.values()
        if reference_words(noun) in ("cube", "cylinder", "pyramid", "sphere", "torus")
    }
    hand, noun_accuracy, verb = shares(reference_sentences, lambda noun: "" if noun in sized else noun)
    assert len(sized) == 15
    assert (hand, noun_accuracy, verb) == (1, 1, 1)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a train, a brain, trains", [(0, 0, 7)]),  # no part of a longer word, no plural the lexicon does not list
        ("cup-holder, big-cup, cup", [(1, 21, 24)]),
        ("cup of tea, cup", [(1, 0, 3), (1, 12, 15), (2, 0, 10)]),
        ("(x) (x)y z(x) (x)", [(3, 0, 3), (3, 14, 17)]),
        ("a b a b a", [(4, 0, 5)]),
    ],
)
def test_forms_are_matched_as_whole_words(text: str, expected) -> None:
    forms = ["a train", "cup", "cup of tea", "(x)", "a b a"]
    lexicon = Lexicon([], [(form, form) for form in forms])
    matches = [(forms.index(match.base), match.start, match.stop) for match in lexicon._nouns.matches(text)]
    assert matches == expected


def test_a_form_that_stands_for_two_words_is_refused() -> None:
    with pytest.raises(ValueError, match="lifts"):
        Lexicon([("lifts", "lift"), ("lifts", "raise")], [])


@pytest.mark.parametrize(
    ("text", "verb", "noun"),
    [
        ("Use a knife to chop with the right hand.", "chop", "knife"),
        ("Hold the cup in your left hand to drink from it.", "drink", "cup"),
        ("Use the right hand to lift a mug.", "lift", "mug"),
        ("Hold a book with both hands.", "hold", "book"),
        ("Put the binoculars to use: look through the binoculars.", "see", "binoculars"),
        ("Put on the glasses' lens with both hands.", "put on", "lens"),
        ("Put on eyeglasses.", "wear", "eyeglasses"),
        ("Wear eyeglasses.", "wear", "eyeglasses"),
        ("Take out milk with both hands.", "take out", "milk"),
        ("A camera is used to take a picture by the right hand.", "take a picture with", "camera"),
        ("The left hand stamps a stamp.", "stamp", "stamp"),
        ("A Stanford bunny is handed over by both hands.", "hand over", "Stanford bunny"),
        ("Spraying spray with the right hand.", "spray", "spray"),
        ("Lift a water bottle with your left hand.", "lift", "water bottle"),
        ("Frobnicate the gizmo with both hands.", None, None),
        ("Lift a mug with one hand.", "lift", "mug"),
        ("Lift the mug with your hand.", "lift", "mug"),
        ("Lift the mug by hand.", "lift", "mug"),
        ("Lift the mug using one hand.", "lift", "mug"),
        ("Using a single hand, lift the mug.", "lift", "mug"),
        ("Lift a mug using only one hand.", "lift", "mug"),
        ("Using only the right hand, open the box.", "open", "box"),
        ("Using just your left hand, lift the mug.", "lift", "mug"),
        ("Using only both hands, open the box.", "open", "box"),
        ("Lift the hand with the right hand.", "lift", "hand"),
        ("Lift a hand with the left hand.", "lift", "hand"),
        ("Lift a hand.", "lift", "hand"),
        ("Lift the hand with one hand.", "lift", "hand"),
    ],
)
def test_a_prompt_gives_back_its_verb_and_object(text: str, verb: str | None, noun: str | None) -> None:
    reading = read_prompt(text)
    assert (reading.verb, reading.object_words) == (verb, noun)


@pytest.mark.parametrize(
    ("text", "verb", "noun"),
    [
        ("Open the box with the right hand but do not close it.", "open", "box"),
        ("Lift the mug, do not drink from it.", "lift", "mug"),
        ("Lift the mug and don't drink from it.", "lift", "mug"),
        ("Lift the mug, don’t drink from it.", "lift", "mug"),
        ("Open the box, never close it.", "open", "box"),
        ("Open the box without closing the bottle.", "open", "box"),
        ("Open the box instead of closing it.", "open", "box"),
        ("Open the box rather than closing it with the left hand.", "open", "box"),
        ("Do not close the bottle; open the box.", "open", "box"),
        ("The right hand opens the box but does not close it.", "open", "box"),
        ("Not only lift the mug but also drink from it.", "drink", "mug"),
        # Nothing else is left.
        ("Do not close the box.", "close", "box"),
        ("Don't lift the mug with the left hand, use the right hand.", "lift", "mug"),
        # A negated hand is not a negated action.
        ("Without using the left hand lift the mug.", "lift", "mug"),
        ("Use the right hand instead of the left hand to lift the mug.", "lift", "mug"),
        ("Use your right rather than your left to lift the mug.", "lift", "mug"),
    ],
)
def test_a_negated_clause_gives_no_verb(text: str, verb: str, noun: str) -> None:
    reading = read_prompt(text)
    assert (reading.verb, reading.object_words) == (verb, noun)


@pytest.mark.parametrize(
    ("text", "noun"),
    [
        ("Lift the cup from the table with the right hand.", "cup"),
        ("Open the box on the table", "box"),
        ("Place the cup next to the laptop", "cup"),
        ("Place the cup beside your laptop", "cup"),
        ("On the table the box is lifted", "box"),
        ("The cup on the table is lifted by the left hand", "cup"),
        ("Lift the mug and place it on the table", "mug"),
        ("From the laptop, lift the cup.", "cup"),
        ("Open the box with a screwdriver", "box"),
        ("Put on the headphones from the table", "headphones"),
        ("Lift the water bottle off the microwave", "water bottle"),
        # A place if there is nothing else; of two, the first.
        ("Drink from a mug", "mug"),
        ("Pour from the water bottle", "water bottle"),
        ("Drink from the mug on the table", "mug"),
        ("Pour from the mug into the water bottle", "mug"),
        ("Pour milk into the cup", "milk"),
        ("Pour water from the teapot into the cup", "teapot"),
    ],
)
def test_the_object_is_the_first_noun_after_the_verb_that_is_no_place(text: str, noun: str) -> None:
    assert read_prompt(text).object_words == noun


def test_of_overlapping_nouns_the_longest_is_the_object() -> None:
    lexicon = Lexicon([("lift", "lift")], [(noun, noun) for noun in ("coffee", "cup", "coffee cup", "dining table")])
    assert lexicon.read("lift the coffee cup from the dining table") == ("lift", "coffee cup")
    assert lexicon.read("lift the cup from the dining table") == ("lift", "cup")
