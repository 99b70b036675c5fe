"""A sentence whose verb was learnt is told so that the networks read that verb; any other is told as it is."""

from collections.abc import Mapping

import numpy as np
import pytest

from hoidata.annotation.encoders import HashEncoder
from models.common.vocabulary import Vocabulary
from models.text2hoi.understanding import Understood, understand

KNOWN = Vocabulary({("screw", "jar", "right"): 3, ("screw", "apple", "right"): 2, ("lift", "box", "left"): 4})
ENCODER = HashEncoder()


def told(sentence: str, verb: str | None, thing: str | None, readings: Mapping[str, tuple[str, float]]) -> Understood:
    """What comes of a sentence; readings: of some sentences, all others are read as "place"."""

    def read(text: np.ndarray) -> tuple[str, float]:
        same = (own for own in readings if (ENCODER.encode([own])[0] == text).all())
        return readings.get(next(same, ""), ("place", 0.9))

    found = understand(sentence, verb, thing, "right", KNOWN, ENCODER, read)
    np.testing.assert_array_equal(found.text, ENCODER.encode([found.sentence])[0])
    assert found.read_as == read(found.text)
    assert found.plainly == read(ENCODER.encode([sentence])[0])
    return found


def test_a_sentence_that_is_read_right_stays() -> None:
    sentence = "Screw a box with the right hand."
    assert told(sentence, "screw", "box", {sentence: ("screw", 0.4)}).sentence == sentence


def test_one_without_a_hand_gets_the_hand_in_words() -> None:
    named = "Screw a jar with the right hand."
    assert told("Screw a jar.", "screw", "jar", {named: ("screw", 0.8)}).sentence == named


@pytest.mark.parametrize("sentence", ["Screw a box.", "Screw a box with the right hand."])
def test_a_strange_object_gives_way_to_the_learnt_one_that_is_read_most_surely(sentence: str) -> None:
    likely = {"jar": 0.7, "apple": 0.6}
    readings = {
        f"Screw {a} {own} with the right hand.": ("screw", likely[own]) for a, own in (("a", "jar"), ("an", "apple"))
    }
    assert told(sentence, "screw", "box", readings).sentence == "Screw a jar with the right hand."
    readings["Screw an apple with the right hand."] = ("screw", 0.8)
    assert told(sentence, "screw", "box", readings).sentence == "Screw an apple with the right hand."


@pytest.mark.parametrize(
    ("verb", "thing"), [("juggle", "box"), (None, None), ("screw", "box"), ("screw", None)],
    ids=["a verb never learnt", "no verb", "no sentence is read right", "no object"],
)  # fmt: skip
def test_what_nothing_helps_is_told_as_it_is(verb: str | None, thing: str | None) -> None:
    sentence = f"{verb or 'Do'} a box."
    assert told(sentence, verb, thing, {}).sentence == sentence


def test_networks_that_are_told_features_get_the_sentence_as_it_is() -> None:
    found = understand("Screw a box.", "screw", "box", "right", KNOWN, ENCODER, lambda text: None)
    assert (found.sentence, found.read_as, found.plainly) == ("Screw a box.", None, None)


def test_an_object_of_two_words_and_one_without_an_article_are_replaced_whole() -> None:
    readings = {"Screw the jar with the right hand.": ("screw", 0.8)}
    assert told("Screw the water bottle.", "screw", "water bottle", readings).sentence in readings
