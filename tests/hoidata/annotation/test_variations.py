"""Richer sentences are kept only when hand, verb and object can be read back; the reference's are as it writes them."""

import pytest

from hoidata.annotation.hand_choice import HAND_TYPES
from hoidata.annotation.prompts import Lexicon
from hoidata.annotation.reference_mode import reference_sentences
from hoidata.annotation.sentences import four_sentences
from hoidata.annotation.variations import Manner, SentenceMaker, manner_of
from hoidata.clips import HandType
from tests.builders.words import ARCTIC_OBJECTS, ARCTIC_VERBS

HOMOGRAPH_VERBS = ("stamp", "staple", "brush", "watch", "hand over", "screw", "use", "pass")
HOMOGRAPH_OBJECTS = ("stamp", "stapler", "toothbrush", "watch", "hand", "train", "knife")


def kept(maker: SentenceMaker, verb: str, thing: str, hand: HandType, manner: Manner | None = None) -> list[str]:
    """Every sentence for one interaction that reads back."""
    made = maker.unguarded(verb, thing, hand, manner)
    return [sentence for sentence in made if maker.lost(sentence, verb, thing, hand) is None]


@pytest.fixture(scope="module")
def arctic() -> SentenceMaker:
    return SentenceMaker(ARCTIC_VERBS, ARCTIC_OBJECTS)


def test_the_papers_four_sentences_are_among_the_variations(arctic) -> None:
    for verb, thing, hand in (("open", "box", "both"), ("lift", "laptop", "left"), ("place", "phone", "right")):
        assert set(four_sentences(verb, thing, hand)) <= set(kept(arctic, verb, thing, hand))


def test_natural_frames_say_how_things_are_used(arctic) -> None:
    cut, typed = kept(arctic, "cut", "scissors", "right"), kept(arctic, "type", "laptop", "both")
    assert "Cut with a pair of scissors in the right hand." in cut
    assert "A pair of scissors is used to cut by the right hand." in cut
    assert "Both hands are typing on this laptop." in typed
    assert "These scissors are used to cut by your right hand." in cut


@pytest.mark.parametrize("hand", HAND_TYPES)
def test_there_are_many_distinct_sentences_for_every_pair_and_no_two_hands_share_one(arctic, hand) -> None:
    others = [other for other in HAND_TYPES if other != hand]
    for verb, thing in zip(ARCTIC_VERBS, ARCTIC_OBJECTS, strict=True):
        found = kept(arctic, verb, thing, hand)
        assert len(found) == len(set(found)) >= 60
        assert not set(found) & {sentence for other in others for sentence in kept(arctic, verb, thing, other)}


@pytest.mark.slow
def test_what_cannot_be_read_back_is_named() -> None:
    maker = SentenceMaker(HOMOGRAPH_VERBS, HOMOGRAPH_OBJECTS)
    lost = [
        maker.lost(sentence, verb, thing, "left")
        for verb in HOMOGRAPH_VERBS
        for thing in HOMOGRAPH_OBJECTS
        for sentence in maker.unguarded(verb, thing, "left")
    ]
    assert {"verb", None} <= set(lost)
    assert maker.lost("Stamp a watch with the left hand.", "stamp", "stamp", "left") == "object"
    assert maker.lost("Lift a stamp with the left hand.", "stamp", "stamp", "left") is not None
    assert maker.lost("Stamp a stamp with the right hand.", "stamp", "stamp", "left") == "hand"
    assert maker.lost("Stamp a stamp.", "stamp", "stamp", "left") == "hand"


def test_a_synonym_that_is_another_verb_of_the_dataset_is_not_used() -> None:
    def bases(*verbs: str) -> list[str]:
        return [forms.base for forms in SentenceMaker(verbs, ["box"]).synonyms("lift")]

    assert bases("lift", "open") == ["lift", "raise"]
    assert bases("lift", "raise") == ["lift"]


def test_a_form_that_stands_for_two_words_is_refused() -> None:
    with pytest.raises(ValueError, match="lifts"):
        Lexicon([("lifts", "lift"), ("lifts", "raise")], [])


def test_adverbs_stand_only_where_a_speed_was_measured(arctic) -> None:
    plain = kept(arctic, "open", "box", "left")
    slow = kept(arctic, "open", "box", "left", manner_of(0.1, (0.2, 0.9)))
    assert not any("slowly" in sentence or "quickly" in sentence for sentence in plain)
    assert "Slowly, open a box with the left hand." in slow
    assert "A box is opened by the left hand slowly." in slow
    assert not any("quickly" in sentence for sentence in slow)
    assert [manner_of(speed, (0.2, 0.9)) for speed in (0.2, 0.9, 1.0)] == [None, None, "quickly"]


@pytest.mark.parametrize(
    ("verb", "thing", "hand", "expected"),
    [
        ("place", "book", "both", ("Place book with both hands.", "Book is placed with both hands.",
                                   "Both hands place book.", "Placing book with both hands.")),
        ("open", "wine glass", "left", ("Open wineglass with left hand.", "Wineglass is opened with left hand.",
                                        "Left hand opens wineglass.", "Opening wineglass with left hand.")),
        ("take out", "large cube", "right", ("Take out cube with right hand.", "Cube is taken out with right hand.",
                                             "Right hand takes out cube.", "Taking out cube with right hand.")),
        ("hand over", "Stanford bunny", "both", (
            "Hand over stanford bunny with both hands.", "Stanford bunny is handed over with both hands.",
            "Both hands hand over stanford bunny.", "Handing over stanford bunny with both hands.")),
        ("take a picture with", "camera", "right", (
            "Take picture camera with right hand.", "Camera is pictured with right hand.",
            "Right hand takes picture camera.", "Taking picture camera with right hand.")),
    ],
)  # fmt: skip
def test_reference_sentences_are_the_references_without_its_misspellings(verb, thing, hand, expected) -> None:
    assert reference_sentences(verb, thing, hand) == expected
