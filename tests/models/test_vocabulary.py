"""The training vocabulary, and unseen words of a sentence with the most similar known ones."""

import pytest

from hoidata.annotation.encoders import load_encoder
from hoidata.annotation.prompts import further_verbs, is_english, read_sentence, unseen_words
from hoidata.annotation.vocabulary import Vocabulary
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common.corpus import Corpus

KNOWN = Vocabulary({("lift", "mug", "right"): 5, ("pour", "teapot", "right"): 3, ("lift", "teapot", "left"): 2})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "words"),
        ("...", "words"),
        ("lift " * 61, "at most 60 words"),
        ("Hebe die Tasse mit der rechten Hand.", "hebe, tasse, mit"),
        ("用右手拿起杯子", "English"),
        ("Levanta la taza con la mano derecha", "levanta"),
    ],
)
def test_text_that_is_not_english_is_refused_with_an_example(text, expected):
    with pytest.raises(BadInput, match=expected) as error:
        read_sentence(text)
    assert "Lift a mug with the right hand." in str(error.value) or "one action" in str(error.value)


ACTIONS = Vocabulary(
    {(verb, "mug", "right"): 3 for verb in ("lift", "pour", "screw", "place", "drink", "use", "hand over", "take out")}
    | {("lift", "stamp", "right"): 1, ("stamp", "mug", "right"): 1}
)


@pytest.mark.parametrize(
    ("text", "made", "further"),
    [
        ("Lift a mug and then pour.", "lift", ["pour"]),
        ("Lift the teapot, slowly pour it, & pour again", "lift", ["pour"]),
        ("Lift the mug and place it on the table.", "place", ["lift"]),
        ("A hand lifts a mug and then it pours.", "pour", ["lift"]),
        ("The mug is lifted and placed.", "place", ["lift"]),
        ("The mug is lifted and placed.", "lift", ["place"]),
        ("Lift the mug and hand it over.", "lift", ["hand over"]),
        ("Grab a mug and lift it.", "lift", []),
        ("Lift a mug and lift it again.", "lift", []),
        ("Lift a mug with thumb and hand.", "lift", []),
        ("Lift a mug and use both hands.", "lift", []),
        ("Lift a mug and take a picture.", "lift", []),
        ("Lift a mug and stamp.", "lift", []),
        ("Lift nuts and screws.", "lift", []),
        ("Lift a mug and pour-over kettle.", "lift", []),
        ("A drink is lifted with the left hand.", "lift", []),
        ("now slowly,", "lift", []),
        ("Lift the mug, never pour.", "lift", []),
        ("Without lifting the mug, pour.", "pour", []),
        ("The mug is not lifted, but placed.", "place", []),
        ("Instead of drinking from the mug, lift it and pour.", "lift", ["pour"]),
    ],
)
def test_a_second_training_action_of_a_sentence_is_found(text, made, further):
    assert further_verbs(text, made, ACTIONS) == further


def test_english_is_accepted_without_words_of_the_table():
    assert read_sentence("Pour water from the teapot.") == ("pour", "teapot")
    assert read_sentence("Juggle three oranges with both hands") == (None, None)
    assert is_english("spatulas")
    assert not is_english("tasse")


@pytest.mark.parametrize(
    ("verb", "noun", "hand", "expected"),
    [
        ("lift", "mug", "right", []),
        ("lift", "mug", "left", ["'lift' with 'mug' was in training, never with hand type 'left'"]),
        ("pour", "mug", "right", ["'pour' and 'mug' were each in training, never together"]),
    ],
)
def test_unseen_combinations_are_reported(verb, noun, hand, expected):
    assert unseen_words(KNOWN, "", verb, noun, hand, load_encoder("hash")) == expected


def test_unknown_words_come_with_the_nearest_known():
    said = unseen_words(KNOWN, "Juggle a vase.", None, "vase", "right", load_encoder("hash"))
    assert said[0].startswith("the verb 'juggle' was never in training; nearest that were: ")
    assert {"lift", "pour"} == set(said[0].split(": ")[1].split(", "))
    assert "'vase'" in said[1]


def test_a_known_object_with_an_unknown_verb_is_recognised():
    assert [
        note.split(" was")[0]
        for note in unseen_words(KNOWN, "Juggle a mug.", *read_sentence("Juggle a mug."), "right", load_encoder("hash"))
    ] == ["the verb 'juggle'"]
    assert len(unseen_words(KNOWN, "Juggle a smug mugger.", None, None, "right", load_encoder("hash"))) == 2


def test_the_better_covered_sentence_scores_higher():
    scores = [
        KNOWN.knows(*words)
        for words in (("lift", "mug"), ("pour", "mug"), ("lift", "vase"), (None, "mug"), (None, None))
    ]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] == 0


def test_a_checkpoint_keeps_the_vocabulary():
    assert Vocabulary.read({"vocabulary": KNOWN.rows}) == KNOWN


@pytest.fixture
def counts(annotated: AnnotatedStore) -> dict:
    return Corpus.of(annotated, seed=0).facts(load_embedded_hands())["hand_types"]


def test_hands_are_counted_on_training_clips_only(annotated: AnnotatedStore, counts: dict) -> None:
    of_part = {
        part: [annotated.hand_type(clip_id) for clip_id in annotated.ids(part)]
        for part in ("train", "validation", "test")
    }
    assert counts == {hand: of_part["train"].count(hand) for hand in ("left", "right", "both")}
    everywhere = [hand for hands in of_part.values() for hand in hands]
    with_validation = of_part["train"] + of_part["validation"]
    for others in (everywhere, with_validation):
        assert counts != {hand: others.count(hand) for hand in ("left", "right", "both")}
