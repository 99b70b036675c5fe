"""Slips of the keys in hand words, priors that are silent, and what is said of a clip without a hand."""

import numpy as np
import pytest

from hoidata.annotation.encoders import HashEncoder
from hoidata.annotation.hand_choice import find_mentions, most_similar_hand, select_hand


@pytest.mark.parametrize(
    "sentence",
    [
        *("lift it with the rihgt hand", "lift it with the right hnad", "lift it with the irght hand"),
        *("lift it with the rigth hand", "lift it with the rright hand", "lift it with the rightt hand"),
        *("lift it with the rigght hand", "lift it with the right hhand", "lift it with the right handd"),
    ],
)
def test_swapped_and_doubled_letters_of_hand_words_are_mended(sentence):
    assert find_mentions(sentence).sides == {"right"}


@pytest.mark.parametrize("sentence", ["lift it with obth hands", "lift it with both hadns", "lift it with bboth hands"])
def test_slips_are_mended_for_both_hands_too(sentence):
    assert select_hand(sentence).hand == "both"


def test_no_both_hands_are_denied_as_both():
    assert find_mentions("lift it, but not with both hands").denied == {"both"}


def test_a_prior_counts_only_the_hands_it_knows_and_that_are_allowed():
    choice = select_hand("lift it with one hand", prior={"right": 0.6, "both": 0.4})
    assert (choice.hand, choice.confidence) == ("right", pytest.approx(1.0))
    shares = select_hand("lift it", prior={"right": 0.6, "both": 0.2})
    assert (shares.hand, shares.confidence) == ("right", pytest.approx(0.75))
    silent = select_hand("lift it", prior={"left": 0.0})
    assert (silent.hand, silent.confidence) == ("left", pytest.approx(1 / 3))


class Scaled:
    """Features of an encoder times a number: cosines do not depend on it."""

    def __init__(self, scale: float) -> None:
        self.scale = scale

    def encode(self, texts):
        return self.scale * np.asarray(HashEncoder().encode(texts))


def test_similarity_is_a_cosine():
    expected = most_similar_hand("the left hand", Scaled(1.0))
    for scale in (1e-3, 1e3):
        hand, lead = most_similar_hand("the left hand", Scaled(scale))
        assert (hand, lead) == (expected[0], pytest.approx(expected[1], rel=1e-5))
