"""Sentences in the paper's four forms, right in article, agreement, particle, plural and mass nouns."""

import csv
import re
from importlib.resources import files

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hoidata.annotation.grammar import Grammar, article, default_grammar, extend_grammar, inflect_verb
from hoidata.annotation.sentences import four_sentences
from hoidata.errors import BadInput


def table_rows(kind: str) -> list[dict[str, str]]:
    text = files("hoidata.annotation").joinpath("grammar.csv").read_text(encoding="utf-8")
    return [row for row in csv.DictReader(text.splitlines()) if row["kind"] == kind]


def test_the_four_forms_are_those_of_the_paper() -> None:
    assert four_sentences("place", "book", "both") == (
        "Place a book with both hands.",
        "A book is placed by both hands.",
        "Both hands place a book.",
        "Placing a book with both hands.",
    )


@pytest.mark.parametrize(
    ("verb", "words", "hand", "expected"),
    [
        ("take out", "milk", "both", "Milk is taken out by both hands."),
        ("take out", "milk", "left", "The left hand takes out milk."),
        ("put in", "cappuccino", "right", "Cappuccino is put in by the right hand."),
        ("cut", "scissors", "right", "Scissors are cut by the right hand."),
        ("open", "chips", "both", "Opening chips with both hands."),
        ("hand over", "Stanford bunny", "both", "Handing over a Stanford bunny with both hands."),
        ("take a picture with", "camera", "right", "A camera is used to take a picture by the right hand."),
        ("fly", "airplane", "left", "An airplane is flown by the left hand."),
        ("wear", "eyeglasses", "both", "Eyeglasses are worn by both hands."),
        ("drink", "mug", "right", "The right hand drinks a mug."),
        ("lift", "hand", "left", "Lift a hand with the left hand."),
        (None, "large cube", "both", "Both hands move a large cube."),
        (None, "teapot", "right", "Moving a teapot with the right hand."),
    ],
)
def test_sentences_of_known_words_read_right(verb: str | None, words: str, hand, expected: str) -> None:
    assert expected in four_sentences(verb, words, hand)


@pytest.mark.parametrize(
    ("verb", "words", "expected"),
    [
        ("zip up", "jacket", "A jacket is zipped up by the left hand."),
        ("unfold", "oat milk", "Oat milk is unfolded by the left hand."),
        ("grip", "garden shears", "Garden shears are gripped by the left hand."),
        ("swap", "pair of socks", "A pair of socks is swapped by the left hand."),
        ("twist", "the red knob", "The red knob is twisted by the left hand."),
        ("hold", "ultrasound probe", "An ultrasound probe is held by the left hand."),
    ],
)
def test_sentences_of_unknown_words_follow_the_rules(verb: str, words: str, expected: str) -> None:
    assert four_sentences(verb, words, "left")[1] == expected


def test_every_verb_and_object_of_the_table_stands_in_its_sentences_as_written() -> None:
    for row in table_rows("verb"):
        sentences = four_sentences(row["base"], "box", "left")
        assert sentences[0].lower().startswith(row["base"] + " a box")
        assert f" is {row['past_participle']} by the left hand." in sentences[1]
        assert sentences[2] == f"The left hand {row['third_singular']} a box."
        assert sentences[3].lower().startswith(row["gerund"] + " a box")
    for row in table_rows("object"):
        sentences = four_sentences("lift", row["base"], "both")
        assert sentences[2] == f"Both hands lift {row['noun_phrase']}."
        assert (" are " if row["number"] == "plural" else " is ") in sentences[1]


def test_the_rules_alone_agree_with_nearly_the_whole_table() -> None:
    """The table is not consulted: verbs by lemminflect, articles by sound. Only "used to take a picture" is lost."""
    verbs = [(row, inflect_verb(row["base"])) for row in table_rows("verb")]
    cells = [getattr(made, name) == row[name] for row, made in verbs for name in ("gerund", "past_participle")]
    cells += [made.third_singular == row["third_singular"] for row, made in verbs]
    singular = [row for row in table_rows("object") if row["number"] == "singular"]
    cells += [f"{article(row['base'])} {row['base']}" == row["noun_phrase"] for row in singular]
    assert len(cells) > 300
    assert sum(cells) >= 0.99 * len(cells)


def test_the_number_rule_knows_plurals_from_singulars_in_s() -> None:
    rows = [row for row in table_rows("object") if row["number"] != "mass"]
    empty = Grammar({}, {})
    right = [empty.noun(row["base"]).number == row["number"] for row in rows]
    assert sum(right) >= 0.97 * len(right)


@given(st.from_regex(r"[a-z]{2,9}( (up|down|out|off))?", fullmatch=True), st.from_regex(r"[a-z]{3,9}", fullmatch=True))
def test_made_up_words_never_break_article_agreement_or_shape(verb: str, noun: str) -> None:
    imperative, passive, subject, gerund = four_sentences(verb, noun, "left")
    for sentence in (imperative, passive, subject, gerund):
        assert re.fullmatch(r"[A-Z8][^.]*[a-z]\.", sentence)
        assert "  " not in sentence
    plural = default_grammar().noun(noun).number == "plural"
    assert (" are " in passive) == plural
    assert re.search(r"\ban? ", subject[len("The left hand ") :].lower()) is not None or plural or noun in MASS


MASS = {row["base"] for row in table_rows("object") if row["number"] == "mass"}


@pytest.mark.parametrize("words", ["", "  ", "--"])
def test_a_sentence_without_an_object_is_refused(words: str) -> None:
    with pytest.raises(BadInput, match="object of a sentence"):
        four_sentences("lift", words, "left")


def test_a_users_table_adds_words_and_wins(tmp_path) -> None:
    header = "kind,base,gerund,past_participle,third_singular,noun_phrase,number\n"
    path = tmp_path / "words.csv"
    path.write_text(header + "object,sand,,,,sand,mass\nobject,mug,,,,a cup,singular\n", encoding="utf-8")
    grammar = extend_grammar(default_grammar(), path)
    assert four_sentences("lift", "sand", "left", grammar)[1] == "Sand is lifted by the left hand."
    assert four_sentences("lift", "mug", "left", grammar)[0] == "Lift a cup with the left hand."


@pytest.mark.parametrize("row", ["noun,sand,,,,sand,mass", "object,sand,,,,sand,some", "verb,sand,,,,,"])
def test_a_broken_row_of_a_users_table_is_named(tmp_path, row: str) -> None:
    path = tmp_path / "words.csv"
    path.write_text("kind,base,gerund,past_participle,third_singular,noun_phrase,number\n" + row + "\n")
    with pytest.raises(BadInput, match=r"words\.csv line 2"):
        extend_grammar(default_grammar(), path)
