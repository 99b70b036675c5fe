"""A sentence whose verb was learnt is told so that the networks read that verb; any other is told as it is."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.annotation.encoders import HashEncoder, TextEncoder
from hoidata.batches.dataset import HoiDataset
from hoidata.batches.requests import Request, Sentence
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import load_checkpoint
from models.common.family import Sources
from models.common.predicting import PredictionConfig, requests_for
from models.common.vocabulary import Vocabulary
from models.registry import load_family
from models.text2hoi.contact_training import CONTACT, touched_maps
from models.text2hoi.diffusion_training import DIFFUSION
from models.text2hoi.family import encoder_of
from models.text2hoi.sampler import Text2Hoi
from models.text2hoi.understanding import Teller, Understood, understand
from tests.models.toy import FAST

KNOWN = Vocabulary({("screw", "jar", "right"): 3, ("screw", "apple", "right"): 2, ("lift", "box", "left"): 4})
ENCODER = HashEncoder()


def told(sentence: str, verb: str | None, thing: str | None, readings: Mapping[str, tuple[str, float]]) -> Understood:
    """What comes of a sentence; readings: of some sentences, all others are read as "place"."""

    def read(text: np.ndarray) -> tuple[str, float]:
        same = (own for own in readings if (ENCODER.encode([own])[0] == text).all())
        return readings.get(next(same, ""), ("place", 0.9))

    text = ENCODER.encode([sentence])[0]
    found = understand(sentence, text, verb, thing, "right", KNOWN, ENCODER.encode, read)
    np.testing.assert_array_equal(found.text, ENCODER.encode([found.sentence])[0])
    assert found.read_as == read(found.text)
    assert found.plainly == read(ENCODER.encode([sentence])[0])
    return found


def test_a_sentence_that_is_read_right_stays() -> None:
    sentence = "Screw a box with the right hand."
    assert told(sentence, "screw", "box", {sentence: ("screw", 0.4)}).sentence == sentence


@pytest.mark.parametrize("end", [".", "", "!", "?", " ."])
def test_one_without_a_hand_gets_the_hand_in_words(end: str) -> None:
    named = "Screw a jar with the right hand."
    assert told(f"Screw a jar{end}", "screw", "jar", {named: ("screw", 0.8)}).sentence == named


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


@pytest.mark.parametrize(
    ("sentence", "thing"),
    [("Screw the lid off with my right hand.", "lid"), ("Screw it.", None), ("With a hand, screw!", None)],
)
def test_a_verb_that_no_other_words_bring_out_is_told_in_a_training_clips_own(sentence: str, thing: str | None) -> None:
    learnt = "Screw an apple with the right hand."
    assert told(sentence, "screw", thing, {learnt: ("screw", 0.6)}).sentence == learnt


def test_networks_that_are_told_features_get_the_sentence_as_it_is() -> None:
    text = ENCODER.encode(["Screw a box."])[0]
    found = understand("Screw a box.", text, "screw", "box", "right", KNOWN, ENCODER.encode, lambda text: None)
    assert (found.sentence, found.read_as, found.plainly) == ("Screw a box.", None, None)


def test_an_object_of_two_words_and_one_without_an_article_are_replaced_whole() -> None:
    readings = {"Screw the jar with the right hand.": ("screw", 0.8)}
    assert told("Screw the water bottle.", "screw", "water bottle", readings).sentence in readings


@pytest.fixture(scope="module")
def request_of_a_clip(annotated: AnnotatedStore) -> Request:
    """A lift with the left hand."""
    sample = next(iter(HoiDataset(annotated, "test", crop="start")))
    return requests_for(sample, PredictionConfig(samples=1))[0]


def asked(request: Request, words: str, *sides: bool) -> Request:
    sentence, text = Sentence(words, "screw", words.split()[2].strip(".")), ENCODER.encode([words])[0]
    return replace(request, sentence=sentence, text=text, active_hands=np.array(sides or (False, True)))


def teller(*right: str) -> tuple[Teller, list[str]]:
    """One for networks that read the sentences ``right`` as "screw", all others as "place"; what it was asked for."""
    features, made = [ENCODER.encode([own])[0] for own in right], list[str]()

    def encoder() -> TextEncoder:
        made.append("encoder")
        return ENCODER

    def read(text: np.ndarray) -> tuple[str, float]:
        return ("screw", 0.8) if any((text == own).all() for own in features) else ("place", 0.9)

    return Teller(KNOWN, encoder, read), made


@pytest.mark.parametrize(
    ("sides", "hand"),
    [((True, False), "the left hand"), ((False, True), "the right hand"), ((True, True), "both hands")],
)
def test_a_clips_sentence_is_told_as_a_persons_with_its_own_hands(
    request_of_a_clip: Request, sides: tuple[bool, bool], hand: str
) -> None:
    wanted = f"Screw a jar with {hand}."
    request = asked(request_of_a_clip, "Screw a box.", *sides)
    made = teller(wanted)[0].told(request)
    assert made.sentence == Sentence(wanted, "screw", "box")
    np.testing.assert_array_equal(made.text, ENCODER.encode([wanted])[0])
    assert all(getattr(made, key) is own for key, own in vars(request).items() if key not in ("sentence", "text"))


def test_no_encoder_is_asked_for_sentences_that_are_read_right_or_not_known(request_of_a_clip: Request) -> None:
    words = "Screw a box with the right hand."
    own, made = teller(words)
    for request in (asked(request_of_a_clip, words), replace(asked(request_of_a_clip, "Screw a box."), sentence=None)):
        found = own.told(request)
        assert found.sentence == request.sentence
        assert found.text is request.text
    assert not made
    own.told(asked(request_of_a_clip, "Screw a jar."))
    assert made


class Stranger(HashEncoder):
    def __init__(self) -> None:
        super().__init__()
        self.identity = self.identity | {"version": "another"}


def test_an_encoder_is_made_once_and_one_of_other_features_is_refused(trained: Path) -> None:
    networks = {network.name: load_checkpoint(trained / network.name, network) for network in (CONTACT, DIFFUSION)}
    made = list[str]()
    own = Teller.of(networks, lambda: made.append("encoder") or HashEncoder())
    assert made == []
    assert own.encoder() is own.encoder()
    assert made == ["encoder"]
    with pytest.raises(BadInput, match=r"annotate\.encoder"):
        Teller.of(networks, Stranger).encoder()


def test_the_encoder_is_the_datasets_own_unless_one_is_named_and_none_where_it_needs_a_file(
    annotated: AnnotatedStore, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = Sources(annotated, trained, load_embedded_hands(), torch.device("cpu"), FAST)
    made, named = encoder_of(sources), encoder_of(replace(sources, encoder="use"))
    assert made is not None
    assert named is not None
    assert made().identity == annotated.encoder_identity
    assert named().identity["name"] == "use"
    monkeypatch.setattr(annotated, "encoder_identity", {"name": "clip"})
    assert encoder_of(sources) is None


def test_the_family_tells_misread_sentences_of_clips(
    annotated: AnnotatedStore, trained: Path, request_of_a_clip: Request, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = Sources(annotated, trained, load_embedded_hands(), torch.device("cpu"), FAST)
    model = load_family("text2hoi").load(sources)
    assert isinstance(model, Text2Hoi)
    assert model.teller is not None
    plain, sentence = replace(model, teller=None), request_of_a_clip.sentence
    assert sentence == Sentence("Lift a box with the left hand.", "lift", "box")
    strange = Sentence(sentence.words.replace("box", "zeppelin"), "lift", "zeppelin")
    misread = replace(request_of_a_clip, text=-request_of_a_clip.text, sentence=strange)
    assert model.teller.read(misread.text)[0] != "lift"  # type: ignore[index]
    expected = model.teller.told(misread)
    assert model.teller.read(expected.text)[0] == "lift"  # type: ignore[index]
    (made,), (wanted,), (as_it_is,) = model.sample([misread]), plain.sample([expected]), plain.sample([misread])
    np.testing.assert_array_equal(made.object.translation_m, wanted.object.translation_m)
    assert (as_it_is.object.translation_m != wanted.object.translation_m).any()
    seen = list[torch.Tensor]()
    monkeypatch.setattr(
        "models.text2hoi.sampler.touched_maps", lambda *given: seen.append(given[2]) or touched_maps(*given)
    )
    assert torch.equal(model.contact_maps([misread])[0], plain.contact_maps([expected])[0])
    assert torch.equal(*seen)
